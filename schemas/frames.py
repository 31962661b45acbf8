"""One row per image: its pose in the local ENU frame, its time, and whether it can be used."""

from schemas._columns import Column, TableSchema, flag, number, text, time_ns


def position_columns() -> tuple[Column, ...]:
    """The camera centre and attitude in ENU, shared by `frames` and `poses`."""
    return (
        number("east_m", "m", "Camera centre, east of the flight's origin.", frame="ENU", nullable=True),
        number("north_m", "m", "Camera centre, north of the flight's origin.", frame="ENU", nullable=True),
        number("up_m", "m", "Camera centre, above the flight's origin.", frame="ENU", nullable=True),
        number("qw", "1", "Attitude enu_from_cam, scalar part.", frame="ENU from camera RDF", nullable=True),
        number("qx", "1", "Attitude enu_from_cam.", frame="ENU from camera RDF", nullable=True),
        number("qy", "1", "Attitude enu_from_cam.", frame="ENU from camera RDF", nullable=True),
        number("qz", "1", "Attitude enu_from_cam.", frame="ENU from camera RDF", nullable=True),
    )


def whole_sigma_columns() -> tuple[Column, ...]:
    """Standard deviations of a pose, shared by `frames` and `poses`."""
    whole = "One sigma of the whole error"
    return (
        number("sigma_east_m", "m", f"{whole}, east.", frame="ENU", nullable=True),
        number("sigma_north_m", "m", f"{whole}, north.", frame="ENU", nullable=True),
        number("sigma_up_m", "m", f"{whole}, up.", frame="ENU", nullable=True),
        number("sigma_yaw_deg", "deg", f"{whole}, about the down axis.", frame="NED", nullable=True),
        number("sigma_pitch_deg", "deg", f"{whole}, about the camera's right axis.", nullable=True),
        number("sigma_roll_deg", "deg", f"{whole}, about the level forward axis.", nullable=True),
    )


def own_sigma_columns() -> tuple[Column, ...]:
    """Standard deviations of the part of a logged pose's error that is new in each frame."""
    own = "One sigma of the part that is independent from frame to frame; the rest is common to the flight"
    return (
        number("own_sigma_east_m", "m", f"{own}, east.", frame="ENU", nullable=True),
        number("own_sigma_north_m", "m", f"{own}, north.", frame="ENU", nullable=True),
        number("own_sigma_up_m", "m", f"{own}, up.", frame="ENU", nullable=True),
        number("own_sigma_yaw_deg", "deg", f"{own}, about the down axis.", frame="NED", nullable=True),
        number("own_sigma_pitch_deg", "deg", f"{own}, about the camera's right axis.", nullable=True),
        number("own_sigma_roll_deg", "deg", f"{own}, about the level forward axis.", nullable=True),
    )


FRAMES = TableSchema(
    "frames",
    1,
    "Images with the pose the log gives them.",
    (
        text("frame_id", "The image's stem, unique in the run."),
        text("image", "Path of the image relative to the run's photo root (manifest: ingest.photo_root)."),
        text("image_sha256", "Digest of the image file's bytes."),
        text("camera_id", "The camera in `cameras`; empty when the image could not be read."),
        time_ns("time", "Exposure.", nullable=True),
        text(
            "time_source",
            "Where time and zone came from: utc_at_exposure, mrk, gps, exif+offset, exif+gps zone, exif (zone unknown)",
        ),
        number("latitude_deg", "deg", "Camera centre, WGS 84.", frame="EPSG:4979", nullable=True),
        number("longitude_deg", "deg", "Camera centre, WGS 84.", frame="EPSG:4979", nullable=True),
        number(
            "height_m",
            "m",
            "Camera centre above the ellipsoid when height_datum is ellipsoidal; else the height as logged.",
            nullable=True,
        ),
        text("height_datum", "What height_m is measured from: ellipsoidal, takeoff, local or unknown."),
        number(
            "above_takeoff_m", "m", "Height above the take-off point as the log says it, where it does.", nullable=True
        ),
        *position_columns(),
        number("yaw_deg", "deg", "Optical axis, clockwise from true north.", frame="NED", nullable=True),
        number(
            "pitch_deg", "deg", "Optical axis above the horizon; -90 looks straight down.", frame="NED", nullable=True
        ),
        number("roll_deg", "deg", "Rotation about the optical axis, clockwise positive.", frame="NED", nullable=True),
        *whole_sigma_columns(),
        *own_sigma_columns(),
        text("pose_source", "Which tags position and attitude came from."),
        flag("usable", "Whether the later stages use this image."),
        text("problem", "Why it is not usable, or what to distrust; empty when nothing was found."),
    ),
)
