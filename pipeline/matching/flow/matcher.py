"""Dense flow as a matcher: the best textured pixel of each grid cell, or any asked for, found in src by RAFT or DIS."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.poses import RelativePose
from pipeline.matching.flow.estimators import FlowEstimator
from pipeline.matching.flow.field import FlowSetting, dense_field
from pipeline.matching.flow.grid_points import grid_points
from pipeline.matching.flow.start import FlowView
from pipeline.matching.matcher import Candidates, SearchLimits, View

# Where the way there and back misses by more, the point is hidden in src, or nothing was found.
_LARGEST_DISCREPANCY_PX = 1.0


@dataclass(frozen=True, slots=True)
class DenseMatcher:
    """Points of a regular grid by dense flow, kept where the way back agrees.

    Args:
        estimator: Of the flow.
        max_points: About how many points of an image.
        asked_px: (n, 2) pixels of ref that are looked for instead of a grid's.
    """

    estimator: FlowEstimator
    max_points: int
    asked_px: Floats | None = None
    extractor: None = None

    @property
    def colour(self) -> bool:
        """As `Matcher.colour`."""
        return self.estimator.channels == 3

    def candidates(self, ref: View, src: View, pose: RelativePose, limits: SearchLimits) -> Candidates:
        """As `Matcher.candidates`; the score is 1 / (1 + px by which the way back misses)."""
        setting = FlowSetting(limits.max_image_px, limits.band.nearest_for(pose))
        field = dense_field(
            FlowView(ref.image, ref.camera), FlowView(src.image, src.camera), pose, self.estimator, setting
        )
        asked = self.asked_px
        if asked is None:
            asked = grid_points(ref.image, self.max_points, limits.max_image_px)
        found = field.sample(asked)
        rows = np.flatnonzero(found.valid & (found.discrepancy_px <= _LARGEST_DISCREPANCY_PX))
        ref_px, src_px, missed = found.ref_px[rows], found.src_px[rows], found.discrepancy_px[rows]
        each = np.arange(len(rows))
        near = limits.reach(ref_px, ref.camera, src_px, src.camera, pose).allows(each, each)
        ref_px, src_px, missed = ref_px[near], src_px[near], missed[near]
        prior = limits.prior_variance(ref.camera, src.camera)
        # The way back has an error of its own, so that half of what it misses by is the way there's.
        seen_in_src = limits.shrink(ref.camera) * src.camera.focal_px / ref.camera.focal_px
        variance = prior + 0.5 * (missed * seen_in_src) ** 2
        return Candidates(ref_px, src_px, 1.0 / (1.0 + missed), variance)
