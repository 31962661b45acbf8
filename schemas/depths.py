"""One row per match, pair and method: depth in the ref frame with its sigma, kept or masked with the reason."""

from schemas._columns import TableSchema, flag, number, single, text

DEPTHS = TableSchema(
    "depths",
    3,
    "Depths of the matches by every method.",
    (
        text("pair_id", "The pair in `pairs`."),
        text("frame_id", "The ref frame, which the depth belongs to."),
        number("u", "px", "Column in the ref image as given.", frame="image"),
        number("v", "px", "Row in the ref image as given.", frame="image"),
        number("src_u", "px", "Column of the match in the src image as given.", frame="image"),
        number("src_v", "px", "Row of the match in the src image as given.", frame="image"),
        text(
            "method",
            "epitransfer (the virtual view of the configuration), epitransfer-lateral, epitransfer-vertical, dlt.",
        ),
        number(
            "depth_m",
            "m",
            "Distance along the optical axis of the ref camera; null when no finite depth exists.",
            frame="ref RDF",
            nullable=True,
        ),
        number("sigma_depth_m", "m", "One sigma from pixel and pose covariance.", frame="ref RDF", nullable=True),
        number(
            "sigma_pixel_m",
            "m",
            "The part of sigma_depth_m that the matched positions have.",
            frame="ref RDF",
            nullable=True,
        ),
        single("parallax_deg", "deg", "Angle between the two rays."),
        single(
            "transfer_angle_deg",
            "deg",
            "Tilt about the src ray between the plane used and the epipolar plane: 90 is best, 0 the trifocal plane.",
            nullable=True,
        ),
        single(
            "normal_x",
            "1",
            "Depth per metre by which the src ray is displaced at the point.",
            frame="ref RDF",
            nullable=True,
        ),
        single("normal_y", "1", "As normal_x.", frame="ref RDF", nullable=True),
        single("normal_z", "1", "As normal_x.", frame="ref RDF", nullable=True),
        flag("kept", "Whether the depth may be published."),
        text("reason", "Why it is masked; empty when kept."),
    ),
)
