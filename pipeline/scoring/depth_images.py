"""Depth images as truth: what was measured in the very frame, so that its pose has no part in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.lidar.reference import Reference
from pipeline.scoring.truth import FrameView
from pipeline.sources.depth_images import read_depth_image

# A plane is fitted to a window of so many pixels about the one asked for, all of which must have been measured.
_ACROSS = 5
# Asked for where it was measured, one pixel in so many along each axis: neighbours tell nothing new.
_STEP = 4


@dataclass(frozen=True, slots=True)
class DepthImages:
    """The depth images of a run.

    Args:
        images: Path or URL by frame_id.
        units_per_metre: Of their values.
        max_range_m: Largest Euclidean distance from the camera that is scored, m.
    """

    images: Mapping[str, str]
    units_per_metre: float
    max_range_m: float

    def near(self, frames: Sequence[FrameView]) -> DepthImages:
        """As `Truth.near`."""
        del frames
        return self

    def moved(self, translation_m: Floats) -> DepthImages:
        """As `NearTruth.moved`: a depth image moves with its camera."""
        del translation_m
        return self

    def seen_by(self, frame: FrameView) -> DepthSeen:
        """As `NearTruth.seen_by`.

        Raises:
            InputError: The frame's depth image cannot be read, or is not of the photo's shape.
        """
        camera, location = frame.view.camera, self.images.get(frame.frame_id)
        if location is None:
            return DepthSeen(camera, np.full((1, 1), np.nan), self.max_range_m)
        depth = read_depth_image(location, self.units_per_metre)
        height, width = depth.shape
        if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
            raise InputError(
                "E-DEPTH-13", "a depth image is not of its photo's shape", where=location, found=f"{width} x {height}",
                expected=f"{camera.width} x {camera.height} of {frame.frame_id}, or that in another resolution",
                hint="depth has to be registered to the photo: pixel by pixel, as the photo's camera sees it",
            )  # fmt: skip
        return DepthSeen(camera, depth, self.max_range_m)


@dataclass(frozen=True, slots=True)
class DepthSeen:
    """One frame's depth image.

    Args:
        camera: The photo's.
        image_m: (h, w) m along the optical axis; NaN where nothing was measured.
        max_range_m: As `DepthImages`.
    """

    camera: Camera
    image_m: Floats
    max_range_m: float

    @property
    def pixels(self) -> Floats:
        """As `FrameTruth.pixels`."""
        rows, columns = self._measured()
        return self._in_photo(np.column_stack([columns, rows]).astype(np.float64))

    @property
    def depth_m(self) -> Floats:
        """As `FrameTruth.depth_m`."""
        return self.image_m[self._measured()]

    def reference_at(self, pixels: Floats) -> Reference:
        """As `FrameTruth.reference_at`: the plane through the window about each pixel, where it is one surface."""
        height, width = self.image_m.shape
        reach = _ACROSS // 2
        own = (pixels + 0.5) * self._scale() - 0.5
        with np.errstate(invalid="ignore"):
            nearest = np.rint(own)
            inside = np.all((nearest >= reach) & (nearest < np.array([width, height]) - reach), axis=1)
        rows = np.flatnonzero(inside)
        column, row = nearest[rows].astype(np.int64).T
        shift = np.arange(-reach, reach + 1)
        down, right = (axis.ravel() for axis in np.meshgrid(shift, shift, indexing="ij"))
        window = self.image_m[row[:, None] + down, column[:, None] + right]
        whole = np.isfinite(window).all(axis=1)
        rows, row, column, window = rows[whole], row[whole], column[whole], window[whole]
        around = np.stack([column[:, None] + right, row[:, None] + down], axis=-1).astype(np.float64)
        focal = self.camera.focal_px
        ideal = focal * self.camera.rays(self._in_photo(around))[..., :2]
        centre = self.camera.rays(pixels[rows])
        found = Reference.of_planes(len(pixels), rows, ideal - focal * centre[:, None, :2], 1.0 / window)
        return replace(found, valid=found.valid & self._in_range(pixels, found.depth_m))

    def pose_sigma(self, pixels: Floats, reference: Reference) -> Floats:
        """As `FrameTruth.pose_sigma`: nothing."""
        del reference
        return np.zeros(len(pixels))

    def _in_range(self, pixels: Floats, depth_m: Floats) -> Bools:
        out: Bools = depth_m * np.linalg.norm(self.camera.rays(pixels), axis=1) <= self.max_range_m
        return out

    def _measured(self) -> tuple[Ints, Ints]:
        rows, columns = np.nonzero(np.isfinite(self.image_m[::_STEP, ::_STEP]))
        return rows * _STEP, columns * _STEP

    def _scale(self) -> Floats:
        """Pixels of the depth image per pixel of the photo."""
        height, width = self.image_m.shape
        return np.array([width / self.camera.width, height / self.camera.height])

    def _in_photo(self, pixels: Floats) -> Floats:
        out: Floats = (pixels + 0.5) / self._scale() - 0.5
        return out
