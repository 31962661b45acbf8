"""What is believed: depths that were measured by something else, as a frame sees them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.lidar.blocks import Blocks
from pipeline.lidar.heightfield import HeightField, return_spacing_m
from pipeline.lidar.reference import Reference, reference_depth
from pipeline.lidar.spacing import surface_spacing_m
from pipeline.lidar.store import Store
from pipeline.lidar.visibility import View, VisibleReturns, behind_columns, visible_returns


@dataclass(frozen=True, slots=True)
class FrameView:
    """A frame to be scored.

    Args:
        frame_id: Its name.
        view: Its camera and pose.
        covariance: (6, 6) of that pose: turn (rad) and shift (m), ENU.
    """

    frame_id: str
    view: View
    covariance: Floats


class FrameTruth(Protocol):
    """What one frame sees of the truth."""

    @property
    def pixels(self) -> Floats:
        """(k, 2) where it was measured, px of the image as given."""

    @property
    def depth_m(self) -> Floats:
        """(k,) what was measured there, along the optical axis."""

    def reference_at(self, pixels: Floats) -> Reference:
        """The reference at any pixels (n, 2), within the range that is scored."""

    def pose_sigma(self, pixels: Floats, reference: Reference) -> Floats:
        """(n,) one sigma, m, of what the error of the frame's pose does to the reference at pixels."""


class NearTruth(Protocol):
    """The truth about a few frames."""

    def seen_by(self, frame: FrameView) -> FrameTruth:
        """What one of these frames sees."""

    def moved(self, translation_m: Floats) -> NearTruth:
        """The same truth, all of it shifted by (3,) ENU m; where it stands still with the cameras, itself."""


class Truth(Protocol):
    """A truth for a whole flight; it is sent to other processes."""

    def near(self, frames: Sequence[FrameView]) -> NearTruth:
        """The part of it that some frames may see; memory grows with these frames, not with the flight."""


@dataclass(frozen=True, slots=True)
class Survey:
    """Returns of tiles or of the run's own sweeps.

    Args:
        returns: Those about the flight, in the local frame.
        from_above: Whether they are a survey from the air.
        max_range_m: Largest Euclidean distance from the camera that is scored, m.
        margin_m: How far the returns may be shifted afterwards, m.
    """

    returns: Store
    from_above: bool
    max_range_m: float
    margin_m: float = 0.0

    def near(self, frames: Sequence[FrameView]) -> SurveyNear:
        """As `Truth.near`."""
        centres = np.array([item.view.centre_in_enu_m for item in frames])
        returns = self.returns.near(centres, self.max_range_m + self.margin_m)
        return SurveyNear.of(returns, self.from_above, self.max_range_m)


@dataclass(frozen=True, slots=True)
class SurveyNear:
    """The returns near some frames.

    Args:
        returns: (n, 3) ENU, m.
        spacing_m: Between neighbouring ones.
        field: What stands there, if they are from above.
        max_range_m: As `Survey`.
        blocks: Of the returns.
    """

    returns: Floats
    spacing_m: float
    field: HeightField | None
    max_range_m: float
    blocks: Blocks

    @staticmethod
    def of(returns: Floats, from_above: bool, max_range_m: float) -> SurveyNear:
        """The surroundings that returns make.

        Args:
            returns: (n, 3) ENU, m.
            from_above: Whether they are a survey from the air.
            max_range_m: As `Survey`.
        """
        blocks = Blocks.of(returns)
        if not len(returns):
            return SurveyNear(returns, np.nan, None, max_range_m, blocks)
        if not from_above:
            return SurveyNear(returns, surface_spacing_m(returns), None, max_range_m, blocks)
        spacing = return_spacing_m(returns)
        return SurveyNear(returns, spacing, HeightField.of(returns, spacing), max_range_m, blocks)

    def moved(self, translation_m: Floats) -> SurveyNear:
        """As `NearTruth.moved`."""
        if not np.any(translation_m):
            return self
        field = None if self.field is None else self.field.moved(translation_m)
        return replace(self, returns=self.returns + translation_m, field=field, blocks=self.blocks.moved(translation_m))

    def seen_by(self, frame: FrameView) -> SurveySeen:
        """As `NearTruth.seen_by`."""
        if not len(self.returns):
            return SurveySeen(frame, self, VisibleReturns.none())
        visible = visible_returns(frame.view, self.returns, self.field, self.spacing_m, self.max_range_m, self.blocks)
        return SurveySeen(frame, self, visible)


@dataclass(frozen=True, slots=True)
class SurveySeen:
    """The returns that a frame sees.

    Args:
        frame: The frame.
        near: All returns about it.
        visible: Those it sees.
    """

    frame: FrameView
    near: SurveyNear
    visible: VisibleReturns

    @property
    def pixels(self) -> Floats:
        """As `FrameTruth.pixels`."""
        return self.visible.pixels

    @property
    def depth_m(self) -> Floats:
        """As `FrameTruth.depth_m`."""
        return self.visible.depth_m

    @property
    def points_in_enu_m(self) -> Floats:
        """(k, 3) the returns themselves."""
        return self.near.returns[self.visible.index]

    def reference_at(self, pixels: Floats) -> Reference:
        """As `FrameTruth.reference_at`."""
        if not len(self.visible.depth_m) or not len(pixels):
            return Reference.none(len(pixels))
        view, field, most = self.frame.view, self.near.field, self.near.max_range_m
        # The same feature is matched in several pairs: its reference is found once.
        distinct, back = np.unique(pixels, axis=0, return_inverse=True)
        rays = view.camera.rays(distinct)
        found = reference_depth(view.camera, distinct, self.visible)
        valid = found.valid & (found.depth_m * np.linalg.norm(rays, axis=1) <= most)
        if field is not None:
            # A pixel on a wall or pole with few returns takes its plane from what is seen behind: a column says so.
            points = view.centre_in_enu_m + (found.depth_m[:, None] * rays)[valid] @ view.rotation_enu_from_cam.T
            valid[valid] = ~behind_columns(view.centre_in_enu_m, points, field, most)
        return replace(found, valid=valid).where(back.ravel())

    def pose_sigma(self, pixels: Floats, reference: Reference) -> Floats:
        """As `FrameTruth.pose_sigma`.

        The local plane is N . p = 1 in the camera, and the depth on a ray v is s = 1 / (N . v). A shift e of the camera
        changes it by -s N . e, a turn t by s^2 t . (N x v).
        """
        view = self.frame.view
        v = view.camera.rays(pixels)
        level = reference.slope * view.camera.focal_px
        normal = np.column_stack([level, 1.0 / reference.depth_m - np.sum(level * v[:, :2], axis=1)])
        s = reference.depth_m[:, None]
        in_enu = view.rotation_enu_from_cam.T
        jacobian = np.concatenate([(s**2 * np.cross(normal, v)) @ in_enu, (-s * normal) @ in_enu], axis=1)
        out: Floats = np.sqrt(np.einsum("ni,ij,nj->n", jacobian, self.frame.covariance, jacobian))
        return out
