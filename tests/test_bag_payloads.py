"""Images and LiDAR sweeps of bags: pixels and points as they were put in, in every encoding."""

import base64
import math
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from bag_files import BEGAN_NS, NS, Row, compressed, header, image, ros, write_folder, write_mcap
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from rosbags.highlevel import AnyReader

from pipeline.engine.errors import InputError
from pipeline.sources.bags.payloads import read_images, read_sweeps
from pipeline.sources.logs import read_log

RNG = np.random.default_rng(3)
BGR = RNG.integers(0, 256, (8, 12, 3), np.uint8)
DEEP = RNG.integers(0, 65536, (8, 12), np.uint16)


def at(second: float) -> int:
    return BEGAN_NS + round(second * NS)


def decoded(data: bytes) -> np.ndarray:
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return picture


def one(path: Path, message: Any) -> tuple[bytes, str]:
    """The file of a bag's only image."""
    location = str(write_mcap(path / "bag.mcap", [("/image", at(0), message)]))
    ((time_ns, data, suffix),) = read_images(location, "/image", read_log(location).images[0].time_ns)
    assert time_ns == at(0)
    return data, suffix


def mosaic(bgr: np.ndarray, pattern: str) -> np.ndarray:
    """What a sensor under a Bayer pattern sees: the letters are of the first two rows."""
    out = np.empty(bgr.shape[:2], bgr.dtype)
    for n, letter in enumerate(pattern):
        row, column = divmod(n, 2)
        out[row::2, column::2] = bgr[row::2, column::2, "bgr".index(letter)]
    return out


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("mono8", BGR[..., 0], BGR[..., 0]),
        ("8UC1", BGR[..., 0], BGR[..., 0]),
        ("mono16", DEEP, DEEP),
        ("bgr8", BGR, BGR),
        ("rgb8", BGR[..., ::-1], BGR),
        ("bgra8", np.dstack([BGR, BGR[..., :1]]), BGR),
        ("rgba8", np.dstack([BGR[..., ::-1], BGR[..., :1]]), BGR),
        ("rgb16", np.dstack([DEEP, DEEP + 1, DEEP + 2]), np.dstack([DEEP + 2, DEEP + 1, DEEP])),
    ],
)
def test_raw_images(tmp_path: Path, encoding: str, pixels: np.ndarray, expected: np.ndarray) -> None:
    data, suffix = one(tmp_path, image(at(0), pixels, encoding))
    assert suffix == ".png"
    np.testing.assert_array_equal(decoded(data), expected)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize(("depth", "kind"), [(8, np.uint8), (16, np.uint16)])
def test_bayer_images(tmp_path: Path, pattern: str, depth: int, kind: type) -> None:
    """A picture of one colour comes back whole from its mosaic, whatever the demosaicing."""
    colour = np.full((8, 12, 3), (40, 120, 200), kind)
    data, _ = one(tmp_path, image(at(0), mosaic(colour, pattern), f"bayer_{pattern}{depth}"))
    np.testing.assert_array_equal(decoded(data), colour)


@pytest.mark.parametrize(("encoding", "order"), [("yuv422", "uyvy"), ("yuv422_yuy2", "yuyv"), ("uyvy", "uyvy")])
def test_yuv_images(tmp_path: Path, encoding: str, order: str) -> None:
    # BT.601 in studio range: pure red is Y 81, U 90, V 240.
    values = {"y": 81, "u": 90, "v": 240}
    pixels = np.tile(np.array([values[letter] for letter in order], np.uint8), (8, 6))
    data, _ = one(tmp_path, image(at(0), pixels, encoding, width=12))
    np.testing.assert_allclose(decoded(data).astype(int), np.full((8, 12, 3), (0, 0, 254)), atol=2)


