"""What the user is told of a known file of weights."""

from __future__ import annotations

from pathlib import Path

from pipeline.matching.weights.known import KnownWeights, matchers_of


def described(known: KnownWeights, path: Path | None) -> dict[str, object]:
    """A known file, and where it lies, as JSON."""
    return {
        "network": known.network,
        "file": known.file,
        "matchers": matchers_of(known.network),
        "found": str(path) if path else None,
        "bytes": known.size_bytes,
        "licence": known.licence,
        "source": known.source,
        "url": known.url,
        "member": known.member,
        "sha256": known.sha256,
        "note": known.note,
    }


def file_lines(known: KnownWeights, path: Path | None) -> list[str]:
    """A known file, and where it lies, as lines of text."""
    size = f"{known.size_bytes / 1e6:.1f} MB" if known.size_bytes else ""
    member = f", {known.member} in it" if known.member else ""
    return [
        f"  {known.file:<42}{size:<9}{known.licence:<14}{path or 'missing'}",
        f"    from    {known.source}{f'; {known.note}' if known.note else ''}",
        f"    address {known.url}{member}" if known.url else "    address none: put the file into a folder by hand",
        f"    sha256  {known.sha256}",
    ]
