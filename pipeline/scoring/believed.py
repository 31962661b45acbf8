"""The truth that a configuration names, made ready for the frames of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.engine.errors import NothingLeftError
from pipeline.engine.stage import Context
from pipeline.lidar.nearby import LocalTiles
from pipeline.lidar.store import gather
from pipeline.scoring.depth_images import DepthImages
from pipeline.scoring.frame_scores import FrameScore
from pipeline.scoring.inputs import TilesNamed, times_of
from pipeline.scoring.refusals import apart, no_depth_seen, no_reference
from pipeline.scoring.truth import FrameView, Survey, Truth
from pipeline.sources.depth_images import find_depth_images


@dataclass(frozen=True, slots=True)
class Believed:
    """What depths are held against.

    Args:
        truth: For scoring.
        kind: "tiles", "sweeps" or "depth images".
        tiles: Of a survey, those that meet the flight; None for depth images.
        nothing: The refusal when no depth has a reference.
    """

    truth: Truth
    kind: str
    tiles: LocalTiles | None
    nothing: Callable[[Sequence[FrameScore]], NothingLeftError]


def survey(
    context: Context, named: TilesNamed, views: Sequence[FrameView], max_range_m: float, margin_m: float
) -> Believed:
    """LiDAR tiles, or the run's own sweeps.

    Args:
        context: Of the stage; what the figures rest on is recorded in it.
        named: The tiles.
        views: The frames that are scored; at least one.
        max_range_m: Largest distance from the camera that is scored, m.
        margin_m: How far the tiles may be shifted afterwards, m.

    Raises:
        InputError: No tile, or one that cannot be read.
        UndeterminedError: Where tiles lie, or what heights are measured from, is not known.
        UsageError: There are neither tiles nor sweeps.
        NothingLeftError: The tiles lie elsewhere, or hold only noise.
    """
    tiles = named.local(context)
    centres = np.array([item.view.centre_in_enu_m for item in views])
    meeting = tiles.meeting(centres, max_range_m + margin_m)
    if not meeting:
        raise apart(tiles, centres, max_range_m)
    context.record("lidar", "the run's own sweeps" if named.lidar is None else "tiles named")
    context.record("lidar_tiles", {"given": len(tiles.tiles), "used": len(meeting)})
    context.record("lidar_heights", sorted({transform.height_note for transform in tiles.transforms().values()}))

    def nothing(scores: Sequence[FrameScore]) -> NothingLeftError:
        matches, visible = (sum(getattr(score, name) for score in scores) for name in ("n_matches", "n_visible"))
        return no_reference(matches, visible, tiles, max_range_m)

    met = replace(tiles, tiles=meeting)
    focal_px = max(item.view.camera.focal_px for item in views)
    store = gather(context.map, met, centres, max_range_m + margin_m, context.scratch / "returns", focal_px)
    truth = Survey(store, met.from_above, max_range_m, margin_m)
    return Believed(truth, "sweeps" if named.lidar is None else "tiles", met, nothing)


def depth_images(context: Context, location: str, units_per_metre: float, max_range_m: float) -> Believed:
    """Depth images of the photos.

    Args:
        context: Of the stage; what the figures rest on is recorded in it.
        location: Folder or glob.
        units_per_metre: Of their values.
        max_range_m: Largest distance from the camera that is scored, m.

    Raises:
        InputError: There is no such file.
        NothingLeftError: None belongs to a frame.
    """
    times = times_of(context.read("frames"))
    found, gap_s = find_depth_images(location, times)
    context.record("depth_images", {"frames": len(times), "with_depth": len(found), "largest_gap_s": gap_s})

    def nothing(scores: Sequence[FrameScore]) -> NothingLeftError:
        return no_depth_seen(location, scores[0].frame_id, sum(score.n_visible for score in scores), units_per_metre)

    return Believed(DepthImages(found, units_per_metre, max_range_m), "depth images", None, nothing)
