"""A run's cameras and poses as a COLMAP model, for programs that go on from poses: no points, no matches."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.engine.errors import InputError, ResourceError
from pipeline.engine.tables import read_table
from pipeline.flight import cameras_of, placements_of, poses_of
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Placement, Pose

SUFFIX = ".colmap"
"""Of a folder to export to."""

# COLMAP's pixel (0, 0) is the corner of the top-left pixel, here it is its centre.
_HALF_PIXEL = 0.5
_RECORD_HEAD_BYTES = 8


def export_colmap(run: Path, folder: Path) -> int:
    """Writes the usable frames of a run as a binary COLMAP model; the world is the run's ENU frame, in metres.

    Images are named by their paths below the photo root. Poses are the refined ones where the run has them, else the
    log's.

    Args:
        run: Run folder with `frames` and `cameras`.
        folder: The model's folder; an older model in it is replaced.

    Returns:
        Number of images.

    Raises:
        InputError: The run lacks a table, or no frame is usable.
        ResourceError: The model cannot be written.

    Source: COLMAP documentation, "Output Format" and "Camera Models".
    """
    frames = read_table(run / "frames.parquet", "frames")
    refined = run / "poses.parquet"
    poses: Mapping[str, Placement | Pose] = (
        placements_of(read_table(refined, "poses")) if refined.exists() else poses_of(frames)
    )
    name = "refined_cameras" if refined.exists() else "cameras"
    cameras = cameras_of(read_table(run / f"{name}.parquet", name))
    usable = frames.filter(frames.column("usable"))
    rows = [row for row in usable.select(["frame_id", "image", "camera_id"]).to_pylist() if row["frame_id"] in poses]
    if not rows:
        raise InputError(
            "E-EXPORT-03", "the run has no usable frame with a pose", where=str(run), found=f"{frames.num_rows} frames",
            hint="epitransfer run, or see frames.problem",
        )  # fmt: skip
    model = _model(rows, cameras, poses)
    with _in_place(folder) as temporary:
        model.write_binary(str(temporary))
        _check_written(temporary, rows)
    return len(rows)


def _model(rows: list[dict[str, str]], cameras: dict[str, Camera], poses: Mapping[str, Placement | Pose]) -> Any:
    """The frames as a pycolmap.Reconstruction."""
    import pycolmap  # noqa: PLC0415 - heavy

    model = pycolmap.Reconstruction()
    names = sorted({row["camera_id"] for row in rows})
    for number, name in enumerate(names, 1):
        kind, parameters = colmap_camera(cameras[name])
        width, height = cameras[name].width, cameras[name].height
        camera = pycolmap.Camera(model=kind, width=width, height=height, params=parameters, camera_id=number)
        model.add_camera_with_trivial_rig(camera)
    for number, row in enumerate(rows, 1):
        pose = poses[row["frame_id"]]
        cam_from_enu = pycolmap.Rigid3d(pycolmap.Rotation3d(pose.rotation.T), -pose.rotation.T @ pose.centre)
        image = pycolmap.Image(name=row["image"], camera_id=names.index(row["camera_id"]) + 1, image_id=number)
        model.add_image_with_trivial_frame(image, cam_from_enu)
    return model


def colmap_camera(camera: Camera) -> tuple[str, list[float]]:
    """A camera as COLMAP has it.

    Args:
        camera: The camera.

    Returns:
        The model's name and its parameters, the principal point counted from the corner of the top-left pixel.
    """
    pinhole = [camera.fx, camera.fy, camera.cx + _HALF_PIXEL, camera.cy + _HALF_PIXEL]
    distortion = np.zeros(8)
    distortion[: len(camera.distortion)] = camera.distortion
    if camera.model == "fisheye":
        return "OPENCV_FISHEYE", [*pinhole, *distortion[:4].tolist()]
    if camera.model == "pinhole" or not np.any(distortion):
        return "PINHOLE", pinhole
    if not np.any(distortion[4:]):
        return "OPENCV", [*pinhole, *distortion[:4].tolist()]
    return "FULL_OPENCV", [*pinhole, *distortion.tolist()]


def _check_written(folder: Path, rows: list[dict[str, str]]) -> None:
    """COLMAP writes on when the disk is full, and says nothing."""
    names = "".join(row["image"] for row in rows).encode()
    # Per image: number, pose, camera, its name's end and the count of its points.
    expected = _RECORD_HEAD_BYTES + len(rows) * (4 + 56 + 4 + 1 + 8) + len(names)
    found = (folder / "images.bin").stat().st_size
    if found != expected:
        raise OSError(f"images.bin has {found} bytes instead of {expected}; is the disk full?")


@contextmanager
def _in_place(folder: Path) -> Iterator[Path]:
    """A folder to write to whose files go into the named one when the block ends without an error.

    What else is in the named folder (images, a database) stays.
    """
    temporary = folder.with_name(f".{folder.name}.tmp")
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        temporary.mkdir()
        yield temporary
        folder.mkdir(exist_ok=True)
        for file in sorted(temporary.iterdir()):
            file.replace(folder / file.name)
    # COLMAP says so with a ValueError when it cannot open a file.
    except (OSError, ValueError) as error:
        raise ResourceError(
            "E-EXPORT-02", "the file cannot be written", where=str(folder), found=str(error),
            hint="check that its folder exists, is writable and has room",
        ) from error  # fmt: skip
    finally:
        if temporary.parent.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
