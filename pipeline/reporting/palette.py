"""Names and colours of the methods, the same in every table and figure; colours that stand on light and on dark."""

from __future__ import annotations

from collections.abc import Iterable

LABELS = {
    "epitransfer": "EpiTransfer",
    "dlt": "Triangulation (DLT)",
    "zoedepth": "ZoeDepth",
    "depth-anything-v2": "Depth Anything V2",
    "epitransfer-lateral": "EpiTransfer, lateral view",
    "epitransfer-vertical": "EpiTransfer, vertical view",
}
_COLOURS = {
    "epitransfer": "#2f7fd1",
    "dlt": "#e0822b",
    "zoedepth": "#2f9e77",
    "depth-anything-v2": "#b562b8",
    "epitransfer-lateral": "#8ab4e0",
    "epitransfer-vertical": "#5b93a8",
}
TAKES = ("#2f7fd1", "#e0822b", "#2f9e77", "#b562b8", "#c9a227", "#5b93a8", "#7b86d6", "#a0703c")
_SPARE = ("#c9a227", "#d1556b", "#7b86d6", "#8f9aa3")
GOOD, BAD, QUIET = "#2f9e77", "#d1556b", "#8f9aa3"


def label(method: str) -> str:
    """What a method is called in the report."""
    return LABELS.get(method, method)


def in_order(methods: Iterable[str]) -> list[str]:
    """Methods in the paper's order, then those it does not have."""
    known = list(LABELS)
    return sorted(methods, key=lambda name: (known.index(name) if name in known else len(known), name))


def colours(methods: Iterable[str]) -> dict[str, str]:
    """A colour for each method; those without one of their own take the spare ones in order."""
    listed = list(methods)
    unknown = [name for name in listed if name not in _COLOURS]
    spare = {name: _SPARE[i % len(_SPARE)] for i, name in enumerate(unknown)}
    return {name: _COLOURS.get(name) or spare[name] for name in listed}
