"""A run's cameras, frames and poses as geometry: from tables to the records the stages compute with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from pipeline.geometry.arrays import AnyArray, Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.pose_errors import PoseErrors
from pipeline.geometry.poses import PlacedPair, Placement, Pose, PoseSigmas, RelativePose
from pipeline.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion

_POSITION = ("east_m", "north_m", "up_m")
_QUATERNION = ("qw", "qx", "qy", "qz")
_SIGMA_POSITION = ("sigma_east_m", "sigma_north_m", "sigma_up_m")
_SIGMA_GIMBAL = ("sigma_yaw_deg", "sigma_pitch_deg", "sigma_roll_deg")


def column(table: pa.Table, name: str) -> AnyArray:
    """A column as a numpy array; nulls of a float column become NaN."""
    values: AnyArray = table.column(name).to_numpy(zero_copy_only=False)
    return values


def columns(table: pa.Table, names: tuple[str, ...]) -> Floats:
    """Float columns side by side: (n, len(names))."""
    return np.stack([np.asarray(column(table, name), np.float64) for name in names], axis=-1)


def cameras_of(table: pa.Table) -> dict[str, Camera]:
    """The cameras of the `cameras` table by camera_id."""
    return {
        row["camera_id"]: Camera(
            row["model"],
            row["width"],
            row["height"],
            row["fx"],
            row["fy"],
            row["cx"],
            row["cy"],
            tuple(row["distortion"]),
        )
        for row in table.to_pylist()
    }


def poses_of(table: pa.Table) -> dict[str, Pose]:
    """The logged poses of the usable rows of `frames`, by frame_id."""
    table = table.filter(table.column("usable"))
    ids = table.column("frame_id").to_pylist()
    rotation = rotation_from_quaternion(columns(table, _QUATERNION)) if ids else np.empty((0, 3, 3))
    centre = columns(table, _POSITION)
    position, gimbal = columns(table, _SIGMA_POSITION), np.radians(columns(table, _SIGMA_GIMBAL))
    own_position = columns(table, tuple(f"own_{name}" for name in _SIGMA_POSITION))
    own_gimbal = np.radians(columns(table, tuple(f"own_{name}" for name in _SIGMA_GIMBAL)))
    common_position, common_gimbal = _rest(position, own_position), _rest(gimbal, own_gimbal)
    return {
        frame_id: Pose(
            rotation[i],
            centre[i],
            PoseSigmas(own_position[i], own_gimbal[i]),
            PoseSigmas(common_position[i], common_gimbal[i]),
        )
        for i, frame_id in enumerate(ids)
    }


def placements_of(table: pa.Table) -> dict[str, Placement]:
    """Where the cameras of all rows of `poses` stand, by frame_id."""
    return dict(zip(table.column("frame_id").to_pylist(), _placements(table), strict=True))


def covariances_of(table: pa.Table) -> dict[str, Floats]:
    """The (6, 6) covariance of every row of `poses`: turn (rad) and shift (m), ENU."""
    found = np.array(table.column("cov").to_pylist(), np.float64).reshape(-1, 6, 6)
    return dict(zip(table.column("frame_id").to_pylist(), found, strict=True))


def _placements(table: pa.Table, role: str = "") -> list[Placement]:
    if not table.num_rows:
        return []
    rotation = rotation_from_quaternion(columns(table, tuple(role + name for name in _QUATERNION)))
    centre = columns(table, tuple(role + name for name in _POSITION))
    return [Placement(*of_row) for of_row in zip(rotation, centre, strict=True)]


def placement_row(placed: Placement, role: str = "") -> dict[str, object]:
    """The columns that hold a placement, their names prefixed with a role."""
    values = (*quaternion_from_rotation(placed.rotation), *placed.centre)
    return {role + name: float(value) for name, value in zip((*_QUATERNION, *_POSITION), values, strict=True)}


def placed_pairs_of(table: pa.Table) -> dict[str, PlacedPair]:
    """How the pairs of the `relative_poses` table are placed, by pair_id."""
    both = [
        [default if value is None else np.array(value).reshape(12, 12) for value in table.column(name).to_pylist()]
        for name, default in (("gain", np.eye(12)), ("noise", np.zeros((12, 12))))
    ]
    parts = (_placements(table, "ref_"), _placements(table, "src_"), *both)
    ids = table.column("pair_id").to_pylist()
    return dict(zip(ids, (PlacedPair(*of_row) for of_row in zip(*parts, strict=True)), strict=True))


def pose_errors_of(table: pa.Table) -> PoseErrors:
    """The covariances of the `pose_covariances` table."""
    ones, others = (table.column(name).to_pylist() for name in ("frame_id", "other_frame_id"))
    blocks = np.array(table.column("cov").to_pylist(), np.float64).reshape(-1, 6, 6)
    return PoseErrors.of(tuple(dict.fromkeys(ones)), zip(ones, others, blocks, strict=True))


def _rest(whole: Floats, own: Floats) -> Floats:
    out: Floats = np.sqrt(np.maximum(whole**2 - own**2, 0.0))
    return out


@dataclass(frozen=True, slots=True)
class PairRow:
    """A selected pair.

    Args:
        pair_id: Its name.
        ref: frame_id of the frame that gets the depth.
        src: frame_id of the other.
    """

    pair_id: str
    ref: str
    src: str


def selected_pairs(table: pa.Table) -> list[PairRow]:
    """The selected rows of `pairs`, in the table's order."""
    kept = table.filter(table.column("selected"))
    names = (kept.column(name).to_pylist() for name in ("pair_id", "ref_frame_id", "src_frame_id"))
    return [PairRow(*row) for row in zip(*names, strict=True)]


