"""A photo's camera: calibration file, DewarpData, calibrated focal length or EXIF, in that order, source kept."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from pipeline.engine.errors import InputError
from pipeline.geometry.cameras import Camera
from pipeline.sources.dji import Unusable, number
from pipeline.sources.exif import Exif
from pipeline.sources.sensors import focal_from_35mm, focal_from_table
from pipeline.sources.xmp import Xmp


@dataclass(frozen=True, slots=True)
class SourcedCamera:
    """Intrinsics and where they came from."""

    camera: Camera
    source: str


def camera_of(exif: Exif, xmp: Xmp, width: int, height: int, given: SourcedCamera | None = None) -> SourcedCamera:
    """The camera of a photo.

    DewarpData's lens is used even where the epipolar residual under the logged pose is smaller without it: on a real
    Phantom 4 Multispectral strip it is 4.7 px with and 3.6 px without, but there a yaw error of 1.6 deg and the missing
    distortion hide each other. With one common misalignment estimated it is 0.83 px against 1.88 px, and without
    distortion that misalignment would have to be 36 deg.

    Args:
        exif: The photo's EXIF.
        xmp: Its XMP.
        width: Width of the pixels in the file; tags may describe a larger original.
        height: Height.
        given: The user's calibration, which wins.

    Returns:
        Camera at the file's size.

    Raises:
        Unusable: No focal length anywhere, or the calibration is of another image shape.
    """
    if given is not None:
        return SourcedCamera(_resized(given.camera, width, height, given.source), given.source)
    dewarped = (number(xmp, "DewarpFlag") or 0.0) == 1.0
    found = _from_dewarp_data(exif, xmp, width, height, dewarped=dewarped)
    found = found or _from_calibrated(exif, xmp, width, height, dewarped=dewarped)
    return found if found is not None else _from_exif(exif, width, height)


def dewarp_data(text: str) -> tuple[float, ...] | None:
    """The nine numbers of DewarpData: fx, fy, cx, cy (px, centre relative to the photo's), k1, k2, p1, p2, k3.

    Args:
        text: "date;fx,fy,cx,cy,k1,k2,p1,p2,k3"; the date may be missing.

    Returns:
        The numbers, or None where the text is not that, or the focal lengths are not positive.

    Source: DJI Phantom 4 RTK and Mavic 3M image processing guides.
    """
    try:
        values = tuple(float(part) for part in re.split(r"[,\s]+", text.rpartition(";")[2].strip()) if part)
    except ValueError:
        return None
    usable = len(values) == 9 and all(math.isfinite(v) for v in values) and values[0] > 0.0 and values[1] > 0.0
    return values if usable else None


def _from_dewarp_data(exif: Exif, xmp: Xmp, width: int, height: int, *, dewarped: bool) -> SourcedCamera | None:
    values = dewarp_data(xmp.dji.get("DewarpData", ""))
    if values is None:
        return None
    full_width, full_height = _original_size(exif, xmp, width, height)
    fx, fy, dx, dy, *distortion = values
    if not _plausible(fx, exif, full_width, full_height):
        return None
    centre = (full_width - 1) / 2.0 + dx, (full_height - 1) / 2.0 + dy
    if dewarped:
        # The camera has already resampled the picture with this calibration: its lens is gone, its focal length stays.
        camera = Camera("pinhole", full_width, full_height, fx, fy, *centre)
        source = "DewarpData, lens already corrected (DewarpFlag 1)"
    else:
        camera = Camera("brown", full_width, full_height, fx, fy, *centre, tuple(distortion))
        source = "DewarpData"
    return SourcedCamera(camera.scaled(width, height), source)


def _from_calibrated(exif: Exif, xmp: Xmp, width: int, height: int, *, dewarped: bool) -> SourcedCamera | None:
    focal = number(xmp, "CalibratedFocalLength")
    if focal is None or focal <= 0.0:
        return None
    full_width, full_height = _original_size(exif, xmp, width, height)
    if not _plausible(focal, exif, full_width, full_height):
        return None
    # DJI counts from the corner of the first pixel (it writes exactly half the size), OpenCV from that pixel's centre.
    cx = number(xmp, "CalibratedOpticalCenterX") or full_width / 2.0
    cy = number(xmp, "CalibratedOpticalCenterY") or full_height / 2.0
    camera = Camera("pinhole", full_width, full_height, focal, focal, cx - 0.5, cy - 0.5)
    source = "CalibratedFocalLength" + (
        ", lens already corrected (DewarpFlag 1)" if dewarped else ", distortion unknown"
    )
    return SourcedCamera(camera.scaled(width, height), source)


def _from_exif(exif: Exif, width: int, height: int) -> SourcedCamera:
    by_table = focal_from_table(exif.model, exif.focal_mm, width, height)
    by_tag = focal_from_35mm(exif.focal_35mm, width, height)
    focal = by_table if by_table is not None else by_tag
    if focal is None:
        raise Unusable(
            f"no focal length: no calibration tags, no 35 mm equivalent, and no sensor width known for model "
            f"'{exif.model}': give a calibration with ingest.camera"
        )
    source = "EXIF focal length, sensor width table" if by_table is not None else "EXIF 35 mm equivalent (diagonal)"
    if by_table is not None and by_tag is not None and abs(by_table / by_tag - 1.0) > 0.05:
        source += f" (the 35 mm tag alone would give {by_tag:.0f} px)"
    if exif.digital_zoom > 1.0:
        focal *= exif.digital_zoom
        source += f", digital zoom {exif.digital_zoom:g}"
    if not 0.1 * max(width, height) < focal < 100.0 * max(width, height):
        raise Unusable(f"the focal length {focal:.0f} px does not fit {width} x {height} px: set ingest.camera")
    return SourcedCamera(Camera("pinhole", width, height, focal, focal, (width - 1) / 2.0, (height - 1) / 2.0), source)


def _plausible(focal: float, exif: Exif, width: int, height: int) -> bool:
    """Whether a calibrated focal length fits the 35 mm equivalent at all.

    Some firmware writes millimetres, or the focal length of another sensor of a multi-camera payload.
    """
    expected = focal_from_35mm(exif.focal_35mm, width, height)
    return expected is None or 0.5 < focal / expected < 2.0


def _original_size(exif: Exif, xmp: Xmp, width: int, height: int) -> tuple[int, int]:
    """The size the calibration tags are for: EXIF's, or twice the calibrated centre, where the file was resampled."""
    candidates = [exif.pixel_size]
    cx, cy = number(xmp, "CalibratedOpticalCenterX"), number(xmp, "CalibratedOpticalCenterY")
    if cx is not None and cy is not None:
        candidates.append((round(2.0 * cx), round(2.0 * cy)))
    for candidate in candidates:
        if candidate is None or min(candidate) <= 0:
            continue
        ratio_x, ratio_y = candidate[0] / width, candidate[1] / height
        # A true centre is within a few percent of the middle; only a common factor well away from 1 is a resampling.
        if abs(ratio_x / ratio_y - 1.0) < 0.05 and not 0.8 < ratio_x < 1.25:
            scale = (ratio_x + ratio_y) / 2.0
            return round(width * scale), round(height * scale)
    return width, height


def _resized(camera: Camera, width: int, height: int, source: str) -> Camera:
    if (camera.width, camera.height) == (width, height):
        return camera
    if abs(camera.width * height - camera.height * width) > max(width, height):
        raise Unusable(
            f"the photo has {width} x {height} px, the calibration ({source}) {camera.width} x {camera.height} px "
            "of another shape: calibrate in the mode the photos were taken in"
        )
    return camera.scaled(width, height)


def checked(camera: Camera, where: str) -> Camera:
    """A camera from a file, refused where no lens can be like it.

    Raises:
        InputError: Size or focal length not positive, or a number not finite.
    """
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    good = all(math.isfinite(v) for v in numbers) and min(camera.fx, camera.fy) > 0.0
    if not good or min(camera.width, camera.height) <= 0:
        raise InputError(
            "E-CAMERA-02", "the calibration is not of a camera", where=where, found=repr(numbers),
            expected="finite numbers, positive size and focal lengths (fx = 0 means uncalibrated in ROS)",
        )  # fmt: skip
    return camera
