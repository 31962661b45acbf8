"""What depths under injected errors are compared with: the scored pixels, or the run's own depths."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.engine.errors import InputError
from pipeline.engine.tables import dataset, explained
from pipeline.flight import column, columns
from pipeline.geometry.arrays import Floats

LIDAR, OWN = "the reference of score", "the run's own depths"


@dataclass(frozen=True, slots=True)
class Reference:
    """Reference depths at the pixels of the run's matches.

    Args:
        kind: LIDAR or OWN.
        place: File or folder.
        name: Of the table, for people.
        value: Its column with the depth.
        where: Which of its rows.
    """

    kind: str
    place: Path
    name: str
    value: str
    where: pc.Expression

    @classmethod
    def of(cls, scores: Path, depths: Path, method: str) -> Reference:
        """The scored pixels where they are those of the matches, else the depths that a method keeps.

        Args:
            scores: The folder `scores`, which need not exist.
            depths: The dataset `depths`.
            method: The published one.
        """
        own, pixels = pc.field("method") == method, scores / "pixels.parquet"
        if pixels.exists() and not scored_elsewhere(scores):
            return cls(LIDAR, pixels, "pixels", "reference_m", own)
        return cls(OWN, depths, "depths", "depth_m", own & pc.field("kept"))

    def pairs(self) -> set[str]:
        """The pairs that have any."""
        names: set[str] = set()
        with explained(self.place, self.name):
            for batch in dataset(self.place).to_batches(columns=["pair_id"], filter=self.where):
                names.update(pc.unique(batch.column("pair_id")).to_pylist())
        return names

    def rows(self, pair_ids: Iterable[str]) -> pa.Table:
        """Those of some pairs."""
        chosen = self.where & pc.field("pair_id").isin(pa.array(list(pair_ids), pa.string()))
        with explained(self.place, self.name):
            return dataset(self.place).to_table(columns=["pair_id", "u", "v", self.value], filter=chosen)

    def at(self, rows: pa.Table, pixels: Floats) -> Floats:
        """(n,) m at pixels (n, 2) of ref; NaN where there is none.

        Args:
            rows: Those of one pair.
            pixels: As in `matches`.
        """
        known, wanted = (uv[:, 0] + 1j * uv[:, 1] for uv in (columns(rows, ("u", "v")), pixels))
        if not known.size:
            return np.full(len(wanted), np.nan)
        order = np.argsort(known, kind="stable")
        place = order[np.minimum(np.searchsorted(known, wanted, sorter=order), len(known) - 1)]
        return np.where(known[place] == wanted, np.asarray(column(rows, self.value), np.float64)[place], np.nan)


def scored_elsewhere(scores: Path) -> bool:
    """Whether the pixels in a folder `scores` are those of the truth, dense, and not those of the matches.

    Raises:
        InputError: Its metrics.json is damaged.
    """
    path = scores / "metrics.json"
    if not path.exists():
        return False
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(
            "E-SENS-02", "the scores cannot be read", where=str(path), found=str(error), hint="rerun score"
        ) from error
    return bool(found.get("truth", {}).get("correspondence") == "dense")
