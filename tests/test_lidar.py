"""LiDAR: tiles and their CRS, which returns are seen, and the reference depth at a pixel."""

from __future__ import annotations

import struct
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from laspy.vlrs.known import WktCoordinateSystemVlr

from pipeline.engine.errors import EpiTransferError, InputError, UndeterminedError, UsageError
from pipeline.geodesy.enu import LocalFrame
from pipeline.geodesy.transform import to_enu
from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import enu_from_cam
from pipeline.lidar.heightfield import HeightField, return_spacing_m
from pipeline.lidar.nearby import LocalTiles, returns_near
from pipeline.lidar.pieces import read_returns
from pipeline.lidar.reference import NEIGHBOURS, reference_depth
from pipeline.lidar.tile_crs import has_heights, tile_crs
from pipeline.lidar.tiles import Tile, expand, read_tile
from pipeline.lidar.visibility import View, VisibleReturns, behind_columns, in_image, visible_returns
from pipeline.simulation import tiles as simulation
from pipeline.simulation.flight import fly
from pipeline.simulation.render import CAMERA as LENS
from pipeline.simulation.site import Site

EVERYWHERE = np.full(2, -1e12), np.full(2, 1e12)
CAMERA = Camera("pinhole", 800, 600, 700.0, 700.0, 399.5, 299.5)
BARREL = Camera("brown", 800, 600, 700.0, 700.0, 399.5, 299.5, (-0.2, 0.03, 0.0005, -0.0003, 0.0))


def write_tile(path: Path, xyz: np.ndarray, crs: str | None = "EPSG:32617+5703", **fields: object) -> Path:
    header = laspy.LasHeader(point_format=6, version="1.4")
    if crs is not None:
        header.vlrs.append(WktCoordinateSystemVlr(pyproj.CRS(crs).to_wkt("WKT1_GDAL")))
        header.global_encoding.wkt = True
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(xyz.min(axis=0)) if len(xyz) else np.zeros(3)
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.classification = np.full(len(xyz), 2, np.uint8)
    for name, values in fields.items():
        setattr(las, name, values)
    las.write(path)
    return path


def some_points(n: int = 50) -> np.ndarray:
    return np.random.default_rng(0).uniform((0, 0, 0), (10, 10, 5), (n, 3)) + np.array([562000.0, 4150000.0, 100.0])


def all_returns(tile: Tile, **kwargs: int) -> np.ndarray:
    return np.concatenate([np.zeros((0, 3)), *read_returns(tile, *EVERYWHERE, **kwargs)])


def header_crs(path: Path) -> pyproj.CRS:
    with laspy.open(path, read_evlrs=True) as reader:
        return tile_crs(reader.header, path)


# ---- tiles


def test_a_tile_comes_back_by_chunk_and_by_box(tmp_path: Path) -> None:
    xyz = some_points()
    tile = read_tile(write_tile(tmp_path / "a.laz", xyz))
    assert tile.point_count == 50
    np.testing.assert_allclose(all_returns(tile, chunk_returns=7), xyz, atol=0.00051)
    west = list(read_returns(tile, np.array([0.0, 0.0]), np.array([562005.0, 1e9])))
    assert sum(map(len, west)) == (xyz[:, 0] <= 562005.0).sum()
    assert tile.meets(xyz.min(axis=0), xyz.max(axis=0))
    assert not tile.meets(xyz.max(axis=0) + 1.0, xyz.max(axis=0) + 2.0)


def test_noise_and_withheld_returns_are_dropped(tmp_path: Path) -> None:
    classes = np.array([2, 7, 18, 6, 2], np.uint8)
    path = write_tile(tmp_path / "a.las", some_points(5), classification=classes, withheld=np.array([0, 0, 0, 0, 1]))
    assert len(all_returns(read_tile(path))) == 2


