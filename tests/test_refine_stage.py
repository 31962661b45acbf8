"""The stage refine on the example flight: all modes, parts and processes, its tables and facts, and what runs again."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from flights import STAGES, copied, outputs
from pydantic import ValidationError

from pipeline.engine.executors import Executor, ProcessExecutor, SerialExecutor
from pipeline.flight import (
    placed_pairs_of,
    placements_of,
    pose_errors_of,
    poses_of,
    relative_poses_of,
    selected_pairs,
)
from pipeline.geometry.poses import joint_covariance, relative_jacobian, relative_pose
from schemas import MATCHES, POSE_COVARIANCES, POSES, RELATIVE_POSES
from stages.app import run as command_line
from stages.refine import STAGE, Config

MODES = ("none", "pair", "flight")
INPUTS = ("frames", "cameras", "pairs")


@dataclass
class FakeContext:
    """What the engine lends, in memory."""

    folder: Path
    tables: dict[str, pa.Table]
    executor: Executor = field(default_factory=SerialExecutor)
    written: dict[str, pa.Table] = field(default_factory=dict)
    recorded: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)

    def setting(self, key: str) -> Any:
        assert key in STAGE.reads

    def facts(self, stage: str) -> Mapping[str, Any]:
        assert stage in STAGE.facts_of
        return {}

    def warn(self, text: str) -> None:
        self.warnings.append(text)

    def read(self, name: str) -> pa.Table:
        assert name in STAGE.inputs
        return self.tables[name]

    def path(self, name: str) -> Path:
        assert name in STAGE.inputs
        return self.folder / name

    def write(self, name: str, table: pa.Table) -> None:
        self.written[name] = table

    def record(self, key: str, value: Any) -> None:
        self.recorded[key] = json.loads(json.dumps(value, allow_nan=False))

    def map(
        self, function: Callable[[Sequence[Any]], Any], items: Iterable[Any], *, shard: int, label: str
    ) -> Iterator[Any]:
        assert label
        listed = list(items)
        return self.executor.map(function, [listed[i : i + shard] for i in range(0, len(listed), shard)])


@dataclass(frozen=True)
class Refined:
    """What a mode wrote."""

    tables: dict[str, pa.Table]
    facts: dict[str, Any]
    said: str

    @property
    def pairs(self) -> dict[str, dict[str, Any]]:
        return {row["pair_id"]: row for row in self.tables["relative_poses"].to_pylist()}


def of_run(run: Path) -> dict[str, pa.Table]:
    return {name: pq.read_table(run / f"{name}.parquet") for name in INPUTS} | {
        "matches": pq.read_table(run / "matches")
    }


def write_parts(folder: Path, matches: pa.Table, of_part: Sequence[Sequence[str]]) -> None:
    (folder / "matches").mkdir(parents=True, exist_ok=True)
    for i, pairs in enumerate(of_part):
        rows = matches.filter(pc.is_in(matches.column("pair_id"), pa.array(pairs, pa.string())))
        pq.write_table(rows.cast(MATCHES.arrow()), folder / "matches" / f"part-{i:05d}.parquet")


def by_ref(tables: dict[str, pa.Table]) -> list[list[str]]:
    """The pairs of each ref frame."""
    found: dict[str, list[str]] = {}
    for pair in selected_pairs(tables["pairs"]):
        found.setdefault(pair.ref, []).append(pair.pair_id)
    return list(found.values())


def refined(folder: Path, tables: dict[str, pa.Table], mode: str, executor: Executor | None = None) -> Refined:
    context = FakeContext(folder, tables, executor or SerialExecutor())
    said = STAGE.run(Config(mode=mode), context)
    return Refined(context.written, context.recorded, said)


@pytest.fixture(scope="module")
def parts(small_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The matches of the small run in one part per ref frame."""
    folder, tables = tmp_path_factory.mktemp("parts"), of_run(small_run)
    write_parts(folder, tables["matches"], by_ref(tables))
    assert len(list((folder / "matches").iterdir())) > 2
    return folder


@pytest.fixture(scope="module")
def every(parts: Path, small_run: Path) -> dict[str, Refined]:
    return {mode: refined(parts, of_run(small_run), mode) for mode in MODES}


@pytest.mark.parametrize("mode", MODES)
def test_its_tables_are_of_their_schemas(every: dict[str, Refined], mode: str) -> None:
    tables = every[mode].tables
    assert set(tables) == set(STAGE.outputs)
    for schema in (RELATIVE_POSES, POSES, POSE_COVARIANCES):
        schema.check(tables[schema.name])
    assert set(tables["relative_poses"].column("mode").to_pylist()) == {mode}


