"""Applies the pair rules in order, cheapest first, and keeps the reason of every rejected candidate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.pairing.candidates import pairs_within
from pipeline.pairing.geometry import (
    PixelGrid,
    View,
    epipoles,
    ground_level,
    ground_overlap,
    view_angles,
)
from pipeline.pairing.region import BorderGrid

_BLOCK = 4096
_REGION_GRID = 13
_OVERLAP_GRID = 6


@dataclass(frozen=True, slots=True)
class PairRules:
    """Limits that a pair has to keep.

    Args:
        baseline_m: Shortest and longest baseline.
        max_view_angle_rad: Largest angle between the optical axes.
        min_overlap: Least share of ref's ground that src sees.
        epipole_margin_px: Least distance of the epipole from the region of interest.
        region: "ground", "image", or left, top, right, bottom as fractions of the image.
        max_range_m: Farthest ground that counts as region of interest and overlap.
        near_limit: A rejected candidate is kept when its baseline is within this factor of the limits.
    """

    baseline_m: tuple[float, float]
    max_view_angle_rad: float
    min_overlap: float
    epipole_margin_px: float
    region: str | tuple[float, float, float, float]
    max_range_m: float
    near_limit: float = 1.5


@dataclass(frozen=True, slots=True)
class Frames:
    """The usable frames of a flight, in order of time.

    Args:
        rotation: (n, 3, 3) enu_from_cam.
        centre: (n, 3) m, ENU.
        above_ground_m: (n,) height above the ground.
        camera: (n,) index into `cameras`.
        cameras: The cameras.
    """

    rotation: Floats
    centre: Floats
    above_ground_m: Floats
    camera: Ints
    cameras: tuple[Camera, ...]

    def view(self, index: Ints) -> View:
        """The poses of some frames."""
        return View(self.rotation[index], self.centre[index])


@dataclass(frozen=True, slots=True)
class Candidates:
    """Looked-at pairs, one row each.

    Args:
        ref: (m,) index of the later frame.
        src: (m,) index of the earlier frame.
        baseline_m: (m,).
        view_angle_rad: (m,).
        epipole_px: (m, 2) ideal pixels of ref; NaN at infinity.
        margin_px: (m,); infinite when the epipole is at infinity, NaN when an earlier rule rejected.
        overlap: (m,); NaN when an earlier rule rejected.
        reason: (m,) text; empty when selected.
    """

    ref: Ints
    src: Ints
    baseline_m: Floats
    view_angle_rad: Floats
    epipole_px: Floats
    margin_px: Floats
    overlap: Floats
    reason: AnyArray


def select_pairs(frames: Frames, rules: PairRules) -> Iterator[Candidates]:
    """Looks at every pair of frames within reach, in blocks.

    Args:
        frames: The flight.
        rules: The limits.

    Yields:
        Selected pairs and those rejected near the limits, in order of (later, earlier) frame.
    """
    grids = [_Grids.of(camera, rules) for camera in frames.cameras]
    low, high = rules.baseline_m
    for pairs in pairs_within(frames.centre, low / rules.near_limit, high * rules.near_limit):
        for start in range(0, len(pairs), _BLOCK):
            yield _judge(frames, pairs[start : start + _BLOCK], rules, grids)


@dataclass(frozen=True, slots=True)
class _Grids:
    region: PixelGrid
    border: BorderGrid
    overlap: PixelGrid

    @classmethod
    def of(cls, camera: Camera, rules: PairRules) -> _Grids:
        box = (0.0, 0.0, 1.0, 1.0) if isinstance(rules.region, str) else rules.region
        region = PixelGrid.of(camera, _REGION_GRID, box)
        # The middles of equal cells, so that each stands for as much of the image.
        edge = 0.5 / _OVERLAP_GRID
        middles = (edge, edge, 1.0 - edge, 1.0 - edge)
        return cls(region, BorderGrid(region.ideal_px, _REGION_GRID), PixelGrid.of(camera, _OVERLAP_GRID, middles))


def _judge(frames: Frames, pairs: Ints, rules: PairRules, grids: list[_Grids]) -> Candidates:
    i, j = pairs[:, 0], pairs[:, 1]
    ref, src = frames.view(i), frames.view(j)
    baseline = np.linalg.norm(ref.centre - src.centre, axis=1)
    angle = view_angles(ref, src)
    reason = np.full(len(pairs), "", dtype=object)
    low, high = rules.baseline_m
    _reject(reason, baseline < low, "baseline", baseline, "m, below", low)
    _reject(reason, baseline > high, "baseline", baseline, "m, above", high)
    degrees = np.degrees(angle)
    _reject(
        reason,
        angle > rules.max_view_angle_rad,
        "view angle",
        degrees,
        "deg, above",
        np.degrees(rules.max_view_angle_rad),
    )
    epipole, margin = _epipole_rule(frames, pairs, rules, grids, reason == "")
    _reject(reason, margin < rules.epipole_margin_px, "epipole margin", margin, "px, below", rules.epipole_margin_px)
    overlap = _overlap_rule(frames, pairs, rules, grids, reason == "")
    _reject(reason, overlap < rules.min_overlap, "overlap", overlap, "below", rules.min_overlap)
    return Candidates(i, j, baseline, angle, epipole, margin, overlap, reason)


def _epipole_rule(
    frames: Frames, pairs: Ints, rules: PairRules, grids: list[_Grids], alive: Bools
) -> tuple[Floats, Floats]:
    epipole, margin = np.full((len(pairs), 2), np.nan), np.full(len(pairs), np.nan)
    for index, camera in enumerate(frames.cameras):
        rows = np.flatnonzero(alive & (frames.camera[pairs[:, 0]] == index))
        if rows.size:
            ref, src = frames.view(pairs[rows, 0]), frames.view(pairs[rows, 1])
            epipole[rows] = epipoles(ref, src, camera)
            margin[rows] = _margins(frames, pairs[rows, 0], epipole[rows], rules, grids[index])
    return epipole, margin


def _margins(frames: Frames, ref: Ints, epipole_px: Floats, rules: PairRules, grids: _Grids) -> Floats:
    """Signed distance from epipoles to the part of the ref image that must be free of them."""
    camera = grids.region.camera
    plane = (epipole_px - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    inside = grids.region.covers(rays)
    distinct, frame = np.unique(ref, return_inverse=True)
    level = np.ones((len(distinct), len(grids.region.rays)))
    if rules.region == "ground":
        level = ground_level(
            frames.view(distinct), grids.region.rays, frames.above_ground_m[distinct], rules.max_range_m
        )
        # A frame that sees no ground within reach (a façade flight) has its whole image as region.
        blind: Bools = ~np.any(level >= 0.0, axis=1)
        level[blind] = 1.0
        at_epipole = ground_level(frames.view(ref), rays[:, None], frames.above_ground_m[ref], rules.max_range_m)[:, 0]
        inside &= (at_epipole >= 0.0) | blind[frame]
    return grids.border.margins(epipole_px, inside, level, frame)


def _overlap_rule(frames: Frames, pairs: Ints, rules: PairRules, grids: list[_Grids], alive: Bools) -> Floats:
    overlap = np.full(len(pairs), np.nan)
    ref_camera, src_camera = frames.camera[pairs[:, 0]], frames.camera[pairs[:, 1]]
    for a in range(len(frames.cameras)):
        for b, camera in enumerate(frames.cameras):
            rows = np.flatnonzero(alive & (ref_camera == a) & (src_camera == b))
            if rows.size:
                i, j = pairs[rows, 0], pairs[rows, 1]
                overlap[rows] = ground_overlap(
                    frames.view(i),
                    frames.view(j),
                    grids[a].overlap,
                    camera,
                    frames.above_ground_m[i],
                    rules.max_range_m,
                )
    return overlap


def _reject(reason: AnyArray, failed: Bools, what: str, found: Floats, unit: str, limit: float) -> None:
    for row in np.flatnonzero(failed & (reason == "")):
        reason[row] = f"{what} {found[row]:.3g} {unit} {limit:.3g}"
