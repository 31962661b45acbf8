"""Points that cannot be true are left out, and thin, sparse and lonely ones that may be are not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_fusion import CAMERA, STATIONS, Flight, point_of

from pipeline.geodesy.local_world import LocalTransform
from pipeline.geometry.arrays import Bools, Floats, Ints
from pipeline.points import freespace
from pipeline.points.covariances import whole
from pipeline.points.freespace import Views, looked_through
from pipeline.points.merge import Merged, merge
from pipeline.points.observed import Observed
from pipeline.points.outliers import isolated

# --- points that stand alone ---


def ground(rng: np.random.Generator, spacing_m: float, n: int = 20) -> Floats:
    """(n^2, 3) an uneven field of points."""
    grid = np.stack(np.meshgrid(np.arange(n), np.arange(n)), axis=-1).reshape(-1, 2) * spacing_m
    xy = grid + rng.uniform(-0.3, 0.3, grid.shape) * spacing_m
    return np.column_stack([xy, rng.normal(0.0, 0.05, len(xy))])


def alone(xyz: Floats, sigma_m: float | Floats = 0.1, n_frames: int | Ints = 2) -> Bools:
    return isolated(xyz, np.broadcast_to(sigma_m, len(xyz)), np.broadcast_to(n_frames, len(xyz)))


def test_floaters_are_found_and_nothing_else() -> None:
    rng = np.random.default_rng(1)
    field = ground(rng, 0.5, 60)
    floaters = np.column_stack([rng.uniform(1.0, 29.0, (6, 2)), rng.uniform(6.0, 12.0, 6)])
    found = alone(np.concatenate([field, floaters]))
    assert np.flatnonzero(found).tolist() == [len(field) + i for i in range(6)]


def test_a_floater_that_its_own_sigma_explains_or_that_three_frames_saw_stays() -> None:
    field = ground(np.random.default_rng(2), 0.5)
    points = np.concatenate([field, [[5.0, 5.0, 12.0]]])
    assert np.flatnonzero(alone(points)).tolist() == [len(field)]
    sigma = np.full(len(points), 0.1)
    sigma[-1] = 5.0
    assert not alone(points, sigma).any()
    frames = np.full(len(points), 2)
    frames[-1] = 3
    assert not alone(points, 0.1, frames).any()


@pytest.mark.parametrize("sparse", [2.0, 5.0, 10.0])
def test_sparse_ground_beside_dense_ground_survives(sparse: float) -> None:
    """A mown lawn beside a gravel path: the density falls by up to 400 at once."""
    rng = np.random.default_rng(3)
    path, lawn = ground(rng, 0.5), ground(rng, sparse, 8)
    found = alone(np.concatenate([path, lawn - [8.0 * sparse, 0.0, 0.0]]))
    assert found.mean() < 0.01


def test_a_thin_pole_survives_to_its_top() -> None:
    rng = np.random.default_rng(4)
    field = ground(rng, 0.4)
    pole = np.column_stack([np.full(12, 4.0), np.full(12, 4.0), np.linspace(0.4, 9.0, 12)])
    assert not alone(np.concatenate([field, pole]), 0.02).any()


@pytest.mark.parametrize("n", [0, 1, 5, 8])
def test_too_few_points_to_tell(n: int) -> None:
    assert not alone(np.random.default_rng(5).normal(size=(n, 3)) * 100.0).any()


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), scale=st.sampled_from([0.01, 1.0, 50.0]))
def test_the_verdict_follows_the_points(seed: int, scale: float) -> None:
    """Not their order, place or unit."""
    rng = np.random.default_rng(seed)
    points = np.concatenate([rng.normal(size=(60, 3)), 20.0 * rng.normal(size=(5, 3))])
    order = rng.permutation(len(points))
    want = alone(points, 0.01)[order]
    assert want.any()
    assert np.array_equal(alone(points[order] * scale + [700.0, 4000.0, 100.0], 0.01 * scale), want)


# --- points that others looked through ---

FLOATER = np.array([1.0, 34.0, 14.0])


def behind(point: Floats, frames: list[int], aside_px: float = 0.0) -> Floats:
    """(n, 2) where on the ground frames see, beyond a point or some pixels to the right of it."""
    found = []
    for i in frames:
        centre = np.array(STATIONS[i][1])
        aside = np.array([aside_px * np.linalg.norm(point - centre) / CAMERA.fx, 0.0, 0.0])
        sight = point + aside - centre
        found.append((centre - sight * (centre[2] / sight[2]))[:2])
    return np.array(found)


@dataclass
class Scene:
    """Ground that all frames see, and points above it that some pairs saw."""

    flight: Flight
    observed: Observed
    track: Ints
    merged: Merged

    @classmethod
    def of(
        cls,
        above: Floats,
        by: list[tuple[int, int]],
        on_ground: Floats,
        turn_deg: float | Sequence[float] = 0.003,
        shift_m: float = 0.002,
        common_m: float = 0.0,
    ) -> Scene:
        pairs, n = [(1, 0), (2, 1), (3, 2), (4, 3)], len(STATIONS)
        turn = np.broadcast_to(np.radians(turn_deg), n)
        covariance = np.diag(np.concatenate([[t**2] * 3 + [shift_m**2] * 3 for t in turn]))
        for axis in (3, 4, 5):
            covariance[axis::6, axis::6] += common_m**2
        flight = Flight(pairs, ground=on_ground, covariance=covariance)
        raised = Flight(by, ground=on_ground[:1].repeat(len(above), axis=0), covariance=covariance)
        raised.points = above
        raised.keypoints = [raised.project(i, above) for i in range(len(STATIONS))]
        # Its keypoints show what stands above the ground.
        raised.shown = dict.fromkeys(range(len(STATIONS)), above).__getitem__  # type: ignore[method-assign]
        down, up = flight.observed(), raised.observed()
        observed = Observed.joined([down, up])
        track = np.concatenate([point_of(down), len(on_ground) + point_of(up)])
        errors = flight.errors()
        return cls(flight, observed, track, merge(observed, track, whole(observed, errors), errors))

    def views(self) -> Views:
        names = [str(i) for i in range(len(STATIONS))]
        return Views(
            names,
            dict.fromkeys(names, CAMERA),
            dict(zip(names, self.flight.frames, strict=True)),
            self.flight.errors(),
            LocalTransform(),
        )

    def looked_through(self) -> Ints:
        return np.flatnonzero(looked_through(self.observed, self.track, self.merged, self.views()))


def test_a_point_that_more_frames_look_through_than_saw_it_is_found() -> None:
    """Two saw it, three others the ground behind it."""
    scene = Scene.of(FLOATER[None], [(2, 0)], behind(FLOATER, [1, 3, 4]))
    assert np.allclose(scene.merged.xyz[-1], FLOATER, atol=1e-6)
    assert scene.looked_through().tolist() == [3]


def test_as_many_frames_for_it_as_against_it_leave_it() -> None:
    scene = Scene.of(FLOATER[None], [(2, 0)], behind(FLOATER, [1, 3]))
    assert scene.looked_through().tolist() == []
    scene = Scene.of(FLOATER[None], [(1, 0), (2, 0)], behind(FLOATER, [3, 4]))
    assert scene.looked_through().tolist() == []


def test_its_own_frames_do_not_speak_against_it() -> None:
    scene = Scene.of(FLOATER[None], [(4, 0), (4, 1)], behind(FLOATER, [0, 1, 2, 3, 4]))
    assert scene.looked_through().tolist() == []


def test_frames_that_do_not_know_where_they_look_say_nothing() -> None:
    """With a tenth of a degree the point may as well stand beside what they saw."""
    scene = Scene.of(FLOATER[None], [(1, 0)], behind(FLOATER, [2, 3, 4]), turn_deg=0.1)
    assert scene.looked_through().tolist() == []


def test_frames_that_do_not_know_their_own_turn_say_nothing() -> None:
    """Though those that saw the point know theirs."""
    known = {"above": FLOATER[None], "by": [(2, 0)], "on_ground": behind(FLOATER, [1, 3, 4])}
    for turn, found in ((0.003, [3]), (0.1, [])):
        assert Scene.of(**known, turn_deg=[0.003, turn, 0.003, turn, turn]).looked_through().tolist() == found


def test_what_all_frames_share_does_not_shield_it_and_its_depth_s_own_error_does() -> None:
    by, on_ground = [(2, 0)], behind(FLOATER, [1, 3, 4])
    assert Scene.of(FLOATER[None], by, on_ground, common_m=20.0).looked_through().tolist() == [3]
    scene = Scene.of(FLOATER[None], by, on_ground)
    best = scene.merged.best[3]
    # So unsure along the sight of frame 1, that the ground may be there.
    sight = FLOATER - STATIONS[1][1]
    sight /= np.linalg.norm(sight)
    for sigma_m, found in ((2.0, [3]), (8.0, [])):
        scene.observed.independent[best] = sigma_m**2 * sight[:, None] * sight
        scene.observed.jacobian[best] *= 0.0
        assert _claimed_by(scene, 1) == found


def _claimed_by(scene: Scene, frame: int) -> list[int]:
    """What one frame's claims alone find."""
    views = scene.views()
    placed = views.placements[str(frame)]
    rows = np.flatnonzero((scene.observed.frames == frame).any(axis=1))
    pixels = [
        scene.observed.ref_px[i] if scene.observed.frames[i, 0] == frame else scene.observed.src_px[i] for i in rows
    ]
    claims = freespace._claims(scene.merged.xyz, placed, CAMERA, np.array(pixels), scene.track[rows])
    return claims.point[freespace._sure(claims, scene.observed, scene.merged, views, frame)].tolist()


def test_a_thin_pole_with_ground_beside_it_survives() -> None:
    """All frames see the ground three pixels to the right of each of its points."""
    pole = np.column_stack([np.full(8, 1.0), np.full(8, 34.0), np.linspace(1.0, 9.0, 8)])
    beside = np.concatenate([behind(point, [0, 1, 2, 3, 4], 3.0) for point in pole])
    assert Scene.of(pole, [(1, 0)], beside).looked_through().tolist() == []
    through = np.concatenate([behind(point, [2, 3, 4], 0.5) for point in pole])
    assert len(Scene.of(pole, [(1, 0)], through).looked_through()) >= 7, "what is not beside it, is looked through"


def test_a_point_on_the_ground_does_not_hide_the_ground() -> None:
    """Nor one that lies above it by less than both depths are known to."""
    low = np.array([[1.0, 34.0, 0.4]])
    assert Scene.of(low, [(1, 0)], behind(low[0], [2, 3, 4])).looked_through().tolist() == []


def test_a_point_behind_what_they_saw_is_only_hidden() -> None:
    """Seen by two frames beneath a roof that hides it from the others."""
    roof = behind(FLOATER, [2, 3, 4])
    scene = Scene.of(FLOATER[None], [(1, 0)], roof)
    swapped = Merged(
        np.where(np.arange(4)[:, None] == 3, scene.merged.xyz - [0.0, 0.0, 30.0], scene.merged.xyz),
        scene.merged.covariance,
        scene.merged.n_pairs,
        scene.merged.n_frames,
        scene.merged.best,
    )
    scene.merged = swapped
    assert scene.looked_through().tolist() == []
