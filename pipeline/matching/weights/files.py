"""Weights of the networks: which files are known, where they are looked for, and how they are loaded."""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import re
import struct
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import platformdirs

from pipeline.engine.digests import digest_file
from pipeline.engine.errors import InputError, MissingPartError
from pipeline.matching.weights.known import KNOWN, KnownWeights

if TYPE_CHECKING:
    import torch

VARIABLE = "EPITRANSFER_WEIGHTS"
CONFIGURED = "match.weights"
_STATED = "#sha256="
# A file of the user's own says by its name which network it is for; the longer names first.
_FAMILIES = ("lighterglue", "raft", "xfeat")
_SHOWN_KEYS = 3
# What a damaged file can raise while it is unpickled, besides being refused.
_DAMAGED = (
    pickle.UnpicklingError, RuntimeError, EOFError, LookupError, ValueError, TypeError, AttributeError, AssertionError,
    ArithmeticError, struct.error,
)  # fmt: skip

Configured = str | Sequence[str]


@dataclass(frozen=True, slots=True)
class WeightPlace:
    """A folder, or a file that the configuration names, in which weights are looked for.

    Args:
        path: Folder or file.
        origin: Who named it: "match.weights", "$EPITRANSFER_WEIGHTS", "cache".
        sha256: What the user states a file's digest to be; "" where he does not.
    """

    path: Path
    origin: str
    sha256: str = ""

    def __str__(self) -> str:
        return f"{self.path} ({self.origin}{'' if self.path.exists() else ', absent'})"


@dataclass(frozen=True, slots=True)
class FoundWeights:
    """A file of weights, not yet read.

    Args:
        path: The file.
        network: The network it is for; "" where neither its name nor what was asked for says.
        sha256: The digest it has to have; "" for a file of the user's own without a stated digest.
        known: Its entry among the known files, if its digest is to be that entry's.
    """

    path: Path
    network: str
    sha256: str
    known: KnownWeights | None


def cache_folder() -> Path:
    """The user's folder of fetched weights."""
    return Path(platformdirs.user_cache_dir("epitransfer", appauthor=False)) / "weights"


def weight_places(configured: Configured = ()) -> list[WeightPlace]:
    """Where weights are looked for, in this order: the configuration, the environment, the user's cache.

    Args:
        configured: The value of `match.weights`: folders, files, or `FILE#sha256=HEX` for files of the user's own.

    Raises:
        InputError: A stated digest is none.
    """
    texts = (configured,) if isinstance(configured, str) else tuple(configured)
    named = [_configured_place(text) for text in texts if text]
    folders = [folder for folder in os.environ.get(VARIABLE, "").split(os.pathsep) if folder]
    return [
        *named,
        *(WeightPlace(Path(folder).expanduser(), f"${VARIABLE}") for folder in folders),
        WeightPlace(cache_folder(), "cache"),
    ]


def _configured_place(text: str) -> WeightPlace:
    path, marked, digest = text.partition(_STATED)
    if marked and not re.fullmatch(r"[0-9a-fA-F]{64}", digest):
        raise InputError(
            "E-WEIGHTS-05",
            "the stated digest is no SHA-256",
            where=f"{CONFIGURED}={text}",
            found=f"{len(digest)} characters",
            expected="64 hexadecimal digits",
        )
    if marked and Path(path).expanduser().is_dir():
        raise InputError(
            "E-WEIGHTS-05",
            "a digest is stated of a folder",
            where=f"{CONFIGURED}={text}",
            expected="a digest goes with a file",
            hint="name the file, or leave the digest out: known files in a folder are checked anyway",
        )
    return WeightPlace(Path(path).expanduser(), CONFIGURED, digest.lower())


def find_weights(networks: str | Sequence[str], configured: Configured = ()) -> FoundWeights:
    """The file that holds a network's weights, by its name, and what its digest has to be.

    A file that the configuration names itself may have any name. One that tells no network ("lighterglue", "raft",
    "xfeat") is taken for whichever is asked for.

    Args:
        networks: One network, or several of which the first found is taken, the preferred first.
        configured: The value of `match.weights`.

    Raises:
        InputError: The configuration names a file or folder that does not exist, or a file that is no known one and
            whose digest it does not state.
        MissingPartError: No file of these networks is in any of the places.
    """
    wanted = _as_tuple(networks)
    places = weight_places(configured)
    for place in places:
        if place.origin == CONFIGURED and not place.path.exists():
            raise no_such_file(place.path, where=CONFIGURED)
        for found in _in_place(place, wanted):
            if not found.sha256:
                raise _of_unknown_origin(found, digest_file(found.path))
            return found
    files = [known for known in KNOWN if known.network in wanted]
    fetchable = [known.network for known in files if known.url]
    by_hand = f"put {files[0].file if files else 'the file'} into {places[-1].path}"
    raise MissingPartError(
        "E-WEIGHTS-01",
        f"the weights of {' or '.join(wanted)} are missing",
        found="none in " + ", ".join(map(str, places)),
        expected=" or ".join(known.file for known in files),
        hint=(f"epitransfer models fetch {fetchable[0]}" if fetchable else by_hand)
        + f"; or name the folder they lie in: --set {CONFIGURED}=FOLDER",
    )


