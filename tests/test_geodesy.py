"""The local frame, vertical datums and the output CRS, against PROJ's own pipelines."""

import pickle
import struct
from pathlib import Path

import numpy as np
import pyproj
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.engine.errors import InputError, UndeterminedError, UsageError
from pipeline.geodesy.crs import output_crs, utm_zone
from pipeline.geodesy.enu import LocalFrame, ecef_from_geodetic, geodetic_from_ecef
from pipeline.geodesy.heights import DATUMS, Geoid, datum_of_vertical, height_datum
from pipeline.geodesy.transform import CrsTransform, to_enu

# Longitude -78.3 is 2.7 degrees east of zone 17's central meridian: 1.64 degrees of grid convergence.
SITE = LocalFrame(37.5, -78.3, 120.0)
ORIGIN = np.zeros(3)
latitudes = st.floats(-83.9, 83.9)
longitudes = st.floats(-180.0, 180.0)


def ring(radius_m: float) -> np.ndarray:
    angle = np.radians(np.arange(0, 360, 15.0))
    return np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), 10.0 * np.sin(3 * angle)], axis=-1)


def proj_utm(frame: LocalFrame, points: np.ndarray, zone: int) -> np.ndarray:
    """UTM of ENU points by PROJ alone."""
    origin = f"+lat_0={frame.latitude_deg!r} +lon_0={frame.longitude_deg!r} +h_0={frame.height_m!r}"
    chain = pyproj.Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 {origin} +step +inv +proj=cart +ellps=WGS84 "
        f"+step +proj=utm +zone={zone} +ellps=WGS84"
    )
    return np.stack(chain.transform(*points.T), axis=-1)


def write_gtx(path: Path, values: np.ndarray, *, lat: float, lon: float, step: float) -> Path:
    """A vertical grid in the GTX format: south-west corner, steps, rows from the south, big endian."""
    header = struct.pack(">ddddii", lat, lon, step, step, *values.shape)
    path.write_bytes(header + values.astype(">f4").tobytes())
    return path


@pytest.fixture
def sloping_geoid(tmp_path: Path) -> Path:
    north, east = np.mgrid[0:5, 0:5]
    # A space in the name: PROJ strings need quotes for it.
    return write_gtx(tmp_path / "a geoid.gtx", -33.0 + 0.4 * north + 0.1 * east**2, lat=37.0, lon=-79.0, step=0.25)


class TestFrame:
    def test_ecef_is_projs(self) -> None:
        rng = np.random.default_rng(1)
        lat, lon, h = rng.uniform(-90, 90, 2000), rng.uniform(-180, 180, 2000), rng.uniform(-11e3, 4e5, 2000)
        oracle = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(lon, lat, h)
        assert np.abs(ecef_from_geodetic(lat, lon, h) - np.stack(oracle, axis=-1)).max() < 5e-9

    @pytest.mark.parametrize(
        ("lat", "lon"), [(90.0, 0.0), (-90.0, 0.0), (0.0, 180.0), (1e-13, -180.0), (89.9999999, 7.0)]
    )
    def test_geodetic_at_the_poles_and_the_equator(self, lat: float, lon: float) -> None:
        back = geodetic_from_ecef(ecef_from_geodetic(lat, lon, 321.5))
        assert np.linalg.norm(ecef_from_geodetic(*back) - ecef_from_geodetic(lat, lon, 321.5)) < 5e-9
        assert abs(back[2] - 321.5) < 5e-9

    def test_enu_is_projs_topocentric(self) -> None:
        points = np.concatenate([ring(50.0), ring(3000.0)])
        chain = pyproj.Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
            f"+step +proj=topocentric +ellps=WGS84 +lat_0={SITE.latitude_deg} +lon_0={SITE.longitude_deg} "
            f"+h_0={SITE.height_m}"
        )
        lat, lon, h = SITE.geodetic_from_enu(points)
        oracle = np.stack(chain.transform(lon, lat, h), axis=-1)
        assert np.abs(oracle - points).max() < 1e-8

    def test_axes_point_east_north_up(self) -> None:
        lat, lon, h = SITE.latitude_deg, SITE.longitude_deg, SITE.height_m
        east, north, up = (
            SITE.enu_from_geodetic(*p) for p in ((lat, lon + 1e-3, h), (lat + 1e-3, lon, h), (lat, lon, h + 9))
        )
        assert east[0] > 80.0
        assert abs(east[1]) < 0.01
        assert north[1] > 110.0
        assert abs(north[0]) < 1e-6
        assert up == pytest.approx([0.0, 0.0, 9.0], abs=1e-8)

    def test_rotation_is_proper(self) -> None:
        rotation = SITE.rotation_ecef_from_enu
        assert np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(rotation) == pytest.approx(1.0)

    @settings(deadline=None)
    @given(latitudes, longitudes, st.floats(-400.0, 9000.0), st.floats(-5000.0, 5000.0), st.floats(-5000.0, 5000.0))
    def test_round_trip_anywhere(self, lat: float, lon: float, h: float, east: float, north: float) -> None:
        frame = LocalFrame(lat, lon, h)
        point = np.array([east, north, 77.0])
        assert np.abs(frame.enu_from_geodetic(*frame.geodetic_from_enu(point)) - point).max() < 1e-7


