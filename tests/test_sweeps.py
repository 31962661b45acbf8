"""Sweeps as tiles: each return at the pose of its own instant, one mean per voxel, bytes and memory bounded."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import laspy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from pipeline.geodesy.local_world import is_engineering
from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import rotation_from_vector
from pipeline.lidar import sweeps as module
from pipeline.lidar import voxels
from pipeline.lidar.pieces import read_returns
from pipeline.lidar.spacing import surface_spacing_m
from pipeline.lidar.sweeps import on_clock, placed, write_sweeps
from pipeline.lidar.tiles import read_local_tile
from pipeline.lidar.voxels import Voxels, append, by_tile, merged
from pipeline.sources.records import Nanoseconds, Sweep

START_NS = 1_717_229_523_000_000_000
TURN_RAD_S, SPEED_M_S = 1.5, np.array([3.0, -2.0, 0.5])
BOUNDED = """
import sys
from pathlib import Path
import numpy as np
from pipeline.lidar.sweeps import write_sweeps
from pipeline.sources.records import Sweep
rng = np.random.default_rng(0)
sweeps = (Sweep(k, rng.uniform(1.0, 15.0, (100_000, 3)), np.zeros(100_000)) for k in range(60))
still = lambda t: (np.broadcast_to(np.eye(3), (len(t), 3, 3)), np.zeros((len(t), 3)))
written = write_sweeps(sweeps, still, Path(sys.argv[1]))
# Not ru_maxrss: that begins with what the process that started this one had.
peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
print(written, int(peak.split()[1]) / 1024)
"""


def moving(instants: Nanoseconds) -> tuple[Floats, Floats]:
    """A sensor that turns and moves all the time."""
    seconds = (instants - START_NS) / 1e9
    turn = np.stack([0.2 * seconds, 0.0 * seconds, TURN_RAD_S * seconds], axis=1)
    return rotation_from_vector(turn), seconds[:, None] * SPEED_M_S + (0.0, 0.0, 2.0)


def box_sweeps(count: int = 20, returns: int = 3000) -> Iterator[tuple[Sweep, Floats]]:
    """Sweeps of the six faces of a room, with the true places of the returns; 100 ms each."""
    rng = np.random.default_rng(4)
    # On no voxel's face, where rounding would decide.
    half = np.array([20.013, 12.017, 6.011])
    for k in range(count):
        delay = np.sort(rng.uniform(0.0, 0.1, returns))
        time_ns = START_NS + k * 100_000_000
        rotation, centre = moving(time_ns + np.rint(delay * 1e9).astype(np.int64))
        direction = rng.normal(size=(returns, 3))
        with np.errstate(divide="ignore"):
            reach = np.min((np.sign(direction) * half - centre) / direction, axis=1)
        place = centre + reach[:, None] * direction
        in_sensor = np.einsum("nij,ni->nj", rotation, place - centre)
        yield Sweep(time_ns, in_sensor, delay), place


def written_points(folder: Path) -> Floats:
    everywhere = np.full(3, -1e9), np.full(3, 1e9)
    chunks = [
        chunk for path in sorted(folder.glob("*.laz")) for chunk in read_returns(read_local_tile(path), *everywhere)
    ]
    return np.concatenate(chunks)


def means(points: Floats, voxel_m: float) -> Floats:
    """The oracle: voxels in a dictionary."""
    found: dict[tuple[int, ...], list[Floats]] = {}
    for point in points:
        found.setdefault(tuple(np.floor(point / voxel_m).astype(int)), []).append(point)
    return np.array([np.mean(group, axis=0) for group in found.values()])


def test_every_return_is_placed_by_the_pose_of_its_own_instant() -> None:
    for sweep, place in box_sweeps(5):
        assert np.abs(placed(sweep, moving, 0.0, 100.0) - place).max() < 1e-6
    # With the pose of the stamp the sweep is smeared by what the sensor turns in it: 0.15 rad at 12 m and more.
    frozen = Sweep(sweep.time_ns, sweep.p_in_sensor_m, np.zeros_like(sweep.delay_s))
    off = np.linalg.norm(placed(frozen, moving, 0.0, 100.0) - place, axis=1)
    assert 0.3 < np.median(off) < 3.0


def test_a_lidar_whose_clock_is_another_is_placed_where_it_was() -> None:
    for sweep, place in box_sweeps(3):
        # Its clock shows 0.25 s less than that of the poses.
        late = Sweep(sweep.time_ns - 250_000_000, sweep.p_in_sensor_m, sweep.delay_s)
        assert np.abs(placed(late, on_clock(moving, 0.25), 0.0, 100.0) - place).max() < 1e-6
        assert np.abs(placed(late, moving, 0.0, 100.0) - place).max() > 0.1


def test_rotations_take_the_sensor_to_the_world() -> None:
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()

    def pose_at(instants: Nanoseconds) -> tuple[Floats, Floats]:
        return np.broadcast_to(turn, (len(instants), 3, 3)), np.tile([10.0, 20.0, 30.0], (len(instants), 1))

    one = Sweep(0, np.array([[5.0, 0.0, 1.0]]), np.zeros(1))
    np.testing.assert_allclose(placed(one, pose_at, 0.5, 100.0), [[10.0, 25.0, 31.0]])


def test_what_has_no_pose_or_is_out_of_range_is_left_out() -> None:
    def early(instants: Nanoseconds) -> tuple[Floats, Floats]:
        known = (instants < 50)[:, None]
        rotation = np.where(known[..., None], np.eye(3), np.nan)
        return rotation, np.where(known, [0.0, 0.0, 0.0], np.nan)

    points = np.array([[1.0, 0, 0], [2, 0, 0], [0.3, 0, 0], [0, 120.0, 0], [np.nan, 1, 1], [3, 0, 0], [4, 0, 0]])
    delay = np.array([0.0, 60e-9, 0.0, 0.0, 0.0, np.nan, 40e-9])
    assert placed(Sweep(0, points, delay), early, 0.5, 100.0).tolist() == [[1.0, 0.0, 0.0], [4.0, 0.0, 0.0]]


def test_a_damaged_pose_places_nothing(tmp_path: Path) -> None:
    def far(instants: Nanoseconds) -> tuple[Floats, Floats]:
        return np.broadcast_to(np.eye(3), (len(instants), 3, 3)), np.full((len(instants), 3), 1e300)

    assert write_sweeps([Sweep(0, np.ones((4, 3)), np.zeros(4))], far, tmp_path / "sweeps") == 0
    assert list((tmp_path / "sweeps").iterdir()) == []


@pytest.mark.parametrize("voxel_m", [0.05, 0.3])
def test_tiles_hold_one_mean_per_voxel_however_the_work_is_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, voxel_m: float
) -> None:
    places = np.concatenate([place for _, place in box_sweeps()])
    want = means(places, voxel_m)
    for name, batch in (("whole", 10**9), ("cut", 7000)):
        monkeypatch.setattr(module, "_BATCH_RETURNS", batch)
        count = write_sweeps((sweep for sweep, _ in box_sweeps()), moving, tmp_path / name, voxel_m)
        found = written_points(tmp_path / name)
        assert count == len(found) == len(want)
        distance, nearest = cKDTree(want).query(found)
        # Half a millimetre of the file's scale, on each axis.
        assert distance.max() < 1e-3
        assert len(set(nearest.tolist())) == len(want)
    assert len(list((tmp_path / "cut").iterdir())) == 4


def test_the_mean_is_nearer_to_the_surface_than_one_return(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    wall = np.column_stack([rng.uniform(-2.0, 2.0, (400_000, 2)), np.full(400_000, 5.025)])
    noisy = wall + rng.normal(0.0, 0.008, wall.shape)

    def still(instants: Nanoseconds) -> tuple[Floats, Floats]:
        return np.broadcast_to(np.eye(3), (len(instants), 3, 3)), np.zeros((len(instants), 3))

    write_sweeps([Sweep(0, noisy, np.zeros(len(noisy)))], still, tmp_path / "sweeps")
    points = written_points(tmp_path / "sweeps")
    inner = points[(np.abs(points - (0.0, 0.0, 5.025)) < (1.9, 1.9, 0.02)).all(axis=1)]
    # Some 60 returns a voxel: 8 mm become 1 mm.
    assert 5700 < len(inner) < 5850
    assert 0.0005 < np.std(inner[:, 2] - 5.025) < 0.002
    assert 0.045 < surface_spacing_m(points) < 0.055


def test_same_sweeps_same_bytes_and_an_interrupted_run_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "b" / ".spill").mkdir(parents=True)
    (tmp_path / "b" / ".spill" / "s_0_0").write_bytes(b"half a record")
    (tmp_path / "b" / "s_999_999.laz").write_bytes(b"of other settings")
    for name in ("a", "b"):
        write_sweeps((sweep for sweep, _ in box_sweeps(3)), moving, tmp_path / name)
    a, b = ({path.name: path.read_bytes() for path in sorted((tmp_path / name).iterdir())} for name in ("a", "b"))
    assert a == b
    assert all(name.endswith(".laz") for name in a)


def test_tiles_are_laz_with_the_engineering_crs(tmp_path: Path) -> None:
    write_sweeps((sweep for sweep, _ in box_sweeps(3)), moving, tmp_path)
    for path in tmp_path.iterdir():
        with laspy.open(path) as reader:
            header = reader.header
            assert (str(header.version), header.point_format.id, header.are_points_compressed) == ("1.4", 6, True)
            assert str(header.creation_date) == "2024-06-01"
            crs = header.parse_crs()
            assert is_engineering(crs)
            assert [axis.direction for axis in crs.axis_info] == ["east", "north", "up"]
        tile = read_local_tile(path)
        east, north = (int(text) for text in path.stem.split("_")[1:3])
        assert east <= tile.minimum[0] <= tile.maximum[0] <= east + 32
        assert north <= tile.minimum[1] <= tile.maximum[1] <= north + 32


def test_a_log_that_counts_from_boot_has_a_day_too(tmp_path: Path) -> None:
    sweep, _ = next(box_sweeps(1))
    early = Sweep(-5, sweep.p_in_sensor_m, sweep.delay_s)
    write_sweeps([early], lambda t: moving(t + START_NS), tmp_path)
    assert str(laspy.read(next(tmp_path.glob("*.laz"))).header.creation_date) == "1970-01-01"


def test_voxels_too_small_to_number_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"voxels of 0\.0001 m"):
        write_sweeps([], moving, tmp_path, 1e-4)
    assert write_sweeps([], moving, tmp_path / "none") == 0
    assert list((tmp_path / "none").iterdir()) == []


def test_a_tile_too_full_for_memory_comes_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MOST_VOXELS", 500)
    monkeypatch.setattr(voxels, "_LEAST_READ", 400)
    monkeypatch.setattr(module, "_BATCH_RETURNS", 5000)
    sweeps = [sweep for sweep, _ in box_sweeps(4)]
    count = write_sweeps(sweeps, moving, tmp_path / "parts")
    assert count == len(written_points(tmp_path / "parts"))
    assert len(list((tmp_path / "parts").glob("*_1.laz"))) == 4
    whole = len(means(np.concatenate([place for _, place in box_sweeps(4)]), 0.05))
    assert whole <= count < 1.2 * whole


@pytest.mark.slow
def test_memory_is_bounded(tmp_path: Path) -> None:
    # Six million returns in as many voxels of one tile: the fullest that can be.
    done = subprocess.run(
        [sys.executable, "-c", BOUNDED, str(tmp_path)], capture_output=True, text=True, check=True, timeout=300
    )
    written, peak_mib = (float(text) for text in done.stdout.split())
    assert 5.5e6 < written <= 6e6
    assert peak_mib < 1024


POINT = st.tuples(*(st.floats(-200.0, 200.0),) * 3)


@settings(max_examples=60)
@given(st.lists(POINT, min_size=1, max_size=60), st.sampled_from([0.05, 0.25, 2.0]))
def test_any_points_keep_their_number_and_their_voxels(points: list[tuple[float, ...]], voxel_m: float) -> None:
    given_points = np.array(points)
    per_tile = round(32.0 / voxel_m)
    total, found = 0, []
    for tile, occupied in by_tile(given_points, voxel_m, per_tile):
        total += int(occupied.count.sum())
        found.append(occupied.means((tile[0] * per_tile, tile[1] * per_tile), voxel_m))
    assert total == len(given_points)
    want = means(given_points, voxel_m)
    got = np.concatenate(found)
    assert len(got) == len(want)
    for point in want:
        assert np.min(np.linalg.norm(got - point, axis=1)) < 1e-6


@settings(max_examples=40)
@given(st.lists(st.lists(st.integers(0, 20), max_size=30), max_size=6))
def test_what_is_appended_is_merged(tmp_path_factory: pytest.TempPathFactory, parts: list[list[int]]) -> None:
    path = tmp_path_factory.mktemp("voxels") / "tile"
    path.touch()
    for keys in parts:
        n = len(keys)
        append(path, Voxels(np.array(keys, np.uint64), np.ones(n, np.int64), np.ones((n, 3)) * 0.5).thinned())
    flat = [key for keys in parts for key in keys]
    found = list(merged(path, 1000))
    assert len(found) == (1 if flat else 0)
    for part in found:
        assert dict(zip(part.key.tolist(), part.count.tolist(), strict=True)) == {k: flat.count(k) for k in flat}
        np.testing.assert_allclose(part.sum_m, part.count[:, None] * np.full(3, 0.5))


@pytest.mark.parametrize("spacing", [0.1, 0.4])
def test_spacing_on_walls_and_ceilings(spacing: float) -> None:
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(0, 12, spacing), np.arange(0, 12, spacing)), axis=-1).reshape(-1, 2)
    faces = []
    for axis, at in ((0, 0.0), (0, 12.0), (1, 0.0), (2, 0.0), (2, 12.0)):
        moved = grid + rng.uniform(0.0, spacing, grid.shape)
        faces.append(np.insert(moved, axis, at, axis=1))
    points = np.concatenate(faces)
    assert 0.85 * spacing < surface_spacing_m(points) < 1.2 * spacing
    assert surface_spacing_m(points[:5]) == np.inf
