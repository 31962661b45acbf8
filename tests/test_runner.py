"""The engine: staleness, atomic commits, what survives a kill, and that the executor never shows in the bytes."""

import contextlib
import json
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pydantic import Field

from pipeline.engine.config import Configuration, resolve
from pipeline.engine.digests import digest_tree
from pipeline.engine.errors import InputError, NothingLeftError, ResourceError, UsageError
from pipeline.engine.executors import Executor, ProcessExecutor, SerialExecutor
from pipeline.engine.progress import Reporter
from pipeline.engine.runfolder import RunFolder, write_json
from pipeline.engine.runner import run_stage, staleness
from pipeline.engine.stage import Context, Stage, StageConfig
from schemas import CLOCKS, MATCHES


class MakeConfig(StageConfig):
    rows: int = 10
    source: str = Field("", json_schema_extra={"path": True})


class UseConfig(StageConfig):
    scale: float = 2.0
    fail: bool = False


def clocks(rows: int) -> pa.Table:
    row = {"clock_id": "", "source": "", "method": "", "offset_s": 0.0, "drift_ppm": 0.0, "anchors": 0, "problem": ""}
    return CLOCKS.from_rows([{**row, "clock_id": str(i), "offset_s": float(i)} for i in range(rows)])


def make(config: MakeConfig, context: Context) -> str:
    context.write("clocks", clocks(config.rows))
    context.record("rows", config.rows)
    return f"{config.rows} rows"


def part(scale: float, items: Sequence[int]) -> pa.Table:
    rng = np.random.default_rng(list(items))
    n = len(items)
    pixels = {name: rng.normal(size=n) * scale for name in ("ref_u", "ref_v", "src_u", "src_v")}
    one = np.ones(n, np.float32)
    covariance = dict.fromkeys(("cov_uu", "cov_uv", "cov_vv"), one)
    known = {"pair_id": [str(i) for i in items], "score": one, "inlier": [True] * n}
    return MATCHES.from_columns({**known, **pixels, **covariance})


def use(config: UseConfig, context: Context) -> str:
    items = [int(x) for x in context.read("clocks").column("offset_s").to_pylist()]
    context.map_tables("matches", partial(part, config.scale), items, shard=3, label="rows")
    if config.fail:
        raise NothingLeftError("E-TEST-01", "nothing")
    return "used"


def sources(config: MakeConfig) -> list[Path]:
    return [Path(config.source)] if config.source else []


# Named after real stages, so that the outputs are tables that the engine knows.
MAKE = Stage("ingest", 1, MakeConfig, (), ("clocks",), make, sources=sources)
USE = Stage("match", 1, UseConfig, ("clocks",), ("matches",), use, reads=("ingest.rows",))
MODELS: dict[str, type[StageConfig]] = {"ingest": MakeConfig, "match": UseConfig}


def configuration(**values: dict[str, object]) -> Configuration:
    return resolve([("test", {"ingest": values.get("ingest", {}), "match": values.get("match", {})})], MODELS)


def run_both(folder: RunFolder, config: Configuration, executor: Executor | None = None) -> None:
    with folder.locked(), executor or SerialExecutor() as worker:
        for stage in (MAKE, USE):
            if staleness(stage, folder, config).status != "fresh":
                run_stage(stage, folder, config, worker, Reporter())


def status(folder: RunFolder, config: Configuration) -> list[tuple[str, str]]:
    states = [staleness(stage, folder, config) for stage in (MAKE, USE)]
    return [(state.status, state.because) for state in states]