@pytest.mark.parametrize("mode", MODES)
def test_every_pair_and_every_frame_has_its_row(every: dict[str, Refined], small_run: Path, mode: str) -> None:
    inputs, tables = of_run(small_run), every[mode].tables
    pairs = selected_pairs(inputs["pairs"])
    assert tables["relative_poses"].column("pair_id").to_pylist() == [pair.pair_id for pair in pairs]
    frames = list(poses_of(inputs["frames"]))
    assert tables["poses"].column("frame_id").to_pylist() == frames
    errors = pose_errors_of(tables["pose_covariances"])
    assert list(errors.index) == frames
    for pair in pairs:
        joint = errors.joint(pair.ref, pair.src)
        scale = np.sqrt(np.diag(joint))
        assert np.linalg.eigvalsh(joint / np.outer(scale, scale))[0] > -1e-9
    counts = inputs["matches"].group_by("pair_id").aggregate([("inlier", "sum"), ("inlier", "count")]).to_pylist()
    for row in counts:
        found = every[mode].pairs[row["pair_id"]]
        assert (found["n_inliers"], found["n_matches"]) == (row["inlier_sum"], row["inlier_count"])


def test_the_log_is_passed_on_as_it_is(every: dict[str, Refined], small_run: Path) -> None:
    poses, tables = poses_of(of_run(small_run)["frames"]), every["none"].tables
    for name, at in placements_of(tables["poses"]).items():
        np.testing.assert_allclose(at.rotation, poses[name].rotation, atol=1e-14)
        np.testing.assert_array_equal(at.centre, poses[name].centre)
    assert not any(tables["poses"].column("refined").to_pylist())
    relative, errors = relative_poses_of(tables["relative_poses"]), pose_errors_of(tables["pose_covariances"])
    for pair in selected_pairs(of_run(small_run)["pairs"]):
        ref, src = poses[pair.ref], poses[pair.src]
        np.testing.assert_allclose(relative[pair.pair_id].covariance, relative_pose(ref, src).covariance, atol=1e-12)
        np.testing.assert_array_equal(errors.joint(pair.ref, pair.src), joint_covariance(ref, src))
    for row in every["none"].pairs.values():
        assert row["gain"] is row["noise"] is row["moved_sigmas"] is None
        assert row["median_before_px"] == row["median_after_px"]
        assert not row["problem"]


@pytest.mark.parametrize("mode", ["pair", "flight"])
def test_refined_residuals_are_a_fraction_of_the_logged_ones(every: dict[str, Refined], mode: str) -> None:
    for name, row in every[mode].pairs.items():
        assert row["median_before_px"] == pytest.approx(every["none"].pairs[name]["median_before_px"])
        assert row["median_after_px"] < 0.5 * row["median_before_px"]
        assert row["rms_after_px"] < row["rms_before_px"]
        assert 0.02 < row["median_after_px"] < 0.5
        assert 0.5 < row["moved_sigmas"] < 6.0
        assert not row["problem"]


@pytest.mark.parametrize("mode", MODES)
def test_a_relative_pose_is_that_of_its_two_cameras(every: dict[str, Refined], mode: str, small_run: Path) -> None:
    tables = every[mode].tables
    relative, placed = relative_poses_of(tables["relative_poses"]), placed_pairs_of(tables["relative_poses"])
    errors, at = pose_errors_of(tables["pose_covariances"]), placements_of(tables["poses"])
    for pair in selected_pairs(of_run(small_run)["pairs"]):
        pose, both = relative[pair.pair_id], placed[pair.pair_id]
        np.testing.assert_allclose(pose.rotation, both.src.rotation.T @ both.ref.rotation, atol=1e-12)
        np.testing.assert_allclose(pose.centre, both.ref.rotation.T @ (both.src.centre - both.ref.centre), atol=1e-9)
        # The errors of the frames, through gain and noise, are those of the relative pose.
        joint = both.gain @ errors.joint(pair.ref, pair.src) @ both.gain.T + both.noise
        jacobian = relative_jacobian(both.ref, both.src)
        expected = jacobian @ joint @ jacobian.T
        scale = np.sqrt(np.diag(pose.covariance))
        np.testing.assert_allclose((expected - pose.covariance) / np.outer(scale, scale), 0.0, atol=1e-5)
        if mode == "flight":
            np.testing.assert_allclose(both.ref.centre, at[pair.ref].centre, atol=1e-12)


