"""One row per match between two images of a pair."""

from schemas._columns import TableSchema, flag, number, single, text

MATCHES = TableSchema(
    "matches",
    1,
    "Correspondences, in pixels of the images as given (distorted).",
    (
        text("pair_id", "The pair in `pairs`."),
        number("ref_u", "px", "Column in the ref image.", frame="image"),
        number("ref_v", "px", "Row in the ref image.", frame="image"),
        number("src_u", "px", "Column in the src image.", frame="image"),
        number("src_v", "px", "Row in the src image.", frame="image"),
        single("score", "1", "1 minus the ratio of best to second-best descriptor distance; higher is better."),
        flag(
            "inlier", "Agrees with the logged pose within its covariance and with the epipolar geometry of the matches."
        ),
    ),
)