def test_paths_globs_folders_and_lists(tmp_path: Path) -> None:
    for name in ("b.LAZ", "a.las", "c.txt"):
        (tmp_path / name).touch()
    both = (tmp_path / "a.las", tmp_path / "b.LAZ")
    assert set(expand(str(tmp_path))) == set(both)
    assert expand(str(tmp_path / "*.las")) == both[:1]
    assert expand([str(both[1]), str(tmp_path / "*.l*"), str(both[0])]) == (both[1], both[0])
    for missing in (str(tmp_path / "*.laz2"), str(tmp_path / "none.laz"), [str(both[0]), str(tmp_path / "x*")]):
        with pytest.raises(InputError, match="E-LIDAR-01"):
            expand(missing)


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.3, 0.7, 0.97, 0.999])
def test_a_truncated_tile_is_an_input_error(tmp_path: Path, suffix: str, share: float) -> None:
    path = write_tile(tmp_path / f"a.{suffix}", some_points(5000))
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(InputError, match=r"E-LIDAR-02(.|\n)*a\.la"):
        all_returns(read_tile(path))


@given(st.lists(st.tuples(st.integers(0, 600), st.integers(0, 255)), min_size=1, max_size=4), st.booleans())
@settings(max_examples=60, deadline=None)
def test_a_damaged_tile_never_shows_a_traceback(changes: list[tuple[int, int]], cut: bool) -> None:
    data = bytearray(damaged_base())
    for place, value in changes:
        data[place % len(data)] = value
    path = Path(damaged_folder().name) / "a.laz"
    path.write_bytes(data[: len(data) // 2] if cut else data)
    try:
        assert np.isfinite(all_returns(read_tile(path, "ellipsoidal"))).all()
    except EpiTransferError as error:
        assert str(path) in str(error)  # noqa: PT017


def damaged_folder(kept: list = []) -> object:  # noqa: B006
    import tempfile  # noqa: PLC0415

    if not kept:
        kept.append(tempfile.TemporaryDirectory())
    return kept[0]


def damaged_base(kept: list[bytes] = []) -> bytes:  # noqa: B006
    if not kept:
        kept.append(write_tile(Path(damaged_folder().name) / "base.laz", some_points()).read_bytes())
    return kept[0]


def test_more_records_than_the_file_can_hold(tmp_path: Path) -> None:
    path = write_tile(tmp_path / "a.laz", some_points())
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, 100, 4_000_000_000)
    path.write_bytes(data)
    with pytest.raises(InputError, match="E-LIDAR-02"):
        read_tile(path)


def test_a_text_file_and_a_folder_are_not_tiles(tmp_path: Path) -> None:
    (tmp_path / "a.laz").write_text("east north up\n" * 100)
    (tmp_path / "b.laz").mkdir()
    for name in ("a.laz", "b.laz", "none.laz"):
        with pytest.raises(InputError, match="E-LIDAR-02"):
            read_tile(tmp_path / name)


def test_a_tile_without_returns_meets_nothing(tmp_path: Path) -> None:
    tile = read_tile(write_tile(tmp_path / "a.las", np.zeros((0, 3))))
    assert tile.point_count == 0
    assert not tile.meets(*EVERYWHERE)
    assert len(all_returns(tile)) == 0


def test_bounds_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    path = write_tile(tmp_path / "a.las", some_points())
    data = bytearray(path.read_bytes())
    struct.pack_into("<d", data, 179, float("nan"))
    path.write_bytes(data)
    with pytest.raises(InputError, match="E-LIDAR-08"):
        read_tile(path)


# ---- CRS


def test_no_crs_and_no_heights_are_for_the_user_to_say(tmp_path: Path) -> None:
    with pytest.raises(UndeterminedError, match=r"E-LIDAR-03(.|\n)*none\.laz(.|\n)*pdal translate"):
        read_tile(write_tile(tmp_path / "none.laz", some_points(), None))
    flat = write_tile(tmp_path / "flat.laz", some_points(), "EPSG:32617")
    with pytest.raises(UndeterminedError, match=r"E-LIDAR-04(.|\n)*lidar_height_datum"):
        read_tile(flat)
    assert read_tile(flat, "navd88").crs.sub_crs_list[1].to_epsg() == 5703
    assert read_tile(flat, "EPSG:6360").crs.sub_crs_list[1].axis_info[0].unit_name == "US survey foot"
    assert len(read_tile(flat, "ellipsoidal").crs.axis_info) == 3
    for nonsense in ("navd8", "EPSG:32617", "EPSG:99999"):
        with pytest.raises(UsageError, match="E-LIDAR-07"):
            read_tile(flat, nonsense)


def test_the_tile_s_own_heights_go_before_stated_ones(tmp_path: Path) -> None:
    path = write_tile(tmp_path / "a.laz", some_points(), "EPSG:32617+5703")
    assert read_tile(path, "ellipsoidal").crs.sub_crs_list[1].to_epsg() == 5703


def geokey_header(keys: dict[int, int]) -> laspy.LasHeader:
    header = laspy.LasHeader(point_format=1, version="1.2")
    body = struct.pack("<4H", 1, 1, 0, len(keys))
    body += b"".join(struct.pack("<4H", key, 0, 1, value) for key, value in keys.items())
    vlr = laspy.vlrs.known.GeoKeyDirectoryVlr()
    vlr.parse_record_data(body)
    header.vlrs.append(vlr)
    return header


@pytest.mark.parametrize(
    ("keys", "vertical", "metres"),
    [
        ({3072: 32617, 4096: 5703}, 5703, 1.0),
        ({3072: 32617, 4096: 5103}, 5703, 1.0),
        ({3072: 32617, 4096: 5703, 4099: 9003}, 6360, 1200 / 3937),
        ({3072: 2903, 4096: 5703, 4099: 9002}, 8228, 0.3048),
    ],
)
def test_geotiff_keys_carry_the_vertical_part(keys: dict[int, int], vertical: int, metres: float) -> None:
    crs = tile_crs(geokey_header(keys), Path("a.las"))
    assert crs.sub_crs_list[0].to_epsg() == keys[3072]
    assert crs.sub_crs_list[1].to_epsg() == vertical
    assert crs.sub_crs_list[1].axis_info[0].unit_conversion_factor == pytest.approx(metres, rel=1e-12)


def test_geotiff_ellipsoidal_and_user_defined() -> None:
    assert len(tile_crs(geokey_header({3072: 32617, 4096: 5030}), Path("a.las")).axis_info) == 3
    with pytest.raises(UndeterminedError, match="E-LIDAR-03"):
        tile_crs(geokey_header({3072: 32767}), Path("a.las"))
    with pytest.raises(UndeterminedError, match="E-LIDAR-06"):
        tile_crs(geokey_header({3072: 32617, 4096: 1025}), Path("a.las"))


@pytest.mark.real
def test_real_tiles_say_what_their_heights_are_or_are_refused(shared: Path) -> None:
    folder = shared / "data" / "lidar"
    tiles = sorted(folder.glob("*/*.la[sz]"))
    assert len(tiles) >= 7
    flat = []
    for path in tiles:
        try:
            assert has_heights(header_crs(path))
        except UndeterminedError as error:
            flat.append((path.name, error.code))
    # The COPC tile has a compound WKT, the .las from New Mexico a vertical GeoTIFF key.
    compound = ("1.2-with-color.copc.laz", "4_6_crop.las")
    assert flat == [(path.name, "E-LIDAR-04") for path in tiles if path.name not in compound]


@pytest.mark.real
def test_a_real_compound_tile_with_heights_in_feet(shared: Path) -> None:
    tile = read_tile(shared / "data" / "lidar" / "pdal" / "1.2-with-color.copc.laz")
    vertical = tile.crs.sub_crs_list[1].axis_info[0]
    assert tile.crs.sub_crs_list[0].axis_info[0].unit_name == "metre"
    assert vertical.unit_name == "US survey foot"
    xyz = all_returns(tile)
    assert 1000 < len(xyz) <= tile.point_count == 1065
    enu = to_enu(tile.crs, middle_frame(tile), -22.0, "ellipsoidal").enu_from(xyz)
    # The heights, and nothing else, shrink by the foot; the earth's curvature over the tile is a metre or two.
    assert np.ptp(enu[:, 2]) == pytest.approx(np.ptp(xyz[:, 2]) * 1200 / 3937, abs=2.5)
    assert np.allclose(np.ptp(enu[:, :2], axis=0), np.ptp(xyz[:, :2], axis=0), rtol=0.05)


@pytest.mark.real
def test_real_tiles_in_feet_need_the_unit_of_their_heights(shared: Path) -> None:
    folder = shared / "data" / "lidar"
    wkt_path = folder / "laspy" / "file_with_both_wkt_and_geotiff_vlrs.las"
    with pytest.raises(UndeterminedError, match=r"E-LIDAR-05(.|\n)*EPSG:6360"):
        read_tile(wkt_path, "navd88")
    assert "2011" in read_tile(wkt_path, "EPSG:6360").crs.name
    tile = read_tile(folder / "pdal" / "4_6_crop.las")
    assert tile.crs.sub_crs_list[1].to_epsg() == 6360
    enu = to_enu(tile.crs, middle_frame(tile), -20.0, "ellipsoidal").enu_from(np.array([tile.minimum, tile.maximum]))
    # 200 US survey feet each way and 61.8 up: 61 m, not 200.
    assert np.allclose(np.abs(enu[1] - enu[0]), [60.95, 60.96, 18.8], atol=0.6)


def middle_frame(tile: Tile) -> LocalFrame:
    middle = (np.array(tile.minimum) + tile.maximum) / 2.0
    transformer = pyproj.Transformer.from_crs(tile.crs.sub_crs_list[0], "EPSG:4979", always_xy=True)
    longitude, latitude = transformer.transform(*middle[:2])
    return LocalFrame(latitude, longitude, middle[2] * 0.3)


@pytest.mark.real
def test_a_real_tile_is_read_whole_and_its_classes_filtered(shared: Path) -> None:
    tile = read_tile(shared / "data" / "lidar" / "pdal" / "las_with_several_extra_byte_bloc.laz", "EPSG:5720")
    xyz = all_returns(tile, chunk_returns=200_000)
    assert len(xyz) == tile.point_count == 697_721
    np.testing.assert_allclose([xyz.min(axis=0), xyz.max(axis=0)], [tile.minimum, tile.maximum], atol=0.01)
    assert 0.30 < return_spacing_m(xyz) < 0.40


# ---- near the cameras

FRAME = LocalFrame(37.5, -78.3, 120.0)


def enu_tile(path: Path, enu: np.ndarray) -> Path:
    return write_tile(path, to_enu(pyproj.CRS("EPSG:32617+5703"), FRAME, -33.0, "ellipsoidal").from_enu(enu))


def test_returns_near_cameras_come_in_the_local_frame(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    enu = rng.uniform((-200, -200, -5), (200, 200, 5), (4000, 3))
    paths = [enu_tile(tmp_path / "a.laz", enu[:2000]), enu_tile(tmp_path / "b.laz", enu[2000:])]
    local = LocalTiles(tuple(map(read_tile, paths)), FRAME, -33.0, "ellipsoidal")
    centres = np.array([[0.0, 0.0, 30.0], [60.0, 10.0, 30.0]])
    found = returns_near(local, centres, 50.0)
    near = np.min([np.hypot(*(enu - c)[:, :2].T) for c in centres], axis=0) <= 50.0
    np.testing.assert_allclose(found, enu[near], atol=0.002)
    assert len(local.meeting(centres, 50.0)) == 2
    assert local.meeting(centres + 1000.0, 50.0) == ()
    few = returns_near(local, centres, 50.0, most=100)
    assert 50 < len(few) <= 100
    assert {tuple(p) for p in few} <= {tuple(p) for p in found}
    assert np.ptp(few[:, 0]) > 100.0


# ---- visibility


def level_view(height_m: float = 20.0, pitch_deg: float = -20.0, camera: Camera = CAMERA) -> View:
    rotation = enu_from_cam(0.0, np.radians(pitch_deg), 0.0)
    return View(camera, np.array([0.0, 0.0, height_m]), rotation)


def grid_points(
    east: tuple[float, float], north: tuple[float, float], up: float, spacing: float, seed: int
) -> np.ndarray:
    rng = np.random.default_rng(seed)
    e, n = (np.arange(low, high, spacing) for low, high in (east, north))
    ground = np.stack(np.meshgrid(e, n), axis=-1).reshape(-1, 2) + rng.uniform(0.0, spacing, (len(e) * len(n), 2))
    return np.column_stack([ground, np.full(len(ground), up) + rng.normal(0.0, 0.02, len(ground))])


def test_ground_behind_a_roof_is_hidden_though_its_wall_has_no_return() -> None:
    # A flat roof 8 m up, from north 30 to 40: its shadow on the ground ends at 40 * 20 / 12 = 66.7 m.
    spacing = 0.35
    ground = grid_points((-40, 40), (5, 95), 0.0, spacing, 1)
    under = (np.abs(ground[:, 0]) < 10) & (ground[:, 1] > 30) & (ground[:, 1] < 40)
    roof = grid_points((-10, 10), (30, 40), 8.0, spacing, 2)
    points = np.concatenate([ground[~under], roof])
    view = level_view()
    field = HeightField.of(points, return_spacing_m(points))
    seen = visible_returns(view, points, field, spacing, 100.0)
    index, _, _ = in_image(view, points, 100.0)
    kept = np.isin(index, seen.index)
    p = points[index]
    # A ray to the ground passes north 40 at 20 (1 - 40 / n) m up: hidden while that is below the roof.
    east_at_roof = p[:, 0] * 40.0 / p[:, 1]
    shadow = (p[:, 2] < 4.0) & (p[:, 1] > 40.0) & (p[:, 1] < 40.0 * 20.0 / 12.0) & (np.abs(east_at_roof) < 10.0)
    side = (p[:, 2] < 4.0) & (np.abs(east_at_roof) > 11.0) & (p[:, 1] > 40.0)
    on_roof = p[:, 2] > 4.0
    assert shadow.sum() > 1000
    assert 0.0 <= kept[shadow].mean() < 0.01
    assert 0.9 < kept[side & (np.abs(p[:, 0] / p[:, 1]) > 0.36)].mean() <= 1.0
    assert 0.9 < kept[on_roof].mean() <= 1.0
    # Hidden where some north on the way lies under the roof, and the ray there below it.
    enters = np.maximum(30.0, 0.6 * p[:, 1])
    leaves = np.minimum(np.minimum(40.0, p[:, 1]), 10.0 * p[:, 1] / np.maximum(np.abs(p[:, 0]), 1e-9))
    truth = on_roof | (enters >= leaves)
    assert (kept & truth).sum() / kept.sum() > 0.99
    assert 0.9 < (kept & truth).sum() / truth.sum() < 1.0


def test_a_near_plane_hides_a_far_one_in_the_z_buffer() -> None:
    # Two panels across the view that the height field is told nothing of; the near one covers the left half.
    rng = np.random.default_rng(3)
    near = np.column_stack([rng.uniform(-12, 0, 3000), np.full(3000, 20.0), rng.uniform(-8, 8, 3000)])
    far = np.column_stack([rng.uniform(-24, 24, 24000), np.full(24000, 40.0), rng.uniform(-16, 16, 24000)])
    points = np.concatenate([near, far])
    nothing = HeightField(np.zeros(2), 1.0, np.full((1, 1), -np.inf))
    seen = visible_returns(level_view(0.0, 0.0), points, nothing, 0.25, 100.0)
    kept = np.zeros(len(points), bool)
    kept[seen.index] = True
    index, _, _ = in_image(level_view(0.0, 0.0), points, 100.0)
    framed = np.zeros(len(points), bool)
    framed[index] = True
    is_far = np.arange(len(points)) >= 3000
    behind = framed & is_far & (points[:, 0] < -1.0) & (np.abs(points[:, 2]) < 15.0)
    beside = framed & is_far & (points[:, 0] > 1.5)
    assert behind.sum() > 3000
    assert 0.0 <= kept[behind].mean() < 0.01
    assert 0.98 < kept[beside].mean() <= 1.0
    assert 0.98 < kept[framed & ~is_far].mean() <= 1.0


def test_a_lone_return_is_dropped() -> None:
    points = np.concatenate([grid_points((-30, 30), (20, 90), 0.0, 0.4, 4), [[0.0, 40.0, 15.0]]])
    field = HeightField.of(points[:-1], 0.4)
    assert len(points) - 1 not in visible_returns(level_view(), points, field, 0.4, 100.0).index


@pytest.mark.parametrize("camera", [CAMERA, BARREL])
def test_in_image_keeps_what_is_in_front_within_range_and_in_the_frame(camera: Camera) -> None:
    rng = np.random.default_rng(5)
    view = level_view(20.0, -20.0, camera)
    points = rng.uniform((-150, -150, -10), (150, 150, 40), (20_000, 3))
    index, pixels, depth = in_image(view, points, 60.0)
    assert len(index) > 200
    assert (pixels >= -0.5).all()
    assert (pixels <= (799.5, 599.5)).all()
    rebuilt = view.centre_in_enu_m + (camera.rays(pixels) * depth[:, None]) @ view.rotation_enu_from_cam.T
    np.testing.assert_allclose(rebuilt, points[index], atol=1e-4)
    distance = np.linalg.norm(points - view.centre_in_enu_m, axis=1)
    assert distance[index].max() <= 60.0
    # A cone well inside the image is kept whole.
    axis = (points - view.centre_in_enu_m) @ view.rotation_enu_from_cam[:, 2] / distance
    assert np.isin(np.flatnonzero((axis > np.cos(np.radians(20))) & (distance < 60.0)), index).all()


def test_all_directions_are_looked_up_without_a_seam() -> None:
    # A ring wall 5 m high at 20 m, the camera 3 m up in the middle: all beyond is hidden, all before it seen.
    rng = np.random.default_rng(6)
    angle = rng.uniform(-np.pi, np.pi, 40_000)
    wall = np.column_stack([20 * np.cos(angle), 20 * np.sin(angle), np.full(len(angle), 5.0)])
    field = HeightField.of(np.concatenate([wall, grid_points((-60, 60), (-60, 60), 0.0, 0.5, 7)]), 0.3)
    for radius, least, most in ((15.0, 0.0, 0.0), (40.0, 0.998, 1.0)):
        points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(len(angle))])
        hidden = behind_columns(np.array([0.0, 0.0, 3.0]), points, field, 100.0)
        assert least <= hidden.mean() <= most
        assert hidden[np.abs(angle) > 3.1].all() == (radius > 20.0)


