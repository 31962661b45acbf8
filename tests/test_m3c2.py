"""M3C2-EP beside py4dgeo, beside Monte Carlo, and on planes and steps whose distances are known."""

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS
from scipy.spatial import cKDTree
from test_points_files import synthetic_columns, write_points

from pipeline.geometry.arrays import Floats
from pipeline.lidar.tile_covariance import tile_covariance
from pipeline.points.geoparquet import PointDataset
from pipeline.points.las import write_las
from pipeline.scoring.m3c2 import CORE_M, DEPTH_M, Cloud, M3C2Sums, along_normals, core_points, m3c2_sums

SPACING_M = 0.3
RADIUS_M = 0.6


def rough(count: int, side_m: float, sigma_m: float, seed: int, slope: float = 0.0) -> Floats:
    """Points scattered over a plane, and off it by a sigma along up."""
    rng = np.random.default_rng(seed)
    p = np.column_stack([rng.uniform(-side_m / 2, side_m / 2, (count, 2)), rng.normal(0.0, sigma_m, count)])
    p[:, 2] += slope * p[:, 0]
    return p


def raised(p: Floats, up_m: float) -> Floats:
    return p + np.array([0.0, 0.0, up_m])


def cloud(p: Floats, sigma_m: float, *, shared: bool = False) -> Cloud:
    return Cloud(p, np.broadcast_to(sigma_m**2 * np.eye(3), (len(p), 3, 3)), shared)


def sums(points: Cloud, reference: Cloud, **more: Any) -> M3C2Sums:
    return m3c2_sums(points, np.ones(len(points.p_in_enu_m), np.bool_), reference, SPACING_M, **more)


def metrics(found: M3C2Sums) -> dict[str, Any]:
    out = found.metrics()
    assert out is not None
    return out


