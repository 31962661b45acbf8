"""Where networks run: the device asked for, and what to do when its memory is too small."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch

from pipeline.engine.errors import ResourceError, UsageError

Item = TypeVar("Item")
Result = TypeVar("Result")

NAMES = ("auto", "cpu", "cuda", "mps")


def choose_device(name: str) -> torch.device:
    """The device a network is to run on.

    Args:
        name: "cpu", "cuda" (also "cuda:1"), "mps"; or "auto": the first of cuda, mps and cpu that is there.

    Raises:
        ResourceError: The named device is not there.
        UsageError: The name is none of these.
    """
    kind, _, number = name.partition(":")
    if kind not in NAMES or (number and not (kind == "cuda" and number.isdecimal())):
        raise UsageError("E-DEVICE-01", "no such device", found=name, expected=", ".join(NAMES))
    there = _there()
    if kind == "auto":
        return torch.device(there[0])
    if kind not in there or (number and int(number) >= torch.cuda.device_count()):
        raise ResourceError(
            "E-DEVICE-02",
            f"the device {name} is not there",
            found=f"{', '.join(there)}; torch {torch.__version__}",
            expected=name,
            hint='take "auto" or "cpu"; for a GPU, torch must be built for it',
        )
    return torch.device(name)


def _there() -> list[str]:
    has = (("cuda", torch.cuda.is_available()), ("mps", torch.backends.mps.is_available()), ("cpu", True))
    return [kind for kind, is_there in has if is_there]


def in_batches(
    run: Callable[[Sequence[Item], torch.device], Sequence[Result]],
    items: Sequence[Item],
    device: torch.device,
    batch: int,
    notes: list[str],
) -> list[Result]:
    """Runs items through a network in batches that fit into the device's memory.

    A batch that does not fit is halved, down to one item; an item that does not fit alone, and all after it, go to
    the CPU.

    Args:
        run: One result for every item of a batch, in its order; it is to move the network to the device it is told.
        items: What to run.
        device: Where to run it.
        batch: Most items at once.
        notes: Gets a sentence for the user when anything ran otherwise than asked.

    Returns:
        One result for every item, in order.

    Raises:
        ResourceError: An item does not fit into the CPU's memory either.
    """
    results: list[Result] = []
    asked = max(1, batch)
    batch = asked
    while len(results) < len(items):
        part = items[len(results) : len(results) + batch]
        try:
            done = run(part, device)
        except (RuntimeError, MemoryError) as error:
            if not _is_out_of_memory(error):
                raise
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        else:
            results.extend(done)
            continue
        # Outside of the handler: the traceback would hold the tensors that are in the way.
        _empty_cache(device)
        if len(part) > 1:
            batch = len(part) // 2
            notes.append(f"{device} ran out of memory: batches of {batch} instead of {len(part)}")
        elif device.type == "cpu":
            raise ResourceError(
                "E-DEVICE-03",
                "not enough memory for the network",
                found=reason,
                hint="match at a smaller size, or with fewer jobs at once",
            )
        else:
            rest = len(items) - len(results)
            notes.append(f"{device} ran out of memory: {rest} of {len(items)} items went to the CPU, which is slower")
            device, batch = torch.device("cpu"), asked
    return results


def _is_out_of_memory(error: Exception) -> bool:
    """Whether an error is about memory; libraries under torch tell it in words of their own."""
    words = ("out of memory", "can't allocate memory", "alloc_failed")
    return isinstance(error, torch.OutOfMemoryError | MemoryError) or any(w in str(error).lower() for w in words)


def _empty_cache(device: torch.device) -> None:
    if device.type == "cuda" and torch.cuda.is_available():
        torch.cuda.empty_cache()
    elif device.type == "mps" and torch.backends.mps.is_available():
        torch.mps.empty_cache()


def device_in_words() -> str:
    """What networks run on by themselves: the GPU's name, "mps", or "cpu only"."""
    kind = _there()[0]
    return torch.cuda.get_device_name() if kind == "cuda" else {"cpu": "cpu only"}.get(kind, kind)
