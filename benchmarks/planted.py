"""Runs of the example whose log is wrong by known amounts: the true poses plus errors of stated sigmas, and no others.

The poses are in the truth's ENU frame throughout. What says where on earth that lies stays as it was, so that latitudes
and the output CRS are those of the run's own origin: a shift of all, which no stage after `ingest` sees.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from flight_truth import TruePose
from redraws import turned

from pipeline.engine.digests import digest_tree
from pipeline.engine.runfolder import RunFolder, tree_size, write_json
from pipeline.engine.tables import read_table, write_table
from pipeline.flight import column, placement_row
from pipeline.geometry.arrays import Floats
from pipeline.geometry.poses import Placement, Pose, PoseSigmas
from pipeline.geometry.rotations import gimbal_angles

POSITION, GIMBAL = ("east_m", "north_m", "up_m"), ("yaw_deg", "pitch_deg", "roll_deg")
_BETWEEN = np.sqrt(2.0)
YAW, CLOCK, LEVER = "boresight_yaw_rad", "clock_s", ("lever_forward_m", "lever_right_m", "lever_down_m")
_CLOCK_SIGMA_S, _LEVER_SIGMA_M, _BIAS_HOLDS_S = 0.2, 0.1, 3600.0


@dataclass(frozen=True, slots=True)
class Case:
    """What a log gets wrong.

    Args:
        name: A letter.
        title: In words.
        position_m: Sigmas between two frames, east, north and up.
        gimbal_deg: Sigmas between two frames, yaw, pitch and roll.
        common_m: Sigma stated for all positions alike, along each axis; nothing is drawn from it.
        common_yaw_deg: Sigma stated for all headings alike; nothing is drawn from it.
        boresight_yaw_deg: By how much all headings are wrong.
        clock_s: By how much the positions are too late.
        drawn: Whether heading, clock, lever arm and a slowly drifting bias are drawn, too, as widely as docs/method.md
            says that a log allows them.
    """

    name: str
    title: str
    position_m: tuple[float, float, float]
    gimbal_deg: tuple[float, float, float]
    common_m: float = 0.0
    common_yaw_deg: float = 0.0
    boresight_yaw_deg: float = 0.0
    clock_s: float = 0.0
    drawn: bool = False

    @property
    def own(self) -> PoseSigmas:
        """Of one frame: what lies between two is of both."""
        return PoseSigmas(np.array(self.position_m) / _BETWEEN, np.radians(self.gimbal_deg) / _BETWEEN)

    @property
    def common(self) -> PoseSigmas:
        """Stated for the flight."""
        return PoseSigmas(np.full(3, self.common_m), np.radians([self.common_yaw_deg, 0.0, 0.0]))


_A = ((0.1, 0.1, 0.1), (0.2, 0.2, 0.2))
SHARED = (
    Case("e", "as a, and a heading 1 deg off, positions 0.2 s late", *_A, 0.5, 1.0, 1.0, 0.2),
    Case("f", "as e, with nothing planted", *_A, 0.5, 1.0),
    Case("g", "as a, and heading, clock, lever arm and bias drawn", *_A, 0.5, 1.0, drawn=True),
)
CASES = (
    Case("a", "0.1 m, 0.2 deg between frames", *_A),
    Case("b", "0.3 m, 1 deg between frames", (0.3, 0.3, 0.3), (1.0, 1.0, 1.0)),
    Case("c", "heading 1 deg; 5 cm, 0.08 deg", (0.05, 0.05, 0.05), (1.0, 0.08, 0.08)),
    Case("d", "height 0.5 m; 5 cm, 0.08 deg", (0.05, 0.05, 0.5), (0.08, 0.08, 0.08)),
    *SHARED,
)


def velocities(truth: Mapping[str, TruePose], time_s: Mapping[str, float]) -> dict[str, Floats]:
    """(3,) m/s of every frame, from its neighbours in its leg."""
    out = {}
    for leg in dict.fromkeys(pose.leg for pose in truth.values()):
        names = [name for name, pose in truth.items() if pose.leg == leg]
        centres = np.stack([truth[name].centre for name in names])
        speed = np.gradient(centres, np.array([time_s[name] for name in names]), axis=0)
        out |= dict(zip(names, speed, strict=True))
    return out


def planted_errors(case: Case, rng: np.random.Generator) -> dict[str, float]:
    """What all frames get wrong alike, by name; nothing is drawn unless the case says so."""
    if not case.drawn:
        return {YAW: float(np.radians(case.boresight_yaw_deg)), CLOCK: case.clock_s, **dict.fromkeys(LEVER, 0.0)}
    sigma = (np.radians(case.common_yaw_deg), _CLOCK_SIGMA_S, *[_LEVER_SIGMA_M] * 3)
    return dict(zip((YAW, CLOCK, *LEVER), (rng.normal(size=5) * sigma).tolist(), strict=True))


def planted_poses(
    truth: Mapping[str, TruePose],
    time_s: Mapping[str, float],
    case: Case,
    shared: Mapping[str, float],
    rng: np.random.Generator,
) -> dict[str, Pose]:
    """One draw of a case's log.

    Args:
        truth: True poses by frame.
        time_s: Exposures by frame.
        case: What is wrong.
        shared: As `planted_errors` gives it.
        rng: Of the frames' own errors, and of a bias.
    """
    speed = velocities(truth, time_s)
    boresight, lever = np.array([shared[YAW], 0.0, 0.0]), np.array([shared[name] for name in LEVER])
    bias = _bias(np.array([time_s[name] for name in truth]), case, rng) if case.drawn else np.zeros((len(truth), 3))
    out = {}
    for name, true, drift in zip(truth, truth.values(), bias, strict=True):
        shift = rng.normal(size=3) * case.own.position_m + speed[name] * shared[CLOCK]
        turn = rng.normal(size=3) * case.own.gimbal_rad + boresight
        yaw = gimbal_angles(true.rotation)[0]
        level = np.array([[np.sin(yaw), np.cos(yaw), 0.0], [np.cos(yaw), -np.sin(yaw), 0.0], [0.0, 0.0, -1.0]])
        centre = true.centre + shift + lever @ level + drift
        out[name] = Pose(turned(true.rotation, turn), centre, case.own, case.common)
    return out


def _bias(time_s: Floats, case: Case, rng: np.random.Generator) -> Floats:
    """(n, 3) m: a stationary Gauss-Markov process."""
    correlation = np.exp(-np.abs(time_s[:, None] - time_s) / _BIAS_HOLDS_S)
    root = np.linalg.cholesky(correlation + 1e-12 * np.eye(len(time_s)))
    out: Floats = case.common_m * root @ rng.normal(size=(len(time_s), 3))
    return out


def planted_run(base: Path, poses: Mapping[str, Pose], run: Path) -> None:
    """A copy of a run whose `frames` hold other poses, as if `ingest` had read them.

    Args:
        base: A run that got as far as `match`, whose features are taken over.
        poses: For every frame.
        run: The copy.
    """
    shutil.copytree(base, run)
    path = run / "frames.parquet"
    table = read_table(path, "frames")
    rows = [_row(poses[name]) for name in column(table, "frame_id")]
    for name in rows[0]:
        at = table.schema.get_field_index(name)
        table = table.set_column(at, table.schema.field(at), pa.array([row[name] for row in rows], pa.float64()))
    write_table(path, table)
    # The later stages go by what the record says of the table.
    folder = RunFolder(run)
    record = folder.record("ingest")
    if record is None:
        raise ValueError(f"{base} has no record of ingest")
    record["outputs"]["frames"] |= {"sha256": digest_tree(path), "bytes": tree_size(path)}
    write_json(folder.record_path("ingest"), record)


def _row(pose: Pose) -> dict[str, object]:
    whole_m = np.hypot(pose.own.position_m, pose.common.position_m)
    whole_deg = np.degrees(np.hypot(pose.own.gimbal_rad, pose.common.gimbal_rad))
    own_deg = np.degrees(pose.own.gimbal_rad)
    angles = np.degrees(gimbal_angles(pose.rotation))
    return {
        **placement_row(Placement(pose.rotation, pose.centre)),
        **dict(zip(GIMBAL, angles.tolist(), strict=True)),
        **{f"sigma_{name}": float(value) for name, value in zip(POSITION, whole_m, strict=True)},
        **{f"sigma_{name}": float(value) for name, value in zip(GIMBAL, whole_deg, strict=True)},
        **{f"own_sigma_{name}": float(value) for name, value in zip(POSITION, pose.own.position_m, strict=True)},
        **{f"own_sigma_{name}": float(value) for name, value in zip(GIMBAL, own_deg, strict=True)},
    }
