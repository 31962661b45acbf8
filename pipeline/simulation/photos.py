"""Photos as a DJI drone stores them: JPEG with EXIF and an XMP packet that carry the logged pose."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.ExifTags import GPS, IFD, Base
from PIL.TiffImagePlugin import IFDRational

from pipeline.geometry.arrays import Bytes, Floats
from pipeline.geometry.cameras import Camera

MAKE, MODEL = "DJI", "EPISIM"
QUALITY = 95
# The sensor is 6.4 mm wide, for the focal length in millimetres; 24 x 36 mm has a diagonal of 43.27 mm.
_PIXEL_MM = 0.004
_FULL_FRAME_MM = 43.2666
_HORIZONTAL_ERROR_M = 0.26
_CALIBRATED = "2024-05-01"

_PACKET = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/"
{tags}/>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>"""


@dataclass(frozen=True, slots=True)
class LoggedPose:
    """What the drone believes at an exposure.

    Args:
        time: UTC.
        latitude_deg: Of the camera, WGS 84.
        longitude_deg: Of the camera, WGS 84.
        navd88_m: Height above NAVD 88.
        above_takeoff_m: Height above the take-off point.
        gimbal_rad: (3,) yaw from true north, pitch, roll of the optical axis.
    """

    time: datetime
    latitude_deg: float
    longitude_deg: float
    navd88_m: float
    above_takeoff_m: float
    gimbal_rad: Floats


def save_photo(path: Path, picture: Bytes, camera: Camera, pose: LoggedPose) -> None:
    """Writes a photo.

    Args:
        path: Where.
        picture: (height, width, 3) red, green, blue.
        camera: Its camera, written as DewarpData.
        pose: The pose as logged.
    """
    packet = xmp_packet(camera, pose).encode()
    Image.fromarray(picture).save(path, "JPEG", quality=QUALITY, exif=exif(camera, pose), xmp=packet)


def save_bare(path: Path, picture: Bytes, camera: Camera, time: datetime) -> None:
    """Writes the same picture as a camera does that knows nothing of the drone: its own clock, no place, no attitude.

    Args:
        path: Where.
        picture: (height, width, 3) red, green, blue.
        camera: Its camera, for the focal length.
        time: What the camera's clock says; written without a zone.
    """
    Image.fromarray(picture).save(path, "JPEG", quality=QUALITY, exif=_camera_tags(camera, time))


def exif(camera: Camera, pose: LoggedPose) -> Image.Exif:
    """The EXIF tags of a photo.

    Source: CIPA DC-008 (EXIF 2.32).
    """
    tags = _camera_tags(camera, pose.time)
    tags.get_ifd(IFD.Exif)[Base.OffsetTimeOriginal] = "+00:00"
    tags.get_ifd(IFD.GPSInfo).update(
        {
            GPS.GPSVersionID: b"\x02\x03\x00\x00",
            GPS.GPSLatitudeRef: "N" if pose.latitude_deg >= 0.0 else "S",
            GPS.GPSLatitude: _sexagesimal(abs(pose.latitude_deg)),
            GPS.GPSLongitudeRef: "E" if pose.longitude_deg >= 0.0 else "W",
            GPS.GPSLongitude: _sexagesimal(abs(pose.longitude_deg)),
            GPS.GPSAltitudeRef: b"\x00" if pose.navd88_m >= 0.0 else b"\x01",
            GPS.GPSAltitude: _rational(abs(pose.navd88_m), 1000),
            GPS.GPSHPositioningError: _rational(_HORIZONTAL_ERROR_M, 100),
        }
    )
    return tags


def _camera_tags(camera: Camera, time: datetime) -> Image.Exif:
    """What a camera knows by itself: who made it, its clock, its lens."""
    tags = Image.Exif()
    taken = time.strftime("%Y:%m:%d %H:%M:%S")
    tags[Base.Make], tags[Base.Model], tags[Base.DateTime] = MAKE, MODEL, taken
    focal_mm = camera.focal_px * _PIXEL_MM
    diagonal_mm = float(np.hypot(camera.width, camera.height)) * _PIXEL_MM
    tags.get_ifd(IFD.Exif).update(
        {
            Base.ExifVersion: b"0232",
            Base.DateTimeOriginal: taken,
            Base.SubsecTimeOriginal: f"{time.microsecond // 1000:03d}",
            Base.FocalLength: _rational(focal_mm, 10_000),
            Base.FocalLengthIn35mmFilm: round(focal_mm * _FULL_FRAME_MM / diagonal_mm),
            Base.ExifImageWidth: camera.width,
            Base.ExifImageHeight: camera.height,
        }
    )
    return tags


def xmp_packet(camera: Camera, pose: LoggedPose) -> str:
    """The XMP packet of a photo, with DJI's tags.

    Source: DJI user manuals (Mavic 3E/3T, "XMP"); DewarpData's centre is relative to the photo's centre.
    """
    yaw, pitch, roll = np.degrees(pose.gimbal_rad)
    yaw = (yaw + 180.0) % 360.0 - 180.0
    centre = camera.cx - (camera.width - 1) / 2.0, camera.cy - (camera.height - 1) / 2.0
    lens = ",".join(f"{v:.9g}" for v in (camera.fx, camera.fy, *centre, *camera.distortion))
    tags = {
        "GpsStatus": "Normal",
        "AltitudeType": "GpsFusionAlt",
        "GpsLatitude": f"{pose.latitude_deg:+.10f}",
        "GpsLongitude": f"{pose.longitude_deg:+.10f}",
        "AbsoluteAltitude": f"{pose.navd88_m:+.3f}",
        "RelativeAltitude": f"{pose.above_takeoff_m:+.3f}",
        "GimbalRollDegree": f"{roll:+.3f}",
        "GimbalYawDegree": f"{yaw:+.3f}",
        "GimbalPitchDegree": f"{pitch:+.3f}",
        "FlightRollDegree": "+0.00",
        "FlightYawDegree": f"{yaw:+.2f}",
        "FlightPitchDegree": "+0.00",
        "DewarpFlag": "0",
        "DewarpData": f"{_CALIBRATED};{lens}",
    }
    return _PACKET.format(tags="\n".join(f'   drone-dji:{name}="{value}"' for name, value in tags.items()))


def _rational(value: float, denominator: int) -> IFDRational:
    return IFDRational(round(value * denominator), denominator)


def _sexagesimal(degrees: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    """Degrees, minutes, and seconds to 1e-7 (3 micrometres)."""
    ticks = round(degrees * 3600.0 * 10_000_000)
    minutes, rest = divmod(ticks, 60 * 10_000_000)
    return IFDRational(minutes // 60, 1), IFDRational(minutes % 60, 1), IFDRational(rest, 10_000_000)
