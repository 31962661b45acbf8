"""The report's heavy figures: what is painted lies where it belongs, and no figure outgrows the page."""

from __future__ import annotations

import base64
import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pyproj import CRS, Transformer

from pipeline.engine.runfolder import RunFolder
from pipeline.flight import column, columns
from pipeline.geometry.arrays import AnyArray, Bytes, Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Placement
from pipeline.points.geoparquet import PointDataset, tile_table, write_dataset
from pipeline.reporting import cloud_view, error_plots, flown, overlays
from pipeline.reporting.error_sums import ErrorSums, Plan, error_sums
from pipeline.reporting.figure import Figure, axis_titles
from pipeline.reporting.gathered import RunData
from pipeline.reporting.ground import ground_of
from pipeline.reporting.painting import WIDEST_PX, backdrop, data_uri, painted, small
from pipeline.reporting.panels import panel
from pipeline.reporting.scales import DEPTH, RISING, SIGNED, coloured, stops
from pipeline.reporting.thinning import thinned
from pipeline.reporting.typed_arrays import singles, typed
from stages.registry import STAGES

RED = np.array([[255, 0, 0]], np.uint8)


def decoded(spec: Mapping[str, str]) -> AnyArray:
    """What plotly makes of a typed array."""
    flat = np.frombuffer(base64.b64decode(spec["bdata"]), "<" + spec["dtype"])
    return flat.reshape([int(n) for n in spec["shape"].split(",")]) if "shape" in spec else flat


def picture_of(figure: Figure) -> Bytes:
    """The picture of a panel, red, green, blue."""
    kind, _, text = figure.layout["images"][0]["source"].partition(",")
    assert kind == "data:image/webp;base64"
    found = cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_COLOR)
    assert found is not None
    return np.asarray(found[:, :, ::-1], np.uint8)


@pytest.fixture(scope="module")
def run(small_run: Path) -> RunData:
    """The small run."""
    folder = RunFolder(small_run)
    names = [name for stage in STAGES.values() for name in stage.outputs]
    paths = {name: folder.output(name) for name in names}
    records = {name: record for name in STAGES if (record := folder.record(name)) is not None}
    return RunData({name: path for name, path in paths.items() if path.exists()}, records)


def without(run: RunData, *names: str) -> RunData:
    """The run without some of its tables."""
    return RunData({name: path for name, path in run.paths.items() if name not in names}, run.records)


def everything(run: RunData) -> list[Figure]:
    """All figures of a run."""
    rows = overlays.rows(run)
    heavy = (*flown.figures(run), *cloud_view.figures(run), *error_plots.figures(run))
    return [*heavy, *(figure for row in rows for figure in row.panels)]


# Typed arrays


@given(
    st.sampled_from([np.float32, np.float64, np.uint8, np.int32]).flatmap(
        lambda kind: hnp.arrays(kind, hnp.array_shapes(max_dims=2, max_side=5))
    )
)
def test_typed_arrays_decode_to_their_values(values: AnyArray) -> None:
    np.testing.assert_array_equal(decoded(json.loads(json.dumps(typed(values)))), values)


def test_typed_arrays_keep_gaps_and_rows_and_refuse_what_plotly_does_not_know() -> None:
    grid = np.array([[1.0, np.nan, 3.0], [4.0, 5.0, 6.0]])
    assert singles(grid)["shape"] == "2, 3"
    np.testing.assert_array_equal(decoded(singles(grid)), grid)
    np.testing.assert_array_equal(decoded(typed(grid.T)), grid.T)
    with pytest.raises(KeyError):
        typed(np.arange(3))


# Painting


