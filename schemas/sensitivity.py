"""One row per take, injected error and method: what the error does to the depths."""

from schemas._columns import TableSchema, count, flag, number, text

CURVES = TableSchema(
    "curves",
    1,
    "Relative error of depths against injected errors of the src camera's pose.",
    (
        text("take", "A stretch of the flight between gaps and turns, as in sensitivity.json."),
        text(
            "kind",
            "The error: translation_along the baseline (its length), translation_across it (level), translation_up; "
            "yaw, pitch, roll about the gimbal's axes.",
        ),
        text("unit", "Unit of `injected`: m or deg."),
        number("injected", "m or deg", "The injected error, in the kind's unit."),
        text("method", "The method, as in `depths`."),
        flag("refined", "Whether pair refinement was given the pose with its error as the log's."),
        count("n", "Pixels compared: those with a reference that the method keeps when no error is injected."),
        number("abs_rel", "1", "Mean of |depth - reference| / reference over them, masked or not.", nullable=True),
        number("median_rel", "1", "Median of the same.", nullable=True),
        number("kept_share", "1", "Share of them that would still be published.", nullable=True),
        number("epipole_inside_share", "1", "Share of the pairs with an epipole inside the ref or the src image."),
        flag("marked", "Whether any pair has."),
        count("n_pairs", "Pairs looked at."),
    ),
)
