"""One row per camera: a lens, a sensor mode and where its calibration came from, as given and as refined."""

import pyarrow as pa

from schemas._columns import Column, TableSchema, count, number, text

_COLUMNS = (
    text("camera_id", "Name of the camera, unique in the run."),
    text("model", "pinhole, brown (OpenCV k1 k2 p1 p2 k3 [k4 k5 k6]) or fisheye (OpenCV k1..k4)."),
    count("width", "Image width in pixels."),
    count("height", "Image height in pixels."),
    number("fx", "px", "Focal length along the rows.", frame="image"),
    number("fy", "px", "Focal length along the columns.", frame="image"),
    number("cx", "px", "Principal point, column; pixel (0, 0) is the centre of the top-left pixel.", frame="image"),
    number("cy", "px", "Principal point, row.", frame="image"),
    Column("distortion", pa.list_(pa.float64()), "Distortion coefficients in OpenCV's order; empty for none.", "1"),
    text("source", "Where the intrinsics came from: calibration file, DewarpData, calibrated focal length, or EXIF."),
)

CAMERAS = TableSchema(
    "cameras",
    1,
    "Cameras that took the images: model, size and intrinsics, with their source.",
    _COLUMNS,
)

REFINED_CAMERAS = TableSchema(
    "refined_cameras",
    1,
    "The cameras that depths and points are made with; equal to `cameras` unless refine.calibrate found better ones.",
    _COLUMNS,
)
