"""Depths at the very pixels where the truth was measured, by dense flow, as the paper evaluates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.depthing import Limits, MatchedRays, MethodDepths, depths_by
from pipeline.flight import PairRow
from pipeline.geometry.arrays import Bytes, Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import RelativePose
from pipeline.geometry.transfer import VirtualView
from pipeline.matching.features import Features
from pipeline.matching.flow.matcher import DenseMatcher
from pipeline.matching.images import read_colour, read_grey
from pipeline.matching.matcher import SearchLimits, View
from pipeline.matching.matchers import MatcherSetting
from pipeline.matching.pair import PairMatches, match_pair
from pipeline.scoring.depth_rows import AlignedDepths
from pipeline.scoring.metrics import usable
from pipeline.scoring.truth import FrameTruth, FrameView


@dataclass(frozen=True, slots=True)
class DensePair:
    """A pair whose ref frame is scored.

    Args:
        pair: Its frames.
        pose: src_from_ref with its covariance, as depths are made with.
        usual_miss_px: Median residual under that pose, as `Limits.usual_miss_rad`.
    """

    pair: PairRow
    pose: RelativePose
    usual_miss_px: float


@dataclass(frozen=True)
class DenseLines:
    """Depths of dense matches, asked for at the pixels of what each frame sees of the truth.

    Matches are made as the stage match makes them - the way back agrees, patches fit, the epipolar line is kept - and
    depths as the stage depth does.

    Args:
        methods: As the stage depth has them, the published one first.
        view: Virtual view of `epitransfer`.
        virtual_baseline_m: Distance of a lateral or vertical view.
        limits: What a published depth has to keep.
        pairs: By ref frame.
        cameras: By frame.
        images: Where the frames' images lie.
        up_in_ref: (3,) the vertical on the axes of each ref frame's camera.
        matcher: "raft" or "dis", with its weights and device.
        search: Limits of the search.
        most: Pixels asked for in a frame at most.
    """

    methods: tuple[str, ...]
    view: VirtualView
    virtual_baseline_m: float
    limits: Limits
    pairs: Mapping[str, Sequence[DensePair]]
    cameras: Mapping[str, Camera]
    images: Mapping[str, str]
    up_in_ref: Mapping[str, Floats]
    matcher: MatcherSetting
    search: SearchLimits
    most: int

    def near(self, frames: Sequence[FrameView]) -> DenseLines:
        """As `Lines.near`."""
        del frames
        return self

    @cached_property
    def _flow(self) -> DenseMatcher:
        built = self.matcher.build([])
        if not isinstance(built, DenseMatcher):
            raise TypeError(self.matcher.name)
        return built

    def of(self, frame: FrameView, seen: FrameTruth) -> AlignedDepths:
        """As `NearLines.of`.

        Raises:
            InputError: An image cannot be read.
        """
        pairs = self.pairs.get(frame.frame_id, ())
        asked = seen.pixels[:: max(1, -(-len(seen.pixels) // self.most))]
        if not len(asked) or not pairs:
            return AlignedDepths.none(self.methods)
        flow = replace(self._flow, asked_px=asked)
        ref = self._seen(frame.frame_id)
        return AlignedDepths.joined([self._of_pair(flow, ref, one) for one in pairs])

    def _of_pair(self, flow: DenseMatcher, ref: View, one: DensePair) -> AlignedDepths:
        src = self._seen(one.pair.src)
        up = self.up_in_ref[one.pair.ref]
        found = match_pair(flow, ref, src, one.pose, self.search, up_in_ref=up)
        rows = np.flatnonzero(found.inlier)
        rays = MatchedRays.of(found.ref_px[rows], found.src_px[rows], ref.camera, src.camera, found.covariance[rows])
        limits = replace(self.limits, usual_miss_rad=one.usual_miss_px / src.camera.focal_px)
        by_method = [
            depths_by(method, self.view, self.virtual_baseline_m, rays, one.pose, limits) for method in self.methods
        ]
        return _lines(self.methods, one.pair, found, rows, by_method)

    def _seen(self, name: str) -> View:
        read = read_colour if self._flow.colour else read_grey
        image: Bytes = read(self.images[name])
        return View(self.cameras[name], image, Features.none())


def _lines(
    methods: tuple[str, ...], pair: PairRow, found: PairMatches, rows: Ints, by_method: Sequence[MethodDepths]
) -> AlignedDepths:
    with np.errstate(invalid="ignore"):
        depth, sigma = (
            np.stack(values, axis=1)
            for values in (
                [one.depths.depth_m for one in by_method],
                [np.sqrt(one.depths.variance_m2) for one in by_method],
            )
        )
    good = np.isfinite(depth) & np.isfinite(sigma)
    kept = usable(depth, good & np.stack([one.kept for one in by_method], axis=1))
    pair_id, frame_id = (np.full(len(rows), name, object) for name in (pair.pair_id, pair.ref))
    parallax = np.degrees(by_method[0].parallax_rad)
    return AlignedDepths(methods, pair_id, frame_id, found.ref_px[rows], parallax, depth, sigma, kept)
