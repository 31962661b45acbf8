"""One photo: from a path to a record of everything its tags say, and what is wrong with it."""

from __future__ import annotations

import hashlib
import io
import struct
import warnings
import zlib
from dataclasses import dataclass, field
from datetime import datetime

from PIL import Image, UnidentifiedImageError

from pipeline.engine.errors import InputError
from pipeline.sources import dji
from pipeline.sources.accuracy import TimingSigmas
from pipeline.sources.exif import Exif, read_exif
from pipeline.sources.files import opened, stem
from pipeline.sources.intrinsics import SourcedCamera, camera_of
from pipeline.sources.xmp import Xmp, read_xmp

# A larger file is no photo; it is not read into memory to find that out.
_MAX_BYTES = 512 << 20
# Enough for every aerial camera on the market; Pillow refuses to open more than twice its own limit (179 megapixels).
_MAX_PIXELS = 2 * (Image.MAX_IMAGE_PIXELS or 89_478_485)
# What Pillow's decoders raise on damaged bytes.
_DAMAGED = (
    OSError,
    ValueError,
    SyntaxError,
    EOFError,
    LookupError,
    ArithmeticError,
    TypeError,
    struct.error,
    zlib.error,
)


@dataclass(frozen=True, slots=True)
class PhotoRecord:
    """What is known of one photo.

    Args:
        location: Path or URL.
        frame_id: Its stem.
        sha256: Digest of the file's bytes, empty where it could not be read.
        width: Pixels per row as stored, 0 where it could not be read.
        height: Rows as stored.
        make: Maker.
        model: Model.
        time: Exposure, UTC, on the camera's own clock.
        time_source: Which tag the time came from.
        position: Latitude and longitude.
        attitude: Gimbal attitude.
        absolute_m: AbsoluteAltitude, or EXIF's altitude, m, datum not known from the photo alone.
        relative_m: Height above the take-off point, m.
        ellipsoidal_m: Height above the ellipsoid, where a log says so, m.
        local_m: Camera centre in a frame tied to no place on earth, m, z up; then `attitude` is against that frame.
        fix: Quality of the position.
        timing: What the error of the exposure's instant adds to the sigmas, where a log gave the pose.
        camera: Intrinsics at the file's size.
        image_problem: Why its pixels or lens cannot be used, with the remedy; empty when they can.
        pose_problem: Why its own tags do not place it; a log may.
        notes: What to distrust although it can be used.
    """

    location: str
    frame_id: str
    sha256: str = ""
    width: int = 0
    height: int = 0
    make: str = ""
    model: str = ""
    time: datetime | None = None
    time_source: str = ""
    position: dji.Position | None = None
    attitude: dji.Attitude | None = None
    absolute_m: float | None = None
    relative_m: float | None = None
    ellipsoidal_m: float | None = None
    local_m: tuple[float, float, float] | None = None
    fix: dji.Fix = field(default_factory=dji.Fix)
    timing: TimingSigmas | None = None
    camera: SourcedCamera | None = None
    image_problem: str = ""
    pose_problem: str = ""
    notes: tuple[str, ...] = ()

    @property
    def problem(self) -> str:
        """Why the photo cannot be used, with the remedy; empty when it can."""
        return "; ".join(text for text in (self.image_problem, self.pose_problem) if text)


def read_photo(location: str, calibration: SourcedCamera | None = None) -> PhotoRecord:
    """Reads a photo's tags and decodes its pixels once, at reduced size, to know that they are all there.

    Args:
        location: Path or URL.
        calibration: The user's calibration, which wins over the photo's tags.

    Returns:
        The record; a photo that cannot be used has a problem and as much as could be read.

    Raises:
        InputError: The file is not there.
        ResourceError: It may not be read.
    """
    with opened(location) as stream:
        data = stream.read(_MAX_BYTES + 1)
    name = stem(location)
    if not data:
        return PhotoRecord(location, name, image_problem="the file is empty (0 bytes): copy it again from the card")
    if len(data) > _MAX_BYTES:
        return PhotoRecord(location, name, image_problem=f"the file has more than {_MAX_BYTES >> 20} MiB: not a photo")
    digest = hashlib.sha256(data).hexdigest()
    try:
        width, height, packet = _decoded(data)
    except dji.Unusable as error:
        return PhotoRecord(location, name, digest, image_problem=str(error))
    notes: list[str] = []
    exif, xmp = _tags(data, packet, notes)
    return _record(
        PhotoRecord(location, name, digest, width, height, exif.make, exif.model), exif, xmp, calibration, notes
    )


