"""One row per two frames that may see the same points: the covariance between the errors of their poses."""

from schemas._columns import COVARIANCE_6X6, Column, TableSchema, text

POSE_COVARIANCES = TableSchema(
    "pose_covariances",
    1,
    "Covariances between the errors of frames' poses, each frame with itself and with the frames near it in the graph "
    "of pairs. With refine.mode = pair they are the log's: `relative_poses` tells what each pair makes of them.",
    (
        text("frame_id", "The frame in `poses`."),
        text("other_frame_id", "Another one, or the same; two frames have one row, and the transpose holds as well."),
        Column(
            "cov",
            COVARIANCE_6X6,
            "Row-major 6x6: rotation vector (rad) and centre (m) of frame_id, by those of other_frame_id.",
            "rad2, rad m, m2",
            "ENU",
        ),
    ),
)
