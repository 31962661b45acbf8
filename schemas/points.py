"""The product: one row per fused point in the output CRS, with its covariance."""

import pyarrow as pa

from schemas._columns import Column, TableSchema, count, number, single, text, time_ns

GEOMETRY = "geometry"
BBOX = pa.struct([(name, pa.float64()) for name in ("xmin", "ymin", "zmin", "xmax", "ymax", "zmax")])

POINTS = TableSchema(
    "points",
    2,
    "Fused points in the dataset's CRS (x east, y north, z up), one row per physical point.",
    (
        Column(GEOMETRY, pa.binary(), "Point Z as WKB.", "m", "dataset CRS"),
        number("x", "m", "Easting or x.", frame="dataset CRS"),
        number("y", "m", "Northing or y.", frame="dataset CRS"),
        number("z", "m", "Height.", frame="dataset CRS"),
        single("sigma_x_m", "m", "One sigma along x, all that its frames share included.", frame="dataset CRS"),
        single("sigma_y_m", "m", "One sigma along y, all that its frames share included.", frame="dataset CRS"),
        single("sigma_z_m", "m", "One sigma along z, all that its frames share included.", frame="dataset CRS"),
        single("cov_xy", "m2", "Covariance of x and y.", frame="dataset CRS"),
        single("cov_xz", "m2", "Covariance of x and z.", frame="dataset CRS"),
        single("cov_yz", "m2", "Covariance of y and z.", frame="dataset CRS"),
        count("n_pairs", "Pairs that saw the point."),
        count("n_frames", "Frames whose images had a part in it."),
        text("frame_id", "The ref frame of the best observation."),
        single("u", "px", "Column of the best observation.", frame="image"),
        single("v", "px", "Row of the best observation.", frame="image"),
        single("depth_m", "m", "Depth of the best observation.", frame="ref RDF"),
        single("parallax_deg", "deg", "Parallax of the best observation."),
        Column("red", pa.uint8(), "Colour in the best view.", "1"),
        Column("green", pa.uint8(), "Colour in the best view.", "1"),
        Column("blue", pa.uint8(), "Colour in the best view.", "1"),
        time_ns("time", "Exposure of the best view.", nullable=True),
        text("tile", "Tile the point lies in."),
        Column("bbox", BBOX, "Covering of the geometry, for readers that filter by it.", "m", "dataset CRS"),
    ),
)
