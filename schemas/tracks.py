"""One row per pose sample as the source logged it, before any interpolation."""

from schemas._columns import TableSchema, number, text, time_ns

TRACKS = TableSchema(
    "tracks",
    1,
    "Positions and attitudes as logged, each on its source's clock.",
    (
        text("source", "The file the sample came from, relative to the run's photo root."),
        text("stream", "What kind of record: photo, mrk."),
        time_ns("time", "Instant of the sample on the source's own clock, read as UTC.", nullable=True),
        number("latitude_deg", "deg", "Position, WGS 84.", nullable=True),
        number("longitude_deg", "deg", "Position, WGS 84.", nullable=True),
        number("height_m", "m", "Height as logged, from `height_datum`.", nullable=True),
        text("height_datum", "What the height is measured from."),
        number("yaw_deg", "deg", "Gimbal yaw as logged, clockwise from true north.", frame="NED", nullable=True),
        number("pitch_deg", "deg", "Gimbal pitch as logged.", frame="NED", nullable=True),
        number("roll_deg", "deg", "Gimbal roll as logged.", frame="NED", nullable=True),
    ),
)