class TestGridConvergence:
    """The site at 1.6 degrees of convergence."""

    @pytest.mark.parametrize("radius_m", [50.0, 100.0, 200.0])
    def test_points_agree_with_an_independent_pipeline(self, radius_m: float) -> None:
        points = ring(radius_m)
        found = output_crs("auto", SITE, "ellipsoidal").from_enu(points)
        assert np.abs(found - proj_utm(SITE, points, 17)).max() < 1e-6

    @pytest.mark.parametrize("radius_m", [50.0, 200.0])
    def test_adding_metres_to_eastings_is_wrong(self, radius_m: float) -> None:
        crs = output_crs("auto", SITE, "ellipsoidal")
        naive = crs.from_enu(ORIGIN) + ring(radius_m)
        off = np.linalg.norm((naive - crs.from_enu(ring(radius_m)))[:, :2], axis=1)
        convergence = np.sin(np.radians(-78.3 + 81.0)) * np.sin(np.radians(37.5))
        assert off.min() > 1.0
        assert off.mean() == pytest.approx(radius_m * convergence, rel=0.02)

    def test_jacobian_holds_convergence_and_scale(self) -> None:
        jacobian = output_crs("auto", SITE, "ellipsoidal").jacobian(ORIGIN)
        assert np.degrees(np.arctan2(jacobian[1, 0], jacobian[0, 0])) == pytest.approx(1.6444, abs=1e-3)
        # The grid's scale on the ellipsoid, by PROJ, and what 120 m above it take off.
        grid = pyproj.Proj("EPSG:32617").get_factors(SITE.longitude_deg, SITE.latitude_deg).parallel_scale
        prime_vertical = 6378137.0 / np.sqrt(1.0 - 0.00669438 * np.sin(np.radians(37.5)) ** 2)
        assert grid > 1.0002
        assert np.hypot(*jacobian[:2, 0]) == pytest.approx(grid * prime_vertical / (prime_vertical + 120.0), abs=2e-8)
        assert jacobian[2] == pytest.approx([0.0, 0.0, 1.0], abs=1e-8)

    def test_jacobian_of_many_points_is_the_difference_of_neighbours(self) -> None:
        crs = output_crs("auto", SITE, "ellipsoidal")
        points, step = ring(400.0), np.array([0.3, -0.2, 0.1])
        moved = crs.from_enu(points + step) - crs.from_enu(points)
        assert np.abs(np.einsum("nij,j->ni", crs.jacobian(points), step) - moved).max() < 5e-8