def test_a_stage_is_fresh_after_it_ran_and_stale_when_a_key_it_reads_changes(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    config = configuration()
    assert [state for state, _ in status(folder, config)] == ["missing", "missing"]
    run_both(folder, config)
    assert [state for state, _ in status(folder, config)] == ["fresh", "fresh"]
    assert status(folder, configuration(match={"scale": 3.0})) == [("fresh", ""), ("stale", "changed: match.scale")]
    changed = status(folder, configuration(ingest={"rows": 11}))
    assert changed == [("stale", "changed: ingest.rows"), ("stale", "changed: ingest.rows")]


def test_a_source_counts_by_content_not_by_place(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    for name in ("a", "b"):
        (tmp_path / name / "photo").write_text("same")
    folder = RunFolder(tmp_path / "run")
    run_both(folder, configuration(ingest={"source": str(tmp_path / "a/photo")}))
    moved = configuration(ingest={"source": str(tmp_path / "b/photo")})
    assert staleness(MAKE, folder, moved).status == "fresh"
    (tmp_path / "b/photo").write_text("other")
    assert staleness(MAKE, folder, moved).because == "changed: sources"


def test_a_lost_or_changed_output_is_stale(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    run_both(folder, configuration())
    (folder.output("matches") / "part-00001.parquet").unlink()
    assert status(folder, configuration())[1] == ("stale", "an output is missing or was changed")


@pytest.mark.parametrize("executor", [SerialExecutor(), ProcessExecutor(2), ProcessExecutor(3)])
def test_bytes_do_not_depend_on_the_executor(tmp_path: Path, executor: Executor) -> None:
    reference, other = RunFolder(tmp_path / "reference"), RunFolder(tmp_path / "other")
    run_both(reference, configuration())
    run_both(other, configuration(), executor)
    for name in ("clocks", "matches"):
        assert digest_tree(reference.output(name)) == digest_tree(other.output(name))


def test_a_failing_stage_leaves_the_last_good_outputs(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    run_both(folder, configuration())
    before = digest_tree(folder.output("matches"))
    with pytest.raises(NothingLeftError):
        run_both(folder, configuration(match={"scale": 5.0, "fail": True}))
    assert digest_tree(folder.output("matches")) == before
    run_both(folder, configuration())
    assert digest_tree(folder.output("matches")) == before


class Killed(BaseException):
    """Stands for a kill: nothing may catch it."""


@pytest.mark.parametrize("moment", range(14))
def test_a_kill_at_any_rename_is_finished_or_undone(
    tmp_path: Path, moment: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, reference = RunFolder(tmp_path / "run"), RunFolder(tmp_path / "reference")
    run_both(folder, configuration(match={"scale": 1.0}))
    run_both(reference, configuration(match={"scale": 7.0}, ingest={"rows": 20}))
    calls = 0
    real = Path.rename

    def rename(self: Path, target: Path) -> Path:
        nonlocal calls
        calls += 1
        if calls > moment:
            raise Killed
        return real(self, target)

    wanted = configuration(match={"scale": 7.0}, ingest={"rows": 20})
    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", rename)
        with contextlib.suppress(Killed):
            run_both(folder, wanted)
    run_both(folder, wanted)
    for name in ("clocks", "matches"):
        assert digest_tree(folder.output(name)) == digest_tree(reference.output(name))
    assert not list((folder.root / ".pending").glob("*"))
    assert [state for state, _ in status(folder, wanted)] == ["fresh", "fresh"]


def test_finished_parts_of_a_killed_stage_are_taken_up(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    failing = configuration(match={"fail": True})
    with pytest.raises(NothingLeftError):
        run_both(folder, failing)
    parts = sorted((folder.root / ".work").rglob("part-*.parquet"))
    assert len(parts) == 4
    stamp = parts[0].stat().st_mtime_ns
    with pytest.raises(NothingLeftError):
        run_both(folder, failing)
    assert parts[0].stat().st_mtime_ns == stamp


def test_two_processes_do_not_share_a_run_folder(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    with folder.locked(), pytest.raises(UsageError, match="another process"), RunFolder(folder.root).locked():
        pass


def test_a_missing_input_names_the_command(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    with folder.locked(), pytest.raises(InputError, match="needs clocks"):
        run_stage(USE, folder, configuration(), SerialExecutor(), Reporter())


def test_the_manifest_tells_values_origins_digests_and_rows(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    run_both(folder, configuration(match={"scale": 4.0}))
    stages = json.loads((folder.root / "manifest.json").read_text())["stages"]
    assert stages["match"]["config"]["scale"] == {"value": 4.0, "from": "test"}
    assert stages["match"]["config"]["fail"]["from"] == "default"
    assert stages["match"]["outputs"]["matches"]["rows"] == 10
    assert stages["match"]["parts"]["clocks"] == stages["ingest"]["outputs"]["clocks"]["sha256"]
    assert stages["ingest"]["facts"] == {"rows": 10}


def test_a_stage_cannot_reach_what_it_does_not_declare(tmp_path: Path) -> None:
    def nosy(config: StageConfig, context: Context) -> str:
        context.setting("match.scale")
        return ""

    stage = Stage("ingest", 1, MakeConfig, (), ("clocks",), nosy)
    folder = RunFolder(tmp_path / "run")
    with folder.locked(), pytest.raises(KeyError, match="does not declare"):
        run_stage(stage, folder, configuration(), SerialExecutor(), Reporter())


def crash(item: int) -> int:
    if item == 2:
        os._exit(9)
    return item


def test_a_killed_worker_is_a_resource_error() -> None:
    with ProcessExecutor(2) as executor, pytest.raises(ResourceError, match="E-EXEC-01"):
        list(executor.map(crash, range(5)))


def refuse(item: int) -> int:
    raise InputError("E-TEST-02", "bad", where="here", hint="mend it")


def test_an_error_keeps_its_fields_across_processes() -> None:
    with ProcessExecutor(1) as executor, pytest.raises(InputError) as caught:
        list(executor.map(refuse, [1]))
    assert (caught.value.where, caught.value.hint, caught.value.exit_code) == ("here", "mend it", 3)


def test_json_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    write_json(path, {"a": 1})
    loop: list[object] = []
    loop.append(loop)
    with pytest.raises(ValueError, match="Circular"):
        write_json(path, loop)
    assert json.loads(path.read_text()) == {"a": 1}
