"""models: the networks' weights: which there are, where they lie, fetched and verified."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from pipeline.engine.errors import InputError, UsageError
from pipeline.engine.progress import Reporter
from pipeline.matching.weights.files import (
    CONFIGURED,
    VARIABLE,
    FoundWeights,
    all_weights,
    cache_folder,
    check_weights,
    identified,
    no_such_file,
    weight_places,
)
from pipeline.matching.weights.known import KNOWN, NETWORKS_OF, KnownWeights, matchers_of
from pipeline.matching.weights.telling import described, file_lines
from pipeline.monodepth.found import CONFIGURED as MODELS_CONFIGURED
from pipeline.monodepth.found import HUB
from pipeline.monodepth.known import BASELINES, known_model
from pipeline.monodepth.published import fetch_model
from pipeline.monodepth.telling import described_models, judged, model_folders, model_lines

AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]

app = typer.Typer(add_completion=False, no_args_is_help=True, rich_markup_mode=None, help="Weights of the networks.")


@app.command("list")
def show(as_json: AsJson = False) -> None:
    """Tells which weights are known, and where they lie."""
    paths: dict[str, Path] = {}
    for found in all_weights():
        if found.known:
            paths.setdefault(found.known.file, found.path)
    places = weight_places()
    if as_json:
        files = [described(known, paths.get(known.file)) for known in KNOWN]
        looked = [{"folder": str(place.path), "origin": place.origin} for place in places]
        typer.echo(json.dumps({"looked_in": looked, "files": files, "models": described_models()}))
        return
    for network in dict.fromkeys(known.network for known in KNOWN):
        typer.echo(f"{network}  (matchers: {', '.join(matchers_of(network))})")
        for known in (known for known in KNOWN if known.network == network):
            typer.echo("\n".join(file_lines(known, paths.get(known.file))))
    typer.echo("\n".join(model_lines()))
    typer.echo("looked in")
    for place in places:
        typer.echo(f"  {place}")
    typer.echo(f"and in what ${VARIABLE} and {CONFIGURED} name; for baselines in what {MODELS_CONFIGURED} names and")
    typer.echo(f"in the {HUB}")


@app.command()
def fetch(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="MATCHER|NETWORK|FILE|BASELINE|MODEL",
            help="All a matcher needs, a network's or baseline's preferred file or model, or a file or model.",
        ),
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="Every file of the matchers that has an address.")] = False,
    to: Annotated[
        Path | None, typer.Option(metavar="FOLDER", file_okay=False, help="Where to; the user's cache by default.")
    ] = None,
) -> None:
    """Fetches weights, and keeps what has the right digest."""
    from pipeline.matching.weights.fetching import fetch as fetch_files  # noqa: PLC0415 - slow, and needed here only

    if bool(names) == everything:
        raise UsageError("E-WEIGHTS-10", "name networks or files, or --all", expected=_choices())
    models = [model for name in names or () if (model := known_model(name))]
    networks = [network for name in names or () if not known_model(name) for network in _networks_of(name)]
    wanted = [known for known in KNOWN if known.url] if everything else [_wanted(name) for name in networks]
    folder = to or cache_folder()
    for fetched in fetch_files(wanted, folder, Reporter(sys.stderr)):
        typer.echo(f"{fetched.path}: {'fetched, ' if fetched.fresh else 'already there, '}sha256 verified")
    for model in models:
        for file in fetch_model(model, folder, Reporter(sys.stderr)):
            told = "sha256 verified, as stated by the publisher" if file.stated else "sha256 recorded"
            typer.echo(f"{file.path}: {'fetched, ' if file.fresh else 'already there, '}{told}")
    if folder.resolve() not in {place.path.resolve() for place in weight_places()}:
        keys = [key for key, fetched in ((CONFIGURED, wanted), (MODELS_CONFIGURED, models)) if fetched]
        stated = " ".join(f"--set {key}={folder}" for key in keys)
        sys.stderr.write(f"not a place that is looked in by itself: state {stated}\n")


def _networks_of(name: str) -> list[str]:
    """What a matcher needs, of alternatives the preferred; any other name stands for itself."""
    known = name in {entry.network for entry in KNOWN}
    return [name] if known or name not in NETWORKS_OF else [alternatives[0] for alternatives in NETWORKS_OF[name]]


def _wanted(name: str) -> KnownWeights:
    named = [known for known in KNOWN if name in {known.network, known.file}]
    for known in named:
        if known.url:
            return known
    if named:
        raise UsageError(
            "E-WEIGHTS-10",
            f"{name} has no address to fetch it from",
            found=named[0].source,
            hint=f"put it into {cache_folder()}, or name its folder: --set {CONFIGURED}=FOLDER",
        )
    raise UsageError("E-WEIGHTS-10", f"no network or file {name}", expected=_choices())


def _choices() -> str:
    networks = dict.fromkeys(known.network for known in KNOWN)
    return f"{', '.join((*networks, *BASELINES))}, or a file or model of theirs (epitransfer models list)"


@app.command()
def verify(
    files: Annotated[
        list[str] | None, typer.Argument(metavar="FILE[#sha256=HEX]|FOLDER", help="All that are found, by default.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compares weights with their digests; exit code 3 if one differs."""
    found = _named(files) if files else all_weights()
    errors = [_error(entry) for entry in found]
    folders = [
        folder for path in files or (None,) for folder in model_folders(Path(path).expanduser() if path else None)
    ]
    models = judged(folders)
    if as_json:
        rows = [_judged(entry, error) for entry, error in zip(found, errors, strict=True)]
        told = [{"path": str(model.folder), "verdict": model.verdict} for model in models]
        typer.echo(json.dumps({"files": rows, "models": told}))
    else:
        for entry, error in zip(found, errors, strict=True):
            typer.echo(f"{'differs' if error else 'ok':<9}{entry.path}")
        for model in models:
            typer.echo(f"{model.verdict:<9}{model.folder}")
        if not found and not models:
            typer.echo(f"nothing to verify: no known weights in {', '.join(map(str, weight_places()))}")
    _raise_first([*errors, *(model.error for model in models)])


def _named(files: Sequence[str]) -> list[FoundWeights]:
    # Named files are read as the configuration's are.
    named = [place for place in weight_places(files) if place.origin == CONFIGURED]
    out = []
    for place in named:
        if not place.path.exists():
            raise no_such_file(place.path)
        inside = [place.path / known.file for known in KNOWN] if place.path.is_dir() else [place.path]
        out += [identified(path, place.sha256) for path in inside if path.is_file()]
    return out


def _error(found: FoundWeights) -> InputError | None:
    try:
        check_weights(found, found.path.read_bytes())
    except InputError as error:
        return error
    return None


def _judged(found: FoundWeights, error: InputError | None) -> dict[str, object]:
    known = found.known.file if found.known else None
    told = {"found": error.found, "expected": error.expected} if error else {}
    return {"path": str(found.path), "network": found.network or None, "known_as": known, "ok": error is None, **told}


def _raise_first(errors: Iterable[InputError | None]) -> None:
    for error in errors:
        if error:
            raise error
