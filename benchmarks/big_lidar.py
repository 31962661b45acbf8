"""A flight of 200 frames scored against tiles of a hundred million returns: time and memory beside laspy's own reading.

    python benchmarks/big_lidar.py FOLDER [MILLIONS] [ROUNDS]

Strips over 0.8 km2 of uneven ground with blocks on it, 60 m up, looking down; the survey was flown twice in lines that
cross the tiles, and its returns come in the order of time. The tiles and a run folder up to `depth` are written into
FOLDER where they are not there yet. Reading once is laspy's chunk iterator over all tiles with its default backend;
both are timed in turn, so that they share what the machine does beside. Memory is the resident size of all processes
of a command together, the largest seen.
"""

from __future__ import annotations

import json
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path

import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from laspy.vlrs.known import WktCoordinateSystemVlr
from measured import measured
from pyproj import CRS

from pipeline.engine.runfolder import RunFolder
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.transform import to_enu
from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import enu_from_cam, quaternion_from_rotation
from schemas import DEPTHS, FRAMES, PAIRS, POSE_COVARIANCES, POSES, REFINED_CAMERAS, RELATIVE_POSES

ORIGIN, UNDULATION_M, COMPOUND = LocalFrame(37.5, -78.3, 120.0), -33.0, "EPSG:32617+5703"
TILE_M, TILES = 200.0, (6, 4)
STRIPS, PER_STRIP, STEP_M, BESIDE_M, ABOVE_M = 8, 25, 40.0, 80.0, 60.0
CAMERA = Camera("brown", 1600, 1200, 1120.0, 1120.0, 799.5, 599.5, (-0.05, 0.01, 0.0, 0.0, 0.0))
MATCHES, METHODS = 3000, {"epitransfer": 1.01, "dlt": 1.03}
BLOCK_M, HALF_M, NOISE_M, WRITTEN_AT_ONCE = 50.0, np.array([12.0, 8.0]), 0.02, 1_000_000
READING = """
import sys
import laspy
for path in sys.argv[1:]:
    with laspy.open(path) as reader:
        for chunk in reader.chunk_iterator(1_000_000):
            pass
"""


def top(east: Floats, north: Floats) -> Floats:
    """Height of the ground or of the block that stands there."""
    ground = 4.0 * np.sin(east / 83.0) * np.cos(north / 61.0)
    column, row = np.floor(east / BLOCK_M), np.floor(north / BLOCK_M)
    aside = np.abs(east - (column + 0.5) * BLOCK_M) < HALF_M[0]
    aside &= np.abs(north - (row + 0.5) * BLOCK_M) < HALF_M[1]
    out: Floats = np.where(aside, 6.0 + (7.0 * column + 5.0 * row) % 11.0, ground)
    return out


def write_tile(job: tuple[Path, int, int, int]) -> None:
    """One tile: two passes of a scanner across it, in the order of time."""
    path, column, row, count = job
    rng = np.random.default_rng([column, row])
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.vlrs.append(WktCoordinateSystemVlr(CRS(COMPOUND).to_wkt("WKT1_GDAL")))
    header.global_encoding.wkt = True
    transform = to_enu(CRS(COMPOUND), ORIGIN, UNDULATION_M, "ellipsoidal")
    corner = np.array([column, row]) * TILE_M
    header.scales, header.offsets = np.full(3, 0.001), np.floor(transform.from_enu(np.array([*corner, 0.0])))
    with laspy.open(path, "w", header=header) as writer:
        for start in range(0, count, WRITTEN_AT_ONCE):
            writer.write_points(
                _returns(rng, header, corner, np.arange(start, min(start + WRITTEN_AT_ONCE, count)), count)
            )


def _returns(
    rng: np.random.Generator, header: laspy.LasHeader, corner: Floats, number: Floats, count: int
) -> laspy.ScaleAwarePointRecord:
    passed, along = np.divmod(2.0 * number / count, 1.0)
    # As many lines across as the returns of a line lie apart.
    lines = np.sqrt(count / 2.0)
    across = np.abs((along * lines + 0.5 * passed) % 2.0 - 1.0)
    place = np.where(passed[:, None] == 0.0, np.stack([along, across], 1), np.stack([across, along], 1)) * TILE_M
    place += corner + rng.normal(0.0, 0.03, place.shape)
    enu = np.column_stack([place, top(*place.T) + rng.normal(0.0, NOISE_M, len(place))])
    xyz = _in_crs(enu)
    record = laspy.ScaleAwarePointRecord.zeros(len(xyz), header=header)
    record.x, record.y, record.z = xyz.T
    record.intensity = rng.normal(20_000.0, 6_000.0, len(xyz)).clip(0, 65_535).astype(np.uint16)
    record.gps_time = 3e5 + number / 3e5 + rng.random(len(xyz)) * 1e-6
    record.classification = np.where(enu[:, 2] > 5.0, 6, 2).astype(np.uint8)
    record.return_number = np.ones(len(xyz), np.uint8)
    record.number_of_returns = np.ones(len(xyz), np.uint8)
    record.scan_angle = ((across - 0.5) * 6_000.0).astype(np.int16)
    record.point_source_id = (1 + passed).astype(np.uint16)
    return record


