"""A run's matches refined again under other logs, in this process and without being made anew: for many redraws."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from redraws import times_of

from pipeline.engine.tables import parquet_files, read_table
from pipeline.flight import PairRow, camera_by_frame, cameras_of, poses_of, relative_poses_of, selected_pairs
from pipeline.geometry.poses import Pose, RelativePose
from pipeline.refinement.flight.flight import Found, RefinedFlight, refine_flight
from pipeline.refinement.flight.stars import Stars, stars_by_ref
from pipeline.refinement.logged import Log, as_logged
from pipeline.refinement.matched import Matched, by_pair
from pipeline.refinement.near import together
from pipeline.refinement.pair import refine_pair
from pipeline.refinement.rows import FLIGHT, PAIR, RefinedPair, pair_row
from schemas import RELATIVE_POSES


@dataclass(frozen=True, slots=True)
class Refit:
    """What refinement made of one log.

    Args:
        relative: Relative poses by pair.
        median_px: Median epipolar residual of every pair under them.
        found: The shared errors; none but in mode flight.
    """

    relative: dict[str, RelativePose]
    median_px: dict[str, float]
    found: tuple[Found, ...]


@dataclass(frozen=True)
class Matches:
    """The matches of a run.

    Args:
        log: The flight; its poses are replaced.
        matched: The inliers of every pair that has any.
        stars: Of every ref frame, as the stage makes them.
    """

    log: Log
    matched: tuple[Matched, ...]
    stars: tuple[Stars, ...]

    @classmethod
    def of(cls, run: Path) -> Matches:
        """Those of a run that got as far as `match`."""
        frames = read_table(run / "frames.parquet", "frames")
        cameras = camera_by_frame(frames, cameras_of(read_table(run / "cameras.parquet", "cameras")))
        pairs = {pair.pair_id: pair for pair in selected_pairs(read_table(run / "pairs.parquet", "pairs"))}
        log = Log(poses_of(frames), cameras, pairs, times_of(run))
        number = {name: i for i, name in enumerate(log.poses)}
        parts = [
            [Matched.of(pairs[name], some, cameras) for name, some in by_pair(read_table(file, "matches"))]
            for file in parquet_files(run / "matches")
        ]
        stars = tuple(one for part in parts for one in stars_by_ref(part, number))
        return cls(log, tuple(some for part in parts for some in part), stars)

    @property
    def pairs(self) -> list[PairRow]:
        """Those with matches."""
        return [some.pair for some in self.matched]

    def refitted(self, poses: Mapping[str, Pose], mode: str) -> Refit:
        """The relative poses that the stage `refine` would find under another log.

        Args:
            poses: That log, by frame in the flight's order.
            mode: One of refine.mode.
        """
        log = replace(self.log, poses={name: poses[name] for name in self.log.poses})
        flight = refine_flight(log, self.stars, self._near) if mode == FLIGHT else None
        refined = list(self._refined(log, mode, flight))
        rows = [pair_row(some, found) for some, found in zip(self.matched, refined, strict=True)]
        table = RELATIVE_POSES.from_rows(rows)
        names = [some.pair.pair_id for some in self.matched]
        medians = {name: found.after.median_px or 0.0 for name, found in zip(names, refined, strict=True)}
        return Refit(relative_poses_of(table), medians, flight.found if flight else ())

    @property
    def _near(self) -> Sequence[tuple[str, str]]:
        return together(tuple(self.log.poses), list(self.log.pairs.values()))

    def _refined(self, log: Log, mode: str, flight: RefinedFlight | None) -> Iterator[RefinedPair]:
        for some in self.matched:
            if flight is not None:
                yield flight.pair(log, some)
            else:
                yield refine_pair(log, some) if mode == PAIR else as_logged(log, some)
