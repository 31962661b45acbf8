"""One row per usable frame: the absolute pose that the points are placed with."""

from schemas._columns import TableSchema, text
from schemas.frames import position_columns, sigma_columns

POSES = TableSchema(
    "poses",
    1,
    "Absolute poses after refinement; equal to the log's with refine.mode = none.",
    (text("frame_id", "The frame in `frames`."), *position_columns(), *sigma_columns()),
)
