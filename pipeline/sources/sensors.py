"""Focal length in pixels from EXIF: a table of sensor widths, or the 35 mm equivalent.

The width is of the full-width still; a 16:9 still is the same width with less height. Where a self-calibration of that
model is at hand the width is the effective one (cameras that correct their lens crop a little), marked below.
"""

from __future__ import annotations

import math

# Diagonal of the 36 x 24 mm frame: cameras state the equivalent by the diagonal (CIPA DC-008, FocalLengthIn35mmFilm).
FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)

# Model (EXIF) to sensor width, mm. Makers' data sheets.
SENSOR_WIDTH_MM = {
    "FC300C": 6.317,  # Phantom 3 Standard
    "FC300S": 6.317,  # Phantom 3 Professional; effective: self-calibration of a crossed flight, 457 px at 800 px width
    "FC300X": 6.317,  # Phantom 3 Professional
    "FC300XW": 6.317,  # Phantom 3 4K
    "FC330": 6.25,  # Phantom 4
    "FC6310": 13.2,  # Phantom 4 Pro
    "FC6310S": 13.2,  # Phantom 4 Pro V2
    "FC6310R": 13.2,  # Phantom 4 RTK
    "FC6360": 4.8,  # Phantom 4 Multispectral; effective: calibrated focal length 1913 px at 5.74 mm and 1600 px
    "FC220": 5.66,  # Mavic Pro; effective: calibration 3320 px at 4.7 mm and 4000 px
    "FC2103": 6.17,  # Mavic Air
    "FC3170": 6.4,  # Mavic Air 2
    "FC3411": 13.2,  # Air 2S
    "FC7203": 6.17,  # Mavic Mini
    "FC7303": 6.17,  # Mini 2
    "FC3582": 9.6,  # Mini 3 Pro
    "FC8482": 9.6,  # Mini 4 Pro
    "FC8282": 9.6,  # Air 3
    "L1D-20c": 13.2,  # Mavic 2 Pro
    "FC2204": 6.17,  # Mavic 2 Zoom
    "L2D-20c": 17.3,  # Mavic 3
    "M3E": 17.3,  # Mavic 3 Enterprise
    "FC350": 6.17,  # Zenmuse X3
    "FC550": 17.3,  # Zenmuse X5
    "FC6510": 13.2,  # Zenmuse X4S
    "FC6520": 17.3,  # Zenmuse X5S
    "FC6540": 23.5,  # Zenmuse X7
    "ZenmuseP1": 35.9,  # Zenmuse P1
}
# Stills wider than this are crops of a 4:3 or 3:2 sensor at full width; the equivalent is stated for the whole sensor.
_CROPPED_ASPECT = 1.6


def focal_from_table(model: str, focal_mm: float | None, width: int, height: int) -> float | None:
    """Focal length by the sensor table.

    Args:
        model: EXIF model.
        focal_mm: EXIF focal length, mm.
        width: Image width as it is, px (a resampled copy keeps the ratio).
        height: Image height, px.

    Returns:
        Focal length, px; None where the model or the focal length is not known.
    """
    sensor_mm = SENSOR_WIDTH_MM.get(model.strip())
    if sensor_mm is None or focal_mm is None:
        return None
    return focal_mm / sensor_mm * max(width, height)


def focal_from_35mm(focal_35mm: float | None, width: int, height: int) -> float | None:
    """Focal length by the 35 mm equivalent, which compares diagonals.

    Args:
        focal_35mm: EXIF FocalLengthIn35mmFilm, mm.
        width: Image width, px.
        height: Image height, px.

    Returns:
        Focal length, px; None where the tag is missing.
    """
    if focal_35mm is None:
        return None
    long, short = max(width, height), min(width, height)
    if long / short > _CROPPED_ASPECT:
        short = round(long * 0.75)
    return focal_35mm / FULL_FRAME_DIAGONAL_MM * math.hypot(long, short)
