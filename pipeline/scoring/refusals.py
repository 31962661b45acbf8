"""Why a run cannot be scored: no reference, heights of no common datum, tiles elsewhere, returns on other surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.engine.errors import NothingLeftError, UndeterminedError, UsageError
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.heights import RELATIVE, UNKNOWN
from pipeline.geometry.arrays import Floats
from pipeline.lidar.nearby import LocalTiles


def nothing_to_score_against() -> UsageError:
    """No tile is named, and the run has no sweeps of its own."""
    return UsageError(
        "E-SCORE-06", "there is nothing to score against", where="score.lidar",
        found="no tiles named, and no LiDAR sweeps in the run", expected="LAS, LAZ or COPC tiles, or a bag with sweeps",
        hint="--set score.lidar=TILES (or score.depth_images=FOLDER), or take the section [score] out of the workflow",
    )  # fmt: skip


def check_datums(datums: Sequence[str]) -> None:
    """Refuses heights that cannot meet those of tiles on earth.

    Args:
        datums: Every height datum of the flight.

    Raises:
        UndeterminedError: Several, or one that nothing ties to the ellipsoid.
    """
    if len(datums) != 1 or datums[0] in (*RELATIVE, UNKNOWN):
        raise UndeterminedError(
            "E-SCORE-02", "the flight's heights cannot be brought to those of LiDAR", where="frames, height_datum",
            found=", ".join(datums) or "no usable frame", expected="one datum that a geoid ties to the ellipsoid",
            hint="say what the source's heights are: --set ingest.height_datum=ellipsoidal (or egm96, egm2008, navd88)",
        )  # fmt: skip


def apart(tiles: LocalTiles, centres_in_enu_m: Floats, max_range_m: float) -> NothingLeftError:
    """Tiles and cameras do not meet; both boxes are told.

    Args:
        tiles: The tiles; at least one.
        centres_in_enu_m: (n, 3) camera centres, ENU m; n >= 1.
        max_range_m: Largest distance from a camera that is scored, m.
    """
    reach = np.array([[-max_range_m] * 3, [max_range_m] * 3])
    flight = np.stack([centres_in_enu_m.min(axis=0), centres_in_enu_m.max(axis=0)]) + reach
    transforms = tiles.transforms()
    boxes = [
        transforms[tile.crs_wkt].enu_from(np.array([tile.minimum, tile.maximum]))
        for tile in tiles.tiles
        if tile.point_count
    ]
    corners = np.concatenate(boxes) if boxes else np.zeros((0, 3))
    lidar = _box(tiles.frame, corners) if len(corners) else "no returns"
    doubt = "that they are in the frame of the poses" if tiles.frame is None else "that their CRS is right"
    return NothingLeftError(
        "E-SCORE-03", "the LiDAR tiles and the flight do not overlap", where=str(tiles.tiles[0].path),
        found=f"LiDAR {lidar}", expected=f"within {max_range_m:g} m of the cameras: {_box(tiles.frame, flight)}",
        hint=f"name the tiles under the flight (score.lidar), and see {doubt}",
    )  # fmt: skip


def no_reference(n_matches: int, n_visible: int, tiles: LocalTiles, max_range_m: float) -> NothingLeftError:
    """The cameras see no return where they have matches.

    Args:
        n_matches: Matches of all frames.
        n_visible: Returns that the frames see.
        tiles: The tiles.
        max_range_m: Largest distance from a camera that is scored, m.
    """
    doubt = (
        "that LiDAR and poses are in one frame"
        if tiles.frame is None
        else "that heights and positions of LiDAR and flight are of one datum (ingest.height_datum, ingest.geoid)"
    )
    return NothingLeftError(
        "E-SCORE-04", "no match has a reference depth",
        found=f"{n_matches:,} matches; the frames see {n_visible:,} LiDAR returns within {max_range_m:g} m",
        expected="returns on the surfaces that are matched", hint=f"see {doubt}, or raise score.max_range_m",
    )  # fmt: skip


def no_depth_seen(location: str, frame_id: str, n_measured: int, units_per_metre: float) -> NothingLeftError:
    """Depth images have nothing at the pixels that are compared.

    Args:
        location: Of the depth images.
        frame_id: The first frame.
        n_measured: Places where one of them was measured.
        units_per_metre: Of their values.
    """
    return NothingLeftError(
        "E-SCORE-07", "no match has a reference depth", where=location,
        found=f"{n_measured:,} measured places of all frames, read with {units_per_metre:g} units in a metre",
        expected=f"depths within score.max_range_m where photos have matches ({frame_id} and others)",
        hint="see score.depth_units_per_m, and that the images are registered to the photos",
    )  # fmt: skip


def _box(frame: LocalFrame | None, corners_in_enu_m: Floats) -> str:
    if frame is None:
        low, high = corners_in_enu_m.min(axis=0), corners_in_enu_m.max(axis=0)
        return f"east {low[0]:.1f} .. {high[0]:.1f} m, north {low[1]:.1f} .. {high[1]:.1f} m"
    latitude, longitude, _ = frame.geodetic_from_enu(corners_in_enu_m)
    return (
        f"latitude {np.min(latitude):.5f} .. {np.max(latitude):.5f}, "
        f"longitude {np.min(longitude):.5f} .. {np.max(longitude):.5f}"
    )
