"""One row per usable frame: the absolute pose after refinement, with its covariance."""

from schemas._columns import COVARIANCE_6X6, Column, TableSchema, flag, text
from schemas.frames import position_columns, whole_sigma_columns

POSES = TableSchema(
    "poses",
    2,
    "Absolute poses after refinement; equal to the log's with refine.mode = none.",
    (
        text("frame_id", "The frame in `frames`."),
        *position_columns(),
        *whole_sigma_columns(),
        Column(
            "cov",
            COVARIANCE_6X6,
            "Row-major 6x6 covariance of the whole error: rotation vector (rad), then centre (m).",
            "rad2, rad m, m2",
            "ENU",
        ),
        flag("refined", "Whether matches had a part in this pose."),
        text("problem", "What to distrust; empty when nothing was found."),
    ),
)
