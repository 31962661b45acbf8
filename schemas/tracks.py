"""One row per pose sample as the source logged it, before any interpolation."""

import pyarrow as pa

from schemas._columns import Column, TableSchema, number, text, time_ns


def _logged(name: str, unit: str, meaning: str, frame: str = "") -> Column:
    return number(name, unit, meaning, frame=frame, nullable=True)


TRACKS = TableSchema(
    "tracks",
    2,
    "Positions and attitudes as logged, each on its source's clock.",
    (
        text("source", "The file the sample came from, relative to the run's photo root where it lies below it."),
        text("stream", "What kind of record: photo, mrk, or the message or topic of a log."),
        text("what", "What was posed: camera, vehicle, gimbal (against the frame after it), body."),
        time_ns(
            "time", "Instant in UTC by the source's clock (see clocks); null where nothing ties it.", nullable=True
        ),
        Column(
            "log_ns", pa.int64(), "The instant on the log's own clock, from its epoch; null for photos.", "ns", "", True
        ),
        _logged("latitude_deg", "deg", "Position, WGS 84."),
        _logged("longitude_deg", "deg", "Position, WGS 84."),
        _logged("height_m", "m", "Height as logged, from `height_datum`; the best known where several are."),
        text("height_datum", "What height_m is measured from: ellipsoidal, amsl, takeoff, barometric, unknown."),
        _logged("amsl_m", "m", "Height above mean sea level by the vehicle's own geoid or barometer."),
        _logged("above_takeoff_m", "m", "Height above home or take-off."),
        _logged("barometric_m", "m", "Height by the barometer alone, from its own zero."),
        _logged("x_m", "m", "Position in a local frame.", "local"),
        _logged("y_m", "m", "Position in a local frame.", "local"),
        _logged("z_m", "m", "Position in a local frame.", "local"),
        _logged("yaw_deg", "deg", "Yaw as logged, clockwise; from true north for attitudes against NED.", "NED"),
        _logged("pitch_deg", "deg", "Pitch as logged.", "NED"),
        _logged("roll_deg", "deg", "Roll as logged.", "NED"),
        _logged("qw", "1", "Attitude in a local frame, scalar part.", "local from child"),
        _logged("qx", "1", "Attitude in a local frame.", "local from child"),
        _logged("qy", "1", "Attitude in a local frame.", "local from child"),
        _logged("qz", "1", "Attitude in a local frame.", "local from child"),
    ),
)
