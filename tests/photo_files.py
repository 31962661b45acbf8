"""Photos built in code: pixels, EXIF with GPS and MakerNotes, and an XMP packet."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from PIL import Image
from PIL.TiffImagePlugin import IFDRational

DJI = "http://www.dji.com/drone-dji/1.0/"
# DJI MakerNotes tags, single precision.
MAKER_TAGS = {"Pitch": 6, "Yaw": 7, "Roll": 8, "CameraPitch": 9, "CameraYaw": 10, "CameraRoll": 11}
GIMBAL = {"GimbalYawDegree": "+0.00", "GimbalPitchDegree": "-90.00", "GimbalRollDegree": "+0.00"}
PLACE = {"latitude": 37.5, "longitude": -78.3, "altitude": 150.0}


def xmp_packet(
    tags: Mapping[str, str], *, prefix: str = "drone-dji", elements: bool = False, creator: str = ""
) -> bytes:
    """An XMP packet with DJI tags as attributes or as elements, under any prefix."""
    names = f'xmlns:{prefix}="{DJI}" xmlns:xmp="http://ns.adobe.com/xap/1.0/"'
    attributes = "" if elements else " ".join(f'{prefix}:{name}="{value}"' for name, value in tags.items())
    inner = "".join(f"<{prefix}:{n}>{v}</{prefix}:{n}>" for n, v in tags.items()) if elements else ""
    if creator:
        inner += f"<xmp:CreatorTool>{creator}</xmp:CreatorTool>"
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" {names} {attributes}>{inner}</rdf:Description>'
        '</rdf:RDF></x:xmpmeta><?xpacket end="w"?>'
    ).encode()


def maker_notes(angles: Mapping[str, float]) -> bytes:
    """DJI's MakerNotes: a bare IFD of single-precision values."""
    entries = sorted((MAKER_TAGS[name], value) for name, value in angles.items())
    body = struct.pack("<H", len(entries) + 1) + struct.pack("<HHI4s", 1, 2, 4, b"DJI\0")
    body += b"".join(struct.pack("<HHIf", tag, 11, 1, value) for tag, value in entries)
    return body + struct.pack("<I", 0)


def exif_block(
    *,
    place: Mapping[str, float] | None = PLACE,
    model: str = "FC6310",
    software: str = "v01.00",
    orientation: int = 1,
    taken: str = "2024:06:01 08:12:03",
    maker: Mapping[str, float] | None = None,
    gps: Mapping[int, Any] | None = None,
    **tags: Any,
) -> Image.Exif:
    """EXIF of a drone photo; `tags` are Exif sub-IFD tags as "x9003", `gps` extra GPS tags."""
    exif = Image.Exif()
    exif[0x010F], exif[0x0110], exif[0x0131], exif[0x0112] = "DJI", model, software, orientation
    sub = exif.get_ifd(0x8769)
    sub[0x9003], sub[0x920A], sub[0xA405] = taken, IFDRational(88, 10), 24
    for name, value in tags.items():
        if value is None:
            sub.pop(int(name[1:], 16), None)
        else:
            sub[int(name[1:], 16)] = value
    if maker is not None:
        sub[0x927C] = maker_notes(maker)
    block = exif.get_ifd(0x8825)
    if place is not None:
        block[1], block[2] = ("N" if place["latitude"] >= 0 else "S"), _sexagesimal(place["latitude"])
        block[3], block[4] = ("E" if place["longitude"] >= 0 else "W"), _sexagesimal(place["longitude"])
        block[5] = b"\x01" if place["altitude"] < 0 else b"\x00"
        block[6] = IFDRational(round(abs(place["altitude"]) * 1000), 1000)
    block.update(gps or {})
    return exif


def write_photo(
    path: Path,
    *,
    xmp: Mapping[str, str] | bytes | None = GIMBAL,
    exif: Image.Exif | None = None,
    size: tuple[int, int] = (80, 60),
    colour: tuple[int, int, int] = (90, 120, 60),
) -> Path:
    """Writes a JPEG; without `exif` that of `exif_block()`."""
    packet = xmp_packet(xmp) if isinstance(xmp, Mapping) else xmp
    extra = {"xmp": packet} if packet is not None else {}
    Image.new("RGB", size, colour).save(path, "JPEG", exif=exif if exif is not None else exif_block(), **extra)
    return path


def _sexagesimal(degrees: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    whole = round(abs(degrees) * 3600 * 10000)
    seconds, rest = whole % 600000, whole // 600000
    return IFDRational(rest // 60, 1), IFDRational(rest % 60, 1), IFDRational(seconds, 10000)