def _in_crs(enu: Floats) -> Floats:
    out: Floats = to_enu(CRS(COMPOUND), ORIGIN, UNDULATION_M, "ellipsoidal").from_enu(enu)
    return out


def flown() -> tuple[Floats, Floats]:
    """Centres (n, 3) and rotations enu_from_cam (n, 3, 3), strip by strip, there and back."""
    strip, along = np.divmod(np.arange(STRIPS * PER_STRIP), PER_STRIP)
    back = strip % 2 == 1
    east = 120.0 + np.where(back, PER_STRIP - 1 - along, along) * STEP_M
    centre = np.column_stack([east, 120.0 + strip * BESIDE_M, np.full(len(strip), ABOVE_M)])
    yaw = np.where(back, 1.5, 0.5) * np.pi
    return centre, enu_from_cam(yaw, np.full(len(yaw), np.radians(-80.0)), np.zeros(len(yaw)))


def true_depth(centre: Floats, rotation: Floats, pixels: Floats) -> Floats:
    """Depth along the optical axis of what each pixel shows, by marching along its ray."""
    rays = CAMERA.rays(pixels) @ rotation.T
    near, step = np.full(len(pixels), 30.0), 0.25
    above = np.ones(len(pixels), np.bool_)
    for depth in np.arange(30.0, 100.0, step):
        at = centre + depth * rays
        above &= at[:, 2] > top(at[:, 0], at[:, 1])
        near[above] = depth
    far = near + step
    for _ in range(20):
        middle = (near + far) / 2.0
        at = centre + middle[:, None] * rays
        free = at[:, 2] > top(at[:, 0], at[:, 1])
        near, far = np.where(free, middle, near), np.where(free, far, middle)
    return far


def write_run(root: Path, tiles: Path) -> None:
    """A run folder as `depth` leaves it."""
    root.mkdir(parents=True)
    centre, rotation = flown()
    names = [f"F{i:04d}" for i in range(len(centre))]
    q = quaternion_from_rotation(rotation)
    poses = [
        {"frame_id": name, "east_m": c[0], "north_m": c[1], "up_m": c[2], "qw": a[0], "qx": a[1], "qy": a[2],
         "qz": a[3], "problem": ""}
        for name, c, a in zip(names, centre, q, strict=True)
    ]  # fmt: skip
    frames = [
        {**pose, "image": f"{pose['frame_id']}.jpg", "image_sha256": "", "camera_id": "c", "time_source": "",
         "usable": True, "height_datum": "ellipsoidal", "pose_source": ""}
        for pose in poses
    ]  # fmt: skip
    camera = {"camera_id": "c", "model": CAMERA.model, "width": CAMERA.width, "height": CAMERA.height,
              "fx": CAMERA.fx, "fy": CAMERA.fy, "cx": CAMERA.cx, "cy": CAMERA.cy,
              "distortion": CAMERA.distortion, "source": ""}  # fmt: skip
    covariance = np.diag([1e-6] * 3 + [1e-4] * 3).ravel().tolist()
    tables = {
        "frames": FRAMES.from_rows(frames),
        "poses": POSES.from_rows({**pose, "cov": covariance, "refined": False} for pose in poses),
        "pose_covariances": POSE_COVARIANCES.empty(),
        "refined_cameras": REFINED_CAMERAS.from_rows([camera]),
        "pairs": PAIRS.empty(),
        "relative_poses": RELATIVE_POSES.empty(),
    }
    for name, table in tables.items():
        pq.write_table(table, root / f"{name}.parquet")
    for name in ("depths", "sweeps", "images"):
        (root / name).mkdir()
    for start in range(0, len(names), 20):
        parts = [_depths(names[i], centre[i], rotation[i], i) for i in range(start, min(start + 20, len(names)))]
        pq.write_table(pa.concat_tables(parts), root / "depths" / f"part-{start // 20:05d}.parquet")
    facts = {
        "world": "earth",
        "height_datum": "ellipsoidal",
        "sweep_points": 0,
        "photo_root": "",
        "origin": asdict(ORIGIN),
    }
    ingest = {"key": "", "parts": {}, "outputs": {}, "items": {"total": 0, "failed": 0}, "facts": facts}
    RunFolder(root).record_path("ingest").parent.mkdir()
    RunFolder(root).record_path("ingest").write_text(json.dumps(ingest))
    methods = json.dumps(list(METHODS))
    RunFolder(root).workflow.write_text(
        f'[ingest]\nphotos = "photos"\ngeoid = {UNDULATION_M}\n\n[depth]\nmethods = {methods}\n\n'
        f'[score]\nlidar = "{tiles}"\n'
    )


