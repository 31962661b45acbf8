"""The depths of a pair under every injected error, with and without refinement, beside a reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.depthing import NO_DEPTH, Limits, MatchedRays, depths_by
from pipeline.flight import PairRow
from pipeline.geometry.arrays import Bools, Floats, Singles
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Pose, RelativePose, relative_jacobian, relative_placement
from pipeline.geometry.transfer import VirtualView
from pipeline.pairing.geometry import View, epipoles
from pipeline.refinement.logged import Log, as_logged
from pipeline.refinement.matched import Matched
from pipeline.refinement.pair import refine_pair
from pipeline.refinement.rows import RefinedPair
from pipeline.sensitivity.injected import Injection, with_error

# Without refinement, then with it.
REFINED = (False, True)


@dataclass(frozen=True, slots=True)
class Ways:
    """How depths are found, and what is kept of them, as in the run.

    Args:
        methods: The published one first.
        view: Virtual view of epitransfer.
        virtual_baseline_m: Distance of a lateral or vertical view.
        limits: What a published depth has to keep; how far the pair's rays usually miss each other follows its pose.
        max_range_m: Where a depth ends, however wrong it is.
    """

    methods: tuple[str, ...]
    view: VirtualView
    virtual_baseline_m: float
    limits: Limits
    max_range_m: float


@dataclass(frozen=True, slots=True)
class PosedPair:
    """A pair as the run has it.

    Args:
        pair: The pair.
        ref: The frame that gets the depth: its pose as placed, its sigmas as logged.
        src: The other, likewise.
        ref_camera: Camera of ref.
        src_camera: Camera of src.
    """

    pair: PairRow
    ref: Pose
    src: Pose
    ref_camera: Camera
    src_camera: Camera

    def off_by(self, injection: Injection) -> Log:
        """The flight of these two frames, logged with an error."""
        src = with_error(self.ref, self.src, injection)
        cameras = {self.pair.ref: self.ref_camera, self.pair.src: self.src_camera}
        return Log({self.pair.ref: self.ref, self.pair.src: src}, cameras, {self.pair.pair_id: self.pair}, {})


@dataclass(frozen=True, slots=True)
class PairErrors:
    """What c injected errors do to the depths of a pair by m methods.

    Args:
        relative: (c, 2, m, n) |depth - reference| / reference, without and with refinement; NaN at pixels that the
            method does not keep at no error.
        kept: (c, 2, m, n) whether the pixel is one of those and would be published.
        epipole_inside: (c,) whether the pose with the error has an epipole inside the ref or the src image.
    """

    relative: Singles
    kept: Bools
    epipole_inside: Bools


def pair_errors(
    posed: PosedPair,
    matched: Matched,
    sampled: MatchedRays,
    reference_m: Floats,
    ways: Ways,
    cases: Sequence[Injection],
) -> PairErrors:
    """The errors of a pair's depths.

    A depth is compared whatever its predicted sigma says, at every pixel that the method keeps when no error is
    injected: a mask that hides what went wrong would flatten the curve. One that is behind a camera, or no number,
    counts as `max_range_m`, and so does one beyond. Sigmas are those of the log, which does not know of the error; with
    refinement, what that leaves of them. They weight the adaptive view, and say what would be published.

    Args:
        posed: The pair.
        matched: All its inliers, which refinement goes by.
        sampled: Those that are compared.
        reference_m: (n,) their reference depths.
        ways: How depths are found.
        cases: The errors, the first of them none.
    """
    shape = (len(cases), len(REFINED), len(ways.methods), len(reference_m))
    relative, kept = np.empty(shape, np.float32), np.empty(shape, np.bool_)
    inside = np.empty(len(cases), np.bool_)
    for c, case in enumerate(cases):
        log = posed.off_by(case)
        inside[c] = epipole_inside(log, posed.pair)
        for r, refine in enumerate(REFINED):
            found = refine_pair(log, matched) if refine else as_logged(log, matched)
            for m, method in enumerate(ways.methods):
                depth, kept[c, r, m] = depths(method, sampled, found, posed.src_camera, ways)
                relative[c, r, m] = np.abs(depth - reference_m) / reference_m
    counted = kept[0, 0] & (reference_m <= _reach(sampled, ways))
    relative[:, :, ~counted] = np.nan
    return PairErrors(relative, kept & counted, inside)


def depths(method: str, rays: MatchedRays, found: RefinedPair, src_camera: Camera, ways: Ways) -> tuple[Floats, Bools]:
    """(n,) depths (m) of matches, none beyond the range, and (n,) whether they would be published."""
    limits = Limits(
        ways.limits.max_relative_sigma,
        ways.limits.max_range_m,
        ways.limits.max_miss_sigmas,
        (found.after.median_px or 0.0) / src_camera.focal_px,
    )
    # A src camera that an error puts onto the ref camera has no epipolar planes.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        by = depths_by(method, ways.view, ways.virtual_baseline_m, rays, relative_of(found), limits)
    none = by.reason == NO_DEPTH
    return np.minimum(np.where(none, np.inf, by.depths.depth_m), _reach(rays, ways)), by.kept


def relative_of(found: RefinedPair) -> RelativePose:
    """A pair's relative pose with its covariance, as `relative_poses` holds it."""
    jacobian = relative_jacobian(found.placed.ref, found.placed.src)
    return relative_placement(found.placed.ref, found.placed.src, jacobian @ found.covariance @ jacobian.T)


def epipole_inside(log: Log, pair: PairRow) -> bool:
    """Whether the line through both centres meets the image of either: a turn of src moves the epipole in src alone."""
    ref, src = (View(pose.rotation[None], pose.centre[None]) for pose in (log.poses[pair.ref], log.poses[pair.src]))
    return any(
        _holds(camera, epipoles(one, other, camera)[0])
        for one, other, camera in ((ref, src, log.cameras[pair.ref]), (src, ref, log.cameras[pair.src]))
    )


def _holds(camera: Camera, ideal_px: Floats) -> bool:
    """Whether an ideal pixel (2,), NaN at infinity, is seen in the image."""
    ideal = (ideal_px - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return bool(camera.holds(camera.project(np.append(ideal, 1.0))))


def _reach(rays: MatchedRays, ways: Ways) -> Floats:
    """(n,) the depth at which a ref ray is as long as the range."""
    out: Floats = ways.max_range_m / np.sqrt(1.0 + np.sum(rays.ref**2, axis=0))
    return out
