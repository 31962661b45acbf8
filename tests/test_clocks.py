"""Clocks: GPS time, fits to anchors, photos and triggers by their intervals, photos on a track by their places."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from time import perf_counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.clocks.fit import fit_clock
from pipeline.clocks.gps import GPS_EPOCH, utc_from_gps, utc_ns_from_gps
from pipeline.clocks.intervals import align, doubts
from pipeline.clocks.places import offset_by_place
from pipeline.geometry.arrays import Floats

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class TestGpsTime:
    @given(st.integers(1600, 2600), st.integers(0, 604_799_999))
    def test_streams_agree_with_single_instants(self, week: int, tow_ms: int) -> None:
        ns = int(utc_ns_from_gps(np.array([week]), np.array([tow_ms / 1e3]))[0])
        assert EPOCH + timedelta(microseconds=ns / 1000) == utc_from_gps(week, tow_ms / 1e3)

    def test_a_leap_second_within_the_week(self) -> None:
        # 2016-12-31 23:59:60 was the 18th: GPS seconds before and after it are two UTC seconds and a leap apart.
        new_year = datetime(2017, 1, 1, tzinfo=UTC)
        week, tow_s = divmod((new_year - GPS_EPOCH).total_seconds() + 17, 604_800)
        ns = utc_ns_from_gps(np.array([week, week]), np.array([tow_s - 1.0, tow_s + 1.0]))
        assert EPOCH + timedelta(microseconds=int(ns[0]) / 1000) == new_year - timedelta(seconds=1)
        assert EPOCH + timedelta(microseconds=int(ns[1]) / 1000) == new_year

    def test_what_is_no_gps_time(self) -> None:
        assert utc_ns_from_gps(np.array([0, 2300, 2300]), np.array([1.0, -1.0, 1e6])).tolist() == [-1, -1, -1]


class TestFit:
    @pytest.mark.parametrize("drift_ppm", [0.0, 35.0, -80.0])
    def test_offset_and_drift_with_glitches(self, drift_ppm: float) -> None:
        rng = np.random.default_rng(1)
        own_s = np.arange(0.0, 900.0, 0.5)
        other_s = own_s * (1.0 + 1e-6 * drift_ppm) + 1.7e9 + rng.normal(0.0, 0.002, len(own_s))
        other_s[100:110] += 604_800.0
        own, other = np.rint(own_s * 1e9).astype(np.int64), np.rint(other_s * 1e9).astype(np.int64)
        fit = fit_clock(own, other)
        assert fit is not None
        assert fit.left_out == 10
        assert 1e6 * fit.drift == pytest.approx(drift_ppm, abs=1.0)
        assert 0.0015 < (fit.residual_s or 0.0) < 0.0025
        assert abs(int(fit.apply(own[:1])[0]) - 1_700_000_000_000_000_000) < 1_000_000

    def test_late_anchors_count_by_the_earliest(self) -> None:
        rng = np.random.default_rng(2)
        utc_s = np.arange(0.0, 100.0, 0.2) + 1.7e9
        arrived_s = utc_s - 1.7e9 + 5.0 + rng.gamma(2.0, 0.05, len(utc_s))
        fit = fit_clock(np.rint(arrived_s * 1e9).astype(np.int64), np.rint(utc_s * 1e9).astype(np.int64), late=True)
        assert fit is not None
        assert fit.offset_ns / 1e9 == pytest.approx(1.7e9 - 5.0, abs=0.03)
        assert 0.05 < fit.sigma_s < 0.2

    def test_no_anchors(self) -> None:
        assert fit_clock(np.empty(0, np.int64), np.empty(0, np.int64)) is None


def flown(count: int, *, gap_s: float = 40.0, jitter_s: float = 0.0, seed: int = 3) -> Floats:
    """Exposures every two seconds, with one turn."""
    rng = np.random.default_rng(seed)
    time_s = 2.0 * np.arange(count) + rng.normal(0.0, jitter_s, count)
    time_s[count * 3 // 5 :] += gap_s
    return time_s


def shown(time_s: Floats, offset_s: float, tick_s: float, drift: float = 0.0) -> Floats:
    """What a camera's clock says."""
    return np.floor((time_s * (1.0 + drift) - offset_s) / tick_s + 1e-6) * tick_s


