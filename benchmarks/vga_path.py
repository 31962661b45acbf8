"""XFeat at 640 x 480 on two cores: from decoded images of a flight to depths with sigma, and how good these are.

usage: python benchmarks/vga_path.py EXAMPLE

Two processes of one thread each take half of the flight's consecutive pairs; each photo's features are found once. The
photos are decoded and shrunk beforehand. With a GPU the same is done at the full size of the photos, in one process.
"""

from __future__ import annotations

import multiprocessing
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Barrier
from pathlib import Path

from pipeline.engine.threads import limit_threads

# Before numpy is imported: its thread pools are sized then.
limit_threads()

import cv2  # noqa: E402
import numpy as np  # noqa: E402
from flight_truth import FlightTruth  # noqa: E402
from match_sets import Flight, example_run  # noqa: E402

from pipeline.depthing import Limits, MatchedRays, MethodDepths, depths_by  # noqa: E402
from pipeline.engine.errors import MissingPartError  # noqa: E402
from pipeline.geometry.arrays import Bytes, Floats  # noqa: E402
from pipeline.geometry.cameras import Camera  # noqa: E402
from pipeline.geometry.poses import RelativePose, relative_pose  # noqa: E402
from pipeline.geometry.transfer import VirtualView  # noqa: E402
from pipeline.matching.features import Extractor, extract  # noqa: E402
from pipeline.matching.images import read_grey, to_full_pixels  # noqa: E402
from pipeline.matching.matcher import Candidates, Matcher, SearchLimits, View  # noqa: E402
from pipeline.matching.matchers import MatcherSetting, device_of, weights_of  # noqa: E402
from pipeline.matching.pair import match_pair  # noqa: E402
from pipeline.matching.reach import Band  # noqa: E402
from stages.depth import Config as DepthConfig  # noqa: E402
from stages.match import Config as MatchConfig  # noqa: E402

SIZE, FEATURES, TARGET = (640, 480), (2048, 4096), 10.0
PROCESSES, ROUNDS = 2, 3
PARTS = ("features", "candidates", "fit and check", "depths")


@dataclass(frozen=True, slots=True)
class Job:
    """One half of the sequence.

    Args:
        example: Folder of the example.
        run: A run folder with its frames and cameras.
        names: Photos that follow one another.
        size: They are shrunk to; None for as they are.
        features: Most per photo.
        device: Of the network.
    """

    example: Path
    run: Path
    names: tuple[str, ...]
    size: tuple[int, int] | None
    features: int
    device: str = "cpu"


@dataclass(slots=True)
class Spent:
    """What a half took and gave.

    Args:
        pairs: Pairs worked on.
        start_s: Wall clock.
        end_s: Wall clock.
        cpu_s: By part.
        matches: Kept ones, of each pair of one round.
        depths: Kept ones, of each pair of one round.
        errors: Their relative errors, where there is a truth.
    """

    pairs: int = 0
    start_s: float = 0.0
    end_s: float = 0.0
    cpu_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PARTS, 0.0))
    matches: list[int] = field(default_factory=list)
    depths: list[int] = field(default_factory=list)
    errors: list[Floats] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Timed:
    """A matcher whose candidates are timed apart.

    Args:
        matcher: It.
        cpu_s: Gets the time.
    """

    matcher: Matcher
    cpu_s: dict[str, float]

    @property
    def extractor(self) -> Extractor | None:
        """As the matcher's."""
        return self.matcher.extractor

    @property
    def colour(self) -> bool:
        """As the matcher's."""
        return self.matcher.colour

    def candidates(self, ref: View, src: View, pose: RelativePose, limits: SearchLimits) -> Candidates:
        """As the matcher's."""
        start = time.process_time()
        found = self.matcher.candidates(ref, src, pose, limits)
        self.cpu_s["candidates"] += time.process_time() - start
        return found