def weight_files(networks: Iterable[str | Sequence[str]], configured: Configured = ()) -> list[Path]:
    """The files that decide what some networks compute, for a stage's staleness key.

    Args:
        networks: As `NETWORKS_OF` gives them for a matcher; each as `find_weights` takes it.
        configured: The value of `match.weights`.

    Returns:
        Those found. What is missing is told by who loads it.
    """
    found = []
    for wanted in networks:
        for place in weight_places(configured):
            hits = _in_place(place, _as_tuple(wanted))
            if (hit := next(hits, None)) is not None:
                found.append(hit.path)
                break
    return found


def all_weights(configured: Configured = ()) -> list[FoundWeights]:
    """Every known file in every place."""
    networks = tuple(dict.fromkeys(known.network for known in KNOWN))
    return [found for place in weight_places(configured) for found in _in_place(place, networks)]


def identified(path: Path, sha256: str = "") -> FoundWeights:
    """What a file is, by its name, else by its digest.

    Args:
        path: The file.
        sha256: What the user states its digest to be.
    """
    known = next((known for known in KNOWN if known.file == path.name), None)
    if known is None and not sha256:
        digest = digest_file(path)
        known = next((known for known in KNOWN if known.sha256 == digest), None)
    network = known.network if known else ""
    if known is None or (sha256 and sha256 != known.sha256):
        return FoundWeights(path, network, sha256, None)
    return FoundWeights(path, network, known.sha256, known)


def _as_tuple(networks: str | Sequence[str]) -> tuple[str, ...]:
    return (networks,) if isinstance(networks, str) else tuple(networks)


def _in_place(place: WeightPlace, wanted: tuple[str, ...]) -> Iterator[FoundWeights]:
    if place.path.is_file():
        found = identified(place.path, place.sha256)
        if found.network in wanted:
            yield found
        elif not found.network and (serves := _served(place.path.name, wanted)):
            yield FoundWeights(found.path, serves[0] if len(serves) == 1 else "", found.sha256, None)
        return
    for known in KNOWN:
        path = place.path / known.file
        if known.network in wanted and path.is_file():
            yield FoundWeights(path, known.network, known.sha256, known)


def _served(name: str, wanted: tuple[str, ...]) -> tuple[str, ...]:
    family = next((family for family in _FAMILIES if family in name.lower()), "")
    return tuple(network for network in wanted if network.startswith(family))


def no_such_file(path: Path, *, where: str = "") -> InputError:
    """The error of a named file that does not exist."""
    return InputError(
        "E-WEIGHTS-05",
        "the weights that are named do not exist",
        where=where,
        found=f"no file or folder {path}",
        hint="give a folder, a file, or FILE#sha256=HEX",
    )


# --- checking and loading ---


def check_weights(found: FoundWeights, data: bytes) -> None:
    """Compares a file's bytes with what is known or stated of them.

    Args:
        found: What they have to be.
        data: The whole file.

    Raises:
        InputError: Nothing is known of the file, it is cut short, or it differs.
    """
    digest = hashlib.sha256(data).hexdigest()
    if not found.sha256:
        raise _of_unknown_origin(found, digest)
    if digest == found.sha256:
        return
    size = found.known.size_bytes if found.known else None
    truncated = size is not None and len(data) < size
    origin = found.known.network if found.known and found.known.url else ""
    again = f"fetch it again: epitransfer models fetch {origin}" if origin else "copy it again"
    own = f"; if the file is your own: --set {CONFIGURED}={found.path}{_STATED}{digest}"
    raise InputError(
        "E-WEIGHTS-02",
        "the weights are truncated" if truncated else "the weights are not what they should be",
        where=str(found.path),
        found=f"{len(data)} bytes, sha256 {digest}",
        expected=(f"{size} bytes, " if size is not None else "") + f"sha256 {found.sha256}",
        # A file that is cut short is nobody's own.
        hint=again if truncated else again + own,
    )


def _of_unknown_origin(found: FoundWeights, digest: str) -> InputError:
    return InputError(
        "E-WEIGHTS-06",
        "weights of unknown origin are not loaded unless their digest is stated",
        where=str(found.path),
        found=f"sha256 {digest}, which is no known file's",
        expected="a known file (epitransfer models list), or a stated digest",
        hint=f"if you trust the file: --set {CONFIGURED}={found.path}{_STATED}{digest}",
    )


