"""The truth of a flight that `epitransfer example` made: poses, legs and exact depths at any pixel; a run's facts."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.geometry.arrays import Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import rotation_from_quaternion
from pipeline.simulation.flight import FORWARD, SIDEWAYS

BETWEEN = "between"
LEGS = (FORWARD, SIDEWAYS)
# Where neighbouring pixels' depths differ by more, the pixel lies on an outline, and what it shows is not certain.
EDGE_SHARE = 0.05


@dataclass(frozen=True, slots=True)
class TruePose:
    """Where a photo was really taken.

    Args:
        leg: FORWARD or SIDEWAYS.
        index: Number of the photo in the flight.
        rotation: (3, 3) enu_from_cam, camera RDF.
        centre: (3,) m, ENU of the site's frame.
    """

    leg: str
    index: int
    rotation: Floats
    centre: Floats


@dataclass(frozen=True)
class FlightTruth:
    """The truth beside the photos of an example.

    Args:
        folder: EXAMPLE/truth.
    """

    folder: Path

    @classmethod
    def of(cls, example: Path) -> FlightTruth:
        """The truth of an example's folder.

        Raises:
            FileNotFoundError: The folder is none that `epitransfer example` wrote.
        """
        folder = example / "truth"
        if not (folder / "poses.csv").is_file():
            raise FileNotFoundError(f"{folder / 'poses.csv'} is missing: is {example} made by `epitransfer example`?")
        return cls(folder)

    @cached_property
    def poses(self) -> dict[str, TruePose]:
        """The true poses by frame_id."""
        with (self.folder / "poses.csv").open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream))
        return {
            row["frame_id"]: TruePose(
                row["leg"],
                i,
                rotation_from_quaternion(np.array([float(row[name]) for name in ("qw", "qx", "qy", "qz")])),
                np.array([float(row[name]) for name in ("east_m", "north_m", "up_m")]),
            )
            for i, row in enumerate(rows)
        }

    def leg(self, ref: str, src: str) -> str:
        """FORWARD or SIDEWAYS when both photos are of that leg, else BETWEEN."""
        legs = {self.poses[ref].leg, self.poses[src].leg}
        return legs.pop() if len(legs) == 1 else BETWEEN

    def neighbours(self, ref: str, src: str) -> bool:
        """Whether two photos of one leg follow one another."""
        return self.leg(ref, src) != BETWEEN and abs(self.poses[ref].index - self.poses[src].index) == 1

    def along_axis(self, ref: str, src: str) -> float:
        """Share of the baseline that lies along ref's optical axis: near 1 in forward flight, near 0 sideways."""
        baseline = self.poses[src].centre - self.poses[ref].centre
        return float(abs(self.poses[ref].rotation[:, 2] @ baseline) / np.linalg.norm(baseline))

    def depths(self, frame_id: str, pixels: Floats) -> Floats:
        """True depths at any pixels, bilinear in the inverse depth: a plane's is linear in the image.

        Args:
            frame_id: The photo.
            pixels: (n, 2) u, v of the photo as given.

        Returns:
            (n,) z in the true camera's frame, m; NaN outside the map, at the sky and on outlines.
        """
        with np.load(self.folder / "depth" / f"{frame_id}.npz", allow_pickle=False) as stored:
            return sampled(stored["depth_m"], pixels)


def sampled(depth_m: Floats, pixels: Floats) -> Floats:
    """As `FlightTruth.depths`, from a depth map (height, width)."""
    height, width = depth_m.shape
    inside = np.all((pixels >= 0.0) & (pixels <= (width - 1, height - 1)), axis=1)
    corner: Ints = np.clip(np.floor(np.where(inside[:, None], pixels, 0.0)), 0, (width - 2, height - 2)).astype(
        np.int64
    )
    a, b = (pixels - corner).T
    u, v = corner.T
    near = np.stack([depth_m[v + j, u + i] for j in (0, 1) for i in (0, 1)]).astype(np.float64)
    weights = np.stack([(1.0 - b) * (1.0 - a), (1.0 - b) * a, b * (1.0 - a), b * a])
    with np.errstate(divide="ignore", invalid="ignore"):
        depth: Floats = 1.0 / np.sum(weights / near, axis=0)
        smooth = near.max(axis=0) <= (1.0 + EDGE_SHARE) * near.min(axis=0)
    return np.where(inside & smooth & np.isfinite(depth), depth, np.nan)


def reprojection_errors(
    ref_px: Floats, src_px: Floats, depth_m: Floats, camera: Camera, *, ref: TruePose, src: TruePose
) -> Floats:
    """How far a match is from the truth: its src pixel, from where src sees what ref's pixel shows.

    Args:
        ref_px: (n, 2).
        src_px: (n, 2).
        depth_m: (n,) true depths at ref_px.
        camera: Of both photos.
        ref: True pose.
        src: True pose.

    Returns:
        (n, 2) px; NaN where the truth is.
    """
    world = (camera.rays(ref_px) * depth_m[:, None]) @ ref.rotation.T + ref.centre
    return src_px - camera.project((world - src.centre) @ src.rotation)


def configured(run: Path, stage: str) -> dict[str, Any]:
    """The configuration a stage of a run was made with."""
    record = json.loads((run / "manifest.json").read_text(encoding="utf-8"))["stages"][stage]
    return {key: entry["value"] for key, entry in record["config"].items()}


def facts(run: Path, stage: str) -> dict[str, Any]:
    """What a stage of a run recorded for those after it."""
    found: dict[str, Any] = json.loads((run / "manifest.json").read_text(encoding="utf-8"))["stages"][stage]["facts"]
    return found
