"""One row per candidate pair of frames: selected, or rejected with the rule that rejected it."""

from schemas._columns import TableSchema, flag, number, text

PAIRS = TableSchema(
    "pairs",
    1,
    "Pairs of frames whose geometry was looked at.",
    (
        text("pair_id", "ref_frame_id~src_frame_id."),
        text("ref_frame_id", "The frame that gets the depth (I_t)."),
        text("src_frame_id", "The frame it is paired with (I_{t-1})."),
        number("baseline_m", "m", "Distance between the camera centres."),
        number(
            "epipole_u",
            "px",
            "Column of the src centre in ref, ideal (undistorted) pixels; null at infinity.",
            frame="image",
            nullable=True,
        ),
        number(
            "epipole_v",
            "px",
            "Row of the src centre in ref, ideal pixels; null at infinity.",
            frame="image",
            nullable=True,
        ),
        number(
            "epipole_margin_px",
            "px",
            "Distance from the epipole to the region of interest; negative inside it.",
            nullable=True,
        ),
        number("view_angle_deg", "deg", "Angle between the optical axes."),
        number(
            "overlap",
            "1",
            "Share of the ref image's ground footprint that src sees; null when an earlier rule rejected.",
            nullable=True,
        ),
        flag("selected", "Whether the pair is matched."),
        text("reason", "The rule that rejected it, with found and allowed; empty when selected."),
    ),
)
