"""Returns kept on disk by ground cell: those of the tiles, whatever the processes, thinned only where dense."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from pipeline.engine.errors import NothingLeftError
from pipeline.geodesy.local_world import LocalTransform
from pipeline.lidar.nearby import LocalTiles, returns_near
from pipeline.lidar.pieces import is_copc
from pipeline.lidar.store import Store, gather
from pipeline.lidar.tiles import Tile, read_header, read_local_tile

CENTRES = np.array([[0.0, 0.0, 40.0], [30.0, 10.0, 40.0]])
REACH_M = 60.0


def in_turn(function: Callable[[Sequence[Any]], Any], items: Any, *, shard: int, label: str) -> Iterator[Any]:
    del label
    listed = list(items)
    for i in range(0, len(listed), shard):
        yield function(listed[i : i + shard])


def backwards(function: Callable[[Sequence[Any]], Any], items: Any, *, shard: int, label: str) -> Iterator[Any]:
    """As processes that finish in another order do: results come in order all the same."""
    del label
    listed = list(items)
    shards = [listed[i : i + shard] for i in range(0, len(listed), shard)]
    yield from reversed([function(one) for one in reversed(shards)])


def write(path: Path, points: np.ndarray, classes: np.ndarray | int = 1) -> Path:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.zeros(3)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.classification = np.broadcast_to(np.asarray(classes, np.uint8), len(points))
    las.write(path)
    return path


def ground(count: int, seed: int, reach: float = 150.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-reach, reach, (count, 2)), rng.uniform(0.0, 5.0, count)]).round(3)


def tiles(folder: Path, *parts: np.ndarray) -> LocalTiles:
    return LocalTiles(tuple(read_local_tile(write(folder / f"{i}.laz", part)) for i, part in enumerate(parts)))


def rows(points: np.ndarray) -> np.ndarray:
    return points[np.lexsort(points.T)]


def stored(folder: Path, local: LocalTiles, spread: Callable[..., Iterator[Any]] = in_turn) -> Store:
    return gather(spread, local, CENTRES, REACH_M, folder, focal_px=100.0)


def test_sparse_returns_are_those_of_the_tiles(tmp_path: Path) -> None:
    local = tiles(tmp_path, ground(6_000, 1), ground(4_000, 2))
    store = stored(tmp_path / "store", local)
    for some in (CENTRES, CENTRES[:1], CENTRES[1:]):
        found, expected = store.near(some, REACH_M), returns_near(local, some, REACH_M)
        assert len(expected) > 500
        assert rows(found) == pytest.approx(rows(expected), abs=1e-4)


def test_neither_processes_nor_order_change_them(tmp_path: Path) -> None:
    local = tiles(tmp_path, ground(6_000, 1), ground(4_000, 2), ground(5_000, 3))
    one, other = stored(tmp_path / "a", local), stored(tmp_path / "b", local, backwards)
    assert np.array_equal(one.near(CENTRES, REACH_M), other.near(CENTRES, REACH_M))


def test_dense_returns_are_thinned_to_some_that_are_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dense = ground(400_000, 4, reach=40.0)
    local = tiles(tmp_path, dense)
    # Tiles in the run's own frame are sweeps and stay whole; a survey from the air is of another kind.
    assert len(stored(tmp_path / "whole", local).near(CENTRES, REACH_M)) == len(returns_near(local, CENTRES, REACH_M))
    monkeypatch.setattr(LocalTiles, "from_above", property(lambda _: True))
    found = stored(tmp_path / "store", local).near(CENTRES, REACH_M)
    assert 0.002 * len(dense) < len(found) < 0.1 * len(dense)
    there = {tuple(point) for point in np.rint(dense * 1000).astype(int)}
    assert all(tuple(point) in there for point in np.rint(found[::500] * 1000).astype(int))


def test_memory_has_a_limit(tmp_path: Path) -> None:
    store = stored(tmp_path / "store", tiles(tmp_path, ground(20_000, 5, reach=60.0)))
    whole, some = store.near(CENTRES, REACH_M), store.near(CENTRES, REACH_M, most=2_000)
    assert len(some) <= 2_100 < len(whole)
    assert len(some) > 500


def test_noise_alone_is_told_with_its_classes(tmp_path: Path) -> None:
    points = ground(2_000, 6)
    path = write(tmp_path / "noise.laz", points, np.where(np.arange(2_000) < 1_500, 7, 18))
    with pytest.raises(NothingLeftError) as caught:
        stored(tmp_path / "store", LocalTiles((read_local_tile(path),)))
    assert caught.value.code == "E-LIDAR-12"
    assert "of class 7" in str(caught.value)
    assert "of class 18" in str(caught.value)


def test_any_other_class_counts(tmp_path: Path) -> None:
    points = ground(3_000, 7)
    path = write(tmp_path / "never_classified.laz", points, 0)
    assert len(stored(tmp_path / "store", LocalTiles((read_local_tile(path),))).near(CENTRES, REACH_M)) > 400


@pytest.mark.real
def test_a_copc_tile_by_nodes_is_the_tile_by_chunks(shared: Path, tmp_path: Path) -> None:
    paths = sorted((shared / "data" / "lidar").rglob("*.copc.laz"))
    assert paths
    for number, path in enumerate(paths):
        header = read_header(path)
        # As if it lay in the run's own frame: what is compared is the reading.
        lower, upper = (tuple(float(x) for x in corner) for corner in (header.mins, header.maxs))
        tile = Tile(path, LocalTransform().crs.to_wkt(), int(header.point_count), lower, upper)
        assert is_copc(tile)
        centre, reach = np.mean([lower, upper], axis=0)[None], (upper[0] - lower[0]) / 5.0
        local = LocalTiles((tile,))
        store = gather(in_turn, local, centre, reach, tmp_path / str(number), focal_px=1e6)
        found = store.near(centre, reach)
        las = laspy.read(path)
        whole = np.column_stack([las.x, las.y, las.z])[~np.isin(las.classification, (7, 18))]
        expected = whole[np.hypot(*(whole[:, :2] - centre[0, :2]).T) <= reach]
        assert rows(returns_near(local, centre, reach)) == pytest.approx(rows(expected))
        assert len(expected) > 10
        assert len(expected) < header.point_count
        assert rows(found) == pytest.approx(rows(expected), abs=2e-3)
