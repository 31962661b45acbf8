"""One row per matched pair: the relative pose used, its covariance, and the residual of the matches."""

from schemas._columns import COVARIANCE_6X6, Column, TableSchema, count, number, text

RELATIVE_POSES = TableSchema(
    "relative_poses",
    1,
    "Relative pose src_from_ref of each pair, with what the matches say of it.",
    (
        text("pair_id", "The pair in `pairs`."),
        number("qw", "1", "Rotation src_from_ref, scalar part.", frame="src RDF from ref RDF"),
        number("qx", "1", "Rotation src_from_ref.", frame="src RDF from ref RDF"),
        number("qy", "1", "Rotation src_from_ref.", frame="src RDF from ref RDF"),
        number("qz", "1", "Rotation src_from_ref.", frame="src RDF from ref RDF"),
        number("tx", "m", "Translation src_from_ref.", frame="src RDF"),
        number("ty", "m", "Translation src_from_ref.", frame="src RDF"),
        number("tz", "m", "Translation src_from_ref.", frame="src RDF"),
        Column(
            "cov",
            COVARIANCE_6X6,
            "Row-major 6x6 covariance of the src camera's pose error seen from ref, on the ref camera's axes: rotation "
            "vector (rad), then centre (m).",
            "rad2, rad m, m2",
            "ref RDF",
        ),
        count("n_matches", "Matches the matcher made."),
        count("n_inliers", "Matches kept."),
        number(
            "rms_before_px",
            "px",
            "Root mean square epipolar residual of the inliers under the logged pose.",
            nullable=True,
        ),
        number(
            "median_before_px",
            "px",
            "Median absolute epipolar residual of the inliers under the logged pose.",
            nullable=True,
        ),
        number("rms_after_px", "px", "The same root mean square under the pose of this row.", nullable=True),
        text("mode", "How the pose was found: none (as logged), pair, flight."),
        text("problem", "What to distrust; empty when nothing was found."),
    ),
)
