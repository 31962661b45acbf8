"""COLMAP's way from the same photos, pairs and poses to points: extract, match, verify, triangulate.

usage: python benchmarks/colmap_side.py RUN PHOTOS WORK THREADS

RUN is a run folder, whose `frames`, `cameras` and `pairs` are taken; WORK an empty folder, where the model is left.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pycolmap
from flight_truth import configured

from pipeline.engine.tables import read_table
from pipeline.flight import camera_by_frame, cameras_of, poses_of, selected_pairs
from pipeline.geometry.cameras import Camera
from pipeline.matching.matchers import MAX_FEATURES

MODEL = "FULL_OPENCV"
SEED = 0


def parameters(camera: Camera) -> list[float]:
    """COLMAP's parameters of a pinhole or Brown camera; its first pixel's centre is (0.5, 0.5).

    Raises:
        ValueError: Of another model.
    """
    if camera.model not in ("pinhole", "brown"):
        raise ValueError(f"a {camera.model} camera has no {MODEL} form")
    k1, k2, p1, p2, k3, k4, k5, k6 = (*camera.distortion, *([0.0] * 8))[:8]
    return [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, k1, k2, p1, p2, k3, k4, k5, k6]


def extract(run: Path, database: Path, photos: Path, names: list[str], camera: Camera, *, threads: int) -> None:
    """SIFT on the processor, of the same image size and number of features as the run's."""
    settings = configured(run, "match")
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = MODEL
    reader.camera_params = ",".join(repr(value) for value in parameters(camera))
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size, options.num_threads, options.use_gpu = settings["max_image_px"], threads, False
    options.sift.max_num_features = settings["max_features"] or MAX_FEATURES["sift"]
    pycolmap.extract_features(database, photos, names, pycolmap.CameraMode.SINGLE, reader, options, pycolmap.Device.cpu)


def match(database: Path, pairs: Path, threads: int) -> None:
    """The listed pairs, with COLMAP's own verification."""
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads, options.use_gpu = threads, False
    listed = pycolmap.ImportedPairingOptions()
    listed.match_list_path = pairs
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    pycolmap.match_image_pairs(database, options, listed, verification, pycolmap.Device.cpu)


def posed_model(database: Path, run: Path, names: dict[str, str]) -> pycolmap.Reconstruction:
    """The cameras and images of the database at the run's poses.

    Args:
        database: After extraction.
        run: With `frames`.
        names: frame_id by image name.
    """
    poses = poses_of(read_table(run / "frames.parquet", "frames"))
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as stored:
        for camera in stored.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for image in stored.read_all_images():
            pose = poses[names[image.name]]
            cam_from_enu = np.column_stack([pose.rotation.T, -pose.rotation.T @ pose.centre])
            model.add_image_with_trivial_frame(
                pycolmap.Image(image.name, camera_id=image.camera_id, image_id=image.image_id),
                pycolmap.Rigid3d(cam_from_enu),
            )
    return model


def triangulate(
    model: pycolmap.Reconstruction, database: Path, photos: Path, out: Path, threads: int
) -> pycolmap.Reconstruction:
    """Points at the given poses; tracks of two views are kept, for most of ours have two."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = threads, SEED
    options.triangulation.random_seed = SEED
    options.triangulation.ignore_two_view_tracks = False
    out.mkdir()
    return pycolmap.triangulate_points(model, database, photos, out, options=options)


def main(run: Path, photos: Path, work: Path, threads: int) -> None:
    """Leaves the triangulated model in WORK/model."""
    frames = read_table(run / "frames.parquet", "frames")
    frames = frames.filter(frames.column("usable"))
    ids, images = frames.column("frame_id").to_pylist(), frames.column("image").to_pylist()
    cameras = set(camera_by_frame(frames, cameras_of(read_table(run / "cameras.parquet", "cameras"))).values())
    if len(cameras) != 1:
        raise ValueError(f"{len(cameras)} cameras: this comparison is made for one")
    image_of = dict(zip(ids, images, strict=True))
    pairs = selected_pairs(read_table(run / "pairs.parquet", "pairs"))
    listed = work / "pairs.txt"
    listed.write_text("".join(f"{image_of[pair.ref]} {image_of[pair.src]}\n" for pair in pairs), encoding="utf-8")
    database = work / "database.db"
    extract(run, database, photos, images, cameras.pop(), threads=threads)
    match(database, listed, threads)
    model = posed_model(database, run, dict(zip(images, ids, strict=True)))
    triangulate(model, database, photos, work / "model", threads)


if __name__ == "__main__":
    if len(sys.argv) != 5:
        sys.exit("usage: python benchmarks/colmap_side.py RUN PHOTOS WORK THREADS")
    main(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4]))
