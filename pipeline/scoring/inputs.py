"""A run's tables as what is scored: its frames, the truth about them, and the depths."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.depthing import Limits
from pipeline.engine.stage import Context
from pipeline.flight import (
    camera_by_frame,
    cameras_of,
    column,
    covariances_of,
    image_locations,
    placements_of,
    relative_poses_of,
    selected_pairs,
)
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.local_world import EARTH, LOCAL_WORLD
from pipeline.geometry.transfer import VirtualView
from pipeline.lidar.nearby import LocalTiles
from pipeline.lidar.tiles import expand, read_local_tile, read_tile
from pipeline.lidar.visibility import View
from pipeline.matching.matcher import SearchLimits
from pipeline.matching.matchers import MatcherSetting, device_of, weights_of
from pipeline.matching.reach import Band
from pipeline.monodepth.baselines import BaselineSetting, depth_maps
from pipeline.scoring.cloud_scores import CloudJob, survey_covariance
from pipeline.scoring.dense import DenseLines, DensePair
from pipeline.scoring.frame_scores import Baselines
from pipeline.scoring.lines import Lines, SparseLines, methods_of
from pipeline.scoring.point_rows import PointsNear
from pipeline.scoring.refusals import check_datums, nothing_to_score_against
from pipeline.scoring.truth import FrameView

# Settings of other stages that dense depths are made with.
DENSE_READS = (
    "match.max_image_px", "match.band_sigmas", "match.sigma_px", "match.nearest_m", "match.consensus_px",
    "match.weights", "match.device", "depth.virtual_view", "depth.virtual_baseline_m", "depth.max_relative_sigma",
    "depth.max_miss_sigmas", "depth.max_range_m",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class TilesNamed:
    """The survey as the configuration names it.

    Args:
        lidar: Tiles: a path, folder, glob or list of these; None for the run's own sweeps.
        height_datum: What their heights are measured from where they do not say.
    """

    lidar: str | tuple[str, ...] | None
    height_datum: str | None

    def local(self, context: Context) -> LocalTiles:
        """The tiles' headers, and the frame they are brought into.

        Raises:
            InputError: No tile, or one that cannot be read.
            UndeterminedError: Where tiles lie, or what heights are measured from, is not known.
            UsageError: There are neither tiles nor sweeps.
        """
        facts = context.facts("ingest")
        if self.lidar is None:
            found = tuple(sorted(context.path("sweeps").rglob("*.laz")))
            if not found:
                raise nothing_to_score_against()
            return LocalTiles(tuple(map(read_local_tile, found)))
        if is_local(facts):
            return LocalTiles(tuple(map(read_local_tile, expand(self.lidar))))
        datum = datum_of(context.read("frames"))
        tiles = tuple(read_tile(path, self.height_datum) for path in expand(self.lidar))
        return LocalTiles(tiles, LocalFrame(**facts["origin"]), context.setting("ingest.geoid"), datum)

    def foresee(self, facts: Mapping[str, Any]) -> None:
        """Refuses what `local` would, before there are any depths."""
        if self.lidar is None:
            if not facts.get("sweep_points"):
                raise nothing_to_score_against()
            return
        if not is_local(facts):
            check_datums([facts["height_datum"]])
        for path in expand(self.lidar):
            read_local_tile(path) if is_local(facts) else read_tile(path, self.height_datum)


def datum_of(frames: pa.Table) -> str:
    """What the flight's heights are measured from.

    Raises:
        UndeterminedError: Several datums, or one that nothing ties to the ellipsoid.
    """
    datums = sorted(set(frames.filter(frames.column("usable")).column("height_datum").to_pylist()))
    check_datums(datums)
    return str(datums[0])


def is_local(facts: Mapping[str, Any]) -> bool:
    """Whether the run is in a frame of its own, nowhere on earth."""
    return bool(facts.get("world", EARTH) == LOCAL_WORLD)


def views_of(context: Context, wanted: set[str]) -> list[FrameView]:
    """The frames of `poses` that are wanted, in order."""
    cameras = camera_by_frame(context.read("frames"), cameras_of(context.read("refined_cameras")))
    poses = context.read("poses")
    covariances = covariances_of(poses)
    return [
        FrameView(frame_id, View(cameras[frame_id], pose.centre, pose.rotation), covariances[frame_id])
        for frame_id, pose in placements_of(poses).items()
        if frame_id in wanted
    ]


def times_of(frames: pa.Table) -> dict[str, float | None]:
    """Seconds of every usable frame, by frame_id; None where it has no time."""
    usable = frames.filter(frames.column("usable"))
    stamps = usable.column("time").cast(pa.int64()).to_pylist()
    return {
        frame: None if stamp is None else stamp * 1e-9
        for frame, stamp in zip(usable.column("frame_id").to_pylist(), stamps, strict=True)
    }


def sparse_lines(context: Context) -> SparseLines:
    """The depths that are delivered."""
    depths = context.path("depths")
    return SparseLines(depths, methods_of(depths, context.setting("depth.methods")[0]))


def images_of(context: Context) -> dict[str, str]:
    """Where the images of usable frames lie, by frame_id."""
    return image_locations(context.read("frames"), str(context.facts("ingest")["photo_root"]), context.path("images"))


def baselines_of(context: Context, names: tuple[str, ...], models: str | None) -> Baselines | None:
    """Networks that look at one image alone; None of none. What they are is recorded.

    Args:
        context: Of the stage.
        names: Of the methods.
        models: Where their networks are looked for first.

    Raises:
        InputError: A folder holds no such model.
        MissingPartError: transformers is not installed, or a model is nowhere.
        ResourceError: The device is not there.
    """
    if not names:
        return None
    found = BaselineSetting.find(names, models, context.setting("match.device"))
    context.record("baselines", {model.baseline: model.provenance for model in found.models})
    return Baselines(names, images_of(context), partial(depth_maps, found), found.device)


def device_of_job(lines: Lines, baselines: Baselines | None) -> str:
    """What the networks of a job run on; "cpu" where there are none."""
    used = [lines.matcher.device] if isinstance(lines, DenseLines) else []
    used += [baselines.device] if baselines else []
    return next((device for device in used if device != "cpu"), "cpu")


def cloud_of(
    context: Context, tiles: LocalTiles | None, max_range_m: float, lidar_sigma_m: float | None
) -> CloudJob | None:
    """The fused points, to be held against returns; None where there are no points, or no returns.

    Args:
        context: Of the stage.
        tiles: The survey.
        max_range_m: Largest distance from the camera that is scored, m.
        lidar_sigma_m: One sigma of a return as stated.

    Raises:
        InputError: The points cannot be read.
    """
    folder = context.path("points")
    if tiles is None or not folder.exists():
        return None
    points = PointsNear.of(folder, tiles.frame, tiles.geoid, tiles.height_datum)
    covariance = survey_covariance(tiles.tiles, lidar_sigma_m)
    context.record("returns_carry_covariance", covariance is not None)
    return CloudJob(points, max_range_m, covariance)


def dense_lines(context: Context, matcher: str, most: int) -> DenseLines:
    """Depths of dense matches, asked for at the truth's pixels.

    Args:
        context: Of the stage.
        matcher: "raft" or "dis".
        most: Pixels asked for in a frame at most.

    Raises:
        MissingPartError: The matcher's network has no weights here.
        ResourceError: Its device is not there.
    """

    def match(key: str) -> Any:
        return context.setting(f"match.{key}")

    def depth(key: str) -> Any:
        return context.setting(f"depth.{key}")

    relative = context.read("relative_poses")
    poses = relative_poses_of(relative)
    usual = np.nan_to_num(column(relative, "median_after_px"))
    usual_px = dict(zip(column(relative, "pair_id"), usual.tolist(), strict=True))
    pairs: dict[str, list[DensePair]] = {}
    for pair in selected_pairs(context.read("pairs")):
        pairs.setdefault(pair.ref, []).append(DensePair(pair, poses[pair.pair_id], usual_px[pair.pair_id]))
    placed = placements_of(context.read("poses"))
    weights, device = weights_of(matcher, match("weights")), device_of(matcher, match("device"))
    return DenseLines(
        methods=tuple(depth("methods")),
        view=VirtualView(depth("virtual_view")),
        virtual_baseline_m=depth("virtual_baseline_m"),
        limits=Limits(depth("max_relative_sigma"), depth("max_range_m"), depth("max_miss_sigmas")),
        pairs=pairs,
        cameras=camera_by_frame(context.read("frames"), cameras_of(context.read("refined_cameras"))),
        images=images_of(context),
        up_in_ref={name: pose.rotation[2] for name, pose in placed.items()},
        matcher=MatcherSetting(matcher, match("max_image_px"), weights=weights, device=device),
        search=SearchLimits(
            Band(match("band_sigmas"), match("sigma_px"), match("nearest_m")),
            match("consensus_px"),
            match("max_image_px"),
        ),
        most=most,
    )
