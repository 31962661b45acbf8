"""What every log reader delivers: one record type per kind of thing a log holds, whatever the format.

Times are int64 nanoseconds on the log's own clock (since boot, or UTC), never decreasing within a stream; `TimeBase`
says what ties that clock to UTC. Arrays of one record have one length n.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from pipeline.geometry.arrays import Floats, Ints
from pipeline.geometry.cameras import Camera

Nanoseconds = npt.NDArray[np.int64]

NS_PER_S, NS_PER_MS, NS_PER_US = 1_000_000_000, 1_000_000, 1_000


@dataclass(frozen=True, slots=True)
class TimeBase:
    """What ties a log's own clock to UTC.

    Args:
        epoch: "utc" when the log's times are UTC already, "boot" when they count from the machine's start.
        anchor_log_ns: (k,) instants on the log's clock at which UTC is known.
        anchor_utc_ns: (k,) UTC of the same instants, leap seconds removed.
        late: Whether the log instants are those of arrival, later than the UTC instants by a delay nobody logged
            (a receiver's latency); the earliest arrivals then count.
        source: Which message says so, for people.
        problem: What to distrust; empty when nothing was found.
    """

    epoch: Literal["utc", "boot"]
    anchor_log_ns: Nanoseconds = field(default_factory=lambda: np.empty(0, np.int64))
    anchor_utc_ns: Nanoseconds = field(default_factory=lambda: np.empty(0, np.int64))
    late: bool = False
    source: str = ""
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Positions:
    """Where the vehicle was: geodetic positions of its antenna or of its navigation's point, WGS 84.

    Args:
        stream: The message or topic, with the instance where there are several ("POS", "GPS[1]", "/fix").
        time_ns: (n,).
        latitude_deg: (n,).
        longitude_deg: (n,).
        ellipsoidal_m: (n,) above the WGS 84 ellipsoid; NaN where the log does not say.
        amsl_m: (n,) above mean sea level by the vehicle's own geoid or barometer; NaN where not logged.
        above_home_m: (n,) above home or take-off; NaN where not logged.
        barometric_m: (n,) by the barometer alone, from its own zero; NaN where not logged.
        sigma_horizontal_m: (n,) one sigma of east and of north, as logged; NaN where not logged.
        sigma_vertical_m: (n,) one sigma, as logged; NaN where not logged.
        segment: (n,) changes wherever interpolation must not cross (an estimator's reset, a lost fix).
        fused: Whether it is a navigation filter's output, preferred to a bare receiver's.
        image: (n,) names of the images that the rows belong to, `time_ns` then zeros; empty when they are of instants.
    """

    stream: str
    time_ns: Nanoseconds
    latitude_deg: Floats
    longitude_deg: Floats
    ellipsoidal_m: Floats
    amsl_m: Floats
    above_home_m: Floats
    barometric_m: Floats
    sigma_horizontal_m: Floats
    sigma_vertical_m: Floats
    segment: Ints
    fused: bool
    image: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Attitudes:
    """How something was turned, over time.

    Args:
        stream: The message or topic.
        time_ns: (n,).
        q_wxyz: (n, 4) unit quaternions `frame`_from_FRD.
        of: "vehicle" (FRD of the body), or "gimbal" (FRD with x along the optical axis).
        frame: What it is measured against: "ned" (local north-east-down, true north); "heading" (level, x along the
            vehicle's heading: MAVLink's "vehicle frame"); "body" (the vehicle's FRD body, roll and pitch included).
        segment: (n,) as in `Positions`.
        image: As in `Positions`.
    """

    stream: str
    time_ns: Nanoseconds
    q_wxyz: Floats
    of: Literal["vehicle", "gimbal"]
    frame: Literal["ned", "heading", "body"]
    segment: Ints
    image: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Events:
    """Exposures as the vehicle logged them; the pose in the event's own message is not used, it is of another instant.

    Args:
        stream: The message or topic.
        time_ns: (n,) the exposure, or the trigger.
        number: (n,) the event's running number as logged, -1 where it has none.
        feedback: True when the camera reported the exposure (hot shoe), False when a trigger was only commanded.
        sigma_s: One sigma between the logged instant and the exposure, s (quantisation, shutter lag).
        image: (n,) names of image files as logged, empty text where not; or an empty tuple.
    """

    stream: str
    time_ns: Nanoseconds
    number: Ints
    feedback: bool
    sigma_s: float
    image: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class LocalPoses:
    """Poses in a frame that is tied to no place on earth: motion capture, odometry, SLAM, a COLMAP model.

    Args:
        stream: The topic or file.
        time_ns: (n,); zeros where `image` names what the poses belong to.
        position_m: (n, 3) of the child's origin in the parent frame.
        q_wxyz: (n, 4) unit quaternions parent_from_child.
        parent: Name of the frame the poses are in ("map", "world"), empty when not named.
        child: Name of what is posed ("base_link", "drone"), empty when not named.
        of: "camera" when the child is the camera itself (RDF); "body" when it is a vehicle or rigid body, which needs
            an extrinsic transform (from the bag or `ingest.mount`).
        axes: The body's axes: "flu" (ROS, REP 103), "frd" (aerospace); "rdf" for a camera.
        image: (n,) names of the images that the poses belong to; empty when they belong to instants.
        segment: (n,) as in `Positions`.
    """

    stream: str
    time_ns: Nanoseconds
    position_m: Floats
    q_wxyz: Floats
    parent: str
    child: str
    of: Literal["camera", "body"]
    axes: Literal["flu", "frd", "rdf"]
    image: tuple[str, ...]
    segment: Ints


@dataclass(frozen=True, slots=True)
class FixedTransform:
    """A transform that does not change: a camera or a LiDAR on a body.

    Args:
        parent: Frame.
        child: Frame.
        translation_m: (3,) origin of the child in the parent.
        q_wxyz: (4,) parent_from_child.
        source: Topic.
    """

    parent: str
    child: str
    translation_m: Floats
    q_wxyz: Floats
    source: str


@dataclass(frozen=True, slots=True)
class ImageStream:
    """Images inside a bag or video; pixels are read later, only those that are wanted.

    Args:
        stream: Topic, or the video's name.
        time_ns: (n,) exposures: header stamps, or presentation times.
        frame: The camera's coordinate frame, empty when not named.
        encoding: As the source says ("bgr8", "jpeg", "h264").
        width: Pixels per row, 0 when only decoding would tell.
        height: Rows, 0 when only decoding would tell.
        note: What to distrust (log time in place of header stamps), empty when nothing.
    """

    stream: str
    time_ns: Nanoseconds
    frame: str
    encoding: str
    width: int
    height: int
    note: str = ""


@dataclass(frozen=True, slots=True)
class LoggedCamera:
    """A calibration as a log carries it.

    Args:
        stream: Topic.
        frame: The camera's coordinate frame, empty when not named.
        camera: Intrinsics, binning and region of interest applied.
    """

    stream: str
    frame: str
    camera: Camera


@dataclass(frozen=True, slots=True)
class SweepStream:
    """LiDAR sweeps inside a bag; points are read later, sweep by sweep.

    Args:
        stream: Topic.
        time_ns: (n,) header stamps.
        frame: The sensor's coordinate frame.
        fields: Names of the points' fields.
        points: Points in all sweeps.
    """

    stream: str
    time_ns: Nanoseconds
    frame: str
    fields: tuple[str, ...]
    points: int


@dataclass(frozen=True, slots=True)
class Sweep:
    """One LiDAR sweep.

    Args:
        time_ns: Header stamp.
        p_in_sensor_m: (n, 3) returns in the sensor's frame, m; none NaN, none at the origin.
        delay_s: (n,) instant of each return after the stamp, s; zeros when the sweep does not say.
    """

    time_ns: int
    p_in_sensor_m: Floats
    delay_s: Floats


@dataclass(frozen=True, slots=True)
class FlightLog:
    """Everything one log, bag, subtitle file or trajectory says.

    Args:
        location: Path or URL.
        kind: The format, for people: "ArduPilot DataFlash".
        counts: Records per message type or topic, as the format's library counts them.
        time_base: What ties its clock to UTC.
        positions: Position streams.
        attitudes: Attitude streams.
        events: Camera event streams.
        poses: Pose streams in local frames.
        transforms: Fixed transforms between frames.
        images: Image streams.
        cameras: Calibrations.
        sweeps: LiDAR streams.
        losses: What could not be read or was left out: sentences in lower case without a full stop, with counts; empty
            when all was read.
        facts: Other things worth telling (firmware, vehicle, library): names with their units, JSON values.
    """

    location: str
    kind: str
    counts: Mapping[str, int]
    time_base: TimeBase
    positions: tuple[Positions, ...] = ()
    attitudes: tuple[Attitudes, ...] = ()
    events: tuple[Events, ...] = ()
    poses: tuple[LocalPoses, ...] = ()
    transforms: tuple[FixedTransform, ...] = ()
    images: tuple[ImageStream, ...] = ()
    cameras: tuple[LoggedCamera, ...] = ()
    sweeps: tuple[SweepStream, ...] = ()
    losses: tuple[str, ...] = ()
    facts: Mapping[str, Any] = field(default_factory=dict)


def nothing(n: int) -> Floats:
    """(n,) NaN: a quantity that the log does not hold."""
    return np.full(n, np.nan)
