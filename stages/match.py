"""match: correspondences of every selected pair, guided by the logged pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import pyarrow as pa
from pydantic import Field

from pipeline.engine.errors import NothingLeftError
from pipeline.engine.progress import counted
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.engine.tables import dataset
from pipeline.flight import PairRow, camera_by_frame, cameras_of, image_locations, poses_of, selected_pairs
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Pose, relative_pose
from pipeline.matching.features import Extractor, SiftExtractor, cached_features
from pipeline.matching.guided import Band
from pipeline.matching.pair import PairImage, PairMatches, SearchLimits, match_pair
from schemas import MATCHES

FEATURE_SHARD, PAIR_SHARD = 2, 20


class Config(StageConfig):
    """How correspondences are found."""

    matcher: Literal["sift"] = Field("sift", description="Feature and matcher")
    max_image_px: int = Field(1600, ge=64, description="Longest side an image is matched at (px)")
    max_features: int = Field(8192, ge=8, description="Most features per image (1)")
    ratio: float = Field(
        0.85, gt=0.0, le=1.0, description="Largest ratio of best to second-best distance in the band (1)"
    )
    band_sigmas: float = Field(4.0, gt=0.0, description="Width of the epipolar band, in sigmas of pose and pixels (1)")
    nearest_m: float = Field(5.0, gt=0.0, description="Range of the nearest point looked for (m)")
    sigma_px: float = Field(
        0.5, gt=0.0, description="One sigma of a matched position per axis, at the size matched at (px)"
    )
    consensus_px: float = Field(
        1.5, gt=0.0, description="Largest residual from the pair's own epipolar geometry, at the size matched at (px)"
    )


@dataclass(frozen=True, slots=True)
class _Image:
    path: str
    digest: str
    camera: Camera
    pose: Pose


def run(config: Config, context: Context) -> str:
    """Extracts features once per image, then matches the pairs; writes `matches`."""
    images = _images(context)
    pairs = selected_pairs(context.read("pairs"))
    extractor = SiftExtractor(config.max_image_px, config.max_features)
    wanted = sorted({name for pair in pairs for name in (pair.ref, pair.src)})
    extract = partial(_extract, images, extractor, context.cache)
    for _ in context.map(extract, wanted, shard=FEATURE_SHARD, label="images"):
        pass
    limits = SearchLimits(
        Band(config.band_sigmas, config.sigma_px, config.nearest_m),
        config.ratio,
        config.consensus_px,
        config.max_image_px,
    )
    job = partial(_match, images, extractor, limits, context.cache)
    context.map_tables("matches", job, pairs, shard=PAIR_SHARD, label="pairs")
    found = inliers = 0
    empty = 0
    per_pair = _count(context.output("matches"))
    for pair in pairs:
        n, n_inliers = per_pair.get(pair.pair_id, (0, 0))
        found, inliers, empty = found + n, inliers + n_inliers, empty + (n_inliers == 0)
    context.count_items(len(pairs), empty)
    if not inliers:
        raise NothingLeftError(
            "E-MATCH-01",
            "no pair has a match that agrees with its pose",
            found=f"{len(pairs)} pairs, {found} matches",
            expected="matches within the epipolar band of the logged poses",
            hint="wrong gimbal angles or camera? compare `epitransfer inspect`; widen: --set match.band_sigmas=10",
        )
    return f"{inliers} inliers of {found} matches in {counted(len(pairs), 'pair')}" + (
        f", {empty} without any" if empty else ""
    )


def _images(context: Context) -> dict[str, _Image]:
    frames = context.read("frames")
    cameras = camera_by_frame(frames, cameras_of(context.read("cameras")))
    poses = poses_of(frames)
    where = image_locations(frames, str(context.facts("ingest")["photo_root"]), context.path("images"))
    usable = frames.filter(frames.column("usable"))
    names = (usable.column(name).to_pylist() for name in ("frame_id", "image_sha256"))
    return {
        frame_id: _Image(where[frame_id], digest, cameras[frame_id], poses[frame_id])
        for frame_id, digest in zip(*names, strict=True)
    }


def _extract(images: Mapping[str, _Image], extractor: Extractor, cache: Path, names: Sequence[str]) -> int:
    for name in names:
        cached_features(images[name].path, images[name].digest, extractor, cache)
    return len(names)


def _match(
    images: Mapping[str, _Image], extractor: Extractor, limits: SearchLimits, cache: Path, pairs: Sequence[PairRow]
) -> pa.Table:
    tables = []
    for pair in pairs:
        ref, src = images[pair.ref], images[pair.src]
        found = match_pair(
            PairImage(cached_features(ref.path, ref.digest, extractor, cache), ref.camera),
            PairImage(cached_features(src.path, src.digest, extractor, cache), src.camera),
            relative_pose(ref.pose, src.pose),
            limits,
        )
        tables.append(_table(pair.pair_id, found))
    return pa.concat_tables(tables).combine_chunks()


def _table(pair_id: str, found: PairMatches) -> pa.Table:
    return MATCHES.from_columns(
        {
            "pair_id": [pair_id] * len(found.score),
            "ref_u": found.ref_px[:, 0],
            "ref_v": found.ref_px[:, 1],
            "src_u": found.src_px[:, 0],
            "src_v": found.src_px[:, 1],
            "score": found.score.astype("float32"),
            "inlier": found.inlier,
        }
    )


def _count(folder: Path) -> dict[str, tuple[int, int]]:
    table = dataset(folder).to_table(columns=["pair_id", "inlier"])
    grouped = table.group_by("pair_id").aggregate([("inlier", "count"), ("inlier", "sum")])
    return {row["pair_id"]: (row["inlier_count"], row["inlier_sum"]) for row in grouped.to_pylist()}


STAGE = Stage("match", 1, Config, ("frames", "cameras", "pairs", "images"), ("matches",), run, facts_of=("ingest",))
