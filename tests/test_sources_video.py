"""Videos: presentation times without decoding, frames exactly, and frames at a spacing along the way."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.engine.errors import InputError
from pipeline.sources.video import describe_video, frame_times, read_frames, srt_beside
from pipeline.tracks.spacing import spaced

WIDTH, HEIGHT, BITS = 128, 64, 8
CODECS = [codec for codec in ("libx264", "mpeg4") if codec in av.codecs_available]
# 30000/1001 Hz with a gap, as a recorder that drops frames leaves it; ticks of 1/30000 s.
TICKS = [1001 * i + (3003 if i >= 40 else 0) for i in range(75)]


def painted(number: int) -> np.ndarray:
    """A grey image whose eight columns are the bits of a number, bright or dark, above the same inverted."""
    bits = np.array([(number >> bit) & 1 for bit in range(BITS)])
    halves = np.stack([bits, 1 - bits]) * 180 + 40
    return np.kron(halves, np.ones((HEIGHT // 2, WIDTH // BITS))).astype(np.uint8)


def told(png: bytes) -> int:
    """The number painted in an image; the halves must agree."""
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image.shape == (HEIGHT, WIDTH)
    blocks = image.reshape(2, HEIGHT // 2, BITS, WIDTH // BITS).mean(axis=(1, 3))
    assert np.all(np.abs(blocks[0] - blocks[1]) > 120)
    return int(np.sum((blocks[0] > 128) << np.arange(BITS)))


def write_video(path: Path, codec: str = CODECS[0], ticks: Sequence[int] = TICKS, rotation_deg: int = 0) -> Path:
    with av.open(str(path), "w") as container:
        container.metadata["creation_time"] = "2024-06-01T08:12:03.000000Z"
        stream = container.add_stream(codec, rate=Fraction(30000, 1001))
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 30000)
        stream.codec_context.gop_size = 12
        stream.codec_context.max_b_frames = 2
        stream.bit_rate = 2_000_000
        if rotation_deg:
            stream.set_display_rotation(rotation_deg)
        for number, tick in enumerate(ticks):
            frame = av.VideoFrame.from_ndarray(painted(number), format="gray").reformat(format="yuv420p")
            frame.pts, frame.time_base = tick, Fraction(1, 30000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.fixture(scope="module", params=CODECS)
def video(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_video(tmp_path_factory.mktemp("video") / "DJI_0001.MP4", request.param)


def exact_ns() -> np.ndarray:
    return np.array([round(Fraction(tick, 30000) * 10**9) for tick in TICKS])


def test_times_of_frames(video: Path) -> None:
    """Counted from the first frame shown, B frames and edit lists notwithstanding; to the container's own tick."""
    times = frame_times(str(video))
    assert times.dtype == np.int64
    assert len(times) == len(TICKS)
    assert times[0] == 0
    assert np.max(np.abs(times - exact_ns())) <= 34_000
    with av.open(str(video)) as container:
        decoded = [frame.time for frame in container.decode(video=0)]
    assert np.allclose(times / 1e9, np.array(decoded) - decoded[0], atol=1e-9)


def test_description(video: Path) -> None:
    stream, facts = describe_video(str(video))
    assert (stream.stream, stream.width, stream.height) == ("DJI_0001.MP4", WIDTH, HEIGHT)
    assert stream.encoding == facts["codec"]
    assert facts["codec"] in {"h264", "mpeg4"}
    assert np.array_equal(stream.time_ns, frame_times(str(video)))
    assert facts["frames"] == 75
    assert facts["frame_rate_hz"] == pytest.approx(74 / (TICKS[-1] / 30000), rel=1e-5)
    assert facts["duration_s"] == pytest.approx(75 / facts["frame_rate_hz"], rel=1e-5)
    assert facts["rotation_deg"] == 0
    assert facts["creation_time"].startswith("2024-06-01T08:12:03")


def test_every_frame_is_the_one_that_was_painted(video: Path) -> None:
    times = frame_times(str(video))
    frames = list(read_frames(str(video), times))
    assert [told(png) for _, png, _ in frames] == list(range(75))
    assert [time for time, _, _ in frames] == times.tolist()
    assert {suffix for _, _, suffix in frames} == {".png"}
    assert all(png.startswith(b"\x89PNG") for _, png, _ in frames)


def test_frames_in_any_order(video: Path) -> None:
    times = frame_times(str(video))
    order = [0, 74, 11, 12, 13, 12, 12, 40, 39, 1, 60, 61, 73, 74, 5]
    assert [told(png) for _, png, _ in read_frames(str(video), times[order])] == order


