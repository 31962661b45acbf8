"""match: correspondences of every selected pair, guided by the logged pose."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import pyarrow as pa
from pydantic import Field

from pipeline.engine.errors import NothingLeftError
from pipeline.engine.progress import counted
from pipeline.engine.stage import Context, Stage, StageConfig
from pipeline.engine.tables import dataset
from pipeline.flight import PairRow, camera_by_frame, cameras_of, image_locations, poses_of, selected_pairs
from pipeline.geometry.poses import relative_pose
from pipeline.matching.features import store_features
from pipeline.matching.matcher import SearchLimits
from pipeline.matching.matchers import DENSE, SLOW, MatcherSetting, device_of, weights_of
from pipeline.matching.pair import match_pair
from pipeline.matching.reach import Band
from pipeline.matching.table import matches_table
from pipeline.matching.views import Source, views

# A pair of the slow matchers takes seconds, and a shard should not take minutes.
FEATURE_SHARD, PAIR_SHARD, SLOW_SHARD = 8, 20, 4


class Config(StageConfig):
    """How correspondences are found."""

    matcher: Literal["sift", "xfeat", "xfeat-star", "xfeat-lighterglue", "raft", "dis"] = Field(
        "sift", description="Feature and matcher"
    )
    max_image_px: int = Field(1600, ge=64, description="Longest side an image is matched at (px)")
    max_features: int | None = Field(
        None, ge=8, description="Most features, or points of a dense matcher, per image; the matcher's own number (1)"
    )
    ratio: float | None = Field(
        None,
        gt=0.0,
        le=1.0,
        description="Largest ratio of best to second-best distance in the band; the matcher's own (1)",
    )
    subpixel: bool = Field(
        True,
        description="Whether matches are fitted on the full image, each with its own covariance, or refused",
    )
    weights: str | tuple[str, ...] | None = Field(
        None,
        description="Where network weights are looked for first: a folder, a file, FILE#sha256=HEX for your own",
        json_schema_extra={"path": True},
    )
    device: Literal["auto", "cpu", "cuda", "mps"] = Field("auto", description="What networks run on")
    band_sigmas: float = Field(4.0, gt=0.0, description="Width of the epipolar band, in sigmas of pose and pixels (1)")
    nearest_m: float = Field(5.0, gt=0.0, description="Range of the nearest point looked for (m)")
    sigma_px: float = Field(
        0.5, gt=0.0, description="One sigma of a position that is not refined, per axis, at the size matched at (px)"
    )
    consensus_px: float = Field(
        1.5, gt=0.0, description="Largest residual from the pair's own epipolar geometry, at the size matched at (px)"
    )


@dataclass(frozen=True, slots=True)
class _Setting:
    images: Mapping[str, Source]
    matcher: MatcherSetting
    limits: SearchLimits
    subpixel: bool
    cache: Path
    notes: list[str]


def run(config: Config, context: Context) -> str:
    """Extracts features once per image, then matches the pairs; writes `matches`."""
    setting = _setting(config, context)
    pairs = selected_pairs(context.read("pairs"))
    # One device serves one process: the cores would only wait for it.
    here = setting.matcher.device != "cpu"
    if setting.matcher.name not in DENSE:
        wanted = sorted({name for pair in pairs for name in (pair.ref, pair.src)})
        for _ in context.map(partial(_extract, setting), wanted, shard=FEATURE_SHARD, label="images", here=here):
            pass
    shard = SLOW_SHARD if setting.matcher.name in SLOW else PAIR_SHARD
    context.map_tables("matches", partial(_match, setting), pairs, shard=shard, label="pairs", here=here)
    for note in dict.fromkeys(setting.notes):
        context.warn(note)
    found = inliers = empty = 0
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
            hint="wrong gimbal angles or camera? compare `epitransfer inspect`; widen: --set match.band_sigmas=10; "
            "few matches a pair: another match.matcher, a larger match.max_features",
        )
    without = f", {empty} without any" if empty else ""
    return f"{inliers} inliers of {found} matches in {counted(len(pairs), 'pair')}{without}"


def _setting(config: Config, context: Context) -> _Setting:
    frames = context.read("frames")
    cameras = camera_by_frame(frames, cameras_of(context.read("cameras")))
    poses = poses_of(frames)
    where = image_locations(frames, str(context.facts("ingest")["photo_root"]), context.path("images"))
    usable = frames.filter(frames.column("usable"))
    names = (usable.column(name).to_pylist() for name in ("frame_id", "image_sha256"))
    images = {
        frame_id: Source(where[frame_id], digest, cameras[frame_id], poses[frame_id])
        for frame_id, digest in zip(*names, strict=True)
    }
    weights = weights_of(config.matcher, config.weights)
    device = device_of(config.matcher, config.device)
    context.record("device", device)
    context.record("weights", [found.sha256 for found in weights])
    return _Setting(
        images,
        MatcherSetting(config.matcher, config.max_image_px, config.max_features, config.ratio, weights, device),
        SearchLimits(
            Band(config.band_sigmas, config.sigma_px, config.nearest_m), config.consensus_px, config.max_image_px
        ),
        config.subpixel,
        context.cache,
        [],
    )


def _extract(setting: _Setting, names: Sequence[str]) -> int:
    matcher = setting.matcher.build(setting.notes)
    if matcher.extractor is not None:
        sources = [(setting.images[name].path, setting.images[name].digest) for name in names]
        store_features(sources, matcher.extractor, setting.cache)
    return len(names)


def _match(setting: _Setting, pairs: Sequence[PairRow]) -> pa.Table:
    matcher = setting.matcher.build(setting.notes)
    sources = [(setting.images[pair.ref], setting.images[pair.src]) for pair in pairs]
    tables = []
    for pair, (ref, src), (ref_view, src_view) in zip(
        pairs, sources, views(sources, matcher, setting.cache), strict=True
    ):
        pose = relative_pose(ref.pose, src.pose)
        found = match_pair(
            matcher, ref_view, src_view, pose, setting.limits, up_in_ref=ref.pose.rotation[2], subpixel=setting.subpixel
        )
        tables.append(matches_table(pair.pair_id, found))
    return pa.concat_tables(tables).combine_chunks()


def _count(folder: Path) -> dict[str, tuple[int, int]]:
    table = dataset(folder).to_table(columns=["pair_id", "inlier"])
    grouped = table.group_by("pair_id").aggregate([("inlier", "count"), ("inlier", "sum")])
    return {row["pair_id"]: (row["inlier_count"], row["inlier_sum"]) for row in grouped.to_pylist()}


def foresee(config: Config, setting: Callable[[str], Any], facts: Mapping[str, Any]) -> None:
    """Refuses a matcher whose weights or device are not there."""
    del setting, facts
    weights_of(config.matcher, config.weights)
    device_of(config.matcher, config.device)


def sources(config: Config) -> Sequence[Path]:
    """The weights files of the matcher's networks."""
    return [found.path for found in weights_of(config.matcher, config.weights)]


STAGE = Stage(
    "match",
    2,
    Config,
    ("frames", "cameras", "pairs", "images"),
    ("matches",),
    run,
    facts_of=("ingest",),
    sources=sources,
    foresee=foresee,
)