class TestOutputCrs:
    @settings(deadline=None, max_examples=60)
    @given(latitudes, longitudes, st.floats(-100.0, 5000.0))
    def test_auto_round_trips_anywhere(self, lat: float, lon: float, h: float) -> None:
        frame = LocalFrame(lat, lon, h)
        crs = output_crs("auto", frame, "ellipsoidal")
        points = ring(150.0)
        assert np.abs(crs.enu_from(crs.from_enu(points)) - points).max() < 1e-6
        assert crs.from_enu(ORIGIN)[0] == pytest.approx(500_000, abs=340_000)
        assert crs.from_enu(ORIGIN)[2] == pytest.approx(h, abs=1e-6)

    @pytest.mark.parametrize(
        ("lat", "lon", "code"), [(37.5, -78.3, 32617), (-33.9, 151.2, 32756), (0.0, 180.0, 32601), (10.0, 179.9, 32660)]
    )
    def test_utm_zone(self, lat: float, lon: float, code: int) -> None:
        assert utm_zone(LocalFrame(lat, lon, 0.0)).to_epsg() == code

    def test_no_utm_near_the_pole(self) -> None:
        with pytest.raises(UsageError, match="E-CRS-02"):
            utm_zone(LocalFrame(85.0, 0.0, 0.0))

    def test_auto_takes_the_vertical_part_of_the_source(self) -> None:
        assert "ellipsoidal" in str(output_crs("auto", SITE, "ellipsoidal").projjson).lower()
        compound = output_crs("auto", SITE, "egm96")
        assert compound.crs.is_compound
        assert compound.crs.sub_crs_list[1].to_epsg() == 5773
        assert compound.from_enu(ORIGIN)[2] == pytest.approx(SITE.height_m)
        assert pyproj.CRS.from_wkt(compound.wkt) == compound.crs

    def test_heights_made_ellipsoidal_go_back_by_the_geoid(self) -> None:
        crs = output_crs("auto", SITE, "ellipsoidal", -32.5, source_datum="egm96")
        assert crs.from_enu(ORIGIN)[2] == pytest.approx(120.0 + 32.5)
        assert "-32.5" in crs.height_note

    def test_takeoff_heights_get_a_vertical_crs_of_their_own(self) -> None:
        crs = output_crs("auto", SITE, "takeoff")
        assert crs.projjson["type"] == "CompoundCRS"
        assert crs.crs.sub_crs_list[1].name == "height above take-off"
        assert datum_of_vertical(crs.crs.sub_crs_list[1]) == "takeoff"
        assert datum_of_vertical(pyproj.CRS.from_json_dict(crs.projjson).sub_crs_list[1]) == "takeoff"

    @pytest.mark.parametrize("crs", ["auto", "EPSG:32617", "EPSG:32617+5703"])
    def test_an_unknown_datum_is_the_users_to_state(self, crs: str) -> None:
        with pytest.raises(UndeterminedError, match=r"ingest\.height_datum") as caught:
            output_crs(crs, SITE, "unknown", -30.0)
        assert caught.value.exit_code == 4

    def test_takeoff_heights_have_no_place_in_an_absolute_crs(self) -> None:
        with pytest.raises(UndeterminedError, match="E-HEIGHT-06"):
            output_crs("EPSG:32617+5703", SITE, "takeoff", -30.0)

    def test_a_horizontal_crs_gets_a_vertical_part(self) -> None:
        crs = output_crs("EPSG:32617", SITE, "ellipsoidal")
        assert len(crs.crs.axis_info) == 3
        assert crs.crs == output_crs("auto", SITE, "ellipsoidal").crs

    @pytest.mark.parametrize(
        ("crs", "why"),
        [
            ("EPSG:4326", "not projected"),
            ("EPSG:2284", "US survey foot"),
            ("EPSG:32617+6360", "US survey foot"),
            ("EPSG:32661", "south"),
            ("EPSG:27700", "area of use"),
            ("EPSG:1", "does not know"),
            ("UTM 17", "does not know"),
        ],
    )
    def test_unfit_crs_is_a_usage_error(self, crs: str, why: str) -> None:
        with pytest.raises(UsageError, match=why):
            output_crs(crs, SITE, "ellipsoidal", -30.0)

    def test_a_neighbouring_zone_is_allowed(self) -> None:
        crs = output_crs("EPSG:32618", SITE, "ellipsoidal")
        assert np.abs(crs.from_enu(ring(90.0)) - proj_utm(SITE, ring(90.0), 18)).max() < 1e-6

    def test_survives_a_process_boundary(self) -> None:
        crs = output_crs("auto", SITE, "egm96")
        copy = pickle.loads(pickle.dumps(crs))  # noqa: S301  # our own bytes
        assert np.array_equal(copy.from_enu(ring(9.0)), crs.from_enu(ring(9.0)))


class TestGeoid:
    @pytest.mark.filterwarnings("ignore:Best transformation:UserWarning")
    def test_the_trap_proj_returns_the_height_unchanged_without_its_grid(self) -> None:
        target = "EPSG:4326+5773"
        if pyproj.transformer.TransformerGroup("EPSG:4979", target, always_xy=True).best_available:
            pytest.skip("this machine has the EGM96 grid")
        silent = pyproj.Transformer.from_crs("EPSG:4979", target, always_xy=True)
        assert silent.transform(-78.3, 37.5, 120.0)[2] == 120.0
        with pytest.raises(UndeterminedError, match="us_nga_egm96") as caught:
            Geoid("egm96").undulation(37.5, -78.3)
        assert "ingest.geoid" in caught.value.hint

    def test_grid_file_is_read_bilinearly(self, sloping_geoid: Path) -> None:
        rng = np.random.default_rng(5)
        lat, lon = rng.uniform(37.0, 38.0, 200), rng.uniform(-79.0, -78.0, 200)
        row, col = (lat - 37.0) / 0.25, (lon + 79.0) / 0.25
        left = np.floor(col)
        across = 0.1 * (left**2 + (col - left) * (2 * left + 1))
        found = Geoid.of(str(sloping_geoid), "egm96").undulation(lat, lon)
        assert np.abs(found - (-33.0 + 0.4 * row + across)).max() < 1e-5

    def test_outside_the_grid_is_undetermined(self, sloping_geoid: Path) -> None:
        with pytest.raises(UndeterminedError, match=r"latitude 37\.500000, longitude -70\.000000"):
            Geoid("egm96", sloping_geoid).undulation([37.5, 37.5], [-78.5, -70.0])

    def test_constant(self) -> None:
        assert Geoid.of("-31.25", "navd88").undulation([1.0, 2.0], 3.0) == pytest.approx([-31.25, -31.25])

    def test_not_finite(self) -> None:
        with pytest.raises(UsageError, match="finite"):
            Geoid.of(float("nan"), "egm96")

    def test_unreadable_grids(self, tmp_path: Path) -> None:
        (tmp_path / "text.gtx").write_text("not a grid")
        for name, why in (("absent.gtx", "no such file"), ("text.gtx", "not a grid"), ("a,b.gtx", "comma")):
            with pytest.raises(InputError, match=why):
                Geoid("egm96", tmp_path / name).undulation(37.5, -78.3)

    def test_datum_names(self) -> None:
        assert [height_datum(name) for name in DATUMS] == list(DATUMS)
        assert height_datum("Ellipsoid") == "ellipsoidal"
        with pytest.raises(UsageError, match="did you mean egm2008"):
            height_datum("egm20008")