@pytest.mark.slow
def test_visibility_on_the_synthetic_site_against_its_rays() -> None:
    site = Site.seeded(7)
    survey = simulation.survey(site)
    points = survey.p_in_enu_m[survey.classification != simulation.CLASS_NOISE]
    spacing = return_spacing_m(points)
    field = HeightField.of(points, spacing)
    flight = fly(site.terrain, 24, 7)
    right = kept_in_all = true_in_all = 0
    for i in range(1, 24, 5):
        view = View(LENS, flight.centre_in_enu_m[i], flight.rotation_enu_from_cam[i])
        index, _, _ = in_image(view, points, 100.0)
        # A return lies up to its noise below the surface, which at a grazing view is farther along the ray.
        raised = points[index] + (0.0, 0.0, 0.06)
        truth = site.sees(view.centre_in_enu_m, raised, 0.06)
        kept = np.isin(index, visible_returns(view, points, field, spacing, 100.0).index)
        right, kept_in_all, true_in_all = (
            right + (kept & truth).sum(),
            kept_in_all + kept.sum(),
            true_in_all + truth.sum(),
        )
    assert 0.99 < right / kept_in_all <= 1.0
    assert 0.92 < right / true_in_all < 1.0


# ---- reference depth


def seen_plane(normal: np.ndarray, offset: float, camera: Camera, noise: float = 0.0) -> VisibleReturns:
    rng = np.random.default_rng(8)
    pixels = rng.uniform((0, 0), (799, 599), (6000, 2))
    depth = offset / (camera.rays(pixels) @ normal)
    depth = depth + noise * rng.normal(size=len(depth))
    return VisibleReturns(np.arange(6000), pixels, depth, np.full(6000, 9.0))