def test_rows_with_padding_and_big_endian_pixels(tmp_path: Path) -> None:
    padded = np.zeros((8, 40), np.uint8)
    padded[:, :36] = BGR.reshape(8, 36)
    np.testing.assert_array_equal(decoded(one(tmp_path, image(at(0), padded, "bgr8", width=12))[0]), BGR)
    swapped = image(at(0), DEEP.byteswap(), "mono16", is_bigendian=1)
    np.testing.assert_array_equal(decoded(one(tmp_path, swapped)[0]), DEEP)


@pytest.mark.parametrize(("suffix", "form"), [(".jpg", "bgr8; jpeg compressed bgr8"), (".png", "png")])
def test_compressed_images_pass_through(tmp_path: Path, suffix: str, form: str) -> None:
    file = cv2.imencode(suffix, BGR)[1].tobytes()
    assert one(tmp_path, compressed(at(0), file, form)) == (file, suffix)


@pytest.mark.parametrize(
    "message", [image(0, DEEP, "16UC1"), image(0, BGR, "nv21"), compressed(0, b"\0" * 99, "16UC1; compressedDepth png"),
                compressed(0, b"RIFF....WEBP", "webp")],
)  # fmt: skip
def test_unknown_encodings_are_named(tmp_path: Path, message: Any) -> None:
    with pytest.raises(InputError, match=r"16UC1|nv21|compressedDepth|webp") as caught:
        one(tmp_path, message)
    assert (caught.value.code, "bag.mcap /image" in caught.value.where) == ("E-BAG-02", True)


def test_damaged_images_are_left_out(tmp_path: Path) -> None:
    file = cv2.imencode(".jpg", BGR)[1].tobytes()
    rows: list[Row] = [
        ("/raw", at(0), image(at(0), BGR, "bgr8", height=9)), ("/raw", at(1), image(at(1), BGR, "bgr8")),
        ("/raw", at(2), image(at(2), BGR, "bgr8", step=7)), ("/raw", at(3), image(at(3), BGR, "bgr8", width=0)),
        ("/jpeg", at(0), compressed(at(0), b"", "jpeg")), ("/jpeg", at(1), compressed(at(1), file, "jpeg")),
    ]  # fmt: skip
    location = str(write_mcap(tmp_path / "bag.mcap", rows))
    for topic in ("/raw", "/jpeg"):
        assert [found[0] for found in read_images(location, topic, [at(n) for n in range(4)])] == [at(1)]


def test_only_wanted_images_come(tmp_path: Path) -> None:
    rows: list[Row] = [("/image", at(n), image(at(n), np.full((2, 2), n, np.uint8))) for n in range(6)]
    rows += [("/image", at(3), image(at(3), BGR, "bgr8")), ("/other", at(2), image(at(2), BGR, "bgr8"))]
    for location in (write_mcap(tmp_path / "bag.mcap", rows), write_folder(tmp_path / "folder", rows)):
        found = list(read_images(str(location), "/image", np.array([at(2), at(3), at(9)])))
        assert [(time_ns, decoded(data).max()) for time_ns, data, _ in found] == [(at(2), 2), (at(3), 3)]
    assert list(read_images(str(location), "/image", [])) == []


def test_images_without_stamps_go_by_log_time(tmp_path: Path) -> None:
    location = str(write_mcap(tmp_path / "bag.mcap", [("/image", at(n), image(0, BGR, "bgr8")) for n in range(3)]))
    times = read_log(location).images[0].time_ns
    assert [time_ns for time_ns, _, _ in read_images(location, "/image", times[1:])] == [at(1), at(2)]


def test_a_topic_that_is_not_there(tmp_path: Path) -> None:
    location = str(write_mcap(tmp_path / "bag.mcap", [("/image", at(0), image(at(0)))]))
    with pytest.raises(InputError, match="/image") as caught:
        list(read_images(location, "/imgae", [at(0)]))
    assert caught.value.code == "E-BAG-03"
    with pytest.raises(InputError, match="E-BAG-03"):
        list(read_sweeps(location, "/image"))


# Foxglove.


def foxglove(kind: Callable[..., Any], second: float, **fields: Any) -> Any:
    message = kind(**fields)
    message.timestamp.FromNanoseconds(at(second))
    return message