class TestDataCrs:
    """The way of LiDAR tiles into the frame."""

    def test_orthometric_tile_meets_ellipsoidal_frame_by_the_grid(self, sloping_geoid: Path) -> None:
        tiles = to_enu(pyproj.CRS("EPSG:32617+5703"), SITE, sloping_geoid, "ellipsoidal")
        points = ring(200.0)
        lat, lon, h = SITE.geodetic_from_enu(points)
        orthometric = h - Geoid("navd88", sloping_geoid).undulation(lat, lon)
        xyz = np.column_stack([proj_utm(SITE, points, 17)[:, :2], orthometric])
        assert np.abs(tiles.enu_from(xyz) - points).max() < 1e-6
        assert np.abs(tiles.from_enu(points) - xyz).max() < 1e-6

    def test_orthometric_frame_meets_ellipsoidal_tile(self) -> None:
        tiles = to_enu(pyproj.CRS("EPSG:32617").to_3d(), SITE, -32.0, "egm96")
        # The frame's 120 m are above the geoid, which lies 32 m below the ellipsoid.
        assert tiles.from_enu(ORIGIN)[2] == pytest.approx(88.0)
        assert tiles.enu_from(tiles.from_enu(ring(100.0))) == pytest.approx(ring(100.0), abs=1e-6)

    def test_feet_are_brought_to_metres(self) -> None:
        tiles = to_enu(pyproj.CRS("EPSG:2284+6360"), SITE, -32.0, "ellipsoidal")
        foot = 1200.0 / 3937.0
        assert tiles.from_enu(ORIGIN)[2] == pytest.approx(152.0 / foot)
        assert tiles.enu_from(tiles.from_enu(ring(100.0))) == pytest.approx(ring(100.0), abs=1e-6)
        # Not the metres of the grid by mistake: Virginia South's false easting is 11 482 916 ft.
        assert tiles.from_enu(ORIGIN)[0] > 1.1e7

    def test_same_datum_needs_no_geoid(self) -> None:
        tiles = to_enu(pyproj.CRS("EPSG:32617+5703"), SITE, None, "navd88")
        assert tiles.enu_from(tiles.from_enu(ring(100.0))) == pytest.approx(ring(100.0), abs=1e-6)

    def test_wkt1_without_a_code_is_known_by_its_datum(self) -> None:
        datum = 'VERT_DATUM["North American Vertical Datum 1988",2005]'
        vertical = f'VERT_CS["NAVD88 - Geoid18",{datum},UNIT["metre",1],AXIS["Up",UP]]'
        text = f'COMPD_CS["c",{pyproj.CRS("EPSG:32617").to_wkt("WKT1_GDAL")},{vertical}]'
        assert to_enu(pyproj.CRS.from_wkt(text), SITE, -32.0, "ellipsoidal").crs_datum == "navd88"

    def test_a_crs_without_heights_does_not_say(self) -> None:
        with pytest.raises(UndeterminedError, match="E-HEIGHT-07"):
            to_enu(pyproj.CRS("EPSG:32617"), SITE, None, "ellipsoidal")
        stated = CrsTransform(pyproj.CRS("EPSG:32617"), SITE, "ellipsoidal", -32.0, crs_datum="navd88")
        assert stated.from_enu(ORIGIN)[2] == pytest.approx(152.0)

    def test_takeoff_frame_cannot_meet_tiles(self) -> None:
        with pytest.raises(UndeterminedError, match="E-HEIGHT-06"):
            to_enu(pyproj.CRS("EPSG:32617+5703"), SITE, -32.0, "takeoff")
