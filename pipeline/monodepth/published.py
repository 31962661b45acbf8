"""A published model's files: fetched with the digests that the publisher states, which are kept beside them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.engine.digests import digest_bytes, digest_file
from pipeline.engine.errors import InputError
from pipeline.engine.progress import Reporter
from pipeline.matching.weights.known import KnownWeights
from pipeline.monodepth.known import CONFIG, PROCESSOR, WEIGHTS, KnownModel

RECORD = "published.json"


@dataclass(frozen=True, slots=True)
class FetchedFile:
    """A file of a model that lies in its folder.

    Args:
        path: Where.
        fresh: Whether it had to be fetched.
        stated: Whether the publisher states its digest; else it is the one it had when it was fetched.
    """

    path: Path
    fresh: bool
    stated: bool


def fetch_model(known: KnownModel, folder: Path, reporter: Reporter) -> Iterator[FetchedFile]:
    """Fetches a model into a folder of its name; one that is there, with its recorded digests, is left as it is.

    The weights are resumed where a connection was cut. The configuration comes last: a folder without it is no model.

    Args:
        known: Which.
        folder: Where to make its folder.
        reporter: Shows the progress.

    Yields:
        Its files.

    Raises:
        InputError: The address has no such file, states no digest, or gives another file than it states.
        ResourceError: The address cannot be reached, or the connection was cut.
    """
    # requests takes a while to import.
    from pipeline.matching.weights.fetching import fetch, fetch_small, stated_of  # noqa: PLC0415

    target = folder / known.name
    recorded = recorded_digests(target)
    if recorded and all(_differs(target / name, digest) is None for name, digest in recorded.items()):
        for name in recorded:
            yield FetchedFile(target / name, fresh=False, stated=name == WEIGHTS)
        return
    stated = stated_of(known.url(WEIGHTS), target / WEIGHTS)
    revision = stated.revision or "main"
    weights = KnownWeights(
        known.baseline, WEIGHTS, stated.sha256, stated.size_bytes, known.licence, known.page,
        known.url(WEIGHTS, revision),
    )  # fmt: skip
    for fetched in fetch([weights], target, reporter):
        yield FetchedFile(fetched.path, fetched.fresh, stated=True)
    small = {name: fetch_small(known.url(name, revision), target / name) for name in (PROCESSOR, CONFIG)}
    digests = {WEIGHTS: stated.sha256, **{name: digest_bytes(data) for name, data in small.items()}}
    record = {"repository": known.repository, "revision": revision, "stated": [WEIGHTS], "sha256": digests}
    (target / RECORD).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    for name, data in small.items():
        part = target / f"{name}.part"
        part.write_bytes(data)
        part.replace(target / name)
        yield FetchedFile(target / name, fresh=True, stated=False)


def recorded_digests(folder: Path) -> dict[str, str]:
    """Digests of a model's files by name, as they were when it was fetched; empty where nothing tells them.

    The Hugging Face cache names the files that it links to by the publisher's digests.
    """
    try:
        digests = json.loads((folder / RECORD).read_bytes())["sha256"]
        return {name: str(digests[name]) for name in (WEIGHTS, PROCESSOR, CONFIG)}
    except (OSError, ValueError, LookupError, TypeError):
        linked = (folder / WEIGHTS).resolve().name
        return {WEIGHTS: linked} if re.fullmatch("[0-9a-f]{64}", linked) else {}


def check_recorded(folder: Path, weights_sha256: str | None = None) -> None:
    """Compares a model's files with their recorded digests, if there are any.

    Args:
        folder: Where it lies.
        weights_sha256: The digest of its weights, where that is known already.

    Raises:
        InputError: A file differs, or is gone.
    """
    for name, digest in recorded_digests(folder).items():
        error = _differs(folder / name, digest, weights_sha256 if name == WEIGHTS else None)
        if error:
            raise error


def _differs(path: Path, expected: str, found: str | None = None) -> InputError | None:
    found = found or (digest_file(path) if path.is_file() else "no file")
    if found == expected:
        return None
    return InputError(
        "E-BASELINE-08",
        "a file of the model is not the one that was published",
        where=str(path),
        found=found if found == "no file" else f"sha256 {found}",
        expected=f"sha256 {expected}" + (", as stated by the publisher" if path.name == WEIGHTS else ""),
        hint=f"fetch it again: epitransfer models fetch {path.parent.name}",
    )
