"""How a sensor sits on the vehicle, as the workflow states it."""

from __future__ import annotations

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator

from pipeline.tracks.mount import Mount

_MOST_DEG, _LONGEST_ARM_M = 360.0, 20.0


class MountConfig(BaseModel):
    """How a sensor sits on the vehicle."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    yaw_deg: float | None = Field(default=None, description="Optical axis in the body: 0 forward, 90 right (deg)")
    pitch_deg: float | None = Field(default=None, description="Optical axis in the body: 0 forward, -90 down (deg)")
    roll_deg: float | None = Field(default=None, description="About the optical axis, clockwise (deg)")
    lever_arm_m: tuple[float, float, float] = Field(
        default=(0.0, 0.0, 0.0),
        description="From the antenna, or what is posed, to the sensor: forward, right, down (m)",
    )

    @field_validator("yaw_deg", "pitch_deg", "roll_deg")
    @classmethod
    def _angle(cls, value: float | None) -> float | None:
        if value is not None and abs(value) > _MOST_DEG:
            raise ValueError(f"an angle between -{_MOST_DEG:g} and {_MOST_DEG:g} degrees")
        return value

    @field_validator("lever_arm_m")
    @classmethod
    def _arm(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if max(map(abs, value)) > _LONGEST_ARM_M:
            raise ValueError(f"metres on the vehicle, at most {_LONGEST_ARM_M:g}")
        return value

    def mount(self) -> Mount:
        """As geometry; angles that are not stated are none where none is, and 0 beside others."""
        angles = (self.yaw_deg, self.pitch_deg, self.roll_deg)
        if all(angle is None for angle in angles):
            return Mount(None, self.lever_arm_m)
        yaw, pitch, roll = (float(np.radians(angle or 0.0)) for angle in angles)
        return Mount((yaw, pitch, roll), self.lever_arm_m)