class TestIntervals:
    @pytest.mark.parametrize("tick_s", [0.001, 0.1, 1.0])
    @pytest.mark.parametrize("lost", [(), (0,), (7,), (23,), (3, 4, 5, 15)])
    def test_lost_photos_and_spare_triggers(self, tick_s: float, lost: tuple[int, ...]) -> None:
        time_s = flown(24)
        events = np.sort(np.concatenate([time_s, [-3.3, 36.7]])) + 1000.0
        kept = np.array([k for k in range(24) if k not in lost])
        found = align(shown(time_s[kept], 37.0, tick_s), events, tick_s)
        assert found.rival is None
        assert found.best is not None
        assert events[found.best.event].tolist() == (time_s[kept] + 1000.0).tolist()
        assert found.best.offset_s == pytest.approx(1037.0, abs=0.51 * tick_s)

    def test_a_rhythm_without_a_mark_does_not_decide(self) -> None:
        # One photo lost at either end of a perfectly regular strip: nobody can tell at which.
        events = 2.0 * np.arange(24) + 1000.0
        found = align(shown(2.0 * np.arange(23), 37.0, 0.001), events, 0.001)
        assert found.best is not None
        assert found.rival is not None
        assert abs(found.best.offset_s - found.rival.offset_s) == pytest.approx(2.0, abs=0.01)

    def test_a_prior_decides_what_intervals_do_not(self) -> None:
        events = 2.0 * np.arange(24) + 1000.0
        found = align(shown(2.0 * np.arange(23), 37.0, 0.001), events, 0.001, prior=(1037.2, 0.3))
        assert found.rival is None
        assert found.best is not None
        assert found.best.offset_s == pytest.approx(1037.0, abs=0.01)

    def test_bursts_within_one_tick_keep_their_order(self) -> None:
        starts = np.array([0.0, 7.3, 15.1, 31.9, 40.4, 61.2])
        time_s = np.concatenate([start + 0.3 * np.arange(3) for start in starts])
        found = align(shown(time_s, -12.4, 1.0), time_s + 50.0, 1.0)
        assert found.best is not None
        assert found.rival is None
        assert found.best.event.tolist() == list(range(18))

    @pytest.mark.parametrize("tick_s", [0.001, 1.0])
    def test_drift_over_a_long_flight(self, tick_s: float) -> None:
        rng = np.random.default_rng(5)
        time_s = np.cumsum(rng.uniform(1.5, 3.0, 500))
        found = align(shown(time_s, 3.0, tick_s, drift=6e-5), time_s, tick_s)
        assert found.best is not None
        assert found.best.event.tolist() == list(range(500))
        assert found.best.drift == pytest.approx(-6e-5, abs=2e-5)

    def test_events_of_another_flight_are_not_taken(self) -> None:
        rng = np.random.default_rng(6)
        photos, events = np.cumsum(rng.uniform(1.5, 9.0, 40)), np.cumsum(rng.uniform(1.5, 9.0, 40)) + 500.0
        found = align(shown(photos, 0.0, 0.001), events, 0.001)
        # Chance brings some together; never nearly all, and never without rivals of the same kind.
        assert found.best is None or found.rival is not None or found.best.matched < 20

    def test_too_few_to_have_intervals(self) -> None:
        assert align(np.array([0.0, 2.0]), np.array([0.0, 2.0, 4.0]), 0.001).best is None

    def test_a_photo_that_two_triggers_fit_is_told(self) -> None:
        time_s = flown(24)
        events = np.sort(np.append(time_s, time_s[9] + 0.4)) + 100.0
        photos = shown(time_s, 0.0, 1.0)
        found = align(photos, events, 1.0)
        told = [k for k, others in enumerate(doubts(photos, events, 1.0, found, 0.0)) if len(others)]
        assert told == [9]

    @settings(max_examples=40)
    @given(
        st.integers(0, 10_000),
        st.floats(-1e6, 1e6),
        st.integers(8, 60),
        st.sampled_from([0.001, 0.01, 1.0]),
    )
    def test_irregular_flights(self, seed: int, offset_s: float, count: int, tick_s: float) -> None:
        rng = np.random.default_rng(seed)
        time_s = np.cumsum(rng.uniform(2.2, 9.0, count))
        kept = np.sort(rng.permutation(count)[: max(6, count * 4 // 5)])
        found = align(shown(time_s[kept], offset_s, tick_s), time_s, tick_s)
        if found.best is not None and found.rival is None and found.best.matched == len(kept):
            error_s = np.abs(time_s[found.best.event] - time_s[kept])
            # With whole seconds a lost photo's exposure can lie within the tick of its neighbour's; else never.
            assert error_s.max() < (2.3 if tick_s == 1.0 else 1e-9)


def rhythm(kind: str, count: int, rng: np.random.Generator) -> Floats:
    """Exposures of a flight in legs."""
    if kind == "bursts":
        starts = np.cumsum(rng.uniform(4.0, 15.0, -(-count // 3)))
        return (starts[:, None] + rng.uniform(0.15, 0.5) * np.arange(3)).ravel()[:count]
    beat_s = {"distance": rng.uniform(1.2, 4.0), "timed": 2.0, "quick": 0.7}[kind]
    step_s = beat_s * (1.0 + rng.normal(0.0, 0.03 if kind == "distance" else 0.002, count))
    step_s[:: int(rng.integers(9, 40))] += rng.uniform(4.0, 20.0)
    return np.cumsum(step_s)


def wrong_in_silence(kind: str, tick_s: float, seed: int) -> tuple[int, int, int]:
    """Photos, those given another exposure's event without a word, and whether the flight was refused."""
    rng = np.random.default_rng(seed)
    count = int(np.exp(rng.uniform(np.log(12.0), np.log(200.0))))
    time_s = rhythm(kind, count, rng)
    missed = rng.random(count) < rng.choice([0.0, 0.01])
    spare = rng.uniform(time_s[0] - 20.0, time_s[-1] + 20.0, int(count * rng.choice([0.0, 0.1, 0.2])))
    events = np.concatenate([time_s[~missed], spare])
    order = np.argsort(events)
    exposure = np.concatenate([np.flatnonzero(~missed), np.full(len(spare), -1)])[order]
    kept = np.flatnonzero(rng.random(count) >= rng.choice([0.0, 0.1, 0.2]))
    jitter_s = rng.normal(0.0, rng.uniform(0.001, 0.02), len(kept))
    photos = np.maximum.accumulate(shown(time_s[kept] + jitter_s, 37.0, tick_s, rng.uniform(-1e-4, 1e-4)))
    found = align(photos - photos[0], events[order] - events[order][0], tick_s)
    if found.best is None or found.rival is not None:
        return 0, 0, 1
    event = found.best.event
    off_s = np.abs(events[order][event] - time_s[kept])
    wrong = (event >= 0) & (exposure[event] != kept) & (off_s > 0.013)
    told = doubts(photos - photos[0], events[order] - events[order][0], tick_s, found, tick_s / 20.0)
    return len(kept), int(np.count_nonzero(wrong & [not len(others) for others in told])), 0


class TestSilentErrors:
    """Flights by the dozen: wrong events without a word are as good as none, and refusals few."""

    @pytest.mark.parametrize("tick_s", [0.001, 0.1, 1.0])
    @pytest.mark.parametrize(("kind", "refusals"), [("distance", 3), ("timed", 5), ("quick", 6), ("bursts", 1)])
    def test_flights(self, kind: str, refusals: int, tick_s: float) -> None:
        photos, wrong, refused = np.sum([wrong_in_silence(kind, tick_s, seed) for seed in range(10)], axis=0)
        assert wrong <= max(3, 0.003 * photos)
        assert refused <= refusals

    def test_a_quick_rhythm_on_a_coarse_clock(self) -> None:
        # One of 40 photos in 0.7 s steps is lost: with whole seconds its neighbours may be each other's.
        time_s = 0.7 * np.arange(40) + 20.0 * (np.arange(40) >= 23)
        kept = np.delete(np.arange(40), 11)
        photos = shown(time_s[kept], 3.0, 1.0)
        found = align(photos, time_s, 1.0)
        assert found.best is not None
        told = doubts(photos, time_s, 1.0, found, 0.02)
        for k, others in enumerate(told):
            assert found.best.event[k] == kept[k] or kept[k] in others
        assert 1 <= sum(bool(len(others)) for others in told) <= 8

    def test_a_beat_among_hundreds(self) -> None:
        # Only where a perfectly regular flight begins and ends tells its offset: both are known, or they are not.
        time_s = 2.0 * np.arange(640)
        whole = align(shown(time_s, 0.0, 0.001), time_s + 500.0, 0.001)
        assert whole.best is not None
        assert whole.rival is None
        assert whole.best.offset_s == pytest.approx(500.0, abs=0.01)
        assert align(shown(time_s[20:-20], 0.0, 0.001), time_s + 500.0, 0.001).rival is not None

    def test_a_long_flight_is_quick(self) -> None:
        time_s = rhythm("quick", 2000, np.random.default_rng(8))
        begun = perf_counter()
        found = align(shown(time_s[5:], 0.0, 1.0), time_s, 1.0)
        assert found.best is not None
        # Two to three seconds on a quiet machine.
        assert perf_counter() - begun < 15.0


class TestPlaces:
    def track(self) -> tuple[Floats, Floats]:
        time_s = np.arange(0.0, 300.0, 0.2)
        return time_s, np.column_stack([5.0 * time_s, 80.0 * np.sin(time_s / 25.0)])

    def test_photos_on_the_track(self) -> None:
        rng = np.random.default_rng(4)
        time_s, track_m = self.track()
        at = np.linspace(40.0, 250.0, 30)
        places = np.column_stack([np.interp(at, time_s, track_m[:, k]) for k in range(2)])
        fit = offset_by_place(at + 7200.4, places + rng.normal(0.0, 0.5, places.shape), time_s, track_m)
        assert fit is not None
        assert not fit.problem
        assert fit.offset_s == pytest.approx(-7200.4, abs=0.1)
        assert 0.05 < fit.sigma_s < 0.3

    def test_two_flights_over_the_same_field(self) -> None:
        time_s, track_m = self.track()
        at = np.linspace(40.0, 250.0, 12)
        places = np.column_stack([np.interp(at, time_s, track_m[:, k]) for k in range(2)])
        # The longer flight is not in the log; it went the other way round.
        fit = offset_by_place(
            np.concatenate([at, 4000.0 + np.linspace(0.0, 200.0, 18)]),
            np.concatenate([places, np.column_stack([np.linspace(1000.0, 300.0, 18), np.zeros(18)])]),
            time_s,
            track_m,
        )
        assert fit is not None
        assert not fit.problem
        assert fit.offset_s == pytest.approx(0.0, abs=0.2)

    def test_a_flight_that_mostly_hovers(self) -> None:
        rng = np.random.default_rng(5)
        time_s = np.arange(0.0, 300.0, 0.2)
        track_m = np.column_stack(
            [np.interp(time_s, [0, 100, 110, 200, 225, 300], [0, 0, 40, 40, 140, 140]), 0 * time_s]
        )
        at = np.linspace(5.0, 290.0, 40)
        places = np.column_stack([np.interp(at, time_s, track_m[:, k]) for k in range(2)])
        errors, claims = [], []
        for _ in range(20):
            fit = offset_by_place(at + 50.0, places + rng.normal(0.0, 0.7, places.shape), time_s, track_m)
            assert fit is not None
            assert not fit.problem
            errors.append(fit.offset_s + 50.0)
            claims.append(fit.sigma_s)
        # The claim holds a lag that these photos have not.
        assert 0.3 < np.std(errors) / np.mean(claims) < 1.3

    def test_photos_over_a_longer_time_than_the_track(self) -> None:
        time_s, track_m = self.track()
        assert offset_by_place(np.array([0.0, 400.0, 900.0]), track_m[[0, 5, 9]], time_s, track_m) is None

    def test_photos_of_another_place(self) -> None:
        time_s, track_m = self.track()
        fit = offset_by_place(np.linspace(0.0, 60.0, 9), np.full((9, 2), 5000.0), time_s, track_m)
        assert fit is None or "from the track" in fit.problem

    def test_a_hover_tells_no_time(self) -> None:
        time_s = np.arange(0.0, 300.0, 0.2)
        fit = offset_by_place(np.linspace(10.0, 60.0, 9), np.zeros((9, 2)), time_s, np.zeros((len(time_s), 2)))
        assert fit is not None
        assert "hardly moved" in fit.problem
