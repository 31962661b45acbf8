"""Accuracy and completeness of clouds whose distances are known, and the rows of `points` near cameras."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from pipeline.engine.errors import InputError
from pipeline.geodesy.crs import local_output, output_crs
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.heights import ELLIPSOIDAL
from pipeline.geodesy.transform import FrameTransform
from pipeline.geometry.arrays import Bools, Floats
from pipeline.points.geoparquet import tile_table, write_dataset
from pipeline.scoring.cloud import TOLERANCES_M, VOXEL_M, CloudSums, cloud_sums
from pipeline.scoring.point_rows import PointsNear
from pipeline.scoring.samples import Sample, cells, mixed

SPACING_M = 0.4
FRAME = LocalFrame(37.5, -78.3, 120.0)


def grid(step_m: float, side_m: float = 12.0, up_m: float = 0.0) -> Floats:
    """A level square of points about the origin."""
    east, north = np.meshgrid(*[np.arange(-side_m / 2, side_m / 2, step_m)] * 2)
    return np.column_stack([east.ravel(), north.ravel(), np.full(east.size, up_m)])


def moved(p: Floats, east_m: float, north_m: float, up_m: float) -> Floats:
    return p + np.array([east_m, north_m, up_m])


def scattered(count: int, side_m: float, seed: int = 1) -> Floats:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-side_m / 2, side_m / 2, (count, 2)), np.zeros(count)])


def judged(points: Floats, returns: Floats, own: Bools | None = None, *, from_above: bool = True) -> CloudSums:
    mine = np.ones(len(points), np.bool_) if own is None else own
    return cloud_sums(points, mine, returns, returns, SPACING_M, from_above=from_above)


class TestAccuracy:
    def test_a_shift_is_met_from_its_own_tolerance_on(self) -> None:
        found = judged(moved(scattered(500, 8.0), 0.0, 0.0, 0.15), grid(SPACING_M)).metrics()
        assert found["accuracy"] == [0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0]
        assert (found["n_points"], found["n_unobserved"]) == (500, 0)

    @pytest.mark.parametrize("slope", [0.0, 0.6])
    def test_points_between_returns_lie_on_their_surface(self, slope: float) -> None:
        tilt = np.array([[1.0, 0.0, slope], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        points, returns = scattered(500, 8.0) @ tilt, grid(SPACING_M) @ tilt
        # To the nearest return it is further than the tolerance for nearly all of them.
        assert np.mean(cdist(points, returns).min(axis=1) > TOLERANCES_M[0]) > 0.9
        assert judged(points, returns).metrics()["accuracy"][0] == 1.0

    def test_a_half_that_is_off(self) -> None:
        points = scattered(4000, 8.0)
        points[points[:, 0] > 0.0, 2] = 0.7
        found = judged(points, grid(SPACING_M)).metrics()["accuracy"]
        assert found[4] == pytest.approx(0.5, abs=0.03)
        assert found[5] == 1.0

    def test_crowded_places_count_no_more(self) -> None:
        # One point per cube; a quarter of the cubes are off, and have fifty.
        points = moved(grid(VOXEL_M, 8.0), VOXEL_M / 2, VOXEL_M / 2, 0.01)
        off = moved(points[points[:, 0] > 2.0], 0.0, 0.0, 0.75)
        crowd = np.repeat(off, 50, axis=0) + np.random.default_rng(2).uniform(-0.04, 0.04, (50 * len(off), 3))
        found = judged(np.concatenate([points[points[:, 0] < 2.0], crowd]), grid(SPACING_M)).metrics()
        assert found["n_points"] > 10_000
        assert found["accuracy"][4] == pytest.approx(0.75, abs=0.01)

    def test_the_air_above_and_the_ground_below_are_known(self) -> None:
        for up in (5.0, -5.0):
            found = judged(moved(scattered(50, 8.0), 0.0, 0.0, up), grid(SPACING_M)).metrics()
            assert found["accuracy"] == [0.0] * len(TOLERANCES_M)
            assert (found["n_points"], found["n_unobserved"]) == (50, 0)

    def test_walls_and_places_without_returns_are_left_out(self) -> None:
        ground, roof = grid(SPACING_M), moved(grid(SPACING_M), 12.0, 0.0, 6.0)
        north, up = np.random.default_rng(4).uniform([-4.0, 0.8], [4.0, 5.2], (300, 2)).T
        wall = np.column_stack([np.full(300, 5.8), north, up])
        away = moved(scattered(70, 8.0), 40.0, 0.0, 0.0)
        found = judged(np.concatenate([wall, away]), np.concatenate([ground, roof])).metrics()
        assert (found["n_points"], found["n_unobserved"]) == (0, 370)
        assert found["accuracy"] == [None] * len(TOLERANCES_M)

    def test_among_dense_surfaces_the_nearest_return_stands_in(self) -> None:
        # A thread of returns is no surface; a point beside it is as far from it as it is.
        thread = np.column_stack([np.arange(-5.0, 5.0, 0.1), np.zeros(100), np.zeros(100)])
        points = moved(thread[20:80], 0.05, 0.03, 0.0)
        found = cloud_sums(points, np.ones(60, np.bool_), thread, thread, 0.1, from_above=False).metrics()
        assert found["accuracy"][:3] == [0.0, 0.0, 1.0]
        # What is as far as a room is wide from all surfaces may be free space or not.
        lost = judged(moved(scattered(20, 4.0), 0.0, 0.0, 2.5), grid(SPACING_M), from_above=False).metrics()
        assert (lost["n_points"], lost["n_unobserved"]) == (0, 20)


class TestCompleteness:
    def test_share_of_returns_with_a_point(self) -> None:
        returns = grid(SPACING_M)
        points = moved(returns[returns[:, 0] < -2.8], 0.0, 0.0, 0.03)
        found = judged(points, returns).metrics()
        assert found["completeness"][:2] == [0.0, pytest.approx(8 / 30)]
        assert found["n_reference"] == 900
        assert found["f1"][1] == pytest.approx(2 * (8 / 30) / (8 / 30 + 1.0))
        assert found["f1"][0] == 0.0

    def test_the_points_of_other_shards_cover_too(self) -> None:
        returns = grid(SPACING_M)
        found = judged(returns, returns, np.zeros(900, np.bool_)).metrics()
        assert found["completeness"] == [1.0] * len(TOLERANCES_M)
        assert (found["n_points"], found["accuracy"][0], found["f1"][0]) == (0, None, None)

    def test_a_return_counts_once_however_many_frames_see_it(self) -> None:
        returns, points = grid(SPACING_M), grid(SPACING_M)[:300]
        own = np.ones(300, np.bool_)
        once = cloud_sums(points, own, returns, returns, SPACING_M, from_above=True)
        often = np.concatenate([returns, np.repeat(returns[:300], 9, axis=0)])
        several = cloud_sums(points, own, returns, often, SPACING_M, from_above=True)
        assert several.metrics() == once.metrics()

    def test_nearest_points_as_counted_by_hand(self) -> None:
        rng = np.random.default_rng(6)
        points, seen = rng.uniform(-3, 3, (200, 3)), rng.uniform(-3, 3, (400, 3))
        found = cloud_sums(points, np.ones(200, np.bool_), seen, seen, SPACING_M, from_above=False).metrics()
        distance = cdist(seen, points).min(axis=1)
        # Nearly every return has a cube of its own.
        for tolerance, share in zip(TOLERANCES_M, found["completeness"], strict=True):
            assert share == pytest.approx(np.mean(distance <= tolerance), abs=0.02)

    def test_nothing(self) -> None:
        nothing = np.zeros((0, 3))
        found = cloud_sums(nothing, np.zeros(0, np.bool_), nothing, nothing, math.nan, from_above=True).metrics()
        assert (found["n_points"], found["n_reference"], found["n_unobserved"]) == (0, 0, 0)
        assert found["f1"] == found["accuracy"] == found["completeness"] == [None] * len(TOLERANCES_M)
        blind = judged(nothing, grid(SPACING_M)).metrics()
        assert blind["completeness"] == [0.0] * len(TOLERANCES_M)
        assert CloudSums.total([]) is None


class TestShards:
    @settings(max_examples=20)
    @given(seed=st.integers(0, 2**32 - 1), shards=st.integers(1, 5))
    def test_parts_add_up_to_the_whole(self, seed: int, shards: int) -> None:
        rng = np.random.default_rng(seed)
        returns = rng.uniform(-4.0, 4.0, (900, 3)) * [1.0, 1.0, 0.02]
        points = rng.uniform(-5.0, 5.0, (250, 3)) * [1.0, 1.0, 0.3]
        shard, frames = rng.integers(0, shards, 250), rng.integers(0, 2, (shards, 900)) == 1
        whole = cloud_sums(
            points, np.ones(250, np.bool_), returns, returns[frames.any(axis=0)], SPACING_M, from_above=True
        )
        parts = [
            cloud_sums(points, shard == i, returns, returns[sees], SPACING_M, from_above=True)
            for i, sees in enumerate(frames)
        ]
        total = CloudSums.total(rng.permutation(np.array(parts, object)).tolist())
        assert total is not None
        assert (total.n_points, total.n_unobserved) == (whole.n_points, whole.n_unobserved)
        assert total.weight == pytest.approx(whole.weight, rel=1e-12)
        np.testing.assert_allclose(total.within, whole.within, rtol=1e-12)
        np.testing.assert_array_equal(total.seen.key, whole.seen.key)
        np.testing.assert_array_equal(total.seen.values, whole.seen.values)

    @settings(max_examples=30)
    @given(seed=st.integers(0, 2**32 - 1), most=st.integers(1, 400))
    def test_a_bounded_sample_is_the_same_of_any_parts(self, seed: int, most: int) -> None:
        rng = np.random.default_rng(seed)
        items = rng.integers(-20, 20, (300, 3))
        key, tie, values = mixed(items[:, :2]), mixed(items), items[:, 2:].astype(np.float32)
        whole = Sample.of(key, tie, values, most)
        draws = [rng.integers(0, 300, 200) for _ in range(4)]
        draws.append(np.setdiff1d(np.arange(300), np.concatenate(draws)))
        total = Sample.total((Sample.of(key[i], tie[i], values[i], most) for i in draws), 1, most)
        assert len(whole.key) == min(most, len(np.unique(items[:, :2], axis=0)))
        np.testing.assert_array_equal(total.key, whole.key)
        np.testing.assert_array_equal(total.values, whole.values)

    def test_a_bounded_sample_is_drawn_evenly(self) -> None:
        # Of 250,000 cells of a plane, a tenth of which are marked, in one block.
        cell = np.stack(np.meshgrid(np.arange(500), np.arange(500), [7]), axis=-1).reshape(-1, 3)
        key = mixed(cell)
        assert len(np.unique(key)) == len(key)
        drawn = Sample.of(key, key, (cell[:, :1] < 50).astype(np.float32), 10_000)
        assert 0.1 - 4 * 0.003 < drawn.values.mean() < 0.1 + 4 * 0.003

    def test_cells_below_zero(self) -> None:
        np.testing.assert_array_equal(cells(np.array([[-0.1, 0.1, -0.4]]), 0.2), [[-1, 0, -2]])


class TestRows:
    """Two files of points about a kilometre apart."""

    @staticmethod
    def write(folder: Path, transform: FrameTransform, p: Floats, covariance: Floats) -> None:
        jacobian = transform.jacobian(np.zeros(3))
        in_crs, xyz = jacobian @ covariance @ jacobian.T, transform.from_enu(p)
        n, zero = len(p), np.zeros(len(p), np.float32)
        sigma = np.sqrt(np.diagonal(in_crs)).astype(np.float32)
        columns = {
            **{axis: xyz[:, i] for i, axis in enumerate("xyz")},
            **{f"sigma_{axis}_m": np.full(n, sigma[i]) for i, axis in enumerate("xyz")},
            **{f"cov_{'xyz'[i]}{'xyz'[j]}": np.full(n, in_crs[i, j], np.float32) for i, j in ((0, 1), (0, 2), (1, 2))},
            **{name: np.ones(n, np.int64) for name in ("n_pairs", "n_frames")},
            "frame_id": np.array([f"f{i % 3}" for i in range(n)], object),
            **dict.fromkeys(("u", "v", "depth_m", "parallax_deg"), zero),
            **{name: np.zeros(n, np.uint8) for name in ("red", "green", "blue")},
            "time": np.array([None] * n, object),
        }
        folder.mkdir()
        far = p[:, 0] > 500.0
        tables = [
            tile_table({key: value[rows] for key, value in columns.items()}, name)
            for name, rows in (("t_far", far), ("t_near", ~far))
        ]
        write_dataset(folder, tables, transform.crs)

    P = np.concatenate([grid(2.0, up_m=3.0), moved(grid(2.0, up_m=3.0), 1000.0, 0.0, 0.0)])
    COVARIANCE = np.array([[0.09, 0.02, 0.01], [0.02, 0.04, -0.01], [0.01, -0.01, 0.16]])

    @pytest.mark.parametrize("world", ["earth", "local"])
    def test_positions_and_covariances_come_back(self, tmp_path: Path, world: str) -> None:
        earth = world == "earth"
        transform = output_crs("EPSG:32617+5703", FRAME, ELLIPSOIDAL, -33.0) if earth else local_output("local")
        self.write(tmp_path / "points", transform, self.P, self.COVARIANCE)
        points = tmp_path / "points"
        dataset = PointsNear.of(points, FRAME, -33.0, ELLIPSOIDAL) if earth else PointsNear.of(points)
        # The far file is not read: it is damaged behind its footer's back.
        data = bytearray((points / "t_far.parquet").read_bytes())
        data[4 : len(data) // 3] = bytes(len(data) // 3 - 4)
        (points / "t_far.parquet").write_bytes(data)
        near = dataset.near(np.array([[0.0, 0.0, 40.0], [4.0, 0.0, 40.0]]), 5.0)
        want = self.P[cdist(self.P[:, :2], [[0.0, 0.0], [4.0, 0.0]]).min(axis=1) <= 5.0]
        assert len(want) > 10
        order, asked = np.lexsort(near.p_in_enu_m.round(2).T), np.lexsort(want.round(2).T)
        np.testing.assert_allclose(near.p_in_enu_m[order], want[asked], atol=1e-3)
        np.testing.assert_allclose(near.covariance, np.broadcast_to(self.COVARIANCE, near.covariance.shape), atol=2e-5)
        with pytest.raises(InputError):
            dataset.near(np.array([[1000.0, 0.0, 40.0]]), 5.0)

    def test_grid_north_is_not_north(self, tmp_path: Path) -> None:
        # 1.64 degrees of convergence here: an error along north shows in x.
        transform = output_crs("EPSG:32617+5703", FRAME, ELLIPSOIDAL, -33.0)
        along_north = np.diag([1e-4, 1.0, 1e-4])
        self.write(tmp_path / "points", transform, self.P, along_north)
        near = PointsNear.of(tmp_path / "points", FRAME, -33.0, ELLIPSOIDAL).near(np.zeros((1, 3)), 5.0)
        np.testing.assert_allclose(near.covariance[0], along_north, atol=1e-5)
        in_crs = transform.jacobian(np.zeros(3)) @ along_north @ transform.jacobian(np.zeros(3)).T
        assert abs(in_crs[0, 1]) > 0.02

    def test_points_belong_to_the_frame_of_their_best_view(self, tmp_path: Path) -> None:
        self.write(tmp_path / "points", local_output("local"), self.P, self.COVARIANCE)
        near = PointsNear.of(tmp_path / "points").near(np.zeros((1, 3)), 20.0)
        centres = np.array([[0.0, 0.0, 8.0], [0.0, 0.0, 8.0]])
        mine = near.of_frames(["f0", "f2"], centres, 8.0)
        close = np.linalg.norm(near.p_in_enu_m - centres[0], axis=1) <= 8.0
        np.testing.assert_array_equal(mine, np.isin(near.frame_id, ["f0", "f2"]) & close)
        assert 0 < mine.sum() < close.sum() < len(close)

    def test_nothing_near(self, tmp_path: Path) -> None:
        self.write(tmp_path / "points", local_output("local"), self.P, self.COVARIANCE)
        near = PointsNear.of(tmp_path / "points").near(np.array([[500.0, 300.0, 0.0]]), 20.0)
        assert near.p_in_enu_m.shape == (0, 3)
        assert near.covariance.shape == (0, 3, 3)
        assert near.of_frames(["f0"], np.zeros((1, 3)), 8.0).shape == (0,)

    def test_no_points(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="no points"):
            PointsNear.of(tmp_path)
