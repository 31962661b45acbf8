"""What the user is told of the baselines' models: which are known, where they lie, whether they are as published."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from pipeline.engine.errors import InputError
from pipeline.matching.weights.files import weight_places
from pipeline.monodepth.found import candidates, in_hub_cache
from pipeline.monodepth.known import BASELINES, CONFIG, KNOWN_MODELS, KnownModel, models_of
from pipeline.monodepth.published import check_recorded, recorded_digests


@dataclass(frozen=True, slots=True)
class JudgedModel:
    """A model's folder, compared with the digests that came with it.

    Args:
        folder: Where it lies.
        verdict: "ok", "differs", or "unstated" where no digest came with it.
        error: What differs.
    """

    folder: Path
    verdict: str
    error: InputError | None = None


def model_lines() -> list[str]:
    """The known models by baseline, and which would be taken, as lines of text."""
    lines = []
    for baseline in BASELINES:
        taken = f"takes {folder}" if (folder := _taken(baseline)) else "missing"
        lines.append(f"{baseline}  (baseline of score: {taken}; sha256 as stated by the publisher when fetched)")
        for known in models_of(baseline):
            size = f"{known.size_mb} MB"
            lines += [
                f"  {known.name:<42}{size:<9}{known.licence:<14}{_where(known) or 'missing'}",
                f"    scenes  {known.scenes}{f'; {known.note}' if known.note else ''}",
                f"    address {known.page}",
            ]
    return lines


def described_models() -> list[dict[str, object]]:
    """The known models, as JSON."""
    return [
        {
            "baseline": known.baseline,
            "name": known.name,
            "found": str(where) if (where := _where(known)) else None,
            "megabytes": known.size_mb,
            "licence": known.licence,
            "source": known.repository,
            "scenes": known.scenes,
            "url": known.page,
            "note": known.note,
        }
        for known in KNOWN_MODELS
    ]


def states_of_baselines() -> dict[str, str]:
    """For each baseline, the folder that would be taken, or the command that fetches one."""
    return {name: str(_taken(name) or f"missing: epitransfer models fetch {name}") for name in BASELINES}


def _taken(baseline: str) -> Path | None:
    return next((folder for folder, _ in candidates(baseline)), None)


def _where(known: KnownModel) -> Path | None:
    folders = [place.path / known.name for place in weight_places()]
    return next((folder for folder in folders if (folder / CONFIG).is_file()), in_hub_cache(known.repository))


def model_folders(named: Path | None = None) -> list[Path]:
    """Folders of models.

    Args:
        named: One itself, or a folder that holds some; None for every place that is looked in.
    """
    if named is not None and (named / CONFIG).is_file():
        return [named]
    found = [folder for baseline in BASELINES for folder, _ in candidates(baseline, named)]
    return [folder for folder in dict.fromkeys(found) if named is None or folder.parent == named]


def judged(folders: Iterable[Path]) -> list[JudgedModel]:
    """Compares models with the digests that came with them."""
    return [_judged(folder) for folder in folders]


def _judged(folder: Path) -> JudgedModel:
    if not recorded_digests(folder):
        return JudgedModel(folder, "unstated")
    try:
        check_recorded(folder)
    except InputError as error:
        return JudgedModel(folder, "differs", error)
    return JudgedModel(folder, "ok")