def _depths(frame_id: str, centre: Floats, rotation: Floats, number: int) -> pa.Table:
    rng = np.random.default_rng([7, number])
    pixels = rng.uniform(10.0, (CAMERA.width - 11.0, CAMERA.height - 11.0), (MATCHES, 2))
    depth = true_depth(centre, rotation, pixels)
    n, count = len(METHODS), len(pixels)
    times = np.tile(list(METHODS.values()), count)
    u, v = (np.repeat(axis, n) for axis in pixels.T)
    found = np.repeat(depth, n) * times
    columns: dict[str, object] = {
        "pair_id": [f"{frame_id}~x"] * (n * count), "frame_id": [frame_id] * (n * count), "u": u, "v": v, "src_u": u,
        "src_v": v, "method": list(METHODS) * count, "depth_m": found, "sigma_depth_m": 0.01 * found,
        "sigma_pixel_m": 0.005 * found, "parallax_deg": np.full(n * count, 8.0, np.float32),
        "kept": np.ones(n * count, np.bool_), "reason": [""] * (n * count),
    }  # fmt: skip
    empty = DEPTHS.arrow()
    for name in empty.names:
        columns.setdefault(name, pa.nulls(n * count, empty.field(name).type))
    return DEPTHS.from_columns(columns)


def write_tiles(folder: Path, count: int) -> None:
    """All tiles, in two processes."""
    folder.mkdir(parents=True)
    each = count // (TILES[0] * TILES[1])
    jobs = [(folder / f"t_{c}_{r}.laz", c, r, each) for c in range(TILES[0]) for r in range(TILES[1])]
    with ProcessPoolExecutor(2) as pool:
        list(pool.map(write_tile, jobs))


def main() -> None:
    """Prints the figures of each round."""
    folder = Path(sys.argv[1])
    millions = float(sys.argv[2]) if len(sys.argv) > 2 else 100.0
    rounds = int(sys.argv[3]) if len(sys.argv) > 3 else 3
    tiles, run = folder / f"tiles-{millions:g}", folder / f"run-{millions:g}"
    if not tiles.exists():
        began = time.perf_counter()
        write_tiles(tiles, int(millions * 1e6))
        print(f"{millions:g} million returns written in {time.perf_counter() - began:.0f} s")
    if not run.exists():
        write_run(run, tiles)
    paths = sorted(map(str, tiles.glob("*.laz")))
    size = sum(Path(path).stat().st_size for path in paths)
    print(f"{len(paths)} tiles, {size / 1e9:.2f} GB; {STRIPS * PER_STRIP} frames of {MATCHES} matches")
    for number in range(rounds):
        reading = measured([sys.executable, "-c", READING, *paths], folder / "reading.log")
        command = [sys.executable, "-c", "from stages.app import main; main()", "score", run, "--jobs", "2"]
        # Another key each time, or the stage would be up to date; no return is nearer to the limit than this.
        changed = f"score.max_range_m={100.0 + 1e-6 * (number + time.time() % 1)}"
        scored = measured([*command, "--set", changed], folder / "score.log")
        record = json.loads(RunFolder(run).record_path("score").read_text())
        facts = record["facts"]
        print(f"reading  {reading.wall_s:6.1f} s wall {reading.cpu_s:6.1f} s cpu {reading.memory_mib:6.0f} MiB")
        print(
            f"score    {scored.wall_s:6.1f} s wall {scored.cpu_s:6.1f} s cpu {scored.memory_mib:6.0f} MiB; the stage "
            f"itself {record['seconds']:.1f} s, its largest process {record['peak_memory_mib']:.0f} MiB"
        )
        print(
            f"ratio    {scored.wall_s / reading.wall_s:6.2f} (the stage itself "
            f"{record['seconds'] / reading.wall_s:.2f}); {facts['matches_with_reference']:,} of {facts['matches']:,} "
            f"with a reference; {record['summary']}"
        )


if __name__ == "__main__":
    main()