@given(
    st.integers(0, 1279), st.integers(0, 959), st.sampled_from([(1280, 960), (1600, 1200), (4000, 3000), (480, 360)])
)
def test_a_depth_is_painted_at_its_place(column_px: int, row_px: int, full: tuple[int, int]) -> None:
    u, v = min(column_px, full[0] - 1), min(row_px, full[1] - 1)
    ground = backdrop(None, full)
    picture = painted(ground, full, np.array([[u, v]], np.float64), RED)
    rows, across = np.nonzero((picture == RED[0]).all(axis=2))
    height, width = picture.shape[:2]
    assert width == min(full[0], WIDEST_PX)
    # The middle of a dot, in the pixels of the photo, edges of pixels counted from its corner.
    inside = 4 < u * width / full[0] < width - 5 and 4 < v * height / full[1] < height - 5
    if inside:
        middle = np.array([(across.mean() + 0.5) * full[0] / width, (rows.mean() + 0.5) * full[1] / height])
        np.testing.assert_allclose(middle, [u + 0.5, v + 0.5], atol=0.51 * full[0] / width)
    at = int(np.floor((u + 0.5) * width / full[0])), int(np.floor((v + 0.5) * height / full[1]))
    near = np.hypot(across - at[0], rows - at[1])
    assert near.min() <= 1.0
    assert near.max() <= 6.0
    assert len(rows) < 60


def test_the_first_and_the_last_pixel_are_in_the_corners() -> None:
    full = (1280, 960)
    for pixel, corner in (((0, 0), (0, 0)), ((1279, 959), (479, 639)), ((0, 959), (479, 0))):
        picture = painted(backdrop(None, full), full, np.array([pixel], np.float64), RED)
        assert tuple(picture[corner]) == (255, 0, 0)


def test_a_dot_s_centre_lies_over_rims_and_later_dots_over_earlier() -> None:
    full = (640, 480)
    colours = np.array([[255, 0, 0], [0, 255, 0]], np.uint8)
    picture = painted(backdrop(None, full), full, np.array([[100.0, 50.0], [102.0, 50.0]]), colours)
    assert tuple(picture[50, 100]) == (255, 0, 0)
    assert tuple(picture[50, 102]) == (0, 255, 0)
    picture = painted(backdrop(None, full), full, np.array([[100.0, 50.0], [100.0, 50.0]]), colours)
    assert tuple(picture[50, 100]) == (0, 255, 0)
    assert not (picture == colours[0]).all(axis=2).any()


def test_many_dots_are_small_dots_and_the_ground_is_a_dark_photo() -> None:
    rng = np.random.default_rng(4)
    photo = rng.integers(0, 256, (480, 640, 3)).astype(np.uint8)
    dark = backdrop(photo, (640, 480))
    assert dark.max() < 80
    assert np.ptp(dark, axis=2).max() == 0
    every = np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), axis=-1).reshape(-1, 2)
    ramp = coloured(every[:, 0], 0.0, 639.0, RISING)
    picture = painted(dark, (640, 480), every, ramp)
    np.testing.assert_array_equal(picture[:, 1:-1], ramp.reshape(480, 640, 3)[:, 1:-1])


def test_the_colour_bar_has_the_colours_that_are_painted() -> None:
    for scale in (RISING, DEPTH, SIGNED):
        places, colours = zip(*stops(scale), strict=True)
        assert (places[0], places[-1]) == (0.0, 1.0)
        values = 30.0 + 20.0 * np.array(places, np.float64)
        found = ["rgb({},{},{})".format(*colour) for colour in coloured(values, 30.0, 50.0, scale)]
        assert found == list(colours)
        np.testing.assert_array_equal(coloured(np.array([-9.0, 99.0]), 30.0, 50.0, scale), scale[[0, -1]])
    assert np.ptp(SIGNED[127].astype(int)) < 4
    # Light means near, and lightness never turns back.
    lightness = cv2.cvtColor(DEPTH[None], cv2.COLOR_RGB2LAB)[0, :, 0].astype(int)
    assert (np.diff(lightness) <= 1).all()
    assert lightness[0] - lightness[-1] > 80


def test_a_panel_counts_pixels_of_the_photo_downwards() -> None:
    figure = panel("k", "t", "c", np.zeros((120, 160, 3), np.uint8), (1600, 1200), 300.0)
    layout = figure.layout
    assert axis_titles(figure) == {"xaxis": "column u (px)", "yaxis": "row v (px)"}
    assert layout["xaxis"]["range"] == [-0.5, 1599.5]
    assert layout["yaxis"]["range"] == [1199.5, -0.5]
    assert layout["yaxis"]["scaleanchor"] == "x"
    image = layout["images"][0]
    assert (image["x"], image["y"], image["sizex"], image["sizey"]) == (-0.5, -0.5, 1600, 1200)