def test_foxglove_images(tmp_path: Path) -> None:
    file = cv2.imencode(".jpg", BGR)[1].tobytes()
    raw = foxglove(RawImage, 0, width=12, height=8, step=36, encoding="rgb8", data=BGR[..., ::-1].tobytes())
    rows: list[Row] = [
        ("/raw", at(0), raw), ("/jpeg", at(0), foxglove(CompressedImage, 0, data=file, format="jpeg"))
    ]  # fmt: skip
    location = str(write_mcap(tmp_path / "protobuf.mcap", rows, "protobuf"))
    streams = {stream.stream: stream for stream in read_log(location).images}
    assert (streams["/raw"].encoding, streams["/raw"].width, streams["/raw"].height) == ("rgb8", 12, 8)
    assert (streams["/jpeg"].encoding, streams["/jpeg"].width) == ("jpeg", 0)
    ((_, data, _),) = read_images(location, "/raw", [at(0)])
    np.testing.assert_array_equal(decoded(data), BGR)
    assert list(read_images(location, "/jpeg", [at(0)])) == [(at(0), file, ".jpg")]
    stamp = {"sec": at(0) // NS, "nsec": at(0) % NS}
    text = {"timestamp": stamp, "frame_id": "c", "format": "jpeg", "data": base64.b64encode(file).decode()}
    rows = [("/jpeg", at(0), ("foxglove.CompressedImage", text))]
    location = str(write_mcap(tmp_path / "json.mcap", rows, "json"))
    assert list(read_images(location, "/jpeg", [at(0)])) == [(at(0), file, ".jpg")]


CODECS = {
    "libx264": {"tune": "zerolatency", "preset": "ultrafast"},
    "libx265": {"tune": "zerolatency", "preset": "ultrafast", "x265-params": "log-level=none"},
    "libvpx-vp9": {"deadline": "realtime", "lag-in-frames": "0"},
    "libsvtav1": {"preset": "12", "svtav1-params": "pred-struct=1:lookahead=0"},
}


def video(codec: str, count: int) -> list[bytes]:
    """Packets of a video whose frames brighten by 10 each; every tenth is a key frame."""
    context = av.CodecContext.create(codec, "w")
    context.width, context.height, context.pix_fmt = 64, 48, "yuv420p"
    context.framerate, context.gop_size, context.max_b_frames = 10, 10, 0
    context.options = CODECS[codec]
    packets = []
    for n in range(count):
        frame = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 10 * n + 20, np.uint8), format="bgr24")
        frame.pts = n
        packets += context.encode(frame)
    return [bytes(packet) for packet in (*packets, *context.encode(None))]


@pytest.mark.parametrize(("form", "codec"), [*zip(("h264", "h265", "vp9", "av1"), CODECS, strict=True)])
def test_video_frames(tmp_path: Path, form: str, codec: str, capfd: pytest.CaptureFixture[str]) -> None:
    if codec not in av.codecs_available:
        pytest.skip(f"no encoder {codec}")
    packets = video(codec, 20)
    capfd.readouterr()
    assert len(packets) == 20
    packets[5] = packets[5][: len(packets[5]) // 2] if form == "h264" else packets[5]
    rows = [("/video", at(n), foxglove(CompressedVideo, n, format=form, data=data)) for n, data in enumerate(packets)]
    location = str(write_mcap(tmp_path / "video.mcap", rows, "protobuf"))
    (stream,) = read_log(location).images
    assert (stream.encoding, len(stream.time_ns)) == (form, 20)
    found = list(read_images(location, "/video", [at(2), at(13), at(19)]))
    assert [time_ns for time_ns, _, _ in found] == [at(2), at(13), at(19)]
    for time_ns, data, suffix in found:
        level = 10 * (time_ns - BEGAN_NS) // NS + 20
        assert suffix == ".png"
        np.testing.assert_allclose(decoded(data).mean(), level, atol=6)
    assert capfd.readouterr() == ("", "")


def test_an_unknown_video(tmp_path: Path) -> None:
    rows = [("/video", at(0), foxglove(CompressedVideo, 0, format="mjpeg2000", data=b"12"))]
    location = str(write_mcap(tmp_path / "video.mcap", rows, "protobuf"))
    with pytest.raises(InputError, match="mjpeg2000"):
        list(read_images(location, "/video", [at(0)]))


# Sweeps.

POINTS = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0], [math.nan, 1.0, 1.0], [-4.0, 5.5, 6.25]])
KEPT = POINTS[[0, 3]]