@pytest.mark.parametrize("mode", ["pair", "flight"])
def test_refined_frames_are_surer_than_logged_ones(every: dict[str, Refined], mode: str) -> None:
    before, after = (every[name].tables["poses"].to_pylist() for name in ("none", mode))
    for logged, now in zip(before, after, strict=True):
        assert now["refined"]
        assert not now["problem"]
        for name in ("yaw", "pitch", "roll"):
            assert now[f"sigma_{name}_deg"] <= logged[f"sigma_{name}_deg"] * 1.001
    assert np.mean([row["sigma_yaw_deg"] for row in after]) < 0.98 * np.mean([row["sigma_yaw_deg"] for row in before])


def test_facts_and_words(every: dict[str, Refined]) -> None:
    facts = {mode: every[mode].facts for mode in MODES}
    for mode in MODES:
        pairs = every[mode].pairs.values()
        for name, column in (("", "median_before_px"), ("_after", "median_after_px")):
            expected = np.median([row[column] for row in pairs])
            assert facts[mode][f"median_epipolar_residual{name}_px"] == pytest.approx(expected, abs=1e-4)
        assert facts[mode]["pairs_not_refined"] == {}
    assert [facts[mode]["share_of_pairs_refined"] for mode in MODES] == [0.0, 1.0, 1.0]
    shared = facts["flight"]["shared_errors"]
    # The example's log says that pitch and roll have nothing in common.
    assert {"boresight yaw", "clock", "lever arm forward"} <= set(shared)
    assert all(found["sigma"] <= found["prior_sigma"] * 1.001 for found in shared.values())
    assert facts["flight"]["frames_refined"] == 6
    assert facts["flight"]["frames_off_the_log"] == {}
    assert 1.0 <= facts["flight"]["information_divided_by"] < 5.0
    assert "shared_errors" not in facts["pair"]
    assert every["none"].said.startswith("7 pairs, median epipolar residual under the logged poses ")
    for mode in ("pair", "flight"):
        assert " px as logged, " in every[mode].said
        assert " px refined" in every[mode].said


# --- parts and processes ---


@pytest.mark.parametrize("mode", ["pair", "flight"])
def test_two_processes_write_the_same(every: dict[str, Refined], parts: Path, small_run: Path, mode: str) -> None:
    with ProcessExecutor(2) as executor:
        found = refined(parts, of_run(small_run), mode, executor)
    for name, table in every[mode].tables.items():
        assert found.tables[name].equals(table), name
    assert found.facts == every[mode].facts


@pytest.mark.parametrize("mode", MODES)
def test_how_the_matches_are_cut_into_parts_says_nothing(
    every: dict[str, Refined], small_run: Path, tmp_path: Path, mode: str
) -> None:
    tables = of_run(small_run)
    write_parts(tmp_path, tables["matches"], [[pair for some in by_ref(tables) for pair in some]])
    found = refined(tmp_path, tables, mode)
    for name in ("relative_poses", "poses", "pose_covariances"):
        assert found.tables[name].equals(every[mode].tables[name]), name


# --- what cannot be refined ---


def thinned(matches: pa.Table, pair_id: str, count: int) -> pa.Table:
    """One pair with so many inliers, and no other match."""
    rows = np.arange(matches.num_rows)
    of_pair = pc.equal(matches.column("pair_id"), pair_id).to_numpy()
    inlier = matches.column("inlier").to_numpy()
    kept = np.concatenate([rows[~of_pair], rows[of_pair & inlier][:count]])
    return matches.take(pa.array(np.sort(kept)))


def test_a_pair_that_is_not_refined_keeps_the_log_and_tells_why(
    every: dict[str, Refined], small_run: Path, tmp_path: Path
) -> None:
    tables = of_run(small_run)
    few, none = (pair.pair_id for pair in selected_pairs(tables["pairs"])[:2])
    tables["matches"] = thinned(thinned(tables["matches"], few, 12), none, 0)
    write_parts(tmp_path, tables["matches"], by_ref(tables))
    found = refined(tmp_path, tables, "pair")
    reasons = {few: "too few matches: 12, and 20 are needed", none: "no match agrees with the logged pose"}
    for name, reason in reasons.items():
        row, logged = found.pairs[name], every["none"].pairs[name]
        assert (row["mode"], row["problem"], row["moved_sigmas"], row["gain"]) == ("none", reason, None, None)
        for column in ("qw", "qx", "tx", "ty", "tz", "cov", "ref_east_m", "src_qw", "src_up_m"):
            assert row[column] == logged[column]
    assert (found.pairs[none]["n_matches"], found.pairs[none]["median_before_px"]) == (0, None)
    assert found.facts["pairs_not_refined"] == dict.fromkeys(sorted(reasons.values()), 1)
    assert found.facts["share_of_pairs_refined"] == pytest.approx(5 / 7, abs=1e-4)
    assert "(71% of the pairs; the others stay as logged)" in found.said
    others = set(found.pairs) - set(reasons)
    assert all(found.pairs[name]["cov"] == every["pair"].pairs[name]["cov"] for name in others)