class TestDistances:
    def test_a_plane_above_a_plane(self) -> None:
        reference = cloud(rough(4000, 20.0, 0.0, 1), 0.03)
        found = metrics(sums(cloud(raised(rough(3000, 16.0, 0.0, 2), 0.25), 0.1), reference))
        assert 240 <= found["n"] <= 16**2 + 2 * 34
        assert found["median_m"] == pytest.approx(0.25, abs=1e-6)
        assert found["rms_m"] == pytest.approx(0.25, abs=1e-6)
        assert (found["radius_m"], found["normals"]) == (RADIUS_M, "reference")

    def test_along_the_normal_of_the_reference(self) -> None:
        reference = cloud(rough(6000, 20.0, 0.0, 1, slope=0.75), 0.03)
        found = metrics(sums(cloud(raised(rough(3000, 14.0, 0.0, 2, slope=0.75), -0.5), 0.1), reference))
        assert found["median_m"] == pytest.approx(-0.4, abs=1e-6)

    def test_a_step_is_found_and_the_rest_is_unchanged(self) -> None:
        # Half a metre up: a plane between two layers of cubes has core points in both.
        points = raised(rough(6000, 20.0, 0.02, 3), 0.5)
        points[points[:, 0] > 0.0, 2] += 0.2
        found = metrics(sums(cloud(points, 0.02), cloud(raised(rough(6000, 24.0, 0.02, 4), 0.5), 0.02)))
        assert found["significant_share"] == pytest.approx(0.5 + 0.5 * 0.05, abs=0.06)
        assert found["within_lod_share"] == 1.0 - found["significant_share"]
        assert found["mean_m"] == pytest.approx(0.1, abs=0.02)

    def test_a_wall_without_returns_does_not_lift_the_ground(self) -> None:
        rng = np.random.default_rng(18)
        ground = rough(6000, 20.0, 0.0, 1)
        returns = ground[ground[:, 0] < 0.0]
        wall = np.column_stack([np.zeros(2000), rng.uniform([-9.0, 0.3], [9.0, 3.0], (2000, 2))])
        flat = rough(1000, 18.0, 0.0, 2)
        found = metrics(sums(cloud(np.concatenate([wall, flat[flat[:, 0] < 0.0]]), 0.1), cloud(returns, 0.03)))
        assert 100 < found["n"] < 200
        assert found["median_m"] == pytest.approx(0.0, abs=1e-6)
        # A few places look as if there were ground behind the wall, too; 26 % do to who does not look at all sides.
        assert found["significant_share"] < 0.1

    def test_as_py4dgeo_measures_them(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        # It writes a log where it is imported.
        monkeypatch.chdir(tmp_path)
        py4dgeo = pytest.importorskip("py4dgeo")
        rng = np.random.default_rng(5)
        reference, points = rng.uniform(-4.0, 4.0, (2, 2500, 3)) * [1.0, 1.0, 0.6]
        normal = rng.normal(size=(400, 3))
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        # None of the points, which would lie where py4dgeo's slabs meet, on neither side or on both.
        core = rng.uniform(-4.0, 4.0, (400, 3)) * [1.0, 1.0, 0.6]
        m3c2 = py4dgeo.M3C2(
            epochs=(py4dgeo.Epoch(reference), py4dgeo.Epoch(points)),
            corepoints=core,
            corepoint_normals=normal,
            cyl_radius=RADIUS_M,
            max_distance=DEPTH_M,
        )
        distance, other = m3c2.run()
        theirs, ours = (along_normals(cloud(p, 0.1), cKDTree(p), core, normal, RADIUS_M) for p in (reference, points))
        both = (ours.count > 0) & (theirs.count > 0)
        assert both.mean() > 0.9
        np.testing.assert_array_equal(ours.count, other["num_samples2"])
        np.testing.assert_array_equal(theirs.count, other["num_samples1"])
        np.testing.assert_allclose((ours.mean_m - theirs.mean_m)[both], distance[both], atol=1e-9)

    def test_as_py4dgeo_propagates_errors_in_common(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Its scanner, at the origin, errs by angles alone; a cylinder's mean is as uncertain as its points."""
        monkeypatch.chdir(tmp_path)
        m3c2ep = pytest.importorskip("py4dgeo.m3c2ep")
        p = np.random.default_rng(17).uniform([-0.3, -0.3, -80.0], [0.3, 0.3, -79.5], (12, 3)) + np.array(
            [30.0, 20.0, 0.0]
        )
        angle = np.array([[0.0, 0.0, 2e-3, 1e-3]])
        still, ones = np.eye(3, 4), np.ones(12, np.int64)
        theirs = m3c2ep.get_local_mean_and_Cxx_nocorr(
            np.zeros((12, 12)), still, np.zeros((1, 3)), np.zeros(3), angle, p, ones, 0, tf=False
        )[1]
        across, ground = np.column_stack([-p[:, 1], p[:, 0], 0.0 * p[:, 0]]), np.hypot(p[:, 0], p[:, 1])
        down = np.column_stack([p[:, :2] * (p[:, 2] / ground)[:, None], -ground])
        covariance = 4e-6 * across[:, :, None] * across[:, None, :] + 1e-6 * down[:, :, None] * down[:, None, :]
        for axis in np.eye(3)[[0, 2]]:
            found = along_normals(
                Cloud(p, covariance, shared=True), cKDTree(p), p.mean(axis=0)[None], axis[None], RADIUS_M
            )
            assert found.count[0] == 12
            assert found.variance[0] == pytest.approx(axis @ theirs @ axis, rel=1e-9)


class TestLevelOfDetection:
    @pytest.mark.parametrize("slope", [0.0, 0.5])
    def test_independent_errors(self, slope: float) -> None:
        """5 % of unchanged distances are significant; the covariances have a direction of their own."""
        rng = np.random.default_rng(7)
        spread = np.array([[0.02, 0.01, 0.0], [0.01, 0.05, 0.02], [0.0, 0.02, 0.03]])
        reference, points = rough(60_000, 60.0, 0.0, 8, slope), rough(12_000, 58.0, 0.0, 9, slope)
        reference += rng.normal(0.0, 0.04, reference.shape)
        points += rng.multivariate_normal(np.zeros(3), spread, len(points))
        mine = Cloud(points, np.broadcast_to(spread, (len(points), 3, 3)), shared=False)
        found = metrics(m3c2_sums(mine, np.ones(len(points), np.bool_), cloud(reference, 0.04), 0.245))
        assert found["n"] > 2000
        # Neighbouring cylinders overlap: some 1,500 independent ones, four sigmas of their share.
        assert 0.027 < found["significant_share"] < 0.073

    @pytest.mark.parametrize(("shared", "low", "high"), [(True, 0.02, 0.08), (False, 0.2, 0.4)])
    def test_errors_in_common_do_not_average_away(self, shared: bool, low: float, high: float) -> None:
        """Patches of 5 m with an error each, as of a frame's pose: taken for independent they look like change."""
        rng = np.random.default_rng(10)
        points = rough(30_000, 100.0, 0.0, 11)
        patch = np.floor(points[:, :2] / 5.0).astype(np.int64) + 10
        points[:, 2] += rng.normal(0.0, 0.2, (21, 21))[patch[:, 0], patch[:, 1]]
        found = metrics(sums(cloud(points, 0.2, shared=shared), cloud(rough(120_000, 104.0, 0.02, 12), 0.02)))
        assert low < found["significant_share"] < high

    def test_one_point_has_its_own_covariance(self) -> None:
        point = Cloud(np.array([[0.5, 0.5, 0.1]]), np.diag([9.0, 9.0, 0.04])[None], shared=True)
        reference = cloud(rough(2000, 8.0, 0.0, 13), 0.05)
        count = np.sum(np.hypot(*(reference.p_in_enu_m[:, :2] - 0.5).T) <= RADIUS_M)
        found = metrics(sums(point, reference))
        assert found["n"] == 1
        assert found["lod95_median_m"] == pytest.approx(1.959964 * np.sqrt(0.04 + 0.05**2 / count), rel=1e-6)
        moved = metrics(sums(point, reference, translation_covariance=np.diag([1.0, 1.0, 0.09])))
        assert moved["lod95_median_m"] == pytest.approx(1.959964 * np.sqrt(0.13 + 0.05**2 / count), rel=1e-6)

    def test_a_reference_with_errors_in_common(self) -> None:
        point = Cloud(np.array([[0.5, 0.5, 0.1]]), np.diag([9.0, 9.0, 0.04])[None], shared=True)
        found = metrics(sums(point, cloud(rough(2000, 8.0, 0.0, 13), 0.3, shared=True)))
        assert found["lod95_median_m"] == pytest.approx(1.959964 * np.sqrt(0.04 + 0.09), rel=1e-6)


class TestShards:
    def test_core_points_are_one_per_cube_near_its_middle(self) -> None:
        p = np.random.default_rng(14).uniform(-5.0, 5.0, (3000, 3)) * [1.0, 1.0, 0.1]
        core = p[core_points(p)]
        cube = np.floor(p / CORE_M)
        assert len(core) == len(np.unique(cube, axis=0)) == len(np.unique(np.floor(core / CORE_M), axis=0))
        assert np.all(np.diff(core_points(p)) > 0)
        middle = np.linalg.norm(core - (np.floor(core / CORE_M) + 0.5) * CORE_M, axis=1)
        for centre, off in zip(np.floor(core / CORE_M), middle, strict=True):
            mine = p[(cube == centre).all(axis=1)]
            assert np.linalg.norm(mine - (centre + 0.5) * CORE_M, axis=1).min() == pytest.approx(off)

    @settings(max_examples=10)
    @given(seed=st.integers(0, 2**32 - 1), shards=st.integers(1, 4))
    def test_parts_are_the_whole(self, seed: int, shards: int) -> None:
        rng = np.random.default_rng(seed)
        reference, points = cloud(rough(1500, 10.0, 0.02, 15), 0.02), cloud(rough(400, 9.0, 0.1, seed), 0.1)
        shard = rng.integers(0, shards, 400)
        parts = [m3c2_sums(points, shard == i, reference, SPACING_M) for i in range(shards)]
        total, whole = M3C2Sums.total(reversed(parts)), sums(points, reference)
        assert total is not None
        np.testing.assert_array_equal(total.distances.key, whole.distances.key)
        np.testing.assert_array_equal(total.distances.values, whole.distances.values)
        assert total.metrics() == whole.metrics()

    def test_nothing_to_compare(self) -> None:
        nothing, some = cloud(np.zeros((0, 3)), 0.1), cloud(rough(500, 8.0, 0.0, 16), 0.1)
        for points, reference in ((nothing, some), (some, nothing), (nothing, nothing)):
            assert sums(points, reference).metrics() is None
        away = Cloud(raised(some.p_in_enu_m, 9.0), some.covariance, shared=True)
        assert sums(away, some).metrics() is None
        assert M3C2Sums.total([]) is None


class TestTiles:
    def test_covariances_of_our_own_export(self, tmp_path: Path) -> None:
        columns = synthetic_columns(200)
        write_points(tmp_path / "points", columns, CRS("EPSG:32617+5703"))
        dataset = PointDataset(tmp_path / "points")
        write_las(dataset, tmp_path / "points.laz", compressed=True)
        found = tile_covariance(laspy.read(tmp_path / "points.laz").points)
        assert found is not None
        table = [row for group in dataset.tables() for row in group.to_pylist()]
        assert found.shape == (200, 3, 3)
        for row, covariance in zip(table, found, strict=True):
            np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [row[f"sigma_{axis}_m"] for axis in "xyz"])
            np.testing.assert_allclose(covariance[0, 1:], [row["cov_xy"], row["cov_xz"]])
            np.testing.assert_allclose(covariance, covariance.T)
            assert covariance[1, 2] == row["cov_yz"]

    def test_other_tiles_have_none(self) -> None:
        las = laspy.create(point_format=6, file_version="1.4")
        las.x = np.arange(5.0)
        assert tile_covariance(las.points) is None
        las.add_extra_dim(laspy.ExtraBytesParams("sigma_x", "f4"))
        assert tile_covariance(las.points) is None
