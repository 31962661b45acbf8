"""Sums of the errors of all scored pixels, a piece at a time: by size, over the image, on the ground."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.engine.tables import dataset, explained
from pipeline.flight import camera_by_frame, cameras_of, column, columns, placements_of
from pipeline.geometry.arrays import AnyArray, Bools, Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Placement
from pipeline.reporting.gathered import RunData
from pipeline.reporting.ground import Ground

# Bins of the histogram: 0.02 % wide, to 100 % on either side; what lies beyond is in the outermost ones.
_BIN_PERCENT, _BINS = 0.02, 10_000
# Cells across the longer side of the image, and of the plan.
_IMAGE_CELLS, _PLAN_CELLS = 32, 140
# Of the reference, what the extent of the plan is found from.
_EVERY = 16
_COLUMNS = ("frame_id", "method", "u", "v", "depth_m", "reference_m")


@dataclass(frozen=True, slots=True)
class Plan:
    """A grid of square cells on the ground.

    Args:
        corner: (2,) of the first cell, m, in the frame of the maps.
        edge: Of a cell, m.
        shape: Rows (north) and columns (east).
    """

    corner: Floats
    edge: float
    shape: tuple[int, int]

    @staticmethod
    def around(places: Floats) -> Plan:
        """The grid that holds some places, (n, 2) m, with cells of a round size."""
        low, high = places.min(axis=0), places.max(axis=0)
        wanted = max(float((high - low).max()), 1e-2) / _PLAN_CELLS
        decade = 10.0 ** np.floor(np.log10(wanted))
        edge = float(decade * next(step for step in (1.0, 2.0, 5.0, 10.0) if step * decade >= wanted))
        corner = np.floor(low / edge) * edge - edge
        across, down = (np.ceil((high - corner) / edge) + 1.0).astype(np.int64)
        return Plan(corner, edge, (int(down), int(across)))


@dataclass(frozen=True, slots=True)
class ErrorSums:
    """What the figures of errors are made of; each array has a first axis of methods.

    Args:
        methods: Their names, the published one first.
        histogram: (m, 10000) pixels by signed relative error.
        image_px: Width and height of the images that `image_sum` is over: those of the size most frames have.
        image_sum: (m, rows, columns) absolute relative errors, summed.
        image_n: (m, rows, columns) pixels.
        plan: The grid on the ground.
        plan_sum: (m, rows, columns) signed errors, m, summed.
        plan_n: (m, rows, columns) pixels.
    """

    methods: tuple[str, ...]
    histogram: Ints
    image_px: tuple[int, int]
    image_sum: Floats
    image_n: Ints
    plan: Plan
    plan_sum: Floats
    plan_n: Ints

    def limit_percent(self, share: float) -> float:
        """The absolute error within which a share of the published method's pixels lies, %."""
        counts = self.histogram[0]
        either = counts[_BINS // 2 :] + counts[: _BINS // 2][::-1]
        index = int(np.searchsorted(np.cumsum(either), share * either.sum()))
        return max((index + 1) * _BIN_PERCENT, _BIN_PERCENT)

    @staticmethod
    def rebinned(counts: Ints, limit_percent: float, bins: int) -> tuple[Floats, Floats, float]:
        """A histogram in fewer bins.

        Args:
            counts: (10000,) of one method.
            limit_percent: Where it ends on either side.
            bins: Some number of bins.

        Returns:
            Centres of the bins (%), share of all pixels in each, and the share beyond the ends.
        """
        each = max(round(2.0 * limit_percent / bins / _BIN_PERCENT), 1)
        half = min(-(-round(limit_percent / _BIN_PERCENT) // each) * each, _BINS // 2 // each * each)
        inner = counts[_BINS // 2 - half : _BINS // 2 + half].reshape(-1, each).sum(axis=1)
        total = max(int(counts.sum()), 1)
        centres = (np.arange(len(inner)) + 0.5) * each * _BIN_PERCENT - half * _BIN_PERCENT
        shares: Floats = inner / total
        return np.asarray(centres, np.float64), shares, 1.0 - float(shares.sum())


@dataclass(frozen=True, slots=True)
class _Flight:
    """The cameras and where they stand, and the frame of the maps."""

    cameras: Mapping[str, Camera]
    placements: Mapping[str, Placement]
    ground: Ground

    def places(self, frame: AnyArray, pixels: Floats, depth_m: Floats) -> Floats:
        """(n, 2) m on the ground of pixels with depths."""
        points = np.empty((len(frame), 3))
        for name in dict.fromkeys(frame):
            here = frame == name
            placed = self.placements[name]
            in_cam = depth_m[here, None] * self.cameras[name].rays(pixels[here])
            points[here] = placed.centre + in_cam @ placed.rotation.T
        out: Floats = self.ground.place(points)[:, :2]
        return out


def error_sums(run: RunData, ground: Ground) -> ErrorSums | None:
    """The sums over all kept pixels of a scored run, of which a piece at a time is in memory.

    Args:
        run: The run.
        ground: The frame of the maps.

    Returns:
        The sums; None if no pixel is kept.

    Raises:
        InputError: The table of pixels cannot be read.
    """
    path = run.paths["scores"] / "pixels.parquet"
    flight = _Flight(camera_by_frame(run.frames, cameras_of(run.cameras)), placements_of(run.poses), ground)
    methods, plan = _first_look(path, flight, run.setting("depth", "methods"))
    if plan is None:
        return None
    sizes = Counter((camera.width, camera.height) for camera in flight.cameras.values())
    image_px = max(sizes, key=lambda size: (sizes[size], size))
    longest = max(image_px)
    grid = tuple(max(round(_IMAGE_CELLS * side / longest), 1) for side in (image_px[1], image_px[0]))
    sums = ErrorSums(
        methods,
        np.zeros((len(methods), _BINS), np.int64),
        image_px,
        np.zeros((len(methods), *grid)),
        np.zeros((len(methods), *grid), np.int64),
        plan,
        np.zeros((len(methods), *plan.shape)),
        np.zeros((len(methods), *plan.shape), np.int64),
    )
    for table in _pieces(path):
        _add(sums, table, flight)
    return sums


def _first_look(path: Path, flight: _Flight, order: Sequence[str] | None) -> tuple[tuple[str, ...], Plan | None]:
    """The methods, and the grid that holds what they see."""
    names: set[str] = set()
    places = [np.empty((0, 2))]
    for table in _pieces(path):
        names.update(pc.unique(table.column("method")).to_pylist())
        some = table.take(np.arange(0, table.num_rows, _EVERY))
        found = flight.places(*_at(some), np.asarray(column(some, "reference_m"), np.float64))
        places.append(found[np.isfinite(found).all(axis=1)])
    listed = list(order or ())
    methods = tuple(sorted(names, key=lambda name: (listed.index(name) if name in listed else len(listed), name)))
    together = np.concatenate(places)
    return methods, Plan.around(together) if len(together) else None


def _pieces(path: Path) -> Iterator[pa.Table]:
    kept = pc.field("kept") & pc.field("depth_m").is_valid()
    with explained(path, "pixels"):
        for batch in dataset(path).to_batches(columns=list(_COLUMNS), filter=kept):
            if batch.num_rows:
                yield pa.Table.from_batches([batch])


def _at(table: pa.Table) -> tuple[AnyArray, Floats]:
    return np.asarray(column(table, "frame_id"), object), columns(table, ("u", "v"))


def _add(sums: ErrorSums, table: pa.Table, flight: _Flight) -> None:
    frame, pixels = _at(table)
    method = _numbers(table, sums.methods)
    depth, reference = (np.asarray(column(table, name), np.float64) for name in ("depth_m", "reference_m"))
    relative = depth / reference - 1.0
    bins = np.clip(np.floor(100.0 * relative / _BIN_PERCENT) + _BINS // 2, 0, _BINS - 1).astype(np.int64)
    np.add.at(sums.histogram, (method, bins), 1)
    width, height = sums.image_px
    same = {name for name, camera in flight.cameras.items() if (camera.width, camera.height) == sums.image_px}
    in_image = np.array([name in same for name in frame], np.bool_)
    rows, across = sums.image_n.shape[1:]
    cell = np.floor((pixels + 0.5) * (across, rows) / (width, height)).astype(np.int64)
    cell = np.clip(cell, 0, (across - 1, rows - 1))
    _count(sums.image_sum, sums.image_n, method, cell, np.abs(relative), in_image)
    place = (flight.places(frame, pixels, reference) - sums.plan.corner) / sums.plan.edge
    down, east = sums.plan.shape
    inside: Bools = np.all(np.isfinite(place) & (place >= 0.0) & (place < (east, down)), axis=1)
    cell = np.floor(np.where(inside[:, None], place, 0.0)).astype(np.int64)
    _count(sums.plan_sum, sums.plan_n, method, cell, depth - reference, inside)


def _count(total: Floats, n: Ints, method: Ints, cell: Ints, values: Floats, which: Bools) -> None:
    at = (method[which], cell[which, 1], cell[which, 0])
    np.add.at(total, at, values[which])
    np.add.at(n, at, 1)


def _numbers(table: pa.Table, methods: tuple[str, ...]) -> Ints:
    encoded = pc.dictionary_encode(table.column("method").combine_chunks())
    of_code = np.array([methods.index(name) for name in encoded.dictionary.to_pylist()], np.int64)
    out: Ints = of_code[np.asarray(encoded.indices.to_numpy(), np.int64)]
    return out
