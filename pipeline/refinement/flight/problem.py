"""The flight as one problem: Gauss-Newton over stars and logged poses, robust on both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats, Ints
from pipeline.geometry.poses import Placement, Pose
from pipeline.geometry.rotations import vector_from_rotation
from pipeline.refinement.flight import control as surveyed
from pipeline.refinement.flight.control import Control
from pipeline.refinement.flight.elimination import Quadratic, eliminated, inverse_depths
from pipeline.refinement.flight.graph import Covariances, Graph
from pipeline.refinement.flight.lens import LensChange, Lenses
from pipeline.refinement.flight.shared import Shared
from pipeline.refinement.flight.stars import Stars

STAR_SCALE = 3.0
_MOST_STEPS = 25
_WIDEST = 200.0
_HALVING = 0.4
_DONE = 1e-2
# A frame's logged turn or shift farther off than this loses its say, as the square of the distance.
FAR_SIGMAS = 5.0
_LEAST_RAD, _LEAST_M = 1e-6, 1e-4


@dataclass(slots=True)
class State:
    """Where everything is.

    Args:
        placed: Every frame.
        constant: (c,) the shared unknowns.
        bias: (k, 3) of the knots.
        lens: (3 c,) changes of the lenses.
        depths: Inverse depths of each ref frame's stars.
        by_lens: How each ref frame's stars change with the lenses as given; that hardly depends on what is found.
        points: (3,) of each control point, ENU m.
        settled: Whether the last step was a small one.
    """

    placed: list[Placement]
    constant: Floats
    bias: Floats
    lens: Floats
    depths: list[Floats | None]
    by_lens: list[LensChange | None]
    points: list[Floats]
    settled: bool = False


@dataclass(frozen=True, slots=True)
class Problem:
    """A flight to be refined.

    Args:
        logged: Every frame.
        shared: What all get wrong alike.
        lenses: What they were seen through.
        stars: Of every ref frame that has any.
        control: Surveyed points in its photos.
    """

    logged: Sequence[Pose]
    shared: Shared
    lenses: Lenses
    stars: Sequence[Stars]
    control: Sequence[Control] = ()

    def start(self) -> State:
        """As logged."""
        placed = [Placement(pose.rotation, pose.centre) for pose in self.logged]
        knots, lens = np.zeros((len(self.shared.knot_s), 3)), np.zeros(len(self.lenses.sigma))
        points = [one.surveyed_m for one in self.control]
        depths: list[Floats | None] = [None] * len(self.stars)
        by_lens = [self.lenses.derivatives(stars, lens) for stars in self.stars]
        return State(placed, np.zeros(len(self.shared.sigma)), knots, lens, depths, by_lens, points)

    def off_log(self, state: State) -> Floats:
        """(n, 6) turn and shift of every frame from its logged pose."""
        return np.stack(
            [
                np.concatenate([vector_from_rotation(now.rotation @ then.rotation.T), now.centre - then.centre])
                for now, then in zip(state.placed, self.logged, strict=True)
            ]
        )

    def own_sigmas_off(self, state: State) -> Floats:
        """(n, 2) how far each frame's own turn and shift are from what the log allows, in its sigmas."""
        off = self.off_log(state) - self._explained(state)
        whitened = np.einsum("nij,nj->ni", self._whitening(), off)
        return np.stack([np.linalg.norm(whitened[:, :3], axis=1), np.linalg.norm(whitened[:, 3:], axis=1)], axis=1)

    def _explained(self, state: State) -> Floats:
        """(n, 6) by the shared unknowns."""
        shared = self.shared
        out: Floats = shared.effect @ state.constant
        share = shared.share[:, None]
        out[:, 3:] += (1.0 - share) * state.bias[shared.before] + share * state.bias[shared.before + 1]
        return out

    def solve(self) -> tuple[State, list[Quadratic]]:
        """The minimum, and its linearisation."""
        state, scale = self.start(), _WIDEST
        for _ in range(_MOST_STEPS):
            quadratics = self._quadratics(state, scale)
            graph = self._graph(state, quadratics, 1.0, scale)
            found = graph.minimum()
            size = self._move(state, found)
            if scale <= STAR_SCALE and size < _DONE:
                state.settled = True
                break
            scale = max(STAR_SCALE, scale * _HALVING)
        return state, self._quadratics(state, STAR_SCALE)

    def final(self, state: State, quadratics: Sequence[Quadratic], scatter: float) -> Covariances:
        """What is left open at the minimum, with the information that the stars really have."""
        return self._graph(state, quadratics, 1.0 / scatter, STAR_SCALE).covariances()

    @property
    def key_of_constant(self) -> int:
        """Number of the constant shared unknowns; frames have theirs from 0."""
        return len(self.logged)

    @property
    def key_of_lens(self) -> int:
        """Number of the unknown parameters of the lenses."""
        return len(self.logged) + 1 + len(self.shared.knot_s)

    def _quadratics(self, state: State, scale: float) -> list[Quadratic]:
        out = []
        for i, as_given in enumerate(self.stars):
            stars = self.lenses.rays(as_given, state.lens) if np.any(state.lens) else as_given
            at = [state.placed[frame] for frame in stars.frames]
            depth = inverse_depths(stars, at, state.depths[i], scale)
            state.depths[i] = depth
            out.append(eliminated(stars, at, depth, scale, state.by_lens[i]))
        return out

    def _graph(self, state: State, quadratics: Sequence[Quadratic], factor: float, scale: float) -> Graph:
        graph = Graph(self._units())
        for stars, quadratic in zip(self.stars, quadratics, strict=True):
            self._add_quadratic(graph, stars.frames, quadratic, factor)
        for i, one in enumerate(self.control):
            at = [state.placed[frame] for frame in one.frames]
            seen = surveyed.sights(one, self.lenses, state.lens)
            state.points[i] = surveyed.most_likely(one, seen, at, state.points[i], scale)
            self._add_quadratic(graph, one.frames, surveyed.eliminated(one, seen, at, state.points[i], scale), 1.0)
        self._add_log(graph, state)
        self._add_shared(graph, state)
        return graph

    def _add_quadratic(self, graph: Graph, frames: Ints, quadratic: Quadratic, factor: float) -> None:
        sizes, keys = [6] * len(frames), [int(frame) for frame in frames]
        if len(self.lenses.unknown):
            sizes, keys = [*sizes, len(self.lenses.unknown)], [*keys, self.key_of_lens]
        graph.add_quadratic(keys, sizes, factor * quadratic.information, factor * quadratic.gradient)

    def _own_sigmas(self) -> Floats:
        """(n, 6) of the frames' own turns and shifts: yaw, pitch, roll, then east, north, up."""
        return np.stack(
            [_own_sigmas(pose, loose) for pose, loose in zip(self.logged, self.shared.loose_m, strict=True)]
        )

    def _whitening(self) -> Floats:
        """(n, 6, 6) from the frames' own turns and shifts to units of their sigmas."""
        out = np.tile(np.eye(6), (len(self.logged), 1, 1))
        out[:, :3, :3] = np.linalg.pinv(np.stack([pose.error_axes for pose in self.logged]))
        return out / self._own_sigmas()[:, :, None]

    def _units(self) -> dict[int, Floats]:
        """One sigma of every unknown, as the log has it."""
        n, shared = len(self.logged), self.shared
        units = dict(enumerate(self._own_sigmas()))
        units[n] = shared.sigma
        bias = np.maximum(shared.bias_sigma_m, _LEAST_M)
        units[self.key_of_lens] = self.lenses.sigma[self.lenses.unknown]
        return units | {n + 1 + knot: bias for knot in range(len(shared.knot_s))}

    def _add_log(self, graph: Graph, state: State) -> None:
        shared, n = self.shared, len(self.logged)
        off, far = self.off_log(state), self.own_sigmas_off(state)
        weight = np.where(far > FAR_SIGMAS, (FAR_SIGMAS / np.maximum(far, FAR_SIGMAS)) ** 2, 1.0)
        whitening = self._whitening()
        for i in range(n):
            white = whitening[i] * np.repeat(np.sqrt(weight[i]), 3)[:, None]
            terms = [(i, white)]
            if len(shared.sigma):
                terms.append((n, -white @ shared.effect[i]))
            before = int(shared.before[i])
            for knot, share in ((before, 1.0 - shared.share[i]), (before + 1, shared.share[i])):
                terms.append((n + 1 + knot, -white[:, 3:] * share))
            graph.add_rows(terms, -white @ off[i])

    def _add_shared(self, graph: Graph, state: State) -> None:
        shared, n = self.shared, len(self.logged)
        if len(shared.sigma):
            graph.add_rows([(n, np.diag(1.0 / shared.sigma))], np.zeros(len(shared.sigma)))
        unknown = self.lenses.unknown
        if len(unknown):
            off = state.lens[unknown] / self.lenses.sigma[unknown]
            graph.add_rows([(self.key_of_lens, np.diag(1.0 / self.lenses.sigma[unknown]))], -off)
        sigma = np.maximum(shared.bias_sigma_m, _LEAST_M)
        graph.add_rows([(n + 1, np.diag(1.0 / sigma))], np.zeros(3))
        for knot, holds in enumerate(shared.holds):
            step = np.diag(1.0 / (sigma * np.sqrt(1.0 - holds**2)))
            graph.add_rows([(n + 1 + knot, -holds * step), (n + 2 + knot, step)], np.zeros(3))

    def _move(self, state: State, found: Mapping[int, Floats]) -> float:
        """Takes the step; returns its largest size per frame in units of the logged sigmas."""
        n = len(self.logged)
        steps = np.stack([found[i] for i in range(n)])
        state.placed = [placed.moved(step) for placed, step in zip(state.placed, steps, strict=True)]
        if len(self.shared.sigma):
            state.constant = found[n]
        if len(self.lenses.unknown):
            state.lens[self.lenses.unknown] += found[self.key_of_lens]
        state.bias = np.stack([found[n + 1 + knot] for knot in range(len(self.shared.knot_s))])
        return float(np.linalg.norm(np.einsum("nij,nj->ni", self._whitening(), steps), axis=1).max())


def _own_sigmas(pose: Pose, loose_m: Floats) -> Floats:
    """(6,) of a frame's own turn and shift: yaw, pitch, roll, then east, north, up."""
    gimbal = np.maximum(pose.own.gimbal_rad, _LEAST_RAD)
    return np.concatenate([gimbal, np.maximum(np.hypot(pose.own.position_m, loose_m), _LEAST_M)])
