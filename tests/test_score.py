"""The stage score: from depths and tiles to metrics.json, on a scene whose scores are known beforehand."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pyproj
import pytest
from laspy.vlrs.known import WktCoordinateSystemVlr

from pipeline.engine.errors import EpiTransferError, InputError, NothingLeftError, UndeterminedError
from pipeline.engine.executors import Executor, ProcessExecutor, SerialExecutor
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.transform import to_enu
from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import enu_from_cam, quaternion_from_rotation
from schemas import DEPTHS, FRAMES, POSES, REFINED_CAMERAS, SCORES
from stages.score import STAGE, Config

ORIGIN = {"latitude_deg": 37.5, "longitude_deg": -78.3, "height_m": 120.0}
CAMERA = Camera("brown", 400, 300, 350.0, 350.0, 199.5, 149.5, (-0.05, 0.01, 0.0, 0.0, 0.0))
UNDULATION_M = -33.0
FRAMES_AT = {"f0": (0.0, 0.0), "f1": (0.0, 8.0), "f2": (5.0, 16.0)}
HEIGHT_M = 30.0
# What each method's depth is of the true one, and which share of its pixels it keeps.
METHODS = {"dlt": (1.2, 1.0), "epitransfer": (1.1, 0.75)}


@dataclass
class FakeContext:
    """What the engine lends, in memory and one process."""

    folder: Path
    tables: dict[str, pa.Table]
    settings: dict[str, Any]
    ingest: dict[str, Any]
    shard: int | None = None
    executor: Executor = field(default_factory=SerialExecutor)
    recorded: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    items: tuple[int, int] | None = None

    def read(self, name: str) -> pa.Table:
        return self.tables[name]

    def path(self, name: str) -> Path:
        return self.folder / name

    def output(self, name: str) -> Path:
        (self.folder / "out" / name).mkdir(parents=True, exist_ok=True)
        return self.folder / "out" / name

    @property
    def scratch(self) -> Path:
        # Made anew for every run, as the engine does.
        return Path(tempfile.mkdtemp(dir=self.folder))

    def setting(self, key: str) -> Any:
        assert key in STAGE.reads
        return self.settings.get(key, ("epitransfer", "dlt") if key == "depth.methods" else None)

    def facts(self, stage: str) -> Mapping[str, Any]:
        assert stage in STAGE.facts_of
        return self.ingest

    def record(self, key: str, value: Any) -> None:
        self.recorded[key] = json.loads(json.dumps(value))

    def warn(self, text: str) -> None:
        self.warnings.append(text)

    def count_items(self, total: int, failed: int) -> None:
        self.items = (total, failed)

    def map(self, function: Callable, items: Iterable, *, shard: int, label: str, here: bool = False) -> Iterator[Any]:
        assert label
        assert not here
        listed: Sequence = list(items)
        size = self.shard or shard
        return self.executor.map(function, [listed[i : i + size] for i in range(0, len(listed), size)])


def write_lidar(path: Path, crs: str = "EPSG:32617+5703", centre: tuple[float, float] = (0.0, 60.0)) -> Path:
    """Flat ground at up 0, 6 returns per square metre."""
    rng = np.random.default_rng(0)
    e, n = np.meshgrid(np.arange(-60.0, 60.0, 0.4) + centre[0], np.arange(-60.0, 60.0, 0.4) + centre[1])
    enu = np.column_stack([e.ravel(), n.ravel(), np.zeros(e.size)])
    enu[:, :2] += rng.uniform(0.0, 0.4, (e.size, 2))
    heights = pyproj.CRS(crs if "+" in crs else f"{crs}+5703")
    xyz = to_enu(heights, LocalFrame(**ORIGIN), UNDULATION_M, "ellipsoidal").from_enu(enu)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.vlrs.append(WktCoordinateSystemVlr(pyproj.CRS(crs).to_wkt("WKT1_GDAL")))
    header.global_encoding.wkt = True
    header.scales, header.offsets = np.full(3, 0.001), np.floor(xyz.min(axis=0))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.write(path)
    return path


def rotation() -> np.ndarray:
    return enu_from_cam(0.0, np.radians(-40.0), 0.0)


def depth_rows() -> list[dict[str, Any]]:
    rng = np.random.default_rng(1)
    rows = []
    for frame in FRAMES_AT:
        pixels = rng.uniform((10, 10), (390, 290), (400, 2))
        down = -(CAMERA.rays(pixels) @ rotation().T)[:, 2]
        truth = np.where(down > 0.0, HEIGHT_M / down, np.nan)
        for method, (scale, share) in METHODS.items():
            for k, (u, v) in enumerate(pixels):
                depth = scale * truth[k]
                rows.append(
                    {"pair_id": f"{frame}~x", "frame_id": frame, "u": u, "v": v, "src_u": u, "src_v": v,
                     "method": method, "depth_m": depth,
                     "sigma_depth_m": 0.08 * depth, "parallax_deg": 3.0, "kept": k % 4 < 4 * share, "reason": ""}
                )  # fmt: skip
    return rows


def make_context(folder: Path, *, datum: str = "ellipsoidal", **changes: Any) -> FakeContext:
    q = quaternion_from_rotation(rotation())
    poses = [
        {"frame_id": name, "east_m": e, "north_m": n, "up_m": HEIGHT_M, "qw": q[0], "qx": q[1], "qy": q[2], "qz": q[3],
         "problem": ""}
        for name, (e, n) in FRAMES_AT.items()
    ]  # fmt: skip
    frames = [
        {**pose, "image": f"{pose['frame_id']}.jpg", "image_sha256": "", "camera_id": "c", "time_source": "",
         "usable": True, "height_datum": datum, "pose_source": ""}
        for pose in poses
    ]  # fmt: skip
    camera = {"camera_id": "c", "model": "brown", "width": 400, "height": 300, "fx": 350.0, "fy": 350.0, "cx": 199.5,
              "cy": 149.5, "distortion": CAMERA.distortion, "source": ""}  # fmt: skip
    (folder / "depths").mkdir(exist_ok=True)
    rows = depth_rows()
    half = next(i for i, row in enumerate(rows) if row["frame_id"] == "f1")
    for i, part in enumerate((rows[:half], rows[half:])):
        pq.write_table(DEPTHS.from_rows(part), folder / "depths" / f"part-{i:05d}.parquet")
    tables = {
        "frames": FRAMES.from_rows(frames),
        "poses": POSES.from_rows({**pose, "cov": np.zeros(36).tolist(), "refined": False} for pose in poses),
        "refined_cameras": REFINED_CAMERAS.from_rows([camera]),
    }
    return FakeContext(folder, tables, {"ingest.geoid": UNDULATION_M}, {"origin": ORIGIN}, **changes)


def config(lidar: Path, **values: Any) -> Config:
    return Config(lidar=str(lidar), **values)


def scores(context: FakeContext) -> dict[str, Any]:
    return json.loads((context.folder / "out" / "scores" / "metrics.json").read_text())


def test_known_depths_get_known_scores(tmp_path: Path) -> None:
    context = make_context(tmp_path)
    line = STAGE.run(config(write_lidar(tmp_path / "a.laz")), context)
    metrics = scores(context)
    dlt, epi = metrics["methods"]["dlt"], metrics["methods"]["epitransfer"]
    # 3 mm of quantisation and the plane fit are all that is between these and 0.2 and 0.1.
    assert dlt["all"]["abs_rel"] == pytest.approx(0.2, abs=2e-4)
    assert epi["all"]["abs_rel"] == pytest.approx(0.1, abs=2e-4)
    assert epi["all"]["rmse_log"] == pytest.approx(np.log(1.1), abs=2e-4)
    assert (dlt["all"]["delta1"], epi["all"]["delta1"]) == (1.0, 1.0)
    assert dlt["kept_share"] == 1.0
    assert 0.72 < epi["kept_share"] < 0.78
    assert dlt["common"]["n"] == epi["common"]["n"] == epi["all"]["n"] < dlt["all"]["n"]
    assert 800 < dlt["all"]["n"] <= 1200
    # 0.1 g of error against 0.088 g of sigma.
    calibration = metrics["calibration"]
    assert (calibration["method"], calibration["n"]) == ("epitransfer", epi["all"]["n"])
    assert (calibration["within_1_sigma"], calibration["within_2_sigma"]) == (0.0, 1.0)
    # Here the poses have no error.
    assert calibration.pop("without_pose") | {"method": "epitransfer"} == calibration
    assert calibration["mean_square"] == pytest.approx((0.1 / 0.088) ** 2, rel=0.01)
    fullest = max(calibration["by_sigma"], key=lambda one: one["n"])
    assert (fullest["predicted"], fullest["observed"]) == pytest.approx((0.08, 0.1 / 1.1), rel=0.01)
    # Parallax is 3 degrees everywhere, and the ground at most 100 m away.
    assert [one["from"] for one in epi["by_parallax"] if one["all"]["n"]] == [2.0]
    assert sum(one["all"]["n"] for one in epi["by_range"]) == epi["all"]["n"]
    assert 0.9 < epi["coverage"]["image_share"] <= dlt["coverage"]["image_share"] == 1.0
    assert metrics["map"]["rmse_z_m"] == pytest.approx(0.1 * HEIGHT_M, abs=0.01)
    assert 1.0 < metrics["map"]["rmse_h_m"] < 6.0
    assert [row["frame_id"] for row in epi["per_frame"]] == list(FRAMES_AT)
    assert sum(row["all"]["n"] for row in epi["per_frame"]) == epi["all"]["n"]
    assert line.startswith("AbsRel epitransfer 0.1000 (")
    assert ", dlt 0.2000 (" in line
    assert context.items == (3, 0)
    assert context.recorded["lidar_tiles"] == {"given": 1, "used": 1}


def test_pixels_hold_what_the_metrics_say(tmp_path: Path) -> None:
    context = make_context(tmp_path)
    STAGE.run(config(write_lidar(tmp_path / "a.laz")), context)
    file = tmp_path / "out" / "scores" / "pixels.parquet"
    SCORES.check_schema(pq.read_schema(file))
    pixels = pq.read_table(file).to_pandas()
    metrics = scores(context)
    for method, rows in pixels.groupby("method"):
        kept = rows[rows["kept"]]
        expected = ((kept["depth_m"] - kept["reference_m"]).abs() / kept["reference_m"]).mean()
        found = metrics["methods"][method]
        assert (found["all"]["n"], found["all"]["abs_rel"]) == (len(kept), pytest.approx(expected, rel=1e-10))
        assert found["kept_share"] == pytest.approx(len(kept) / len(rows), rel=1e-10)
    by_pixel = pixels.groupby(["pair_id", "u", "v"])["kept"]
    assert by_pixel.all().sum() == metrics["methods"]["dlt"]["common"]["n"]
    assert by_pixel.size().eq(2).all()


def test_processes_change_no_byte(tmp_path: Path) -> None:
    lidar = write_lidar(tmp_path / "a.laz")
    texts = []
    for name, executor in (("serial", SerialExecutor()), ("processes", ProcessExecutor(2))):
        (tmp_path / name).mkdir()
        context = make_context(tmp_path / name, shard=2, executor=executor)
        with executor:
            STAGE.run(config(lidar), context)
        written = tmp_path / name / "out" / "scores"
        texts.append([(written / file).read_bytes() for file in ("metrics.json", "pixels.parquet")])
    assert texts[0] == texts[1]


def test_range_is_measured_from_the_camera(tmp_path: Path) -> None:
    lidar = write_lidar(tmp_path / "a.laz")
    context = make_context(tmp_path)
    STAGE.run(config(lidar, max_range_m=45.0), context)
    pixels = pq.read_table(tmp_path / "out" / "scores" / "pixels.parquet").to_pandas()
    distance = pixels["reference_m"] * np.linalg.norm(CAMERA.rays(pixels[["u", "v"]].to_numpy()), axis=1)
    assert 43.0 < distance.max() <= 45.0
    assert len(pixels) > 100


@pytest.mark.parametrize("datum", ["takeoff", "unknown"])
def test_heights_of_no_datum_are_for_the_user_to_say(tmp_path: Path, datum: str) -> None:
    context = make_context(tmp_path, datum=datum)
    with pytest.raises(UndeterminedError, match=r"E-SCORE-02(.|\n)*ingest\.height_datum"):
        STAGE.run(config(write_lidar(tmp_path / "a.laz")), context)


def test_a_tile_elsewhere_is_told_with_both_boxes(tmp_path: Path) -> None:
    lidar = write_lidar(tmp_path / "a.laz", centre=(5000.0, 0.0))
    with pytest.raises(
        NothingLeftError, match=r"E-SCORE-03(.|\n)*LiDAR latitude 37(.|\n)*cameras: latitude 37\.49"
    ) as error:
        STAGE.run(config(lidar), make_context(tmp_path))
    assert error.value.exit_code == 5


def test_a_wrong_geoid_leaves_nothing_or_says_so_in_the_scores(tmp_path: Path) -> None:
    context = make_context(tmp_path)
    context.settings["ingest.geoid"] = UNDULATION_M + 200.0
    with pytest.raises(NothingLeftError, match=r"E-SCORE-04(.|\n)*ingest\.geoid"):
        STAGE.run(config(write_lidar(tmp_path / "a.laz")), context)


@pytest.mark.parametrize(
    ("break_it", "kind", "code"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:-3000]), InputError, "E-LIDAR-02"),
        (lambda path: path.write_bytes(b""), InputError, "E-LIDAR-02"),
        (lambda path: path.unlink(), InputError, "E-LIDAR-01"),
        (lambda path: write_lidar(path, "EPSG:32617"), UndeterminedError, "E-LIDAR-04"),
    ],
)
def test_bad_tiles_end_with_their_path_and_exit_code(
    tmp_path: Path, break_it: Callable[[Path], object], kind: type[EpiTransferError], code: str
) -> None:
    path = write_lidar(tmp_path / "bad.laz")
    break_it(path)
    with pytest.raises(kind, match=rf"{code}(.|\n)*bad\.laz"):
        STAGE.run(config(path), make_context(tmp_path))


def test_a_stated_height_datum_makes_up_for_a_flat_crs(tmp_path: Path) -> None:
    flat = write_lidar(tmp_path / "flat.laz", "EPSG:32617")
    context = make_context(tmp_path)
    STAGE.run(config(flat, lidar_height_datum="navd88"), context)
    assert scores(context)["methods"]["dlt"]["all"]["abs_rel"] == pytest.approx(0.2, abs=2e-4)
    assert any("navd88" in note for note in context.recorded["lidar_heights"])


def test_half_a_flight_without_lidar_is_told(tmp_path: Path) -> None:
    lidar = write_lidar(tmp_path / "a.laz")
    context = make_context(tmp_path)
    poses = context.tables["poses"].to_pylist()
    poses[2]["east_m"] = 3000.0
    context.tables["poses"] = POSES.from_rows(poses)
    STAGE.run(config(lidar), context)
    assert context.recorded["frames_that_see_no_truth"] == ["f2"]
    assert "1 of 3 frames" in context.warnings[0]
    last = scores(context)["methods"]["dlt"]["per_frame"][2]
    assert (last["n_scored"], last["kept_share"], last["all"]["abs_rel"]) == (0, None, None)