def test_the_nearest_frame(video: Path) -> None:
    times = frame_times(str(video))
    step = 33_366_667
    wanted = [-(10**9), times[3] + step // 2 - 10**6, times[3] + step // 2 + 10**6, times[39] + step, 10**12]
    assert [told(png) for _, png, _ in read_frames(str(video), wanted)] == [0, 3, 4, 39, 74]


@pytest.mark.skipif(not hasattr(av.VideoStream, "set_display_rotation"), reason="this PyAV writes no rotation")
def test_rotation_is_told_and_not_applied(tmp_path: Path) -> None:
    path = write_video(tmp_path / "turned.mp4", ticks=TICKS[:5], rotation_deg=90)
    assert abs(describe_video(str(path))[1]["rotation_deg"]) == 90
    assert [told(png) for _, png, _ in read_frames(str(path), [0])] == [0]


def test_what_is_no_video(tmp_path: Path, video: Path) -> None:
    data = video.read_bytes()
    for name, content in (("empty.mp4", b""), ("text.mp4", b"hello" * 100), ("cut.mp4", data[: len(data) // 2])):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(InputError, match="E-VIDEO-01") as caught:
            frame_times(str(path))
        assert str(path) in caught.value.where
    with pytest.raises(InputError, match="E-FILE-01"):
        frame_times(str(tmp_path / "missing.mp4"))


def test_a_damaged_video_gives_what_it_can(tmp_path: Path, video: Path) -> None:
    """Frames are left out or shown damaged, never another's time; nothing but an InputError escapes."""
    data = bytearray(video.read_bytes())
    rng = np.random.default_rng(5)
    for _ in range(20):
        hurt = bytearray(data)
        for at in rng.integers(0, len(data), 12):
            hurt[at] ^= 1 << int(rng.integers(8))
        path = tmp_path / "hurt.mp4"
        path.write_bytes(bytes(hurt))
        found, times, refused = attempt(path)
        assert set(found) <= set(times)
        assert not refused or str(path) in refused


def attempt(path: Path) -> tuple[list[int], list[int], str]:
    """Times of frames got and wanted, and where an error was if there was one."""
    try:
        times = frame_times(str(path))[::7].tolist()
        return [time for time, _, _ in read_frames(str(path), times)], times, ""
    except InputError as error:
        return [], [], error.where


@pytest.mark.parametrize(("name", "found"), [("DJI_0001.SRT", True), ("dji_0001.srt", True), ("DJI_0002.SRT", False)])
def test_subtitles_beside_a_video(tmp_path: Path, name: str, found: bool) -> None:
    (tmp_path / name).write_text("1\n")
    (tmp_path / "DJI_0001.MP4").write_bytes(b"")
    assert srt_beside(str(tmp_path / "DJI_0001.MP4")) == (str(tmp_path / name) if found else None)


def test_spacing_on_a_straight_way() -> None:
    x = np.arange(301) * 0.1
    way = np.stack([x, np.zeros(301), np.full(301, 50.0)], axis=1)
    assert np.array_equal(x[spaced(way, 5.0)], [0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0])
    assert spaced(way, 0.05).tolist() == list(range(301))
    assert spaced(way, 1e9).tolist() == [0]


def test_spacing_follows_the_way_and_not_the_crow() -> None:
    angle = np.linspace(0.0, 1.5 * np.pi, 3001)
    circle = 20.0 * np.stack([np.cos(angle), np.sin(angle), np.zeros(3001)], axis=1)
    between = np.diff(angle[spaced(circle, 10.0)]) * 20.0
    # Way is summed over chords, which are a little shorter than the arc.
    assert np.all((between >= 9.99) & (between < 10.1))


def test_hovering_earns_no_frames() -> None:
    """Ten minutes of hovering with half a metre of noise between two flights of 40 m: 2 m apart, 20 + 20 frames."""
    rng = np.random.default_rng(1)
    out = np.linspace(0.0, 40.0, 400)
    x = np.concatenate([out, np.full(18_000, 40.0), 40.0 + out])
    way = np.stack([x, np.zeros_like(x), np.full_like(x, 60.0)], axis=1)
    noisy = way + np.repeat(rng.normal(0.0, 0.15, (len(x) // 30 + 1, 3)), 30, axis=0)[: len(x)]
    chosen = spaced(noisy, 2.0)
    assert 38 <= len(chosen) <= 46
    assert np.count_nonzero((chosen >= 400) & (chosen < 18_400)) <= 3
    steps = np.linalg.norm(np.diff(noisy[chosen], axis=0), axis=1)
    assert steps.min() >= 1.0


def test_unknown_places_are_not_taken() -> None:
    way = np.stack([np.arange(20.0), np.zeros(20), np.zeros(20)], axis=1)
    way[[0, 7, 8]] = np.nan
    assert spaced(way, 4.0).tolist() == [1, 5, 9, 13, 17]
    assert spaced(way[:1], 4.0).tolist() == []
    assert spaced(np.empty((0, 3)), 4.0).tolist() == []


@given(
    st.lists(st.tuples(*[st.floats(-1e4, 1e4)] * 3), min_size=1, max_size=60),
    st.floats(0.1, 1e3),
)
def test_spacing_holds_on_any_way(points: list[tuple[float, float, float]], spacing_m: float) -> None:
    way = np.array(points)
    chosen = spaced(way, spacing_m)
    assert chosen[0] == 0
    assert np.all(np.diff(chosen) > 0)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    assert np.all(np.diff(arc[chosen]) >= spacing_m * (1 - 1e-9))
    assert np.all(np.linalg.norm(np.diff(way[chosen], axis=0), axis=1) >= 0.5 * spacing_m * (1 - 1e-9))
