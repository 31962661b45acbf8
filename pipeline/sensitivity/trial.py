"""Errors tried on pairs of a run, read from its tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from pipeline.depthing import MatchedRays
from pipeline.engine.tables import dataset, explained
from pipeline.flight import PairRow, columns
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import PlacedPair, Pose
from pipeline.refinement.matched import Matched
from pipeline.sensitivity.injected import Injection
from pipeline.sensitivity.pair_errors import PairErrors, PosedPair, Ways, pair_errors
from pipeline.sensitivity.references import Reference
from pipeline.sensitivity.takes import spread

# A take of a few such pairs has thousands, whose mean says more than the pairs are alike.
_MOST_PIXELS = 1000


@dataclass(frozen=True, slots=True)
class Trial:
    """What is tried on pairs; sent to other processes.

    Args:
        matches: The dataset `matches`.
        reference: What depths are compared with.
        poses: The log's, by frame; their sigmas are what counts.
        cameras: By frame.
        placed: Where the run has the cameras of each pair, by pair_id.
        ways: How depths are found.
        cases: The errors.
    """

    matches: Path
    reference: Reference
    poses: Mapping[str, Pose]
    cameras: Mapping[str, Camera]
    placed: Mapping[str, PlacedPair]
    ways: Ways
    cases: tuple[Injection, ...]

    def part(self, pairs: Sequence[PairRow]) -> list[PairErrors]:
        """The errors of some pairs."""
        names = [pair.pair_id for pair in pairs]
        inlier = pc.field("inlier") & pc.field("pair_id").isin(pa.array(names, pa.string()))
        with explained(self.matches, "matches"):
            matches = dataset(self.matches).to_table(filter=inlier)
        rows = self.reference.rows(names)
        return [self._pair(pair, _of(matches, pair), _of(rows, pair)) for pair in pairs]

    def _pair(self, pair: PairRow, matches: pa.Table, rows: pa.Table) -> PairErrors:
        posed = self._posed(pair)
        matched = Matched.of(pair, matches, self.cameras)
        reference_m = self.reference.at(rows, matched.ref_px)
        known = np.flatnonzero(np.isfinite(reference_m))
        chosen = known[spread(len(known), _MOST_PIXELS)]
        covariance = columns(matches, ("cov_uu", "cov_uv", "cov_vv"))[chosen]
        ref_px, src_px = matched.ref_px[chosen], matched.src_px[chosen]
        sampled = MatchedRays.of(ref_px, src_px, posed.ref_camera, posed.src_camera, covariance)
        return pair_errors(posed, matched, sampled, reference_m[chosen], self.ways, self.cases)

    def _posed(self, pair: PairRow) -> PosedPair:
        """Both cameras where the run places them, with the sigmas of the log."""
        placed = self.placed[pair.pair_id]
        ref, src = (
            Pose(at.rotation, at.centre, self.poses[name].own, self.poses[name].common)
            for name, at in ((pair.ref, placed.ref), (pair.src, placed.src))
        )
        return PosedPair(pair, ref, src, self.cameras[pair.ref], self.cameras[pair.src])


def _of(table: pa.Table, pair: PairRow) -> pa.Table:
    return table.filter(pc.equal(table.column("pair_id"), pair.pair_id)).combine_chunks()
