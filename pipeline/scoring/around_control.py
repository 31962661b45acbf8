"""Pixels on control points, which are not scored: the truth was fitted there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Bools, Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Placement
from pipeline.sources.control_places import Mark

# A mark and what a surveyor clears around it.
_RADIUS_M = 1.0
# Far away a mark is smaller than what the poses leave open.
_LEAST_PX = 10.0


@dataclass(frozen=True, slots=True)
class AroundControl:
    """Discs about control points in the images.

    Args:
        discs: (k, 3) column, row and radius, px, by frame_id.
    """

    discs: Mapping[str, Floats]

    @staticmethod
    def of(
        marks: Sequence[Mark], translation_m: Floats, placements: Mapping[str, Placement], cameras: Mapping[str, Camera]
    ) -> AroundControl:
        """About all sightings, and about where the points project in any frame, whether it is known to see them or not.

        Args:
            marks: The points.
            translation_m: (3,) that brings their surveyed places to the poses, ENU.
            placements: By frame_id.
            cameras: By frame_id.
        """
        places = np.array([mark.surveyed_m for mark in marks]).reshape(-1, 3) + translation_m
        sightings: dict[str, list[tuple[int, Floats]]] = {}
        for point, mark in enumerate(marks):
            for frame, pixel in zip(mark.frames, mark.pixels, strict=True):
                sightings.setdefault(frame, []).append((point, pixel))
        discs = {
            frame: found
            for frame, placed in placements.items()
            if len(found := _discs(places, sightings.get(frame, []), placed, cameras[frame]))
        }
        return AroundControl(discs)

    def excluded(self, pixels: Floats, frame_id: str) -> Bools:
        """Whether pixels lie on a control point.

        Args:
            pixels: (n, 2).
            frame_id: Of the frame.

        Returns:
            (n,).
        """
        out = np.zeros(len(pixels), bool)
        for u, v, radius in self.discs.get(frame_id, np.zeros((0, 3))):
            out |= np.hypot(pixels[:, 0] - u, pixels[:, 1] - v) <= radius
        return out


def _discs(places: Floats, sightings: Sequence[tuple[int, Floats]], placed: Placement, camera: Camera) -> Floats:
    """(k, 3) of one frame."""
    in_cam = (places - placed.centre) @ placed.rotation
    with np.errstate(divide="ignore", invalid="ignore"):
        ahead = in_cam[:, 2] > 0.0
        radius = np.where(ahead, np.maximum(camera.focal_px * _RADIUS_M / in_cam[:, 2], _LEAST_PX), _LEAST_PX)
    # No wider than the image: a camera that stands on a mark sees little else.
    radius = np.minimum(radius, max(camera.width, camera.height))
    pixels = camera.project(in_cam)
    outside = np.maximum(np.abs(pixels - (np.array([camera.width, camera.height]) - 1.0) / 2.0), 0.0)
    near: Bools = ahead & np.all(outside <= np.array([camera.width, camera.height]) / 2.0 + radius[:, None], axis=1)
    projected = np.column_stack([pixels, radius])[near]
    seen = np.array([(*pixel, radius[point]) for point, pixel in sightings]).reshape(-1, 3)
    return np.concatenate([projected, seen])
