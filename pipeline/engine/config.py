"""Strict configuration: workflow file, command line and run folder into one frozen model per stage.

An unknown section or key is an error that names the nearest known one; every value remembers where it came from.
"""

from __future__ import annotations

import difflib
import json
import os
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from pipeline.engine.errors import InputError, UsageError
from pipeline.engine.stage import StageConfig

Sections = dict[str, dict[str, Any]]
Models = Mapping[str, type[StageConfig]]


@dataclass(frozen=True, slots=True)
class Configuration:
    """The resolved configuration of a run.

    Args:
        sections: One validated model per stage the workflow has a section for.
        origins: "section.key" to where the value came from: default, the workflow's file name, or the command line.
        given: The values that are not defaults, paths absolute: what the run folder keeps.
    """

    sections: Mapping[str, StageConfig]
    origins: Mapping[str, str]
    given: Mapping[str, Mapping[str, Any]]

    def value(self, key: str) -> Any:
        """The value of "section.key"; None where the workflow has no such section."""
        section, _, name = key.partition(".")
        return getattr(self.sections[section], name) if section in self.sections else None


def load_workflow(path: Path, models: Models) -> Sections:
    """Reads a workflow file and makes its paths absolute.

    Args:
        path: TOML file.
        models: The configuration model of each known section.

    Returns:
        Section to key to value, not yet validated.

    Raises:
        InputError: The file cannot be read.
        UsageError: It is not TOML, or a section is unknown.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            "E-CONFIG-01",
            "cannot read the workflow file",
            where=str(path),
            found=str(error),
            expected="a TOML file",
            hint="check the path",
        ) from error
    try:
        sections = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UsageError("E-CONFIG-02", "the workflow file is not TOML", where=str(path), found=str(error)) from error
    for name, section in sections.items():
        _check_section(name, models, str(path))
        if not isinstance(section, dict):
            raise UsageError(
                "E-CONFIG-03", f"{name} is not a section", where=str(path), found=repr(section), expected=f"[{name}]"
            )
    return absolute_paths(sections, models, path.resolve().parent)


def absolute_paths(sections: Sections, models: Models, base: Path) -> Sections:
    """Makes the path-valued keys of known sections absolute; URLs and numbers stay as they are."""
    out: Sections = {}
    for name, section in sections.items():
        fields = models[name].model_fields
        out[name] = {
            key: _absolute(value, base) if key in fields and is_path(fields[key]) else value
            for key, value in section.items()
        }
    return out


def is_path(field: FieldInfo) -> bool:
    """Whether a configuration key names files outside the run folder."""
    extra = field.json_schema_extra
    return isinstance(extra, dict) and bool(extra.get("path"))


def parse_overrides(items: Iterable[str], models: Models) -> Sections:
    """Reads `--set section.key=value` items; a value is TOML, or else plain text.

    Raises:
        UsageError: An item has no "=", or its section is unknown.
    """
    sections: Sections = {}
    for item in items:
        key, separator, text = item.partition("=")
        section, dot, name = key.strip().partition(".")
        name, inner, part = name.partition(".")
        if not (separator and dot and name) or (inner and not part):
            raise UsageError(
                "E-CONFIG-04", "--set needs section.key=value", found=item, hint="--set depth.max_range_m=80"
            )
        _check_section(section, models, f"--set {item}")
        value = _toml_value(text.strip())
        keys = sections.setdefault(section, {})
        # ingest.mount.pitch_deg=-90 is one entry of the table ingest.mount.
        keys[name] = {**_table(keys.get(name)), part: value} if inner else value
    return absolute_paths(sections, models, Path.cwd())


def resolve(layers: Iterable[tuple[str, Sections]], models: Models) -> Configuration:
    """Merges layers (later ones win) and validates every section.

    Args:
        layers: (origin, sections) pairs, weakest first.
        models: The configuration model of each known section.

    Raises:
        UsageError: An unknown key, or a value its model refuses.
    """
    given: dict[str, dict[str, Any]] = {}
    origins: dict[str, str] = {}
    for origin, sections in layers:
        for name, section in sections.items():
            given.setdefault(name, {})
            for key, value in section.items():
                both_tables = isinstance(value, Mapping) and isinstance(given[name].get(key), Mapping)
                given[name][key] = {**given[name][key], **value} if both_tables else value
                origins[f"{name}.{key}"] = origin
    resolved: dict[str, StageConfig] = {}
    for name, model in models.items():
        if name not in given:
            continue
        _check_keys(name, given[name], model, origins)
        try:
            resolved[name] = model.model_validate(given[name])
        except ValidationError as error:
            raise _explained(name, model, error, origins) from error
        for key in model.model_fields:
            origins.setdefault(f"{name}.{key}", "default")
    return Configuration(resolved, origins, given)


def to_toml(sections: Mapping[str, Mapping[str, Any]]) -> str:
    """Writes flat sections as TOML."""
    blocks = []
    for name, section in sections.items():
        lines = [f"[{name}]"] + [f"{key} = {_toml_text(value)}" for key, value in section.items() if value is not None]
        blocks.append("\n".join(lines) + "\n")
    return "\n".join(blocks)


def _toml_text(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml_text(item) for item in value) + "]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml_text(item)}" for key, item in value.items()) + " }"
    # JSON's escapes are a subset of those of a TOML basic string, which wants DEL escaped too.
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")


def _toml_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _absolute(value: Any, base: Path) -> Any:
    if isinstance(value, str) and "://" not in value and not _is_number(value):
        return os.path.normpath(base / Path(value).expanduser())
    if isinstance(value, list):
        return [_absolute(item, base) for item in value]
    return value


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _check_section(name: str, models: Models, where: str) -> None:
    if name not in models:
        raise UsageError(
            "E-CONFIG-05",
            f"unknown section [{name}]",
            where=where,
            expected=", ".join(models),
            hint=_home(name, models) or _nearest(name, models) or "remove it",
        )


def _check_keys(name: str, section: Mapping[str, Any], model: type[StageConfig], origins: Mapping[str, str]) -> None:
    for key in section:
        if key not in model.model_fields:
            raise UsageError(
                "E-CONFIG-06",
                f"unknown key {name}.{key}",
                where=origins[f"{name}.{key}"],
                expected=", ".join(model.model_fields),
                hint=_nearest(key, model.model_fields) or "remove it",
            )


def _home(name: str, models: Models) -> str:
    """Where a key belongs that stands where a section should."""
    homes = [section for section, model in models.items() if name in model.model_fields]
    return f"put it under [{homes[0]}] ({homes[0]}.{name})" if homes else ""


def _nearest(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.4)
    return f"did you mean {close[0]}?" if close else ""


def _explained(name: str, model: type[StageConfig], error: ValidationError, origins: Mapping[str, str]) -> UsageError:
    first = error.errors()[0]
    key = ".".join(str(part) for part in (name, *first["loc"][:1]))
    if first["type"] == "extra_forbidden" and len(first["loc"]) > 1:
        known = _keys_within(model.model_fields[str(first["loc"][0])])
        wrong = str(first["loc"][-1])
        return UsageError(
            "E-CONFIG-06",
            f"unknown key {key}.{wrong}",
            where=origins.get(key, "workflow"),
            expected=", ".join(known),
            hint=_nearest(wrong, known) or "remove it",
        )
    if first["type"] == "missing" and len(first["loc"]) == 1:
        return UsageError(
            "E-CONFIG-08",
            f"{key} has no value",
            where=f"[{name}]",
            hint=f"put it into the workflow, or give --set {key}=...",
        )
    if not first["loc"]:
        # A rule on the section as a whole.
        return UsageError(
            "E-CONFIG-09",
            f"[{name}] does not say enough",
            where=f"[{name}]",
            expected=str(first["msg"]).removeprefix("Value error, "),
        )
    return UsageError(
        "E-CONFIG-07",
        f"{key} has a value that is not allowed",
        where=origins.get(key, "workflow"),
        found=repr(first.get("input")),
        expected=_wanted(first["type"], str(first["msg"]), model, first["loc"]),
    )


def _table(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _keys_within(field: FieldInfo) -> list[str]:
    """The keys of a table-valued key, whatever else its type allows."""
    for kind in (field.annotation, *get_args(field.annotation)):
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            return list(kind.model_fields)
    return []


def _wanted(kind: str, message: str, model: type[StageConfig], where: tuple[int | str, ...]) -> str:
    """What a value should be, in the workflow's words."""
    inside = _keys_within(model.model_fields[str(where[0])])
    if kind == "model_type":
        return f"a table: {{ {', '.join(f'{key} = ...' for key in inside)} }}"
    told = "more numbers in the list" if kind == "missing" else message.removeprefix("Value error, ")
    named = [str(part) for part in where[1:] if str(part) in inside]
    return f"{named[0]}: {told}" if named else told
