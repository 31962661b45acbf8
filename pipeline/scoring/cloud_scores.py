"""The fused points of a shard of frames beside the returns about them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import laspy
import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.lidar.tile_covariance import tile_covariance
from pipeline.lidar.tiles import Tile
from pipeline.scoring.cloud import TOLERANCES_M, CloudSums, cloud_sums
from pipeline.scoring.m3c2 import Cloud, M3C2Sums, m3c2_sums
from pipeline.scoring.point_rows import NearPoints, PointsNear
from pipeline.scoring.truth import FrameView, SurveyNear, SurveySeen

_SAMPLED_RETURNS = 100_000


@dataclass(frozen=True, slots=True)
class CloudJob:
    """What is the same for every shard.

    Args:
        points: The run's fused points.
        max_range_m: Largest Euclidean distance from the camera that is scored, m.
        survey_covariance: (3, 3) of a return, m^2, ENU; None where nothing tells it.
    """

    points: PointsNear
    max_range_m: float
    survey_covariance: Floats | None

    def near(self, frames: Sequence[FrameView]) -> NearPoints:
        """The fused points that returns near these frames may be compared with."""
        centres = np.array([frame.view.centre_in_enu_m for frame in frames])
        # As far beyond the range as the largest distance that is told.
        return self.points.near(centres, self.max_range_m + TOLERANCES_M[-1])


@dataclass(frozen=True, slots=True)
class CloudScore:
    """Sums of a shard.

    Args:
        cloud: Accuracy and completeness.
        m3c2: Distances with their levels of detection; None where returns have no covariance.
    """

    cloud: CloudSums
    m3c2: M3C2Sums | None


def score_cloud(
    job: CloudJob,
    points: NearPoints,
    near: SurveyNear,
    frames: Sequence[FrameView],
    seen: Sequence[SurveySeen],
    translation_covariance: Floats | None,
) -> CloudScore:
    """The fused points whose best view is one of some frames, beside the returns about these.

    Args:
        job: What is the same for every shard.
        points: From `CloudJob.near`.
        near: The returns.
        frames: The frames.
        seen: What each of them sees.
        translation_covariance: (3, 3) of the shift of the returns, m^2; None for none.
    """
    names = [frame.frame_id for frame in frames]
    own = points.of_frames(names, np.array([frame.view.centre_in_enu_m for frame in frames]), job.max_range_m)
    visible = np.concatenate([one.points_in_enu_m for one in seen])
    cloud = cloud_sums(points.p_in_enu_m, own, near.returns, visible, near.spacing_m, from_above=near.field is not None)
    if job.survey_covariance is None:
        return CloudScore(cloud, None)
    covariance = np.broadcast_to(job.survey_covariance, (len(near.returns), 3, 3))
    ours, theirs = Cloud(points.p_in_enu_m, points.covariance, True), Cloud(near.returns, covariance, False)
    return CloudScore(cloud, m3c2_sums(ours, own, theirs, near.spacing_m, translation_covariance))


def survey_covariance(tiles: Sequence[Tile], stated_sigma_m: float | None) -> Floats | None:
    """The covariance of a return.

    Args:
        tiles: The survey.
        stated_sigma_m: One sigma along each axis as the user states it; None leaves it to the tiles.

    Returns:
        (3, 3) m^2; where tiles carry covariances, as this project's exports do, their mean over the first returns of
        each, the axes of their CRS taken for east, north and up. None where nothing tells it.
    """
    if stated_sigma_m is not None:
        return stated_sigma_m**2 * np.eye(3)
    found = [covariance for tile in tiles if (covariance := _sampled(tile)) is not None]
    return np.mean(np.concatenate(found), axis=0) if len(found) == len(tiles) and found else None


def _sampled(tile: Tile) -> Floats | None:
    with laspy.open(tile.path) as reader:
        chunks = list(islice(reader.chunk_iterator(_SAMPLED_RETURNS), 1))
    return tile_covariance(chunks[0]) if chunks else None