def test_a_photo_of_twenty_megapixels_stays_small() -> None:
    rng = np.random.default_rng(1)
    photo = cv2.resize(rng.integers(0, 256, (365, 547, 3)).astype(np.uint8), (5472, 3648))
    shown = small(np.asarray(photo, np.uint8))
    assert shown.shape == (427, 640, 3)
    assert 20_000 < len(data_uri(shown)) < 300_000


# Thinning


def cloud(folder: Path, xyz: Floats, pieces: int) -> PointDataset:
    """A dataset of points, in some tiles, x being their sigma."""
    folder.mkdir()
    tables = []
    for k, part in enumerate(np.array_split(xyz, pieces)):
        n = len(part)
        plain = {
            name: np.ones(n, np.float32) for name in ("cov_xy", "cov_xz", "cov_yz", "u", "v", "depth_m", "parallax_deg")
        }
        columns_of = {
            **plain,
            **{axis: part[:, i] for i, axis in enumerate("xyz")},
            **{
                f"sigma_{axis}_m": np.full(n, size, np.float32)
                for axis, size in zip("xyz", (2.0, 3.0, 6.0), strict=True)
            },
            **{name: np.ones(n, np.int64) for name in ("n_pairs", "n_frames")},
            "frame_id": ["f"] * n,
            **{name: np.full(n, 9, np.uint8) for name in ("red", "green", "blue")},
            "time": pa.nulls(n, pa.timestamp("ns", tz="UTC")),
        }
        tables.append(tile_table(columns_of, f"t_{k}"))
    write_dataset(folder, tables, CRS.from_epsg(32617).to_3d())
    return PointDataset(folder)