def cloud(
    time_field: tuple[str, int, str] | None = None, times: Any = (), big: bool = False, height: int = 1, pad: int = 0
) -> Any:
    """A PointCloud2 whose fields are not in the order x, y, z and not packed."""
    order = ">" if big else "<"
    fields = [("z", 7, "f4"), ("intensity", 2, "u1"), ("y", 8, "f8"), ("x", 7, "f4")]
    fields += [time_field] if time_field else []
    offsets = np.cumsum([0, *(2 + int(code[1]) for _, _, code in fields)])
    names = [name for name, _, _ in fields]
    dtype = np.dtype({"names": names, "formats": [order + code for _, _, code in fields], "offsets": offsets[:-1],
                      "itemsize": int(offsets[-1])})  # fmt: skip
    table = np.zeros(4, dtype)
    for axis, name in enumerate("xyz"):
        table[name] = POINTS[:, axis]
    if time_field:
        table[time_field[0]] = times
    width = 4 // height
    rows = [table[n * width : (n + 1) * width].tobytes() + b"\xff" * pad for n in range(height)]
    described = [
        ros("sensor_msgs/PointField", name=name, offset=int(offset), datatype=kind, count=1)
        for (name, kind, _), offset in zip(fields, offsets, strict=False)
    ]
    return ros(
        "sensor_msgs/PointCloud2", header=header(at(0), "lidar"), height=height, width=width, fields=described,
        is_bigendian=big, point_step=dtype.itemsize, row_step=width * dtype.itemsize + pad,
        data=np.frombuffer(b"".join(rows), np.uint8), is_dense=False,
    )  # fmt: skip


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(("height", "pad"), [(1, 0), (2, 0), (2, 5)])
def test_points_by_name(tmp_path: Path, big: bool, height: int, pad: int) -> None:
    location = str(write_mcap(tmp_path / "bag.mcap", [("/points", at(0), cloud(big=big, height=height, pad=pad))]))
    (stream,) = read_log(location).sweeps
    assert (stream.points, stream.frame, stream.fields) == (4, "lidar", ("z", "intensity", "y", "x"))
    (sweep,) = read_sweeps(location, "/points")
    np.testing.assert_array_equal(sweep.p_in_sensor_m, KEPT)
    assert (sweep.time_ns, sweep.delay_s.tolist()) == (at(0), [0.0, 0.0])


@pytest.mark.parametrize(
    ("name", "kind", "code", "values"),
    [
        ("t", 6, "u4", [0, 1, 2, 99_000_000]),
        ("time", 7, "f4", [0.0, math.nan, 2.0, 0.099]),
        ("timestamp", 8, "f8", np.add(at(0) / NS, [0.0, 1.0, 2.0, 0.099])),
        ("timestamp", 8, "f8", np.add(float(at(0)), [0.0, 1e9, 2e9, 99e6])),
        ("time_offset", 8, "f8", [0.0, 1.0, 2.0, 0.099]),
    ],
)
def test_times_within_a_sweep(tmp_path: Path, name: str, kind: int, code: str, values: Any) -> None:
    location = str(write_mcap(tmp_path / "bag.mcap", [("/points", at(0), cloud((name, kind, code), values))]))
    (sweep,) = read_sweeps(location, "/points")
    np.testing.assert_allclose(sweep.delay_s, [0.0, 0.099], atol=3e-7)