def relative_pose_row(pair_id: str, pose: RelativePose) -> dict[str, object]:
    """The pose columns of a row of `relative_poses`."""
    q = quaternion_from_rotation(pose.rotation)
    return {
        "pair_id": pair_id,
        **{name: float(value) for name, value in zip(_QUATERNION, q, strict=True)},
        **{name: float(value) for name, value in zip(("tx", "ty", "tz"), pose.translation, strict=True)},
        "cov": pose.covariance.ravel().tolist(),
    }


def relative_poses_of(table: pa.Table) -> dict[str, RelativePose]:
    """The poses of the `relative_poses` table by pair_id."""
    rotation = rotation_from_quaternion(columns(table, _QUATERNION)) if table.num_rows else np.empty((0, 3, 3))
    translation = columns(table, ("tx", "ty", "tz"))
    covariance = table.column("cov").to_pylist()
    return {
        pair_id: RelativePose(rotation[i], translation[i], np.array(covariance[i]).reshape(6, 6))
        for i, pair_id in enumerate(table.column("pair_id").to_pylist())
    }


# Images that ingest took out of a bag or video lie in the run folder, and are named so.
RUN_IMAGES = "run://images/"


def image_locations(frames: pa.Table, photo_root: str, run_images: Path) -> dict[str, str]:
    """Where the image of every usable frame lies, by frame_id.

    Args:
        frames: The `frames` table.
        photo_root: Where ingest found the photos.
        run_images: The run folder's `images`.

    Returns:
        Paths or URLs.
    """
    usable = frames.filter(frames.column("usable"))
    ids, images = (usable.column(name).to_pylist() for name in ("frame_id", "image"))
    inside = {
        image: str(run_images / image.removeprefix(RUN_IMAGES)) for image in images if image.startswith(RUN_IMAGES)
    }
    return {frame: inside.get(image) or f"{photo_root}/{image}" for frame, image in zip(ids, images, strict=True)}


def camera_by_frame(frames: pa.Table, cameras: Mapping[str, Camera]) -> dict[str, Camera]:
    """The camera of every usable frame by frame_id."""
    usable = frames.filter(frames.column("usable"))
    ids, names = (usable.column(name).to_pylist() for name in ("frame_id", "camera_id"))
    return {frame_id: cameras[name] for frame_id, name in zip(ids, names, strict=True)}
