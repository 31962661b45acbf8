"""A bag's columns as the records of a flight, all on one clock."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.sources.bags.columns import Columns, Timed, epoch_of, timed
from pipeline.sources.bags.container import Bag
from pipeline.sources.bags.frame_tree import transform_between
from pipeline.sources.bags.messages import BagMessages, Calibration, Edge
from pipeline.sources.records import (
    Attitudes,
    Events,
    FixedTransform,
    FlightLog,
    ImageStream,
    LocalPoses,
    LoggedCamera,
    Positions,
    SweepStream,
    TimeBase,
    nothing,
)
from pipeline.sources.streams import FEEDBACK_SIGMA_S, is_rotation, segments, unit

# A trigger line's own time reference, not the command that passed through an autopilot.
_TRIGGER_LINE_SIGMA_S = 0.01
# Half turns, w first: about east + north, and about forward.
_NED_FROM_ENU = np.array([0.0, np.sqrt(0.5), np.sqrt(0.5), 0.0])
_FLU_FROM_FRD = np.array([0.0, 1.0, 0.0, 0.0])
# The body's own frame (REP 105): an IMU may be mounted any way in it.
_BODY = "base_link"


def flight_log(messages: BagMessages, bag: Bag, location: str, losses: Iterable[str]) -> FlightLog:
    """Makes the records of all messages of a bag.

    Args:
        messages: All that were read.
        bag: The container, read to its end.
        location: Path or URL.
        losses: What could not be decoded, one sentence each.

    Returns:
        The log; `facts["attitude_frames"]` says which frames the attitudes are of.

    Source: ROS REP 103 (axes), REP 145 (Imu: orientation is ENU_from_FLU), sensor_msgs; Foxglove schemas.
    """
    found = _Maker(messages).log(location, bag.kind)
    facts = {**bag.facts, "duration_s": bag.duration_s, "topics": dict(sorted(bag.types.items())), **found.facts}
    return replace(
        found, counts=dict(sorted(bag.counted.items())), losses=(*bag.losses, *losses, *found.losses), facts=facts
    )


class _Maker:
    """Makes records, and gathers what was lost."""

    def __init__(self, messages: BagMessages) -> None:
        self._of = messages
        self._losses: list[str] = []
        self._attitude_frames: dict[str, str] = {}
        self._epoch = epoch_of(messages.streams())

    def log(self, location: str, kind: str) -> FlightLog:
        positions = tuple(self._positions(topic, samples) for topic, samples in self._of.fixes.items())
        poses = [self._poses(key, samples, key[0]) for key, samples in self._of.poses.items()]
        edges = [self._poses(key, rows, f"{key[0]} {key[1]}>{key[2]}") for key, rows in self._of.edges.items()]
        transforms = self._transforms()
        attitudes, cameras, events = self._attitudes(transforms), self._cameras(), self._events()
        return FlightLog(
            location=location,
            kind=kind,
            counts={},
            time_base=self._time_base(),
            positions=tuple(stream for stream in positions if len(stream.time_ns)),
            attitudes=attitudes,
            events=events,
            poses=tuple(stream for stream in (*poses, *edges) if len(stream.time_ns)),
            transforms=transforms,
            images=self._images(),
            cameras=cameras,
            sweeps=self._sweeps(),
            losses=tuple(self._losses),
            facts={"attitude_frames": self._attitude_frames} if self._attitude_frames else {},
        )

    def _time_base(self) -> TimeBase:
        problem = "" if self._epoch == "utc" else "stamps do not count from 1970: simulated time, or a clock never set"
        return TimeBase(self._epoch, source="header stamps, by the clock of the machine that stamped", problem=problem)

    def _in_time(self, stream: str, samples: Columns, good: np.ndarray | None = None, *, tell: bool = True) -> Timed:
        found = timed(samples, self._epoch, good)
        if found.dropped:
            self._losses.append(
                f"{stream}: {found.dropped} of {len(samples)} messages have an impossible time and were left out"
            )
        if found.note and tell:
            self._losses.append(f"{stream}: {found.note}")
        return found

    def _positions(self, topic: str, samples: Columns) -> Positions:
        lost = self._of.lost_fixes[topic]
        if lost:
            self._losses.append(f"{topic}: {lost} of {lost + len(samples)} messages have no fix and were left out")
        found = self._in_time(topic, samples)
        n = len(found.time_ns)
        latitude, longitude, altitude, level, up, breaks = found.values.T.copy()
        return Positions(
            stream=topic,
            time_ns=found.time_ns,
            latitude_deg=latitude,
            longitude_deg=longitude,
            ellipsoidal_m=np.where(np.isfinite(altitude), altitude, np.nan),
            amsl_m=nothing(n),
            above_home_m=nothing(n),
            barometric_m=nothing(n),
            sigma_horizontal_m=level,
            sigma_vertical_m=up,
            segment=segments(found.time_ns, breaks.astype(np.int64)),
            fused=False,
        )

    def _rotations(self, stream: str, samples: Columns, first: int) -> tuple[Timed, Floats]:
        """Rows whose numbers are a pose: finite, with a quaternion that is near a unit one, made so."""
        values = samples.values
        good = np.all(np.isfinite(values), axis=1) & is_rotation(values[:, first:])
        bad = len(good) - int(np.count_nonzero(good))
        if bad:
            self._losses.append(f"{stream}: {bad} of {len(good)} messages hold no rotation and were left out")
        found = self._in_time(stream, samples, good)
        return found, unit(found.values[:, first:])

    def _attitudes(self, transforms: tuple[FixedTransform, ...]) -> tuple[Attitudes, ...]:
        """Attitudes of the body where the bag says how the sensor is mounted on it, else of the sensor."""
        out = []
        for (topic, frame), samples in self._of.attitudes.items():
            found, enu_from_sensor = self._rotations(topic, samples, 0)
            if not len(found.time_ns):
                continue
            mount = transform_between(transforms, frame, _BODY)
            enu = enu_from_sensor if mount is None else _product(enu_from_sensor, mount[1])
            ned = _product(_product(_NED_FROM_ENU, enu), _FLU_FROM_FRD)
            out.append(Attitudes(topic, found.time_ns, ned, "vehicle", "ned", segments(found.time_ns)))
            self._attitude_frames[topic] = frame if mount is None else _BODY
        return tuple(out)

    def _poses(self, key: Edge, samples: Columns, stream: str) -> LocalPoses:
        found, q_wxyz = self._rotations(stream, samples, 3)
        return LocalPoses(
            stream=stream,
            time_ns=found.time_ns,
            position_m=found.values[:, :3].copy(),
            q_wxyz=q_wxyz,
            parent=key[1],
            child=key[2],
            of="body",
            axes="flu",
            image=(),
            segment=segments(found.time_ns),
        )

    def _transforms(self) -> tuple[FixedTransform, ...]:
        """Latched transforms, and edges that never change: ROS 1 and Foxglove publish fixed ones among the others."""
        fixed = {key: np.array(values) for key, values in self._of.static.items()}
        for key, samples in self._of.edges.items():
            values = samples.values
            if len(values) and np.all(values == values[0]):
                fixed.setdefault(key, values[0])
        out = []
        for (topic, parent, child), values in fixed.items():
            if np.all(np.isfinite(values)) and is_rotation(values[3:]):
                out.append(FixedTransform(parent, child, values[:3], unit(values[3:]), topic))
            else:
                self._losses.append(f"{topic} {parent}>{child}: no rotation, it was left out")
        for (topic, parent, child), changes in self._of.static_changes.items():
            if changes:
                self._losses.append(f"{topic} {parent}>{child}: changes {changes} times, the last one is used")
        return tuple(out)

    def _images(self) -> tuple[ImageStream, ...]:
        out = []
        for topic, held in self._of.images.items():
            found = self._in_time(topic, held.samples, tell=False)
            if len(found.time_ns):
                stream = ImageStream(
                    topic, found.time_ns, held.frame, held.encoding, held.width, held.height, found.note
                )  # fmt: skip
                out.append(stream)
        return tuple(out)

    def _sweeps(self) -> tuple[SweepStream, ...]:
        out = []
        for topic, held in self._of.sweeps.items():
            found = self._in_time(topic, held.samples)
            if len(found.time_ns):
                out.append(SweepStream(topic, found.time_ns, held.frame, held.fields, held.points))
        return tuple(out)

    def _cameras(self) -> tuple[LoggedCamera, ...]:
        out = []
        for topic, held in self._of.calibrations.items():
            if isinstance(held.first, Camera):
                out.append(LoggedCamera(topic, held.frame, held.first))
            else:
                self._losses.append(f"{topic}: {held.first or 'not calibrated (K is zero)'}")
            if held.changes:
                self._losses.append(
                    f"{topic}: {held.changes} messages differ from the first calibration, which is used"
                )
        return tuple(out)

    def _events(self) -> tuple[Events, ...]:
        out = []
        for topic, held in self._of.calibrations.items():
            # One message is a calibration and no more.
            if len(held.samples) > 1 and not self._has_images(topic, held):
                # The camera stamps it as it would the image.
                out.append(self._exposures(topic, held.samples, FEEDBACK_SIGMA_S, feedback=True))
        for topic, samples in self._of.triggers.items():
            out.append(self._exposures(topic, samples, _TRIGGER_LINE_SIGMA_S, feedback=False))
        return tuple(stream for stream in out if len(stream.time_ns))

    def _exposures(self, topic: str, samples: Columns, sigma_s: float, *, feedback: bool) -> Events:
        time_ns = self._in_time(topic, samples).time_ns
        return Events(topic, time_ns, np.full(len(time_ns), -1, np.int64), feedback, sigma_s)

    def _has_images(self, topic: str, held: Calibration) -> bool:
        """Whether the camera's images are in the bag: by the frame, or by the namespace where frames are not named."""
        namespace = topic.rpartition("/")[0]
        return any(
            image.frame == held.frame if image.frame and held.frame else name.startswith(f"{namespace}/")
            for name, image in self._of.images.items()
        )


def _product(a: Floats, b: Floats) -> Floats:
    """Hamilton product of quaternions, w first."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )
