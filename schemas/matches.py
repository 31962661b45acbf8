"""One row per match between two images of a pair."""

from schemas._columns import TableSchema, flag, number, single, text

MATCHES = TableSchema(
    "matches",
    2,
    "Correspondences, in pixels of the images as given (distorted).",
    (
        text("pair_id", "The pair in `pairs`."),
        number("ref_u", "px", "Column in the ref image.", frame="image"),
        number("ref_v", "px", "Row in the ref image.", frame="image"),
        number("src_u", "px", "Column in the src image.", frame="image"),
        number("src_v", "px", "Row in the src image.", frame="image"),
        single("score", "1", "The matcher's own score, 0 to 1; higher is better."),
        single("cov_uu", "px^2", "Variance of src_u, ref_u and ref_v taken as given.", frame="image"),
        single("cov_uv", "px^2", "Covariance of src_u and src_v.", frame="image"),
        single("cov_vv", "px^2", "Variance of src_v.", frame="image"),
        flag(
            "inlier",
            "Its patches fit, and it agrees with the logged pose within its covariance and with the other matches' "
            "epipolar geometry.",
        ),
    ),
)