@pytest.mark.parametrize("camera", [CAMERA, BARREL])
@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.1, 0.94, 0.34), (0.7, 0.0, 0.71)])
def test_reference_is_exact_on_slanted_planes(camera: Camera, normal: tuple[float, float, float]) -> None:
    plane = np.array(normal)
    visible = seen_plane(plane, 20.0, camera)
    front = visible.depth_m > 1.0
    visible = VisibleReturns(
        visible.index[front], visible.pixels[front], visible.depth_m[front], visible.footprint_px[front]
    )
    pixels = np.random.default_rng(9).uniform((40, 330), (760, 580), (500, 2))
    rays = camera.rays(pixels)
    found = reference_depth(camera, pixels, visible)
    assert found.valid.mean() > 0.7
    truth = 20.0 / (rays @ plane)
    np.testing.assert_allclose(found.depth_m[found.valid], truth[found.valid], rtol=1e-9)
    assert found.spread_m[found.valid].max() < 1e-6


def test_spread_is_the_noise_of_the_returns() -> None:
    visible = seen_plane(np.array([0.0, 0.0, 1.0]), 30.0, CAMERA, noise=0.05)
    pixels = np.random.default_rng(10).uniform((40, 40), (760, 560), (2000, 2))
    found = reference_depth(CAMERA, pixels, visible)
    assert 0.044 < np.sqrt(np.mean(found.spread_m[found.valid] ** 2)) < 0.056
    assert 0.01 < np.std(found.depth_m[found.valid] - 30.0) < 0.035


