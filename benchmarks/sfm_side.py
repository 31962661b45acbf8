"""COLMAP's own way from photos to poses and points: extract, match all pairs, map incrementally.

usage: python benchmarks/sfm_side.py PHOTOS WORK THREADS [RUN]

WORK is an empty folder, where the database, the largest model and the seconds of each step are left. All options are
COLMAP's defaults but the processor instead of a graphics card, the threads and the seeds. With RUN its camera is given
and held; without, COLMAP takes the focal length from the tags and calibrates its default model by itself.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import pycolmap
from colmap_side import MODEL, SEED, parameters

from pipeline.engine.tables import read_table
from pipeline.flight import cameras_of


def extract(database: Path, photos: Path, threads: int, run: Path | None) -> None:
    """SIFT on the processor."""
    reader = pycolmap.ImageReaderOptions()
    if run is not None:
        (camera,) = cameras_of(read_table(run / "cameras.parquet", "cameras")).values()
        reader.camera_model = MODEL
        reader.camera_params = ",".join(repr(value) for value in parameters(camera))
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.use_gpu = threads, False
    mode, device = pycolmap.CameraMode.SINGLE, pycolmap.Device.cpu
    pycolmap.extract_features(
        database, photos, camera_mode=mode, reader_options=reader, extraction_options=options, device=device
    )


def match(database: Path, threads: int) -> None:
    """All pairs, with COLMAP's own verification."""
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads, options.use_gpu = threads, False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    pycolmap.match_exhaustive(
        database, matching_options=options, verification_options=verification, device=pycolmap.Device.cpu
    )


def reconstruct(database: Path, photos: Path, out: Path, threads: int, *, held: bool) -> None:
    """Incremental mapping; leaves the model of most images in OUT.

    Raises:
        RuntimeError: There is none.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = threads, SEED
    if held:
        options.ba_refine_focal_length = options.ba_refine_extra_params = options.ba_refine_principal_point = False
    made = out.with_name("models")
    made.mkdir()
    models = pycolmap.incremental_mapping(database, photos, made, options=options)
    if not models:
        raise RuntimeError("COLMAP found no model")
    out.mkdir()
    max(models.values(), key=lambda model: model.num_reg_images()).write(out)


def main(photos: Path, work: Path, threads: int, run: Path | None) -> None:
    """Leaves the model in WORK/model and the seconds in WORK/seconds.json."""
    database = work / "database.db"
    marks = [time.perf_counter()]
    extract(database, photos, threads, run)
    marks.append(time.perf_counter())
    match(database, threads)
    marks.append(time.perf_counter())
    reconstruct(database, photos, work / "model", threads, held=run is not None)
    marks.append(time.perf_counter())
    steps = ("extract", "match", "map")
    seconds = {name: end - start for name, start, end in zip(steps, marks[:-1], marks[1:], strict=True)}
    (work / "seconds.json").write_text(json.dumps(seconds), encoding="utf-8")


if __name__ == "__main__":
    if len(sys.argv) not in (4, 5):
        sys.exit("usage: python benchmarks/sfm_side.py PHOTOS WORK THREADS [RUN]")
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]) if len(sys.argv) == 5 else None)
