"""One row per scored pixel and method: what was measured and what the truth says."""

from schemas._columns import TableSchema, flag, number, single, text

SCORES = TableSchema(
    "pixels",
    3,
    "Depths beside the reference depth at the same pixel.",
    (
        text("pair_id", "The pair in `pairs`."),
        text("frame_id", "The ref frame."),
        number("u", "px", "Column in the ref image.", frame="image"),
        number("v", "px", "Row in the ref image.", frame="image"),
        text("method", "The method, as in `depths`."),
        number("depth_m", "m", "Estimated depth.", frame="ref RDF", nullable=True),
        number("sigma_depth_m", "m", "Its predicted sigma.", frame="ref RDF", nullable=True),
        single("parallax_deg", "deg", "Angle between the rays of the match.", nullable=True),
        number("reference_m", "m", "Reference depth at the pixel.", frame="ref RDF"),
        single("reference_spread_m", "m", "Spread of the reference about its local surface."),
        single("reference_sigma_m", "m", "One sigma of the reference by the error of the frame's pose."),
        flag("kept", "Whether the method keeps the depth."),
    ),
)