def test_thinning_is_bounded_even_and_the_same_however_the_points_are_stored(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    crowd = rng.uniform((0.0, 0.0, 0.0), (10.0, 10.0, 1.0), (20_000, 3))
    few = rng.uniform((0.0, 0.0, 0.0), (100.0, 100.0, 5.0), (500, 3))
    xyz = np.concatenate([crowd, few]) + np.array([7e5, 4e6, 100.0])
    whole, parts = cloud(tmp_path / "whole", xyz, 1), cloud(tmp_path / "parts", xyz, 7)
    shown = thinned(whole, 1_000)
    assert 400 < len(shown) <= 1_000
    np.testing.assert_array_equal(shown.xyz, thinned(parts, 1_000).xyz)
    np.testing.assert_array_equal(shown.xyz, thinned(whole, 1_000).xyz)
    # The crowd is 98 % of the points on 1 % of the ground.
    in_crowd = (shown.xyz[:, :2] < np.array([7e5, 4e6]) + 10.0).all(axis=1)
    assert in_crowd.mean() < 0.5
    assert (~in_crowd).sum() > 0.7 * 495
    np.testing.assert_allclose(shown.sigma_m, 7.0)
    stored = {tuple(point) for point in xyz}
    assert all(tuple(point) in stored for point in shown.xyz)


def test_a_grid_that_is_coarsened_does_not_tell_pieces_apart(tmp_path: Path) -> None:
    xyz = np.random.default_rng(5).uniform((0.0, 0.0, 0.0), (100.0, 80.0, 20.0), (12_000, 3))
    shown = thinned(cloud(tmp_path / "whole", xyz, 1), 300)
    assert 120 < len(shown) <= 300
    np.testing.assert_array_equal(shown.xyz, thinned(cloud(tmp_path / "parts", xyz, 5), 300).xyz)
    # Each fifth of the volume has its share.
    shares = np.histogram(shown.xyz[:, 0], 5, (0.0, 100.0))[0] / len(shown)
    assert shares.min() > 0.1


def test_few_points_are_all_shown(tmp_path: Path) -> None:
    xyz = np.random.default_rng(3).uniform(0.0, 9.0, (300, 3))
    assert len(thinned(cloud(tmp_path / "few", xyz, 2), 300)) == 300
    # All in one place: thinning still ends.
    assert len(thinned(cloud(tmp_path / "one", np.repeat(xyz[:1], 300, axis=0), 1), 10)) == 1


# Figures of a run


def test_every_figure_has_named_axes_unique_keys_and_a_bounded_size(run: RunData) -> None:
    shown = everything(run)
    assert {"map", "cloud", "error-spread", "error-image", "error-plan"} < {figure.key for figure in shown}
    assert len({figure.key for figure in shown}) == len(shown)
    for figure in shown:
        titles = axis_titles(figure)
        assert titles, figure.key
        for axis, title in titles.items():
            assert any(unit in title for unit in ("(m)", "(px)", "(%")), (figure.key, axis, title)
        text = json.dumps({"traces": figure.traces, "layout": figure.layout}, allow_nan=False)
        assert len(text) < (3_000_000 if figure.key in {"map", "cloud"} else 600_000), figure.key
        assert 200 < figure.height_px < 800
    for of_colour in [t["marker"] for f in shown for t in f.traces if t.get("marker", {}).get("showscale")]:
        assert "(" in of_colour["colorbar"]["title"]["text"]


def test_figures_are_the_same_every_time(run: RunData) -> None:
    one, two = (json.dumps([(f.traces, f.layout) for f in everything(run)]) for _ in range(2))
    assert one == two


def test_frames_are_on_the_map_where_their_photos_say(run: RunData) -> None:
    figure = flown.figures(run)[0]
    frames = next(trace for trace in figure.traces if trace["name"] == "frames")
    assert frames["text"] == run.poses.column("frame_id").to_pylist()
    assert "UTM zone 17N" in axis_titles(figure)["xaxis"]
    longitude, latitude = (column(run.frames, name) for name in ("longitude_deg", "latitude_deg"))
    east, north = Transformer.from_crs("EPSG:4326", "EPSG:32617", always_xy=True).transform(longitude, latitude)
    off = np.hypot(decoded(frames["x"]) - east, decoded(frames["y"]) - north)
    # Refinement moves frames by less than what their positions are known to.
    assert off.max() < 1.0
    points = next(trace for trace in figure.traces if trace["name"] == "points")
    assert 100 < len(decoded(points["x"])) <= flown.MOST_POINTS
    # The drone flies ahead, and looks at what it sees.
    sight = next(trace for trace in figure.traces if trace["name"] == "view direction")
    ends = np.column_stack([decoded(sight["x"]), decoded(sight["y"])]).reshape(-1, 3, 2)
    assert np.isnan(ends[:, 2]).all()
    middle = np.array([decoded(points["x"]).mean(), decoded(points["y"]).mean()])
    assert (np.linalg.norm(ends[:, 1] - middle, axis=1) < np.linalg.norm(ends[:, 0] - middle, axis=1)).mean() > 0.8


def test_pairs_are_drawn_selected_and_rejected(run: RunData) -> None:
    figure = flown.figures(run)[0]
    selected = int(pc.sum(run.pairs.column("selected")).as_py())
    for name, count in (("selected pairs", selected), ("rejected pairs", run.pairs.num_rows - selected)):
        trace = next(trace for trace in figure.traces if trace["name"] == name)
        assert len(decoded(trace["x"])) == 3 * count


def test_surveyed_points_are_on_the_map_where_the_scores_tell_their_place(run: RunData, tmp_path: Path) -> None:
    assert run.metrics is not None
    points = [{"name": "C1", "position_m": [0.0, 0.0, 0.0]}, {"name": "C2"}]
    told = {**run.metrics, "checkpoints": {"points": points}, "control_points": None}
    (tmp_path / "metrics.json").write_text(json.dumps(told))
    figure = flown.figures(RunData({**run.paths, "scores": tmp_path}, run.records))[0]
    trace = next(trace for trace in figure.traces if trace["name"] == "checkpoints")
    assert trace["text"] == ["C1"]
    origin = ground_of(run).place(np.zeros(3))
    np.testing.assert_allclose([decoded(trace["x"])[0], decoded(trace["y"])[0]], origin[:2], atol=0.006)


def test_the_buttons_of_the_cloud_recolour_its_points(run: RunData) -> None:
    figure = cloud_view.figures(run)[0]
    points, cameras = figure.traces
    n = len(decoded(points["x"]))
    assert n == PointDataset(run.points).rows <= cloud_view.MOST_POINTS
    assert points["x"]["dtype"] == "f4"
    buttons = figure.layout["updatemenus"][0]["buttons"]
    assert [button["label"] for button in buttons] == ["photo colours", "height", "sigma"]
    (change, which) = buttons[1]["args"]
    assert which == [0]
    np.testing.assert_allclose(decoded(change["marker.color"][0]), decoded(points["z"]), atol=0.006)
    assert len(buttons[0]["args"][0]["marker.color"][0]) == n
    assert (decoded(buttons[2]["args"][0]["marker.color"][0]) > 0.0).all()
    # The offset that the caption tells brings the points back.
    corner = ground_of(run).corner
    for value in corner[:2]:
        assert f"{value:,.0f}" in figure.caption
    low, high = np.array(PointDataset(run.points).bounds).reshape(2, 3)
    found = np.column_stack([decoded(points[axis]) for axis in "xyz"]) + corner
    np.testing.assert_allclose(found.min(axis=0), low, atol=0.02)
    np.testing.assert_allclose(found.max(axis=0), high, atol=0.02)
    assert len(set(cameras["text"])) == run.poses.num_rows


def test_a_camera_s_pyramid_opens_towards_what_it_sees() -> None:
    # Level, to the east: right is south, down the image is down.
    turn = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    placed = Placement(turn, np.array([1.0, 2.0, 10.0]))
    line = cloud_view.pyramid(placed, Camera("pinhole", 400, 200, 100.0, 100.0, 199.5, 99.5), 2.0)
    assert np.isnan(line[-1]).all()
    np.testing.assert_allclose(line[0], placed.centre)
    corners = np.unique(line[1:-1][line[1:-1, 0] > 1.5], axis=0)
    np.testing.assert_allclose(corners, [[3, -2, 8], [3, -2, 12], [3, 6, 8], [3, 6, 12]], atol=1e-12)


# Pictures


def test_the_worst_the_median_and_the_best_frame_are_among_those_shown(run: RunData) -> None:
    assert run.metrics is not None
    per_frame = run.metrics["methods"]["epitransfer"]["per_frame"]
    ranked = sorted((one for one in per_frame if one["all"]["n"]), key=lambda one: float(one["all"]["abs_rel"]))
    chosen = overlays.chosen_frames(run)
    assert len(chosen) == min(overlays.SHOWN, len(per_frame))
    assert list(chosen) == sorted(chosen)
    assert chosen[ranked[-1]["frame_id"]].startswith("largest AbsRel")
    assert chosen[ranked[0]["frame_id"]].startswith("smallest AbsRel")
    assert sum(why.startswith("median AbsRel") for why in chosen.values()) == 1
    plain = overlays.chosen_frames(without(run, "scores"))
    assert set(plain.values()) == {"one of several spread evenly over the flight"}
    assert list(plain) == list(chosen)


def test_a_row_has_the_photo_every_method_and_the_errors(run: RunData) -> None:
    rows = overlays.rows(run)
    methods = list(run.setting("depth", "methods"))
    for row in rows:
        names = [figure.key.removeprefix(f"overlay-{row.frame_id}-") for figure in row.panels]
        assert names[0] == "photo"
        assert names[1:3] == methods[:2]
        assert set(names[1 : 1 + len(methods)]) == set(methods)
        assert names[1 + len(methods) :] == [f"{name}-error" for name in methods[:2]]
        bars = [figure.traces[0].get("marker", {}) for figure in row.panels[1 : 1 + len(methods)]]
        assert len({(bar["cmin"], bar["cmax"]) for bar in bars}) == 1
        assert len({figure.height_px for figure in row.panels}) == 1


def test_depths_are_painted_at_their_pixels_and_nowhere_else(run: RunData) -> None:
    row = overlays.rows(run)[0]
    photo, published = row.panels[0], row.panels[1]
    table = pq.read_table(run.depths)
    mine = table.filter(
        (pc.field("frame_id") == row.frame_id) & (pc.field("method") == "epitransfer") & pc.field("kept")
    )
    assert published.caption == f"{mine.num_rows:,} depths."
    picture = picture_of(published).astype(int)
    assert picture.shape == picture_of(photo).shape
    assert picture.shape == (360, 480, 3)
    at = np.round(columns(mine, ("u", "v"))).astype(int)
    # WebP keeps colour in blocks of two pixels; a dot is wider than that.
    assert (np.ptp(picture[at[:, 1], at[:, 0]], axis=1) > 40).mean() > 0.97
    marked = np.zeros(picture.shape[:2], np.uint8)
    marked[at[:, 1], at[:, 0]] = 1
    far = cv2.dilate(marked, np.ones((15, 15), np.uint8)) == 0
    assert far.sum() > 1000
    assert (np.ptp(picture[far], axis=1) > 30).mean() < 1e-3
    # Near is yellow, where red outweighs blue; far is violet.
    bar = published.traces[0]["marker"]
    depth = np.asarray(column(mine, "depth_m"), np.float64)
    warm = picture[at[:, 1], at[:, 0], 0] - picture[at[:, 1], at[:, 0], 2]
    third = (bar["cmax"] - bar["cmin"]) / 4.0
    assert np.median(warm[depth < bar["cmin"] + third]) > 40
    assert np.median(warm[depth > bar["cmax"] - third]) < -40


def test_errors_are_coloured_by_their_sign(run: RunData, tmp_path: Path) -> None:
    for sign, colder in ((1.0, 0), (-1.0, 2)):
        folder = _scores_with(run, tmp_path / f"{sign}", lambda r, sign=sign: r * (1.0 + 0.1 * sign))
        row = overlays.rows(RunData({**run.paths, "scores": folder}, run.records))[0]
        figure = next(one for one in row.panels if one.key.endswith("epitransfer-error"))
        assert figure.traces[0]["marker"]["cmax"] == pytest.approx(10.0)
        picture = picture_of(figure).astype(int)
        dots = picture[np.ptp(picture, axis=2) > 60]
        assert len(dots) > 500
        assert (np.argmax(dots, axis=1) == colder).mean() > 0.97


def _scores_with(run: RunData, folder: Path, depth_of: Any, name: str | None = None) -> Path:
    """The scores with depths made from the reference, of every method or of one that only they have."""
    assert run.scores is not None
    shutil.copytree(run.scores, folder)
    table = pq.read_table(folder / "pixels.parquet")
    changed = table if name is None else table.filter(pc.field("method") == "dlt")
    reference = changed.column("reference_m").to_numpy()
    index = table.schema.get_field_index
    changed = changed.set_column(index("depth_m"), table.schema.field("depth_m"), pa.array(depth_of(reference)))
    if name is not None:
        names = pa.array([name] * changed.num_rows)
        changed = pa.concat_tables([table, changed.set_column(index("method"), table.schema.field("method"), names)])
    pq.write_table(changed, folder / "pixels.parquet")
    return folder


def test_a_learned_method_is_shown_from_its_scored_pixels(run: RunData, tmp_path: Path) -> None:
    folder = _scores_with(run, tmp_path / "scores", lambda r: 1.5 * r, "zoedepth")
    scored = RunData({**run.paths, "scores": folder}, run.records)
    row = overlays.rows(scored)[0]
    assert "ZoeDepth" in [figure.title for figure in row.panels]
    spread = error_plots.figures(scored)[0]
    zoe = next(trace for trace in spread.traces if trace["name"].startswith("ZoeDepth"))
    assert "100.0 % beyond" in zoe["name"]


def test_without_scores_there_are_no_errors_and_without_photos_the_ground_is_grey(run: RunData) -> None:
    bare = without(run, "scores", "points")
    assert error_plots.figures(bare) == []
    assert cloud_view.figures(bare) == []
    figure = flown.figures(bare)[0]
    assert axis_titles(figure) == {"xaxis": "east of the origin (m)", "yaxis": "north of the origin (m)"}
    assert "points" not in [trace["name"] for trace in figure.traces]
    ingest = {**run.records["ingest"], "facts": {**run.records["ingest"]["facts"], "photo_root": "/nowhere"}}
    lost = replace(bare, records={**run.records, "ingest": ingest})
    for row in overlays.rows(lost):
        assert not any(figure.key.endswith("error") for figure in row.panels)
        assert "grey" in row.panels[0].caption
        assert picture_of(row.panels[0]).std() < 1.0
        assert (np.ptp(picture_of(row.panels[1]).astype(int), axis=2) > 40).any()


def test_without_depths_there_are_no_rows(run: RunData) -> None:
    assert overlays.rows(without(run, "depths")) == []


# Errors


@pytest.fixture(scope="module")
def sums(run: RunData) -> ErrorSums:
    """The sums of the small run."""
    found = error_sums(run, ground_of(run))
    assert found is not None
    return found


def test_the_sums_are_those_of_the_scores(run: RunData, sums: ErrorSums) -> None:
    assert run.metrics is not None
    table = pq.read_table(run.paths["scores"] / "pixels.parquet").filter(pc.field("kept"))
    assert sums.methods[0] == "epitransfer"
    for m, name in enumerate(sums.methods):
        scored = run.metrics["methods"][name]["all"]
        mine = table.filter(pc.field("method") == name)
        depth, reference = (mine.column(one).to_numpy() for one in ("depth_m", "reference_m"))
        assert sums.histogram[m].sum() == sums.image_n[m].sum() == scored["n"]
        assert sums.image_sum[m].sum() / scored["n"] == pytest.approx(scored["abs_rel"], rel=1e-6)
        assert sums.plan_n[m].sum() > 0.99 * scored["n"]
        if sums.plan_n[m].sum() == scored["n"]:
            assert sums.plan_sum[m].sum() == pytest.approx(float((depth - reference).sum()), rel=1e-6)
        half = (np.abs(depth / reference - 1.0) * 100.0 <= sums.limit_percent(0.5)).mean() if m == 0 else 0.5
        assert half == pytest.approx(0.5, abs=0.05)


def test_errors_lie_on_the_ground_where_the_points_are(run: RunData, sums: ErrorSums) -> None:
    down, across = np.nonzero(sums.plan_n[0])
    at = sums.plan.corner + (np.column_stack([across, down]) + 0.5) * sums.plan.edge
    xyz = thinned(PointDataset(run.points), 40_000).xyz[:, :2]
    nearest = np.array([np.hypot(*(xyz - place).T).min() for place in at])
    assert np.median(nearest) < 1.0
    assert np.quantile(nearest, 0.95) < 4.0


def test_histograms_keep_their_pixels_in_fewer_bins() -> None:
    counts = np.zeros(10_000, np.int64)
    # 1 % and -1 %, and one pixel far off.
    counts[5_050], counts[4_949], counts[9_999] = 30, 10, 1
    centres, shares, beyond = ErrorSums.rebinned(counts, 2.0, 40)
    assert beyond == pytest.approx(1 / 41)
    assert shares.sum() == pytest.approx(40 / 41)
    np.testing.assert_allclose(centres, -centres[::-1], atol=1e-9)
    assert centres[np.argmax(shares)] == pytest.approx(1.0, abs=0.06)
    assert shares[np.argmin(np.abs(centres + 1.0))] == pytest.approx(10 / 41)


@given(hnp.arrays(np.float64, (7, 2), elements=st.floats(-1e4, 1e4, width=32)))
def test_a_plan_holds_its_places_in_cells_of_a_round_size(places: Floats) -> None:
    plan = Plan.around(places)
    cells = (places - plan.corner) / plan.edge
    assert (cells >= 0.0).all()
    assert (cells < plan.shape[::-1]).all()
    assert max(plan.shape) < 150
    assert float(f"{plan.edge:.0e}") == pytest.approx(plan.edge)
