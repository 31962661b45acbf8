"""What DJI's subtitle cues say: fields by their names, in each firmware's way of writing them.

    [latitude: 41.4] [longtitude : 2.1] [rel_alt: 1.2 abs_alt: 90.1] [gb_yaw: 1 gb_pitch: -90 gb_roll: 0]
    HOME(149.0251,-20.2532) 2017.08.05 14:11:51 / GPS(149.0251,-20.2533,16) BAROMETER:1.9 (or Hb:1.9 Hs:1.9)
    GPS(36.6146,-6.1120,0.0M) BAROMETER:0.3M                          (Matrice 300: latitude first)
    F/5.6, SS 400, ISO 100, EV 0, GPS (lon, lat, 15), HOME (..), D 698.70m, H 85.80m, F.PRY (..), G.PRY (..)

Source: files of fourteen models and firmwares collected at github.com/JuanIrache/DJI_SRT_Parser (b6ed790); there is no
published specification.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from math import isfinite, nan

from pipeline.sources.time_bases import unix_us

# Bounded repeats: a damaged line of one megabyte must not take quadratic time.
_NUMBER = r"[-+]?\d{1,12}(?:\.\d{1,12})?"
_PAIR = re.compile(rf"\b([A-Za-z_]\w{{0,30}})\s{{0,3}}:\s{{0,3}}({_NUMBER})")
_TUPLE = re.compile(r"\b(GPS|RTK|HOME|[FG]\.PRY)\s{0,3}\(([^()\n]{0,120})\)")
_BARE_HEIGHT = re.compile(rf"(?:^|,)\s{{0,3}}H\s{{1,3}}({_NUMBER})\s{{0,3}}[mM]\b", re.MULTILINE)
_FIRST_NUMBER = re.compile(rf"\s*({_NUMBER})")
_METRES = re.compile(rf"\s*{_NUMBER}\s*[mM]\s*$")
_DATE = re.compile(
    r"(?<!\d)(\d{4})[-.](\d{1,2})[-.](\d{1,2})[ T](\d{1,2}):(\d\d):(\d\d)(?:[.,](\d{1,6})(?:,(\d{3}))?)?"
    r"(?:\s?(UTC|GMT|Z)\b|\s?([-+])(\d\d):?(\d\d)\b)?"
)

# Column of each name, lower case. "longtitude" is DJI's own spelling.
_PAIRS = {
    "latitude": "latitude",
    "longitude": "longitude",
    "longtitude": "longitude",
    "rel_alt": "rel_alt",
    "abs_alt": "abs_alt",
    "altitude": "altitude",
    "barometer": "barometer",
    "hb": "barometer",
    "gb_yaw": "gimbal_yaw",
    "gb_pitch": "gimbal_pitch",
    "gb_roll": "gimbal_roll",
    "framecnt": "frame",
    "srtcnt": "frame",
}
_ANGLES = {"F.PRY": "vehicle", "G.PRY": "gimbal"}
# Camera settings: name in the facts, and how dialects write it ("Shutter:400", "TV:60", "SS 400" are 1/400 s).
_SETTINGS = (
    ("iso", re.compile(rf"\bISO\s{{0,3}}[: ]\s{{0,3}}({_NUMBER})", re.IGNORECASE)),
    ("f_number", re.compile(rf"\b(?:F/|(?:fnum|IR)\s{{0,3}}:\s{{0,3}}F?)({_NUMBER})", re.IGNORECASE)),
    ("focal_len_mm", re.compile(rf"\bfocal_len\s{{0,3}}:\s{{0,3}}({_NUMBER})", re.IGNORECASE)),
    ("shutter_s", re.compile(rf"\b(?:shutter|TV|SS)\s{{0,3}}[: ]\s{{0,3}}(?:1/)?({_NUMBER})", re.IGNORECASE)),
)
SETTINGS = len(_SETTINGS)


def fields(text: str) -> dict[str, float]:
    """The numbers of one cue.

    Args:
        text: Lines of the cue, markup included.

    Returns:
        By column: "latitude", "longitude" where they are named; "first", "second" of a GPS tuple, "home_first",
        "home_second" of a HOME tuple, all deg; "metres" 1 where the tuple's third value is in metres; heights
        "rel_alt", "abs_alt", "altitude", "barometer", "h", m; "vehicle_pitch", "gimbal_yaw" and so on, deg; "frame".
        A value that is not a number ("n/a") is NaN or missing.
    """
    out: dict[str, float] = {}
    for name, value in _PAIR.findall(text):
        column = _PAIRS.get(name.lower())
        if column is not None:
            out.setdefault(column, float(value))
    for name, inside in _TUPLE.findall(text):
        _add_tuple(out, name, inside.split(","))
    height = _BARE_HEIGHT.search(text)
    if height:
        out["h"] = float(height[1])
    return out


def _add_tuple(out: dict[str, float], name: str, parts: list[str]) -> None:
    values = [_number(part) for part in parts]
    if name in _ANGLES and len(values) == 3:
        for axis, value in zip(("pitch", "roll", "yaw"), values, strict=True):
            out.setdefault(f"{_ANGLES[name]}_{axis}", value)
    elif name == "HOME" and len(values) >= 2:
        out.setdefault("home_first", values[0])
        out.setdefault("home_second", values[1])
    elif name in {"GPS", "RTK"} and len(values) >= 2 and "first" not in out:
        out["first"], out["second"] = values[:2]
        out["metres"] = float(len(parts) > 2 and bool(_METRES.match(parts[2])))


def _number(text: str) -> float:
    found = _FIRST_NUMBER.match(text)
    return float(found[1]) if found else nan


def settings(text: str) -> dict[str, float]:
    """Camera settings of one cue, normalised: "iso", "f_number", "focal_len_mm" (35 mm equivalent), "shutter_s".

    Two firmwares write f/2.8 as 280 and 24 mm as 240; later ones write 3.2 and 24.00.
    """
    out: dict[str, float] = {}
    for name, pattern in _SETTINGS:
        found = pattern.search(text)
        if found is None or not isfinite(value := float(found[1])) or value <= 0.0:
            continue
        if name == "f_number" and value > 50.0:
            value /= 100.0
        elif name == "focal_len_mm" and "." not in found[1]:
            value /= 10.0
        elif name == "shutter_s":
            value = 1.0 / value
        out[name] = value
    return out


def date(text: str) -> tuple[float, bool] | None:
    """The date and time of one cue.

    Returns:
        Microseconds since 1970 of the time as written, and whether that is UTC because the text says so; None where
        there is no date.
    """
    found = _DATE.search(text)
    if found is None:
        return None
    year, month, day, hour, minute, second = (int(part) for part in found.groups()[:6])
    fraction = ((found[7] or "") + (found[8] or "")).ljust(6, "0")[:6]
    try:
        moment = datetime(year, month, day, hour, minute, second, int(fraction), tzinfo=UTC)
        if found[10]:
            offset = timedelta(hours=int(found[11]), minutes=int(found[12]))
            moment += offset if found[10] == "-" else -offset
    except (ValueError, OverflowError):
        return None
    return float(unix_us(moment)), bool(found[9] or found[10])
