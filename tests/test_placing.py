"""Photos brought to logs: clocks, exposures, mounts, lever arms, heights, local frames, and refusals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from pipeline.engine.errors import UndeterminedError
from pipeline.geodesy.enu import LocalFrame
from pipeline.geometry.arrays import Floats
from pipeline.geometry.rotations import (
    ENU_FROM_NED,
    FRD_FROM_RDF,
    gimbal_angles,
    ned_from_frd,
    quaternion_from_rotation,
)
from pipeline.placing.photo_clock import photo_times
from pipeline.placing.place import Placed, Stamp, place
from pipeline.placing.pose import camera_poses
from pipeline.placing.timeline import FRD_FROM_FLU, Timeline, timeline
from pipeline.sources.dji import Position
from pipeline.sources.photos import PhotoRecord
from pipeline.sources.records import (
    Attitudes,
    Events,
    FixedTransform,
    FlightLog,
    LocalPoses,
    Positions,
    TimeBase,
    nothing,
)
from pipeline.tracks.mount import Mount

NS = 1_000_000_000
HOME = LocalFrame(47.0, 8.0, 400.0)
BEGIN = datetime(2024, 6, 1, 8, 0, 0, tzinfo=UTC)
BEGIN_NS = int(BEGIN.timestamp()) * NS
SPEED_M_S = 4.0
DOWN = Mount((0.0, float(np.radians(-90.0)), 0.0))


def ns(seconds: Floats | Sequence[float]) -> np.ndarray:
    return np.rint(np.asarray(seconds) * NS).astype(np.int64)


def along(time_s: Floats) -> Floats:
    """Where the antenna is: north at 4 m/s, 50 m up, ENU of home."""
    return np.column_stack([np.zeros(len(time_s)), SPEED_M_S * time_s, np.full(len(time_s), 50.0)])


def positions(duration_s: float = 120.0, hz: float = 10.0, **changes: object) -> Positions:
    time_s = np.arange(0.0, duration_s, 1.0 / hz)
    latitude, longitude, height = HOME.geodetic_from_enu(along(time_s))
    n = len(time_s)
    made = Positions(
        "POS", ns(time_s), latitude, longitude, height, height - 48.0, np.full(n, 50.0), nothing(n),
        np.full(n, 0.4), np.full(n, 0.6), np.zeros(n, np.int64), fused=True,
    )  # fmt: skip
    return replace(made, **changes)


def attitudes(
    of: str = "vehicle", frame: str = "ned", yaw_deg: float = 0.0, pitch_deg: float = 0.0, **c: object
) -> Attitudes:
    time_s = np.arange(0.0, 120.0, 0.1)
    q = quaternion_from_rotation(ned_from_frd(np.radians(yaw_deg), np.radians(pitch_deg), 0.0))
    made = Attitudes(
        "MNT" if of == "gimbal" else "ATT", ns(time_s), np.tile(q, (len(time_s), 1)), of, frame,  # type: ignore[arg-type]
        np.zeros(len(time_s), np.int64),
    )  # fmt: skip
    return replace(made, **c)


def shots(count: int = 20) -> Floats:
    """Exposures, s since boot: every two seconds, with a turn."""
    time_s = 20.123 + 2.0 * np.arange(count)
    time_s[count * 3 // 5 :] += 11.0
    return time_s


def log(*, utc: bool = True, **parts: object) -> FlightLog:
    base = TimeBase("boot", ns([0.0, 60.0]), BEGIN_NS + ns([0.0, 60.0]), source="GPS") if utc else TimeBase("boot")
    given = {
        "positions": (positions(),),
        "attitudes": (attitudes(),),
        "events": (Events("CAM", ns(shots()), np.arange(1, 21), feedback=True, sigma_s=0.001),),
        **parts,
    }
    return FlightLog("flight.BIN", "test log", {}, base, **given)  # type: ignore[arg-type]


def photos(time_s: Floats, offset_s: float = 0.0, **changes: object) -> list[PhotoRecord]:
    """Bare photos that show `time_s` since boot, less an offset."""
    made = [
        PhotoRecord(
            f"DJI_{k + 1:04d}.JPG", f"DJI_{k + 1:04d}", width=4000, height=3000, make="A", model="B",
            time=BEGIN + timedelta(seconds=float(t) - offset_s), time_source="exif (zone unknown)",
            pose_problem="no GPS position",
        )
        for k, t in enumerate(time_s)
    ]  # fmt: skip
    return [replace(record, **changes) for record in made]


def placed(
    records: Sequence[PhotoRecord], *logs: FlightLog, mount: Mount = DOWN, clock_offset_s: float | None = None,
    stamps: dict[str, Stamp] | None = None, y_up: bool = False, pose_topic: str | None = None,
) -> Placed:  # fmt: skip
    lines = [timeline(item, pose_topic) for item in logs]
    return place(records, lines, stamps or {}, mount, clock_offset_s=clock_offset_s, y_up=y_up)


def enu(record: PhotoRecord) -> Floats:
    assert record.position is not None
    assert record.ellipsoidal_m is not None
    return HOME.enu_from_geodetic(record.position.latitude_deg, record.position.longitude_deg, record.ellipsoidal_m)


class TestClock:
    def test_a_wrong_clock_a_lost_photo_and_spare_triggers(self) -> None:
        time_s = shots()
        events = np.sort(np.append(time_s, [15.3, 47.1]))
        triggers = Events("CAM", ns(events), np.arange(1, 23), feedback=True, sigma_s=0.001)
        records = photos(time_s, 37.0)
        found = placed(records[:6] + records[7:], log(events=(triggers,)))
        for record, at in zip(found.records, np.delete(time_s, 6), strict=True):
            assert not record.problem
            assert record.time_source == "log event"
            assert enu(record) == pytest.approx(along(np.array([at]))[0], abs=1e-4)
            assert record.time is not None
            assert (record.time - BEGIN).total_seconds() == pytest.approx(at, abs=1e-5)
        assert found.missing["photos"][0].startswith("DJI_0007")
        assert len(found.missing["photos"]) == 1
        assert len(found.missing["triggers"]) == 2
        row = found.clocks[0]
        assert row["offset_s"] == pytest.approx(37.0, abs=0.01)
        assert row["anchors"] == 19

    def test_a_photo_without_a_trigger_is_placed_by_the_clock_with_its_sigma(self) -> None:
        time_s = shots()
        events = Events("CAM", ns(np.delete(time_s, 4)), np.arange(19), feedback=True, sigma_s=0.001)
        found = placed(photos(time_s, 5.0), log(events=(events,)))
        record = found.records[4]
        assert record.time_source == "log clock"
        assert enu(record) == pytest.approx(along(time_s[4:5])[0], abs=0.02)
        assert record.timing is not None
        assert found.records[3].timing is not None
        assert 0.004 < record.timing.position_m[1] < 0.1
        assert found.records[3].timing.position_m[1] == pytest.approx(SPEED_M_S * 0.001, rel=0.05)

    def test_a_rhythm_without_a_mark_is_refused_with_both_offsets(self) -> None:
        events = Events("CAM", ns(20.123 + 2.0 * np.arange(20)), np.arange(20), feedback=True, sigma_s=0.001)
        with pytest.raises(UndeterminedError, match=r"do not decide.*ingest\.clock_offset_s=") as error:
            placed(photos(20.123 + 2.0 * np.arange(19), 37.0), log(events=(events,)))
        assert error.value.code == "E-CLOCK-02"

    def test_the_user_decides_what_the_rhythm_does_not(self) -> None:
        time_s = 20.123 + 2.0 * np.arange(19)
        events = Events("CAM", ns(20.123 + 2.0 * np.arange(20)), np.arange(20), feedback=True, sigma_s=0.001)
        found = placed(photos(time_s, 37.0), log(events=(events,)), clock_offset_s=37.3)
        assert enu(found.records[0]) == pytest.approx(along(time_s[:1])[0], abs=1e-4)

    def test_a_statement_that_the_intervals_contradict_is_refused(self) -> None:
        for stated in (3637.0, 39.0, -37.0):
            with pytest.raises(UndeterminedError, match=r"clock_offset_s says .* say \+37\.00 s"):
                placed(photos(shots(), 37.0), log(), clock_offset_s=stated)
        found = placed(photos(shots(), 37.0), log(), clock_offset_s=37.0)
        assert {record.time_source for record in found.records} == {"log event"}

    def test_the_log_of_another_day_is_not_taken_for_a_clock_days_off(self) -> None:
        rng = np.random.default_rng(8)
        strange = Events("CAM", ns(np.cumsum(rng.uniform(1.0, 6.0, 30))), np.arange(30), feedback=True, sigma_s=0.001)
        with pytest.raises(UndeterminedError) as error:
            placed(photos(shots(), 40 * 86_400.0), log(events=(strange,)))
        assert "--set" not in error.value.hint
        # A clock that was never set is believed where all photos fit.
        found = placed(photos(shots(), 3000 * 86_400.0), log())
        assert {record.time_source for record in found.records} == {"log event"}

    def test_photos_of_another_place_are_not_moved_to_the_log(self) -> None:
        elsewhere = photos(shots(), 37.0, position=Position(48.0, 11.0, "exif position"))
        with pytest.raises(UndeterminedError, match="km from where the log was then"):
            placed(elsewhere, log())

    def test_photos_that_know_where_they_were(self) -> None:
        time_s = shots()
        latitude, longitude, _ = HOME.geodetic_from_enu(along(time_s))
        records = [
            replace(record, position=Position(round(float(a), 5), round(float(b), 5), "exif position"))
            for record, a, b in zip(photos(time_s, 7200.0), latitude, longitude, strict=True)
        ]
        found = placed(records, log(events=()))
        assert enu(found.records[3]) == pytest.approx(along(time_s[3:4])[0], abs=1.0)
        assert found.clocks[0]["offset_s"] == pytest.approx(7200.0, abs=0.3)
        assert "positions of 20 photos" in found.clocks[0]["method"]

    def test_times_that_do_not_overlap_name_the_offset_that_would(self) -> None:
        with pytest.raises(UndeterminedError) as error:
            placed(photos(shots(), 7200.0, time_source="exif+offset"), log(events=()))
        assert "--set ingest.clock_offset_s=7200" in error.value.hint
        assert "20 of 20 photos" in error.value.hint

    def test_a_log_that_knows_no_utc_is_met_by_its_events_alone(self) -> None:
        found = placed(photos(shots(), 123.4), log(utc=False))
        assert enu(found.records[5]) == pytest.approx(along(shots()[5:6])[0], abs=1e-4)
        assert "boot" in found.clocks[0]["method"]
        assert found.records[5].time == photos(shots(), 123.4)[5].time

    def test_two_flights_on_one_card(self) -> None:
        second = FlightLog(
            "second.BIN", "test log", {},
            TimeBase("boot", ns([0.0, 60.0]), BEGIN_NS + 3600 * NS + ns([0.0, 60.0]), source="GPS"),
            (positions(),), (attitudes(),),
            (Events("CAM", ns(shots(14) + 3.0), np.arange(14), feedback=True, sigma_s=0.001),),
        )  # fmt: skip
        records = photos(np.concatenate([shots(), 3600.0 + shots(14) + 3.0]), 37.0)
        found = placed(records, log(), second)
        assert [record.time_source for record in found.records] == ["log event"] * 34
        assert enu(found.records[20]) == pytest.approx(along(shots(14)[:1] + 3.0)[0], abs=1e-4)

    def test_two_triggers_within_a_second_are_not_guessed_at(self) -> None:
        events = np.sort(np.append(shots(), shots()[8] + 0.35))
        triggers = Events("CAM", ns(events), np.arange(21), feedback=True, sigma_s=0.001)
        coarse = photos(np.floor(shots()) - 37.0)
        found = placed(coarse, log(events=(triggers,)))
        assert "2 triggers fit its time" in found.records[8].problem
        assert sum(bool(record.problem) for record in found.records) == 1

    def test_a_hint_that_would_not_help_is_not_given(self) -> None:
        # An offset to UTC cannot decide where the log knows no UTC.
        events = Events("CAM", ns(20.123 + 2.0 * np.arange(20)), np.arange(20), feedback=True, sigma_s=0.001)
        with pytest.raises(UndeterminedError, match="do not decide") as error:
            placed(photos(20.123 + 2.0 * np.arange(19), 37.0), log(events=(events,), utc=False))
        assert "clock_offset_s" not in error.value.hint

    @pytest.mark.parametrize(("source", "sigma_s"), [("utc_at_exposure", 0.4), ("gps", 0.4), ("exif+offset", 2.0)])
    def test_what_the_files_say_is_as_good_as_their_clock(self, source: str, sigma_s: float) -> None:
        found = placed(photos(shots(), 0.0, time_source=source), log(events=()))
        assert found.clocks[0]["sigma_s"] == pytest.approx(sigma_s, rel=0.02)
        record = found.records[4]
        assert record.timing is not None
        assert record.timing.position_m[1] == pytest.approx(SPEED_M_S * sigma_s, rel=0.02)

    def test_names_in_one_second_go_by_their_numbers(self) -> None:
        records = photos(np.array([1.0, 1.0, 1.0]))
        names = ("IMG_10", "IMG_9", "IMG_100")
        found = photo_times([replace(r, frame_id=name) for r, name in zip(records, names, strict=True)])
        assert [record.frame_id for record in found.records] == ["IMG_9", "IMG_10", "IMG_100"]


class TestPose:
    def one(self, mount: Mount = DOWN, at_s: float = 33.33, y_up: bool = False, **parts: object) -> Floats:
        line = timeline(log(**parts))
        return camera_poses(line, ns([at_s]), mount, y_up=y_up).rotation[0]

    def angles(self, rotation: Floats) -> list[float]:
        return np.degrees(gimbal_angles(rotation)).tolist()

    def test_a_fixed_mount_turns_with_the_vehicle(self) -> None:
        rotation = self.one(
            Mount((0.0, float(np.radians(-20.0)), 0.0)), attitudes=(attitudes(yaw_deg=90.0, pitch_deg=5.0),)
        )
        assert self.angles(rotation) == pytest.approx([90.0, -15.0, 0.0], abs=1e-9)

    @pytest.mark.parametrize(("frame", "yaw"), [("ned", 30.0), ("heading", 120.0), ("body", 120.0)])
    def test_gimbal_frames(self, frame: str, yaw: float) -> None:
        streams = (attitudes(yaw_deg=90.0), attitudes("gimbal", frame, yaw_deg=30.0, pitch_deg=-45.0))
        assert self.angles(self.one(Mount(), attitudes=streams)) == pytest.approx([yaw, -45.0, 0.0], abs=1e-9)

    def test_a_lever_arm_turns_with_the_body(self) -> None:
        line = timeline(log(attitudes=(attitudes(yaw_deg=90.0),)))
        poses = camera_poses(line, ns([33.0]), Mount(DOWN.angles_rad, (0.5, 0.2, 0.3)))
        assert poses.frame is not None
        centre = HOME.enu_from_ecef(poses.frame.ecef_from_enu(poses.centre_m[0]))
        # Heading east: forward is east, right is south.
        assert centre == pytest.approx(along(np.array([33.0]))[0] + (0.5, -0.2, -0.3), abs=1e-4)
        assert poses.ellipsoidal_m[0] == pytest.approx(poses.amsl_m[0] + 48.0)
        assert poses.above_home_m[0] == pytest.approx(49.7, abs=1e-3)

    def test_a_lever_arm_without_the_bodys_attitude(self) -> None:
        # Left out it would shift every photo, and nobody would know.
        streams = (attitudes("gimbal", "ned", pitch_deg=-45.0),)
        found = placed(photos(shots(), 37.0), log(attitudes=streams), mount=Mount(None, (0.5, 0.0, 0.3)))
        assert all("lever arm needs the vehicle's attitude" in record.problem for record in found.records)
        found = placed(photos(shots(), 37.0), log(attitudes=streams), mount=Mount())
        assert not any(record.problem for record in found.records)

    @pytest.mark.parametrize("at_s", [0.0, 0.03, 119.88, 119.9, 30.5])
    def test_it_moves_at_the_ends_of_a_stream_too(self, at_s: float) -> None:
        # With no speed the uncertain instant would add nothing to the position's sigma.
        segment = (np.arange(1200) >= 305).astype(np.int64)
        turned = np.radians(10.0 * np.arange(1200) / 10.0)
        q = quaternion_from_rotation(ned_from_frd(turned, np.zeros(1200), np.zeros(1200)))
        parts = {"positions": (positions(segment=segment),), "attitudes": (attitudes(q_wxyz=q),)}
        poses = camera_poses(timeline(log(**parts)), ns([at_s]), DOWN)
        assert not poses.reason[0]
        assert poses.velocity_m_s[0] == pytest.approx((0.0, SPEED_M_S, 0.0), abs=1e-3)
        assert np.degrees(np.linalg.norm(poses.turning_rad_s[0])) == pytest.approx(10.0, rel=0.01)

    def test_a_slow_attitude_widens_the_angles(self) -> None:
        time_s = np.arange(0.0, 120.0, 0.5)
        yaw = 0.4 * np.sin(2.0 * time_s)
        q = quaternion_from_rotation(ned_from_frd(yaw, np.zeros(240), np.zeros(240)))
        slow = attitudes(time_ns=ns(time_s), q_wxyz=q, segment=np.zeros(240, np.int64))
        at_s = np.arange(20.25, 100.0, 0.5)
        poses = camera_poses(timeline(log(attitudes=(slow,))), ns(at_s), DOWN)
        # Straight down the image's top points where the vehicle's nose does.
        top = -poses.rotation[:, :, 1]
        missed = np.abs(np.arctan2(top[:, 0], top[:, 1]) - 0.4 * np.sin(2.0 * at_s))
        assert 0.8 < np.sqrt(np.mean(poses.bend_rad**2)) / np.sqrt(np.mean(missed**2)) < 1.6

    def test_a_height_that_is_not_always_logged(self) -> None:
        height = positions().ellipsoidal_m + 2.0 * np.arange(1200) / 10.0
        height[100:130] = np.nan
        gappy = positions(ellipsoidal_m=height, amsl_m=nothing(1200), above_home_m=nothing(1200))
        poses = camera_poses(timeline(log(positions=(gappy,))), ns([11.0, 33.0]), DOWN)
        assert np.isnan(poses.ellipsoidal_m).tolist() == [True, False]
        assert poses.velocity_m_s[:, 2] == pytest.approx([2.0, 2.0], abs=1e-3)

    def test_no_gimbal_and_no_mount(self) -> None:
        found = placed(photos(shots(), 37.0), log(), mount=Mount())
        assert "nothing says how the camera is mounted" in found.records[0].problem
        assert "ingest.mount=" in found.records[0].problem

    def test_a_gimbal_that_contradicts_the_mount_is_told(self) -> None:
        streams = (attitudes(), attitudes("gimbal", "ned", pitch_deg=-45.0))
        found = placed(photos(shots(), 37.0), log(attitudes=streams))
        assert any("contradicts ingest.mount by 45.0 deg" in note for note in found.notes)
        attitude = found.records[0].attitude
        assert attitude is not None
        assert attitude.pitch_deg == pytest.approx(-90.0)

    def test_never_across_a_reset(self) -> None:
        segment = (np.arange(1200) >= 305).astype(np.int64)
        line = timeline(log(positions=(positions(segment=segment),)))
        poses = camera_poses(line, ns([30.35, 30.45, 30.55]), DOWN)
        assert ["reset" in reason for reason in poses.reason] == [False, True, False]

    def test_sigmas_as_logged_and_what_the_clock_adds(self) -> None:
        found = placed(photos(shots(), 37.0), log())
        assert found.records[0].fix.sigma_horizontal_m == pytest.approx(0.4)
        assert found.records[0].fix.sigma_vertical_m == pytest.approx(0.6)

    def test_a_stream_that_repeats_a_slower_ones_fixes_is_not_the_better(self) -> None:
        held = positions(hz=10.0)
        rows = np.arange(1200) // 2 * 2
        held = replace(held, stream="AHR2", latitude_deg=held.latitude_deg[rows], fused=False)
        line = timeline(log(positions=(held, positions(hz=5.0, stream="GPS", fused=False))))
        assert line.positions is not None
        assert line.positions.stream == "GPS"

    def test_across_the_date_line(self) -> None:
        time_s = np.arange(0.0, 120.0, 0.1)
        frame = LocalFrame(-17.0, 180.0, 0.0)
        latitude, longitude, height = frame.geodetic_from_enu(
            np.column_stack([SPEED_M_S * (time_s - 60.0), np.zeros(1200), np.full(1200, 50.0)])
        )
        assert longitude.min() < -179.0
        assert longitude.max() > 179.0
        line = timeline(
            log(positions=(positions(latitude_deg=latitude, longitude_deg=longitude, ellipsoidal_m=height),))
        )
        poses = camera_poses(line, ns([60.05]), DOWN)
        assert poses.frame is not None
        there = frame.enu_from_ecef(poses.frame.ecef_from_enu(poses.centre_m[0]))
        assert there == pytest.approx((0.2, 0.0, 50.0), abs=1e-3)


class TestLocalFrames:
    def body(self, **changes: object) -> LocalPoses:
        """Motion capture, y up: moves along the frame's x, half a metre up, heading along x."""
        time_s = np.arange(0.0, 20.0, 0.01)
        n = len(time_s)
        # FLU body whose up is the frame's y: z_flu = y, x_flu = x, so y_flu = z x x = ... = -z.
        flu = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
        made = LocalPoses(
            "/rig/pose", ns(time_s), np.column_stack([0.2 * time_s, np.full(n, 0.5), np.zeros(n)]),
            np.tile(quaternion_from_rotation(flu), (n, 1)), "mocap", "", "body", "flu", (), np.zeros(n, np.int64),
        )  # fmt: skip
        return replace(made, **changes)

    def line(self, transforms: tuple[FixedTransform, ...] = (), frame: str | None = None) -> Timeline:
        found = log(positions=(), attitudes=(), events=(), poses=(self.body(),), transforms=transforms)
        return timeline(found, None, frame)

    def test_y_up_becomes_z_up(self) -> None:
        poses = camera_poses(self.line(), ns([5.0]), Mount((0.0, 0.0, 0.0)), y_up=True)
        assert poses.centre_m[0] == pytest.approx((1.0, 0.0, 0.5))
        # Looks along the frame's x, level: yaw 90 deg from the frame's y ("north").
        assert np.degrees(gimbal_angles(poses.rotation[0])) == pytest.approx([90.0, 0.0, 0.0], abs=1e-9)
        assert poses.frame is None

    def test_extrinsics_from_the_bag(self) -> None:
        # The camera 10 cm ahead of the body and 5 cm above, looking ahead: RDF in FLU.
        rdf = FRD_FROM_FLU @ np.eye(3) @ FRD_FROM_RDF
        fixed = FixedTransform(
            "rig", "optical", np.array([0.1, 0.0, 0.05]), quaternion_from_rotation(rdf), "/tf_static"
        )
        poses = camera_poses(self.line((fixed,), "optical"), ns([5.0]), Mount(), y_up=True)
        assert poses.centre_m[0] == pytest.approx((1.1, 0.0, 0.55))
        assert np.degrees(gimbal_angles(poses.rotation[0])) == pytest.approx([90.0, 0.0, 0.0], abs=1e-9)

    def test_no_extrinsics_at_all(self) -> None:
        poses = camera_poses(self.line(), ns([5.0]), Mount(), y_up=True)
        assert "nothing says how the camera sits on it" in poses.reason[0]

    def test_images_of_the_same_log_need_no_clock(self) -> None:
        source = log(positions=(), attitudes=(), events=(), poses=(self.body(),))
        records = photos(np.array([1.0, 2.0]), location="x")
        records = [replace(record, location=f"run://images/{k}.png") for k, record in enumerate(records)]
        stamps = {record.location: Stamp(0, (k + 1) * NS) for k, record in enumerate(records)}
        found = placed(records, source, mount=Mount((0.0, 0.0, 0.0)), stamps=stamps, y_up=True)
        assert [record.local_m for record in found.records] == [
            pytest.approx((0.2, 0.0, 0.5)),
            pytest.approx((0.4, 0.0, 0.5)),
        ]
        assert {record.time_source for record in found.records} == {"log stamp"}

    def test_an_image_that_a_model_does_not_name_is_a_row(self) -> None:
        poses = LocalPoses(
            "model", np.zeros(1, np.int64), np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]), "world", "", "camera",
            "rdf", ("DJI_0001.JPG",), np.zeros(1, np.int64),
        )  # fmt: skip
        found = placed(photos(np.array([1.0, 2.0])), log(positions=(), attitudes=(), events=(), poses=(poses,)))
        assert [bool(record.problem) for record in found.records] == [False, True]
        assert "does not name it" in found.records[1].problem
        assert found.idle == ()

    def test_poses_of_named_images(self) -> None:
        rotation = (
            ENU_FROM_NED
            @ ned_from_frd(np.radians([10.0, 20.0]), np.radians([-30.0, -40.0]), np.zeros(2))
            @ FRD_FROM_RDF
        )
        poses = LocalPoses(
            "model", np.zeros(2, np.int64), np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]),
            quaternion_from_rotation(rotation), "world", "", "camera", "rdf", ("DJI_0002.JPG", "sub/DJI_0001.JPG"),
            np.zeros(2, np.int64),
        )  # fmt: skip
        found = placed(photos(np.array([1.0, 2.0])), log(positions=(), attitudes=(), events=(), poses=(poses,)))
        assert [record.local_m for record in found.records] == [(4.0, 5.0, 6.0), (1.0, 2.0, 3.0)]
        attitude = found.records[0].attitude
        assert attitude is not None
        assert (attitude.yaw_deg, attitude.pitch_deg) == pytest.approx((20.0, -40.0))

    def named(self, *names: str) -> FlightLog:
        n = len(names)
        poses = LocalPoses(
            "model", np.zeros(n, np.int64), np.arange(3.0 * n).reshape(n, 3), np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
            "world", "", "camera", "rdf", names, np.zeros(n, np.int64),
        )  # fmt: skip
        return log(positions=(), attitudes=(), events=(), poses=(poses,))

    def placed_x(self, locations: Sequence[str], *names: str) -> list[float | None]:
        records = photos(np.arange(float(len(locations))))
        records = [replace(r, location=name, time=None) for r, name in zip(records, locations, strict=True)]
        found = placed(records, self.named(*names))
        return [None if record.local_m is None else record.local_m[0] for record in found.records]

    def test_namesakes_in_two_folders(self) -> None:
        cards = ["/c/100MEDIA/DJI_0001.JPG", "/c/101MEDIA/DJI_0001.JPG"]
        assert self.placed_x(cards, "101MEDIA/DJI_0001.JPG", "100MEDIA/DJI_0001.JPG") == [3.0, 0.0]
        assert self.placed_x(cards, "101MEDIA/DJI_0001.JPG") == [None, 0.0]
        # One name for both: it is one of them, and nobody can tell which.
        assert self.placed_x(cards, "DJI_0001.JPG") == [None, None]
        assert self.placed_x(["/c/DJI_0001.JPG"], "100MEDIA/DJI_0001.JPG", "101MEDIA/DJI_0001.JPG") == [None]

    def test_a_name_with_another_ending(self) -> None:
        assert self.placed_x(["/c/DJI_0001.JPG", "/c/DJI_0002.JPG"], "DJI_0002", "dji_0001.png") == [3.0, 0.0]