def _record(
    base: PhotoRecord, exif: Exif, xmp: Xmp, calibration: SourcedCamera | None, notes: list[str]
) -> PhotoRecord:
    unusable = [text] if (text := dji.rewritten(exif, xmp)) else []
    unplaced: list[str] = []
    time, time_source = dji.exposure_time(exif, xmp)
    position = attitude = camera = None
    try:
        position = dji.position(exif, xmp)
        notes.append(position.note)
    except dji.Unusable as error:
        unplaced.append(str(error))
    try:
        attitude = dji.attitude(exif, xmp)
        notes.append(attitude.note)
    except dji.Unusable as error:
        unplaced.append(str(error))
    try:
        camera = camera_of(exif, xmp, base.width, base.height, calibration)
    except dji.Unusable as error:
        unusable.append(str(error))
    if exif.orientation not in {0, 1}:
        notes.append(f"EXIF orientation {exif.orientation}: pixels are used as they are stored")
    absolute = dji.number(xmp, "AbsoluteAltitude")
    return PhotoRecord(
        base.location, base.frame_id, base.sha256, base.width, base.height, base.make, base.model,
        time=time,
        time_source=time_source,
        position=position,
        attitude=attitude,
        absolute_m=absolute if absolute is not None else exif.altitude_m,
        relative_m=dji.number(xmp, "RelativeAltitude"),
        fix=dji.fix(exif, xmp),
        camera=camera,
        image_problem="; ".join(unusable),
        pose_problem="; ".join(unplaced),
        notes=tuple(note for note in notes if note),
    )  # fmt: skip


def _decoded(data: bytes) -> tuple[int, int, bytes]:
    """Size and XMP packet of an image whose pixels all decode.

    Raises:
        Unusable: Not an image, truncated, or too large to be one.
    """
    try:
        with warnings.catch_warnings():
            # Pillow warns of odd tags, and of sizes between one and two times its limit; what matters here it raises.
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data)) as image:
                width, height = image.size
                packet = _packet(image)
                # An eighth of the size still reads the file to its end, without holding all pixels.
                image.draft("L", (max(1, width // 8), max(1, height // 8)))
                image.load()
                whole = image.format not in {"JPEG", "MPO"} or _ended(data)
    except Image.DecompressionBombError as error:
        raise dji.Unusable(
            f"more than {_MAX_PIXELS // 1_000_000} megapixels, not decoded: not an aerial photo"
        ) from error
    except UnidentifiedImageError as error:
        raise dji.Unusable("not an image, whatever its name says: leave it out") from error
    except _DAMAGED as error:
        raise dji.Unusable(f"damaged or truncated ({error}): copy it again from the card") from error
    if not whole:
        raise dji.Unusable("damaged or truncated (it ends in zeros): copy it again from the card")
    return width, height, packet


def _ended(data: bytes) -> bool:
    """Whether a JPEG does not break off into zeros, as an interrupted copy does: decoders take those for grey."""
    return not data.endswith(bytes(64)) or data.rstrip(b"\0").endswith(b"\xff\xd9")


def _packet(image: Image.Image) -> bytes:
    packet = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    return packet.encode("utf-8", "replace") if isinstance(packet, str) else bytes(packet)


def _tags(data: bytes, packet: bytes, notes: list[str]) -> tuple[Exif, Xmp]:
    try:
        exif = read_exif(data)
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001 - the per-item guard: the EXIF library names no set of errors for bad tags
        notes.append(f"EXIF cannot be read ({type(error).__name__}: {error})")
        exif = Exif()
    try:
        xmp = read_xmp(packet) if packet else Xmp()
    except InputError as error:
        notes.append(f"{error.message} ({error.found})")
        xmp = Xmp()
    return exif, xmp