class Half:
    """One process's work."""

    def __init__(self, job: Job) -> None:
        cv2.setNumThreads(1)
        self.spent = Spent()
        self._job, self._flight, config = job, Flight.of(job.run), MatchConfig.model_validate({})
        self._images: dict[str, Bytes] = {}
        self._cameras: dict[str, Camera] = {}
        for name in job.names:
            image, camera = read_grey(self._flight.photos[name]), self._flight.cameras[name]
            if job.size is not None:
                image = np.asarray(cv2.resize(image, job.size, interpolation=cv2.INTER_AREA), np.uint8)
                camera = camera.scaled(*job.size)
            self._images[name], self._cameras[name] = image, camera
        longest = max(next(iter(self._images.values())).shape)
        setting = MatcherSetting("xfeat", longest, job.features, weights=weights_of("xfeat", None), device=job.device)
        self._matcher = Timed(setting.build([]), self.spent.cpu_s)
        self._limits = SearchLimits(
            Band(config.band_sigmas, config.sigma_px, config.nearest_m), config.consensus_px, longest
        )

    def go(self, names: tuple[str, ...]) -> Iterator[tuple[str, Floats, MethodDepths]]:
        """From decoded photos to depths: the ref frame, its pixels and their depths, pair by pair."""
        before = self._view(names[0])
        for src, ref in pairwise(names):
            view = self._view(ref)
            pose = relative_pose(self._flight.poses[ref], self._flight.poses[src])
            start = time.process_time()
            up = self._flight.poses[ref].rotation[2]
            inside = self.spent.cpu_s["candidates"]
            found = match_pair(self._matcher, view, before, pose, self._limits, up_in_ref=up)
            between = time.process_time()
            inside = self.spent.cpu_s["candidates"] - inside
            self.spent.cpu_s["fit and check"] += between - start - inside
            pixels = found.ref_px[found.inlier]
            rays = MatchedRays.of(
                pixels, found.src_px[found.inlier], view.camera, before.camera, found.covariance[found.inlier]
            )
            config = DepthConfig.model_validate({})
            limits = Limits(config.max_relative_sigma, config.max_range_m)
            depths = depths_by("epitransfer", VirtualView.ADAPTIVE, config.virtual_baseline_m, rays, pose, limits)
            self.spent.cpu_s["depths"] += time.process_time() - between
            before = view
            yield ref, pixels, depths

    def measure(self, barrier: Barrier | None) -> None:
        """The rounds, with the others at once."""
        names = self._job.names
        list(self.go(names[:2]))
        self.spent.cpu_s.update(dict.fromkeys(PARTS, 0.0))
        if barrier is not None:
            barrier.wait()
        self.spent.start_s = time.monotonic()
        for _ in range(ROUNDS):
            last = list(self.go(names))
        self.spent.end_s = time.monotonic()
        self.spent.pairs = ROUNDS * len(last)
        truth = FlightTruth.of(self._job.example)
        for ref, pixels, depths in last:
            self.spent.matches.append(len(pixels))
            self.spent.depths.append(int(depths.kept.sum()))
            camera, full = self._cameras[ref], self._flight.cameras[ref]
            at = to_full_pixels(pixels[depths.kept], (camera.width, camera.height), (full.width, full.height))
            error = np.abs(depths.depths.depth_m[depths.kept] / truth.depths(ref, at) - 1.0)
            self.spent.errors.append(error[np.isfinite(error)])

    def _view(self, name: str) -> View:
        extractor = self._matcher.extractor
        if extractor is None:
            raise TypeError("a matcher with features is wanted")
        start = time.process_time()
        features = extract(extractor, [self._images[name]])[0]
        self.spent.cpu_s["features"] += time.process_time() - start
        return View(self._cameras[name], self._images[name], features)


def work(job: Job, barrier: Barrier, answers: SimpleQueue[Spent]) -> None:
    """One process."""
    half = Half(job)
    half.measure(barrier)
    answers.put(half.spent)


def together(jobs: list[Job]) -> list[Spent]:
    """The halves, each in a process of its own, at once."""
    context = multiprocessing.get_context("spawn")
    barrier, answers = context.Barrier(len(jobs)), context.SimpleQueue()
    processes = [context.Process(target=work, args=(job, barrier, answers)) for job in jobs]
    for process in processes:
        process.start()
    found: list[Spent] = [answers.get() for _ in jobs]
    for process in processes:
        process.join()
    return found


def row(title: str, halves: list[Spent]) -> str:
    """A row of the table."""
    pairs = sum(half.pairs for half in halves)
    wall = max(half.end_s for half in halves) - min(half.start_s for half in halves)
    spent = [1e3 * sum(half.cpu_s[part] for half in halves) / pairs for part in PARTS]
    matches, depths = (np.mean([n for half in halves for n in getattr(half, name)]) for name in ("matches", "depths"))
    error = np.median(np.concatenate([e for half in halves for e in half.errors]))
    cpu = "".join(f"{ms:11.0f}" for ms in (*spent, sum(spent)))
    return f"  {title:26}{pairs / wall:8.1f}{cpu}{matches:9.0f}{depths:8.0f}{error:8.2%}"


def main(example: Path) -> None:
    """Prints the table."""
    try:
        weights_of("xfeat", None)
    except MissingPartError:
        print("XFeat at 640 x 480: no weights")
        return
    truth = FlightTruth.of(example)
    names = sorted(truth.poses)
    legs = [
        tuple(n for n in names if truth.poses[n].leg == leg)
        for leg in dict.fromkeys(p.leg for p in truth.poses.values())
    ]
    with tempfile.TemporaryDirectory(prefix="vga_path.") as folder:
        run = example_run(example, "workflow.toml", Path(folder))
        print("XFeat from decoded photos to depths with sigma: the example's consecutive pairs, features once a photo;")
        print(
            f"{PROCESSES} processes of one thread, {ROUNDS} rounds. Per pair: CPU ms, matches kept, depths kept; median"
        )
        print(
            "relative error of these. Pairs per second are of the wall clock: other work on the machine lowers them.\n"
        )
        print(
            f"  {'':26}{'pairs/s':>8}"
            + "".join(f"{part.split()[0]:>11}" for part in PARTS)
            + f"{'CPU ms':>11}{'matches':>9}{'depths':>8}{'error':>8}"
        )
        for features in FEATURES:
            jobs = [Job(example, run, leg, SIZE, features) for leg in legs[:PROCESSES]]
            print(row(f"{SIZE[0]} x {SIZE[1]}, {features} features", together(jobs)), flush=True)
        print(f"  wanted: {TARGET:g} pairs/s at {SIZE[0]} x {SIZE[1]} on two free cores")
        device = device_of("xfeat", "auto")
        if device == "cpu":
            print("  full size on a GPU: no GPU here")
            return
        half = Half(replace(Job(example, run, legs[0], None, FEATURES[-1]), device=device))
        half.measure(None)
        print(row(f"full size, {device}", [half.spent]))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python benchmarks/vga_path.py EXAMPLE")
    main(Path(sys.argv[1]))