@pytest.mark.parametrize("mode", MODES)
def test_a_flight_without_a_single_match(every: dict[str, Refined], small_run: Path, tmp_path: Path, mode: str) -> None:
    tables = of_run(small_run)
    tables["matches"] = tables["matches"].slice(0, 0)
    write_parts(tmp_path, tables["matches"], [[]])
    found = refined(tmp_path, tables, mode)
    assert found.said == "7 pairs, none with a match that agrees with its pose"
    assert found.facts["median_epipolar_residual_px"] is None
    at, logged = (placements_of(of.tables["poses"]) for of in (found, every["none"]))
    for name, pose in logged.items():
        np.testing.assert_allclose(at[name].centre, pose.centre, atol=1e-6)
        np.testing.assert_allclose(at[name].rotation, pose.rotation, atol=1e-9)
    assert not any(found.tables["poses"].column("refined").to_pylist())
    assert {row["problem"] for row in found.pairs.values()} == {"no match agrees with the logged pose"}


@pytest.mark.parametrize("mode", MODES)
def test_a_flight_without_times(small_run: Path, parts: Path, mode: str) -> None:
    tables = of_run(small_run)
    frames = tables["frames"]
    nothing = pa.nulls(frames.num_rows, frames.schema.field("time").type)
    tables["frames"] = frames.set_column(frames.schema.get_field_index("time"), frames.schema.field("time"), nothing)
    found = refined(parts, tables, mode)
    if mode == "flight":
        assert "clock" not in found.facts["shared_errors"]
        assert found.facts["median_epipolar_residual_after_px"] < 0.5


def test_a_mode_nobody_knows() -> None:
    with pytest.raises(ValidationError):
        Config(mode="both")  # type: ignore[arg-type]


# --- through the command line ---


def did(capsys: pytest.CaptureFixture[str], flight: Path, run: Path, *arguments: str) -> list[str]:
    """The stages that ran."""
    capsys.readouterr()
    code = command_line(["run", str(flight / "workflow.toml"), "--out", str(run), *arguments])
    told = capsys.readouterr().err
    assert code == 0, told
    words = [line.split(" ")[0] for line in told.splitlines() if "up to date" not in line]
    return [word for word in words if word in STAGES]


@pytest.mark.slow
def test_another_mode_runs_what_follows_from_refine_and_jobs_do_not_matter(
    small_flight: Path, small_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before, follows = outputs(small_run), ["refine", "depth", "fuse", "score", "report"]
    assert STAGES[-5:] == tuple(follows)
    usual = json.loads((small_run / "manifest.json").read_text())["stages"]["refine"]["config"]["mode"]["value"]
    mode = "flight" if usual == "pair" else "pair"
    given, made = ("--set", f"refine.mode={mode}", "--jobs"), {}
    for jobs in ("1", "2"):
        run = copied(small_run, tmp_path / jobs)
        assert did(capsys, small_flight, run, *given, jobs) == follows
        made[jobs] = outputs(run)
        assert did(capsys, small_flight, run, *given, jobs) == []
    assert made["1"] == made["2"]
    kept = [name for name in before if name.startswith(("frames", "cameras", "pairs", "matches"))]
    assert kept
    assert all(made["1"][name] == before[name] for name in kept)
    assert made["1"]["relative_poses.parquet"] != before["relative_poses.parquet"]
    entry = json.loads((tmp_path / "1" / "manifest.json").read_text())["stages"]["refine"]
    assert entry["config"]["mode"]["value"] == mode
    facts = {**entry, **entry.get("facts", {})}
    assert facts["share_of_pairs_refined"] == 1.0
    assert facts["median_epipolar_residual_after_px"] < facts["median_epipolar_residual_px"]
