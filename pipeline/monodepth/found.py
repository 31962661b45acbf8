"""Where a baseline's model lies, and whether the folder holds one: told without loading a network."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.engine.digests import digest_file
from pipeline.engine.errors import InputError, MissingPartError, UsageError
from pipeline.matching.weights.files import WeightPlace, weight_places
from pipeline.monodepth.known import ARCHITECTURES, BASELINES, CONFIG, INSTALL, PROCESSOR, WEIGHTS, models_of
from pipeline.monodepth.published import check_recorded

CONFIGURED = "score.models"
HUB = "Hugging Face cache"
# A model's config.json says so of weights that nobody trained.
UNTRAINED = "epitransfer_random_weights"


@dataclass(frozen=True, slots=True)
class FoundModel:
    """A model that a folder holds; small and picklable.

    Args:
        baseline: The baseline it serves.
        folder: Where it lies.
        origin: Who named that place: "score.models", "$EPITRANSFER_WEIGHTS", "cache", "Hugging Face cache".
        architecture: The class that transformers builds.
        name: What its config.json says it was made from, else its folder's name.
        sha256: Digest of its weights.
        untrained: Whether its config.json says that its weights are random.
    """

    baseline: str
    folder: Path
    origin: str
    architecture: str
    name: str
    sha256: str
    untrained: bool

    @property
    def provenance(self) -> dict[str, object]:
        """What the manifest and the report tell of it."""
        return {
            "baseline": self.baseline,
            "folder": str(self.folder),
            "origin": self.origin,
            "architecture": self.architecture,
            "name": self.name,
            "sha256": self.sha256,
            "untrained": self.untrained,
            "note": self.note,
        }

    @property
    def note(self) -> str:
        """One line beside its depths."""
        weights = f"{self.name}, weights sha256 {self.sha256[:12]}"
        return f"{weights}; random weights: proves the path only" if self.untrained else weights


def find_models(baselines: Sequence[str], folder: Path | str | None = None) -> tuple[FoundModel, ...]:
    """The model of each baseline.

    Looked for in the folder that is stated (a model itself, or holding models in folders named after the baseline or
    the published model), in those of $EPITRANSFER_WEIGHTS, in the cache of `epitransfer models fetch`, and in the
    user's Hugging Face cache. Nothing is ever fetched from here.

    Args:
        baselines: "zoedepth", "depth-anything-v2".
        folder: The value of `score.models`.

    Raises:
        InputError: A folder that is looked into holds something else, or the stated one does not exist.
        MissingPartError: transformers is not installed, or a model is nowhere.
        UsageError: No such baseline.
    """
    for name in baselines:
        if name not in BASELINES:
            raise UsageError("E-BASELINE-07", "no such baseline", found=name, expected=", ".join(BASELINES))
    if baselines and importlib.util.find_spec("transformers") is None:
        raise MissingPartError("E-BASELINE-05", "transformers is not installed", hint=INSTALL)
    stated = None if folder is None else _stated(Path(folder).expanduser(), baselines)
    return tuple(_find(name, stated) for name in baselines)


def _stated(folder: Path, baselines: Sequence[str]) -> Path:
    if not folder.is_dir():
        raise InputError(
            "E-BASELINE-02", "the folder of models does not exist", where=CONFIGURED, found=f"no folder {folder}"
        )
    if (folder / CONFIG).is_file() and _serves(folder) not in baselines:
        raise _no_such_model(folder, " or ".join(ARCHITECTURES[name] for name in baselines))
    return folder


def _find(baseline: str, stated: Path | None) -> FoundModel:
    for folder, origin in candidates(baseline, stated):
        return read_model(folder, baseline, origin)
    first = models_of(baseline)[0]
    looked = [] if stated is None else [str(stated)]
    raise MissingPartError(
        "E-BASELINE-01",
        f"the model of {baseline} is missing",
        found="none in " + ", ".join([*looked, *map(str, weight_places()), HUB]),
        expected=f"a folder {baseline} or {first.name} with {CONFIG}, {PROCESSOR} and {WEIGHTS}, as {first.page}",
        hint=f"epitransfer models fetch {baseline}; or name the folder it lies in: --set {CONFIGURED}=FOLDER",
    )


def model_files(baselines: Sequence[str], folder: Path | str | None = None) -> list[Path]:
    """The files that decide what some baselines say, for a stage's staleness key.

    Args:
        baselines: As `find_models` takes them.
        folder: The value of `score.models`.

    Returns:
        Those of the models found. What is missing is told by `find_models`.
    """
    stated = None if folder is None else Path(folder).expanduser()
    folders = [next(candidates(name, stated), None) for name in baselines]
    files = [found[0] / name for found in folders if found for name in (CONFIG, PROCESSOR, WEIGHTS)]
    return [file for file in files if file.is_file()]


def candidates(baseline: str, stated: Path | None = None) -> Iterator[tuple[Path, str]]:
    """Folders that hold a model of a baseline, by their names, and who named the place; the preferred first."""
    if stated is not None and (stated / CONFIG).is_file() and _serves(stated) == baseline:
        yield stated, CONFIGURED
    named = [] if stated is None else [WeightPlace(stated, CONFIGURED)]
    for place in [*named, *weight_places()]:
        for name in (baseline, *(known.name for known in models_of(baseline))):
            if (place.path / name / CONFIG).is_file():
                yield place.path / name, place.origin
    for known in models_of(baseline):
        if (folder := in_hub_cache(known.repository)) is not None:
            yield folder, HUB


def in_hub_cache(repository: str) -> Path | None:
    """The snapshot of a repository that transformers or huggingface_hub fetched earlier."""
    if importlib.util.find_spec("huggingface_hub") is None:
        return None
    from huggingface_hub import try_to_load_from_cache  # noqa: PLC0415 - an optional part

    # Whoever only asked what a model is has its configuration there, too.
    weights = try_to_load_from_cache(repository, WEIGHTS)
    return Path(weights).parent if isinstance(weights, str) else None


def _serves(folder: Path) -> str | None:
    """The baseline that a model serves, by its architecture."""
    built = _architecture(_read_json(folder / CONFIG))
    return next((name for name, architecture in ARCHITECTURES.items() if architecture == built), None)


def read_model(folder: Path, baseline: str, origin: str) -> FoundModel:
    """What a folder holds, checked as far as it can be without building the network.

    Raises:
        InputError: It is no model of that baseline, gives relative depth, lacks a file, or a file is damaged.
    """
    config = _read_json(folder / CONFIG)
    if _architecture(config) != ARCHITECTURES[baseline]:
        raise _no_such_model(folder, ARCHITECTURES[baseline])
    kind = config.get("depth_estimation_type", "relative")
    if baseline == "depth-anything-v2" and kind != "metric":
        raise InputError(
            "E-BASELINE-03",
            "the model gives relative depth, which has no unit",
            where=str(folder / CONFIG),
            found=f"depth_estimation_type {kind!r}",
            expected="metric",
            hint=f"take one of {', '.join(known.name for known in models_of(baseline))}",
        )
    _read_json(folder / PROCESSOR)
    sha256 = _checked_weights(folder)
    check_recorded(folder, sha256)
    name = config.get("_name_or_path") or folder.name
    untrained = config.get(UNTRAINED) is True
    return FoundModel(baseline, folder, origin, ARCHITECTURES[baseline], str(name), sha256, untrained)


def _architecture(config: dict[str, Any]) -> str:
    architectures = config.get("architectures")
    return str(architectures[0]) if isinstance(architectures, list) and architectures else "none"


def _no_such_model(folder: Path, expected: str) -> InputError:
    return InputError(
        "E-BASELINE-02",
        "the folder holds another model",
        where=str(folder / CONFIG),
        found=f"architecture {_architecture(_read_json(folder / CONFIG))}",
        expected=expected,
        hint="see epitransfer models list",
    )


def _read_json(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise _incomplete(path.parent, f"no {path.name}")
    try:
        value = json.loads(path.read_bytes())
    except ValueError as error:
        raise _incomplete(path.parent, f"{path.name} is no JSON: {error}") from error
    if not isinstance(value, dict):
        raise _incomplete(path.parent, f"{path.name} is no JSON object")
    return value


def _checked_weights(folder: Path) -> str:
    """The digest of the weights, of which the header says that the file is whole."""
    from safetensors import SafetensorError, safe_open  # noqa: PLC0415 - as the networks, only where a baseline is used

    path = folder / WEIGHTS
    if not path.is_file():
        raise _incomplete(folder, f"no {WEIGHTS} (weights of other kinds may hold code and are not read)")
    try:
        with safe_open(path, framework="numpy"):
            return digest_file(path)
    except SafetensorError as error:
        raise _incomplete(folder, f"{WEIGHTS} is truncated or damaged: {error}") from error


def _incomplete(folder: Path, found: str) -> InputError:
    return InputError(
        "E-BASELINE-04",
        "the folder holds no whole model",
        where=str(folder),
        found=found,
        expected=f"{CONFIG}, {PROCESSOR} and {WEIGHTS} as published",
        hint="fetch it again: epitransfer models fetch, see epitransfer models list",
    )