def test_times_of_another_clock_say_nothing(tmp_path: Path) -> None:
    message = cloud(("timestamp", 8, "f8"), np.add(at(0) / NS - 1e4, [0.0, 1.0, 2.0, 0.099]))
    location = str(write_mcap(tmp_path / "bag.mcap", [("/points", at(0), message)]))
    (sweep,) = read_sweeps(location, "/points")
    assert sweep.delay_s.tolist() == [0.0, 0.0]


def test_foxglove_points_in_their_pose(tmp_path: Path) -> None:
    data = b"".join(struct.pack("<fffI", *point, 7) for point in POINTS)
    message = foxglove(PointCloud, 0, frame_id="base", point_stride=16, data=data)
    for name, offset in (("x", 0), ("y", 4), ("z", 8)):
        message.fields.add(name=name, offset=offset, type=7)
    message.fields.add(name="t", offset=12, type=5)
    message.pose.position.z = 10.0
    # A quarter turn about z: x to y, y to -x.
    message.pose.orientation.w = message.pose.orientation.z = math.sqrt(0.5)
    location = str(write_mcap(tmp_path / "bag.mcap", [("/points", at(0), message)], "protobuf"))
    (stream,) = read_log(location).sweeps
    assert (stream.points, stream.frame) == (4, "base")
    (sweep,) = read_sweeps(location, "/points")
    np.testing.assert_allclose(sweep.p_in_sensor_m, [[-2.0, 1.0, 13.0], [-5.5, -4.0, 16.25]], atol=1e-12)
    np.testing.assert_allclose(sweep.delay_s, [7e-9, 7e-9])


def test_damaged_sweeps_are_left_out_and_points_without_axes_refused(tmp_path: Path) -> None:
    short, whole, flat = cloud(), cloud(), cloud()
    short.data = short.data[:-1]
    flat.fields = flat.fields[:2]
    rows = [("/points", at(0), short), ("/points", at(0), whole), ("/flat", at(0), flat)]
    location = str(write_mcap(tmp_path / "bag.mcap", rows))
    assert len(list(read_sweeps(location, "/points"))) == 1
    with pytest.raises(InputError, match="z, intensity"):
        list(read_sweeps(location, "/flat"))


def test_sweeps_of_another_clock_go_by_log_time(tmp_path: Path) -> None:
    message = cloud()
    message.header.stamp.sec = 12
    location = str(write_mcap(tmp_path / "bag.mcap", [("/points", at(5), message), ("/i", at(5), image(at(5)))]))
    log = read_log(location)
    assert log.sweeps[0].time_ns.tolist() == [at(5)]
    assert [sweep.time_ns for sweep in read_sweeps(location, "/points", log.time_base.epoch)] == [at(5)]


# Real images, and memory.


@pytest.mark.real
def test_real_fisheye_images(shared: Path) -> None:
    path = shared / "data/bags/kapture_t265/trimmed_locoffice.bag"
    for stream in read_log(str(path)).images:
        with AnyReader([path]) as reader:
            wanted = [connection for connection in reader.connections if connection.topic == stream.stream]
            messages: list[Any] = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(wanted)]
        found = list(read_images(str(path), stream.stream, stream.time_ns))
        assert [time_ns for time_ns, _, _ in found] == stream.time_ns.tolist()
        for (_, data, suffix), message in zip(found, messages, strict=True):
            assert suffix == ".png"
            np.testing.assert_array_equal(decoded(data), message.data.reshape(800, 848))


def test_reading_keeps_no_payload(tmp_path: Path) -> None:
    data = RNG.integers(0, 256, 1 << 20, np.uint8).tobytes()
    path = tmp_path / "bag.mcap"
    rows = (("/image", at(n), foxglove(CompressedImage, n, data=data, format="jpeg")) for n in range(64))
    write_mcap(path, rows, "protobuf", chunk=4 << 20)
    read_log(str(path))
    tracemalloc.start()
    log = read_log(str(path))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert path.stat().st_size > 64 << 20
    assert len(log.images[0].time_ns) == 64
    # A chunk and a message at a time.
    assert peak < 24 << 20
