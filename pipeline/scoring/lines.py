"""Which pixels are compared: those of the run's own matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.engine.tables import dataset, explained
from pipeline.scoring.depth_rows import AlignedDepths, align
from pipeline.scoring.truth import FrameTruth, FrameView

_COLUMNS = ["pair_id", "frame_id", "u", "v", "method", "depth_m", "sigma_depth_m", "parallax_deg", "kept"]


class NearLines(Protocol):
    """The lines of a few frames."""

    def of(self, frame: FrameView, seen: FrameTruth) -> AlignedDepths:
        """The depths of one of these frames by every method, at the pixels that are compared."""


class Lines(Protocol):
    """Depths by every method at the pixels that are compared; sent to other processes."""

    @property
    def methods(self) -> tuple[str, ...]:
        """Every method, the published one first."""

    def near(self, frames: Sequence[FrameView]) -> NearLines:
        """Those of some frames."""


@dataclass(frozen=True, slots=True)
class SparseLines:
    """The depths that are delivered, at the pixels of the matches.

    Args:
        depths: Folder of the dataset `depths`.
        methods: Every method in it, the published one first.
    """

    depths: Path
    methods: tuple[str, ...]

    def near(self, frames: Sequence[FrameView]) -> AlignedLines:
        """As `Lines.near`.

        Raises:
            InputError: The rows of `depths` do not belong together.
        """
        ids = pa.array([frame.frame_id for frame in frames])
        with explained(self.depths, "depths"):
            rows = dataset(self.depths).to_table(columns=_COLUMNS, filter=pc.field("frame_id").isin(ids))
        return AlignedLines(align(rows, self.methods))


@dataclass(frozen=True, slots=True)
class AlignedLines:
    """Lines of a few frames that do not depend on what these see of the truth.

    Args:
        lines: Of all of them.
    """

    lines: AlignedDepths

    def of(self, frame: FrameView, seen: FrameTruth) -> AlignedDepths:
        """As `NearLines.of`."""
        del seen
        return self.lines.where(np.flatnonzero(self.lines.frame_id == frame.frame_id))


def methods_of(depths: Path, published: str) -> tuple[str, ...]:
    """The methods in a dataset `depths`: the published one first where it is there, the others by name."""
    return tuple(sorted(_distinct(depths, "method"), key=lambda name: (name != published, name)))


def frames_in(depths: Path) -> set[str]:
    """The ref frames in a dataset `depths`."""
    return _distinct(depths, "frame_id")


def _distinct(depths: Path, column: str) -> set[str]:
    names: set[str] = set()
    with explained(depths, "depths"):
        for batch in dataset(depths).to_batches(columns=[column]):
            names.update(pc.unique(batch.column(column)).to_pylist())
    return names
