import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from pipeline.engine.config import load_workflow, parse_overrides, resolve, to_toml
from pipeline.engine.errors import InputError, UsageError
from pipeline.engine.stage import StageConfig
from stages.registry import MODELS as STAGE_MODELS


class First(StageConfig):
    photos: str | tuple[str, ...] = Field("photos", json_schema_extra={"path": True})
    geoid: float | str | None = Field(None, json_schema_extra={"path": True})
    baseline_m: tuple[float, float] = (2.0, 20.0)


class Second(StageConfig):
    mode: str = "none"


MODELS: dict[str, type[StageConfig]] = {"first": First, "second": Second}


def workflow(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "flight.toml"
    path.write_text(text)
    return path


def test_paths_are_relative_to_the_file_and_numbers_are_not_paths(tmp_path: Path) -> None:
    path = workflow(tmp_path, '[first]\nphotos = "a/b"\ngeoid = "-33.0"\n')
    section = load_workflow(path, MODELS)["first"]
    assert section["photos"] == str(tmp_path / "a/b")
    assert section["geoid"] == "-33.0"


def test_urls_stay_as_they_are(tmp_path: Path) -> None:
    path = workflow(tmp_path, '[first]\nphotos = ["s3://bucket/flight", "near"]\n')
    assert load_workflow(path, MODELS)["first"]["photos"] == ["s3://bucket/flight", str(tmp_path / "near")]


def test_unknown_key_names_the_nearest_one(tmp_path: Path) -> None:
    sections = load_workflow(workflow(tmp_path, "[first]\nbaseline = [1, 2]\n"), MODELS)
    with pytest.raises(UsageError) as caught:
        resolve([("flight.toml", sections)], MODELS)
    assert "did you mean baseline_m?" in str(caught.value)
    assert caught.value.exit_code == 2


def test_unknown_section_names_the_nearest_one(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="did you mean second"):
        load_workflow(workflow(tmp_path, "[secnd]\n"), MODELS)


def test_broken_toml_and_missing_file_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="E-CONFIG-02"):
        load_workflow(workflow(tmp_path, "[first\n"), MODELS)
    with pytest.raises(InputError, match="E-CONFIG-01"):
        load_workflow(tmp_path / "none.toml", MODELS)


def test_refused_value_says_where_it_came_from() -> None:
    overrides = parse_overrides(["first.baseline_m=[1, 'x']"], MODELS)
    with pytest.raises(UsageError) as caught:
        resolve([("command line", overrides)], MODELS)
    assert "first.baseline_m" in str(caught.value)
    assert "command line" in str(caught.value)


def test_later_layers_win_and_origins_are_kept() -> None:
    layers = [("flight.toml", {"second": {"mode": "pair"}}), ("command line", {"second": {"mode": "flight"}})]
    found = resolve(layers, MODELS)
    assert found.value("second.mode") == "flight"
    assert found.origins["second.mode"] == "command line"
    assert found.origins["second.max_failed_share"] == "default"
    assert found.value("first.photos") is None


@pytest.mark.parametrize("item", ["second", "second=1", "mode=1", "second.=1"])
def test_malformed_override_is_a_usage_error(item: str) -> None:
    with pytest.raises(UsageError):
        parse_overrides([item], MODELS)


@given(
    text=st.text(),
    number=st.floats(allow_nan=False, allow_infinity=False),
    flag=st.booleans(),
    listed=st.lists(st.text(), max_size=3),
)
def test_toml_round_trip(text: str, number: float, flag: bool, listed: list[str]) -> None:
    section = {"text": text, "number": number, "flag": flag, "listed": listed}
    assert tomllib.loads(to_toml({"second": section}))["second"] == section


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("ingest.mount={pich_deg=-90}", "did you mean pitch_deg?"),
        ("ingest.mount.pich_deg=-90", "did you mean pitch_deg?"),
        ("ingest.mount={lever_arm_m=[0.1, 0.2]}", "lever_arm_m: more numbers"),
        ("ingest.mount=down", "a table: { yaw_deg"),
        ("ingest.mount.pitch_deg=-9000", "pitch_deg: an angle between"),
        ("ingest.mount.lever_arm_m=[0, 0, 100]", "lever_arm_m: metres on the vehicle"),
        ("photos.x=1", "put it under [ingest]"),
    ],
)
def test_tables_within_a_section_are_explained(text: str, told: str) -> None:
    def resolved() -> None:
        layers = [("w.toml", {"ingest": {"photos": "p"}}), ("command line", parse_overrides([text], STAGE_MODELS))]
        resolve(layers, STAGE_MODELS)

    with pytest.raises(UsageError, match=re.escape(told)):
        resolved()


def test_entries_of_a_table_add_up() -> None:
    layers = [("w.toml", {"ingest": {"photos": "p", "mount": {"lever_arm_m": [1.0, 2.0, 3.0], "yaw_deg": 5.0}}})]
    overrides = ["ingest.mount.pitch_deg=-90", "ingest.mount.yaw_deg=0"]
    layers.append(("command line", parse_overrides(overrides, STAGE_MODELS)))
    mount = resolve(layers, STAGE_MODELS).value("ingest.mount")
    assert (mount.lever_arm_m, mount.yaw_deg, mount.pitch_deg) == ((1.0, 2.0, 3.0), 0.0, -90.0)