def test_no_reference_across_an_edge_off_the_data_or_without_enough() -> None:
    visible = seen_plane(np.array([0.0, 0.0, 1.0]), 30.0, CAMERA)
    step = VisibleReturns(
        visible.index, visible.pixels, np.where(visible.pixels[:, 0] < 400, 30.0, 36.0), visible.footprint_px
    )
    down = np.linspace(50, 550, 200)
    for u, share in ((400.0, (0.0, 0.05)), (300.0, (0.75, 1.0)), (500.0, (0.75, 1.0)), (1000.0, (0.0, 0.0))):
        pixels = np.column_stack([np.full(200, u), down])
        found = reference_depth(CAMERA, pixels, step)
        assert share[0] <= found.valid.mean() <= share[1]
        np.testing.assert_array_equal(np.isfinite(found.depth_m), found.valid)
    few = VisibleReturns(
        *(values[: NEIGHBOURS - 1] for values in (step.index, step.pixels, step.depth_m, step.footprint_px))
    )
    assert not reference_depth(CAMERA, pixels, few).valid.any()
    nan = np.full((3, 2), np.nan)
    assert not reference_depth(CAMERA, nan, step).valid.any()


def test_height_field_fills_small_gaps_only() -> None:
    points = grid_points((0, 60), (0, 60), 3.0, 0.5, 11)
    small = (np.abs(points[:, 0] - 20) < 0.8) & (np.abs(points[:, 1] - 20) < 0.8)
    large = (np.abs(points[:, 0] - 45) < 6) & (np.abs(points[:, 1] - 45) < 6)
    field = HeightField.of(points[~small & ~large], 0.5)
    assert field.at(np.array([20.0]), np.array([20.0]))[0] == pytest.approx(3.0, abs=0.1)
    assert field.at(np.array([45.0, 1e4]), np.array([45.0, 0.0])).tolist() == [-np.inf, -np.inf]
    assert 0.45 < return_spacing_m(points) < 0.55