def load_state(found: FoundWeights) -> dict[str, torch.Tensor]:
    """The tensors of a file of weights, its digest checked first; code in it is never executed.

    Args:
        found: As `find_weights` gives it.

    Returns:
        Tensors by name, on the CPU.

    Raises:
        InputError: The file is gone, cut short, not the expected one, damaged, or holds more than named tensors.
    """
    try:
        data = found.path.read_bytes()
    except (FileNotFoundError, IsADirectoryError) as error:
        raise no_such_file(found.path) from error
    # What is checked is what is loaded, even if the file changes meanwhile.
    check_weights(found, data)
    state = _read_safetensors(found.path, data) if found.path.suffix == ".safetensors" else _read_torch(found, data)
    return _named_tensors(found.path, state)


def _read_safetensors(path: Path, data: bytes) -> Any:
    from safetensors import SafetensorError  # noqa: PLC0415 - as torch
    from safetensors.torch import load  # noqa: PLC0415 - as torch

    try:
        return load(data)
    except (SafetensorError, *_DAMAGED) as error:
        raise _unreadable(path, str(error)) from error


def _read_torch(found: FoundWeights, data: bytes) -> Any:
    import torch  # noqa: PLC0415 - takes seconds, and only networks need it

    try:
        with warnings.catch_warnings():
            # They are about pickles of other kinds, which are refused.
            warnings.simplefilter("ignore")
            return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except _DAMAGED as error:
        text = str(error)
        code = re.search(r"(?i)unsupported (?:global|class)\W+(?:GLOBAL )?([\w.]+)", text)
        told = f"a call of {code[1]}" if code else f"{type(error).__name__} {text.splitlines()[0] if text else ''}"
        raise _unreadable(found.path, told, harmful=code is not None) from error


def _unreadable(path: Path, found: str, *, harmful: bool = False) -> InputError:
    return InputError(
        "E-WEIGHTS-03",
        "the file holds code, which was not executed" if harmful else "the file cannot be read as weights",
        where=str(path),
        found=found[:300].rstrip(". ") + ("" if harmful else "; nothing in it was executed"),
        expected="tensors by name, as torch.save or safetensors write a state_dict",
        hint="do not use this file" if harmful else "fetch or convert it again",
    )


def _named_tensors(path: Path, state: Any) -> dict[str, torch.Tensor]:
    import torch  # noqa: PLC0415 - as above

    if not isinstance(state, dict):
        raise _unreadable(path, f"a {type(state).__name__}")
    for name, value in state.items():
        if not (isinstance(name, str) and isinstance(value, torch.Tensor)):
            raise _unreadable(path, f"{name!r} is a {type(value).__name__}")
    if not state:
        raise _unreadable(path, "no tensors")
    return dict(state)


def strict_load(module: torch.nn.Module, state: dict[str, torch.Tensor], found: FoundWeights) -> None:
    """Puts tensors into a network that must have exactly these.

    Args:
        module: The network, changed in place.
        state: Tensors by the network's own names.
        found: The file they come from.

    Raises:
        InputError: Tensors are missing, left over, or of another shape.
    """
    own = {name: tuple(value.shape) for name, value in module.state_dict().items()}
    given = {name: tuple(value.shape) for name, value in state.items()}
    told = [
        _keys("missing", [name for name in own if name not in given]),
        _keys("unexpected", [name for name in given if name not in own]),
        _keys("of another shape", [name for name in own if name in given and given[name] != own[name]]),
    ]
    if any(told):
        raise wrong_network(found, found.network or type(module).__name__, list(filter(None, told)))
    module.load_state_dict(state, strict=True)


def wrong_network(found: FoundWeights, network: str, told: Sequence[str]) -> InputError:
    """The error of a file whose tensors are those of another network.

    Args:
        found: The file.
        network: The network it was to be for.
        told: Names of its tensors, or what is wrong with them; the first few are shown.
    """
    return InputError(
        "E-WEIGHTS-04",
        f"the file holds other weights than those of {network}",
        where=str(found.path),
        found="; ".join(told[:_SHOWN_KEYS]),
        expected=f"the tensors of {network}",
        hint=f"a file's name should tell its network ({', '.join(_FAMILIES)}); see epitransfer models list",
    )


def _keys(what: str, names: list[str]) -> str:
    if not names:
        return ""
    more = f" and {len(names) - _SHOWN_KEYS} more" if len(names) > _SHOWN_KEYS else ""
    return f"{what}: {', '.join(names[:_SHOWN_KEYS])}{more}"
