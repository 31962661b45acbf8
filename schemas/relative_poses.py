"""One row per matched pair: the relative pose used, its covariance, and the residual of the matches."""

import pyarrow as pa

from schemas._columns import COVARIANCE_6X6, Column, TableSchema, count, number, text

_OF_BOTH = pa.list_(pa.float64(), 144)


def _placement(role: str) -> tuple[Column, ...]:
    """Where the pair takes one of its cameras to be."""
    return (
        number(f"{role}_east_m", "m", f"Camera centre of {role} that the pair's points are placed with.", frame="ENU"),
        *(number(f"{role}_{axis}_m", "m", f"As {role}_east_m.", frame="ENU") for axis in ("north", "up")),
        number(f"{role}_qw", "1", f"Attitude enu_from_cam of {role}, scalar part.", frame="ENU from camera RDF"),
        *(number(f"{role}_{name}", "1", f"As {role}_qw.", frame="ENU from camera RDF") for name in ("qx", "qy", "qz")),
    )


RELATIVE_POSES = TableSchema(
    "relative_poses",
    2,
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
        *_placement("ref"),
        *_placement("src"),
        Column(
            "gain",
            _OF_BOTH,
            "Row-major 12x12: the errors of the two placed cameras (turn and shift of ref, then of src, ENU) by those "
            "of the two frames, whose covariances are in `pose_covariances`; null for the unit matrix.",
            "1",
            "ENU",
            nullable=True,
        ),
        Column(
            "noise",
            _OF_BOTH,
            "Row-major 12x12 covariance of the error of the two placed cameras that is the pair's; null for none.",
            "rad2, rad m, m2",
            "ENU",
            nullable=True,
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
        number("median_after_px", "px", "The same median under the pose of this row.", nullable=True),
        number(
            "moved_sigmas",
            "1",
            "How far this row's pose is from the logged one in units of the logged pose's covariance (Mahalanobis).",
            nullable=True,
        ),
        text("mode", "How the pose was found: none (as logged, also where refinement was refused), pair, flight."),
        text("problem", "Why the logged pose stands, or what to distrust; empty when nothing was found."),
    ),
)
