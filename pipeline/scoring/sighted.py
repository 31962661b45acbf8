"""Sightings of control points beside the poses of their frames, and the one shift that makes them meet.

With X the surveyed place of a point, R and C of a frame that sees it and s the shift, y = R^T (X + s - C) is the ray in
the camera and pi(y) its pixel. s is least squares on pi(y) - sighting. It starts where the shifted places lie nearest
to the rays of the sightings: that is linear in s, so that no start is needed and none can be too far away.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Placement
from pipeline.geometry.rotations import skew
from pipeline.sources.control_places import Mark

_STEPS, _SETTLED_M = 30, 1e-7
_NEAREST_M = 0.1


@dataclass(frozen=True, slots=True)
class Sighted:
    """Sightings of points in placed frames, one row each.

    Args:
        names: Of the points.
        surveyed_m: (p, 3) their places, ENU.
        point: (m,) which point.
        frame: (m,) which frame.
        frame_ids: Of the frames.
        pixels: (m, 2) where.
        centre: (m, 3) of the camera, ENU m.
        rotation: (m, 3, 3) enu_from_cam.
        camera: (m,) which camera.
        cameras: The different ones.
    """

    names: tuple[str, ...]
    surveyed_m: Floats
    point: Ints
    frame: Ints
    frame_ids: tuple[str, ...]
    pixels: Floats
    centre: Floats
    rotation: Floats
    camera: Ints
    cameras: tuple[Camera, ...]

    @staticmethod
    def of(marks: Sequence[Mark], placements: Mapping[str, Placement], cameras: Mapping[str, Camera]) -> Sighted:
        """The sightings in frames that are placed.

        Args:
            marks: The points.
            placements: By frame_id.
            cameras: By frame_id.
        """
        rows = [(p, frame) for p, mark in enumerate(marks) for frame in mark.frames]
        pixels = np.array([pixel for mark in marks for pixel in mark.pixels]).reshape(-1, 2)
        placed = [i for i, (_, frame) in enumerate(rows) if frame in placements]
        frame_ids = tuple(dict.fromkeys(rows[i][1] for i in placed))
        lenses = tuple(dict.fromkeys(cameras[frame] for frame in frame_ids))
        number = {frame: i for i, frame in enumerate(frame_ids)}
        frame = np.array([number[rows[i][1]] for i in placed], np.int64)
        lens = np.array([lenses.index(cameras[name]) for name in frame_ids], np.int64)
        return Sighted(
            tuple(mark.name for mark in marks),
            np.array([mark.surveyed_m for mark in marks]).reshape(-1, 3),
            np.array([rows[i][0] for i in placed], np.int64),
            frame,
            frame_ids,
            pixels[placed],
            np.array([placements[name].centre for name in frame_ids]).reshape(-1, 3)[frame],
            np.array([placements[name].rotation for name in frame_ids]).reshape(-1, 3, 3)[frame],
            lens[frame],
            lenses,
        )

    def where(self, rows: Bools) -> Sighted:
        """Some of the sightings; points keep their numbers."""
        return replace(
            self,
            point=self.point[rows],
            frame=self.frame[rows],
            pixels=self.pixels[rows],
            centre=self.centre[rows],
            rotation=self.rotation[rows],
            camera=self.camera[rows],
        )

    def with_pixels(self, pixels: Floats) -> Sighted:
        """The sightings at other pixels (m, 2)."""
        return replace(self, pixels=pixels)

    @property
    def points(self) -> Ints:
        """The points that have a sighting, in order."""
        return np.unique(self.point)

    @property
    def rays(self) -> Floats:
        """(m, 3) unit vectors from the cameras through the sightings, ENU."""
        rays = np.empty((len(self.point), 3))
        for k, camera in enumerate(self.cameras):
            rows = self.camera == k
            rays[rows] = camera.rays(self.pixels[rows])
        turned = np.einsum("mij,mj->mi", self.rotation, rays)
        out: Floats = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        return out

    def offsets(self, shift_m: Floats) -> Offsets:
        """From the sightings to where the shifted points project.

        Args:
            shift_m: (3,) or (m, 3), ENU.
        """
        away = self.surveyed_m[self.point] + shift_m - self.centre
        y = np.einsum("mji,mj->mi", self.rotation, away)
        z = np.where(y[:, 2] > _NEAREST_M, y[:, 2], np.nan)
        rays = y / z[:, None]
        pixels, by_plane, most = np.empty((len(y), 2)), np.empty((len(y), 2, 2)), np.empty(len(y))
        for k, camera in enumerate(self.cameras):
            rows = self.camera == k
            pixels[rows], by_plane[rows] = camera.project(rays[rows]), camera.pixel_jacobian(rays[rows])
            # Beside the camera a pixel is as far as one likes.
            most[rows] = camera.width + camera.height
        found = pixels - self.pixels
        with np.errstate(invalid="ignore"):
            seen: Bools = np.linalg.norm(found, axis=1) < most
        plane = np.zeros((len(y), 2, 3))
        plane[:, 0, 0] = plane[:, 1, 1] = 1.0
        plane[:, :, 2] = -rays[:, :2]
        by_shift = by_plane @ plane @ np.swapaxes(self.rotation, 1, 2) / z[:, None, None]
        found, by_shift = np.where(seen[:, None], found, 0.0), np.where(seen[:, None, None], by_shift, 0.0)
        return Offsets(found, by_shift, seen, np.where(seen[:, None], away, 0.0))


@dataclass(frozen=True, slots=True)
class Offsets:
    """From sightings to projections, to first order in the errors of all that they are made of.

    Args:
        found_px: (m, 2); 0 where the point is out of the camera's sight.
        by_shift: (m, 2, 3) of it by the point's place, px / m.
        seen: (m,) whether the camera sees it.
        away_m: (m, 3) from the camera to the point, ENU.
    """

    found_px: Floats
    by_shift: Floats
    seen: Bools
    away_m: Floats

    @property
    def distance_px(self) -> Floats:
        """(m,) infinite where the camera does not see the point."""
        return np.where(self.seen, np.linalg.norm(self.found_px, axis=1), np.inf)

    @property
    def by_pose(self) -> Floats:
        """(m, 2, 6) by the turn (rad) and the shift (m) of the frame, ENU."""
        return np.concatenate([self.by_shift @ skew(self.away_m), -self.by_shift], axis=2)


def best_shift(sighted: Sighted) -> Floats:
    """(3,) by which all places are shifted so that they project onto their sightings, ENU m.

    Args:
        sighted: Sightings of one point or more; at least two rays that are not parallel.
    """
    shift = _nearest_to_rays(sighted)
    for _ in range(_STEPS):
        now = sighted.offsets(shift)
        step = np.linalg.lstsq(now.by_shift.reshape(-1, 3), now.found_px.ravel())[0]
        shift = shift - step
        if np.max(np.abs(step)) < _SETTLED_M:
            break
    return shift


def _nearest_to_rays(sighted: Sighted) -> Floats:
    """(3,) the shift with the least squares of the distances of the places from the rays of their sightings."""
    rays = sighted.rays
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    away = sighted.centre - sighted.surveyed_m[sighted.point]
    out: Floats = np.linalg.lstsq(across.sum(axis=0), np.einsum("mij,mj->i", across, away))[0]
    return out
