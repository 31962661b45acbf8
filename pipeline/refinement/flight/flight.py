"""A flight refined as a whole: from stars to poses, their covariances, and what all frames got wrong alike."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.geometry.poses import PlacedPair, Placement, relative_placement, relative_pose
from pipeline.geometry.rotations import vector_from_rotation
from pipeline.refinement.flight.control import Control, ControlFit, offsets_px
from pipeline.refinement.flight.graph import Covariances
from pipeline.refinement.flight.lens import NAMES, Lenses
from pipeline.refinement.flight.problem import FAR_SIGMAS, Problem, State
from pipeline.refinement.flight.shared import shared_unknowns
from pipeline.refinement.flight.stars import Stars, stars_by_ref
from pipeline.refinement.logged import NO_INLIER, Log, logged_frames
from pipeline.refinement.matched import Matched
from pipeline.refinement.pair import trusted
from pipeline.refinement.relative import inverse
from pipeline.refinement.rows import FLIGHT, NONE, Misses, RefinedFrame, RefinedPair
from pipeline.refinement.scatter import SHARED_PX, scatter_between


@dataclass(frozen=True, slots=True)
class Found:
    """A shared unknown.

    Args:
        name: With its unit.
        value: By which the log has to be corrected.
        sigma: Of it.
        prior_sigma: What the log allowed.
    """

    name: str
    value: float
    sigma: float
    prior_sigma: float


@dataclass(frozen=True, slots=True)
class RefinedFlight:
    """A flight after refinement.

    Args:
        frames: By name.
        errors: Covariances between frames.
        cameras: Of every frame, by name.
        found: The shared unknowns.
        scatter: Factor by which the matches' information was too large.
        control: How the control points fit.
        lens_as_given: Parameters of lenses that were looked for and are not determined.
        parts: Sets of frames that no pair ties together, those without any match left out.
        set_aside: By pair, why its matches had no part.
        settled: Whether the poses had stopped moving when the steps were used up.
    """

    frames: dict[str, RefinedFrame]
    errors: PoseErrors
    cameras: dict[str, Camera]
    found: tuple[Found, ...]
    scatter: float
    control: tuple[ControlFit, ...] = ()
    lens_as_given: tuple[str, ...] = ()
    parts: int = 0
    settled: bool = True
    set_aside: Mapping[str, str] = field(default_factory=dict)

    def pair(self, log: Log, matched: Matched) -> RefinedPair:
        """A pair as the flight places it.

        Args:
            log: The flight as logged.
            matched: The pair's inliers.
        """
        pair = matched.pair
        ref, src = self.frames[pair.ref].placed, self.frames[pair.src].placed
        logged = relative_pose(log.poses[pair.ref], log.poses[pair.src])
        now = relative_placement(ref, src, logged.covariance)
        off = np.concatenate([vector_from_rotation(now.rotation.T @ logged.rotation), now.centre - logged.centre])
        moved = float(np.sqrt(off @ inverse(logged.covariance) @ off))
        reason = self.set_aside.get(pair.pair_id, "" if len(matched) else NO_INLIER)
        held = self.frames[pair.ref].refined and self.frames[pair.src].refined
        return RefinedPair(
            PlacedPair.plain(ref, src),
            self.errors.joint(pair.ref, pair.src),
            FLIGHT if held else NONE,
            Misses.of(matched.residuals_px(logged)),
            Misses.of(self._through(log, matched).residuals_px(now)),
            moved,
            f"its matches had no part: {reason}" if reason and held else reason,
        )

    def _through(self, log: Log, matched: Matched) -> Matched:
        cameras = [self.cameras[name] for name in (matched.pair.ref, matched.pair.src)]
        given = [log.cameras[name] for name in (matched.pair.ref, matched.pair.src)]
        return matched if cameras == given else matched.through(*cameras)


def trusted_stars(log: Log, matched: Iterable[Matched]) -> tuple[list[Stars], dict[str, str]]:
    """The stars of several pairs, of those matches of each that agree with one another.

    Args:
        log: The flight as logged; its frames are numbered in the order of its poses.
        matched: The pairs' inliers, those of one ref frame among them all.

    Returns:
        The stars, and by pair why none of its matches is among them.
    """
    number = {name: i for i, name in enumerate(log.poses)}
    kept, reasons = [], {}
    for one in matched:
        some, reason = trusted(log, one)
        kept.append(some)
        if reason:
            reasons[one.pair.pair_id] = reason
    return stars_by_ref(kept, number), reasons


def refine_flight(
    log: Log,
    stars: Sequence[Stars],
    near: Sequence[tuple[str, str]],
    *,
    calibrate: bool = False,
    control: Sequence[Control] = (),
) -> RefinedFlight:
    """Refines all frames together.

    Args:
        log: The flight as logged; frames are numbered in the order of its poses.
        stars: Of every ref frame that has any.
        near: Couples of frames whose covariance is wanted.
        calibrate: Whether the lenses are unknown, too; what the images do not determine of them stays as given.
        control: Surveyed points in its photos.
    """
    if not stars and not control:
        errors = PoseErrors.of_log(log.poses, near)
        return RefinedFlight(logged_frames(log), errors, dict(log.cameras), (), 1.0, ())
    names, poses = list(log.poses), list(log.poses.values())
    lenses = Lenses.of([log.cameras[name] for name in names], unknown=calibrate)
    shared = shared_unknowns(poses, np.array([log.time_s[name] for name in names]))
    problem = Problem(poses, shared, lenses, stars, control)
    state, covariances, scatter = _solved(problem)
    left: tuple[str, ...] = ()
    if calibrate:
        lenses = lenses.observed(state.lens, _lens_sigma(problem, covariances))
        problem = replace(problem, lenses=lenses)
        left = tuple(NAMES[k % len(NAMES)] for k in np.flatnonzero(lenses.sigma == 0.0))
        state, covariances, scatter = _solved(problem)
    errors = _errors(names, near, covariances, [SHARED_PX / log.cameras[name].focal_px for name in names])
    seen = [*(one.frames for one in stars), *(one.frames for one in control)]
    touched = {int(frame) for some in seen for frame in some}
    far = problem.own_sigmas_off(state)
    frames = {
        name: RefinedFrame(state.placed[i], errors.between(name, name), i in touched, _problem(far[i]))
        for i, name in enumerate(names)
    }
    now = lenses.changed(state.lens)
    cameras = {name: now[lenses.of_frame[i]] for i, name in enumerate(names)}
    found = (*_found(problem, state, covariances), *_found_of_lenses(problem, state, covariances))
    fits = _fits(problem, state, [*cameras.values()])
    return RefinedFlight(frames, errors, cameras, found, scatter, fits, left, _parts(stars, len(names)), state.settled)


def _solved(problem: Problem) -> tuple[State, Covariances, float]:
    state, quadratics = problem.solve()
    found = [scatter_between(quadratic.by_cell, quadratic.information) for quadratic in quadratics]
    scatter = max(1.0, float(np.mean(found))) if found else 1.0
    return state, problem.final(state, quadratics, scatter), scatter


def _parts(stars: Sequence[Stars], frames: int) -> int:
    """Sets of frames that stars tie together; frames without any are not counted."""
    links = [(int(one.frames[0]), int(other)) for one in stars for other in one.frames[1:]]
    if not links:
        return 0
    ends = np.array(links)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(frames, frames))
    _, part = connected_components(graph, directed=False)
    return len(np.unique(part[np.unique(ends)]))


def _lens_sigma(problem: Problem, covariances: Covariances) -> Floats:
    """(3 c,) of what is found of the lenses; infinite for what was not looked for."""
    out = np.full(len(problem.lenses.sigma), np.inf)
    unknown = problem.lenses.unknown
    if len(unknown):
        out[unknown] = np.sqrt(np.diag(covariances.of(problem.key_of_lens)))
    return out


def _errors(
    names: Sequence[str], near: Sequence[tuple[str, str]], covariances: Covariances, shared_rad: Sequence[float]
) -> PoseErrors:
    number = {name: i for i, name in enumerate(names)}
    couples = [*((name, name) for name in names), *near]
    numbers = np.array([(number[one], number[other]) for one, other in couples], np.int64)
    blocks = covariances.couples(numbers)
    for i, sigma in enumerate(shared_rad):
        # The first of the couples are every frame with itself.
        blocks[i] = blocks[i] + np.diag([sigma**2] * 3 + [0.0] * 3)
    return PoseErrors.of(names, ((*couple, block) for couple, block in zip(couples, blocks, strict=True)))


def _fits(problem: Problem, state: State, cameras: Sequence[Camera]) -> tuple[ControlFit, ...]:
    lenses, out = problem.lenses, []
    logged = [Placement(pose.rotation, pose.centre) for pose in problem.logged]
    for one in problem.control:
        given = [lenses.cameras[lenses.of_frame[frame]] for frame in one.frames]
        now = [cameras[frame] for frame in one.frames]
        before = offsets_px(one, [logged[frame] for frame in one.frames], given)
        after = offsets_px(one, [state.placed[frame] for frame in one.frames], now)
        out.append(ControlFit(one.name, before, after))
    return tuple(out)


def _found(problem: Problem, state: State, covariances: Covariances) -> tuple[Found, ...]:
    shared = problem.shared
    if not len(shared.sigma):
        return ()
    sigma = np.sqrt(np.diag(covariances.of(problem.key_of_constant)))
    rows = zip(shared.names, state.constant, sigma, shared.sigma, strict=True)
    return tuple(Found(name, float(value), float(s), float(prior)) for name, value, s, prior in rows)


def _found_of_lenses(problem: Problem, state: State, covariances: Covariances) -> tuple[Found, ...]:
    sigma = _lens_sigma(problem, covariances)
    names = [name for _ in problem.lenses.cameras for name in NAMES]
    return tuple(
        Found(names[k], float(state.lens[k]), float(sigma[k]), float(problem.lenses.sigma[k]))
        for k in problem.lenses.unknown
    )


def _problem(far: Floats) -> str:
    said = [
        f"the logged {what} is {sigmas:.0f} sigmas from what the images say, and was left aside"
        for what, sigmas in zip(("attitude", "position"), far, strict=True)
        if sigmas > FAR_SIGMAS
    ]
    return "; ".join(said)
