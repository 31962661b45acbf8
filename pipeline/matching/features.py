"""Local features of one image, extracted once and kept by content and settings."""

from __future__ import annotations

import hashlib
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from pipeline.geometry.arrays import AnyArray, Bytes, Floats, Ints, Singles
from pipeline.matching.images import read_grey, resized, shrunk_size, to_full_pixels
from pipeline.matching.tiles import tiles

Item = TypeVar("Item")
Result = TypeVar("Result")

# Of the pieces that an image too large for one is cut into: wider than what a feature looks at.
TILE_PX, TILE_MARGIN_PX = 2048, 128


@dataclass(frozen=True, slots=True)
class Features:
    """Features of an image.

    Args:
        pixels: (n, 2) px.
        descriptors: (n, d), of the kind the extractor makes.
        strength: (n,) the detector's response.
        scale: (n,) px of the image per unit of the extractor's own pixels.
    """

    pixels: Floats
    descriptors: AnyArray
    strength: Singles
    scale: Singles

    @classmethod
    def none(cls) -> Features:
        """Of an image without any."""
        return cls(np.empty((0, 2)), np.empty((0, 0), np.float32), np.empty(0, np.float32), np.empty(0, np.float32))

    @classmethod
    def joined(cls, parts: Sequence[Features]) -> Features:
        """Those of several parts of one image, one after the other; at least one part."""
        names = ("pixels", "descriptors", "strength", "scale")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def take(self, rows: Ints) -> Features:
        """Some of them, in the order of `rows`."""
        return Features(self.pixels[rows], self.descriptors[rows], self.strength[rows], self.scale[rows])


class Extractor(Protocol):
    """Finds features in images."""

    @property
    def settings(self) -> str:
        """All that the result depends on besides the image, as text."""

    @property
    def max_image_px(self) -> int:
        """Longest side an image is looked at."""

    @property
    def max_features(self) -> int:
        """Most features kept of an image."""

    @property
    def batch(self) -> int:
        """How many images are best looked at together."""

    def detect(self, pieces: Sequence[Bytes]) -> list[Features]:
        """Features of grey images (height, width) of one size, in their pixels; at most `max_features` of each."""


def extract(extractor: Extractor, images: Sequence[Bytes]) -> list[Features]:
    """Features of grey images, shrunk and in pieces as need be; the strongest are kept.

    Args:
        extractor: Finds them.
        images: (height, width) each.

    Returns:
        Of each image, in its pixels as given.
    """
    found: list[list[Features]] = [[] for _ in images]
    by_size: dict[tuple[int, ...], list[tuple[int, Bytes, tuple[int, int], Callable[[Floats], AnyArray]]]] = {}
    sizes = []
    for index, image in enumerate(images):
        height, width = image.shape
        size = shrunk_size(width, height, extractor.max_image_px)
        sizes.append((size, (width, height)))
        small = resized(image, size)
        for tile in tiles(*size, TILE_PX, TILE_MARGIN_PX):
            piece = tile.cut(small)
            by_size.setdefault(piece.shape, []).append((index, piece, (tile.left, tile.top), tile.owns))
    for pieces in by_size.values():
        for (index, _, corner, owns), features in zip(
            pieces, extractor.detect([piece for _, piece, _, _ in pieces]), strict=True
        ):
            placed = Features(features.pixels + corner, features.descriptors, features.strength, features.scale)
            found[index].append(placed.take(np.flatnonzero(owns(placed.pixels))))
    return [
        _in_full(_strongest(parts, extractor.max_features), *size) for parts, size in zip(found, sizes, strict=True)
    ]


def _strongest(parts: Sequence[Features], most: int) -> Features:
    full = [part for part in parts if len(part.pixels)]
    if not full:
        return Features.none()
    joined = Features.joined(full)
    return joined.take(np.argsort(-joined.strength, kind="stable")[:most])


def _in_full(features: Features, shrunk: tuple[int, int], full: tuple[int, int]) -> Features:
    factor = np.float32(full[0] / shrunk[0])
    pixels = to_full_pixels(features.pixels, shrunk, full)
    return Features(pixels, features.descriptors, features.strength, features.scale * factor)


def ahead(make: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[Result]:
    """Results in order, the next ones made in another thread while the caller works on the last one.

    Args:
        make: From item to result; decoding an image leaves the interpreter to others.
        items: What to make them from.
    """
    with ThreadPoolExecutor(1) as pool:
        source = iter(items)
        waiting = [pool.submit(make, item) for item in islice(source, 2)]
        while waiting:
            result = waiting.pop(0).result()
            waiting += [pool.submit(make, item) for item in islice(source, 1)]
            yield result


def store_features(sources: Sequence[tuple[Path | str, str]], extractor: Extractor, cache: Path) -> None:
    """Extracts and keeps the features of images that are not in the cache.

    Args:
        sources: Image file or URL, and the SHA-256 of its bytes.
        extractor: Finds the features.
        cache: Folder of cached features.

    Raises:
        InputError: An image cannot be read.
    """
    missing = [source for source in sources if _stored(_file(source[1], extractor, cache)) is None]
    decoded = ahead(read_grey, [path for path, _ in missing])
    for start in range(0, len(missing), extractor.batch):
        part = missing[start : start + extractor.batch]
        images = list(islice(decoded, len(part)))
        for (_, digest), features in zip(part, extract(extractor, images), strict=True):
            _store(features, _file(digest, extractor, cache))


def cached_features(path: Path | str, digest: str, extractor: Extractor, cache: Path) -> Features:
    """Features of an image file, from the cache when this content met these settings before.

    Args:
        path: Image file or URL.
        digest: SHA-256 of the file's bytes.
        extractor: Finds the features when they are not cached.
        cache: Folder of cached features.

    Raises:
        InputError: The image cannot be read.
    """
    file = _file(digest, extractor, cache)
    features = _stored(file)
    if features is None:
        features = extract(extractor, [read_grey(path)])[0]
        _store(features, file)
    return features


def _file(digest: str, extractor: Extractor, cache: Path) -> Path:
    name = hashlib.sha256(f"{digest} {extractor.settings}".encode()).hexdigest()
    return cache / "features" / name[:2] / f"{name}.npz"


def _stored(file: Path) -> Features | None:
    try:
        with np.load(file, allow_pickle=False) as stored:
            return Features(stored["pixels"], stored["descriptors"], stored["strength"], stored["scale"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        # Absent, or cut short by a full disk or a kill: to be made again.
        return None


def _store(features: Features, file: Path) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    # A name of its own: two photos of the same bytes may be worked on at once.
    with tempfile.NamedTemporaryFile(dir=file.parent, prefix=".", suffix=".tmp", delete=False) as stream:
        temporary = Path(stream.name)
        try:
            np.savez(
                stream,
                pixels=features.pixels,
                descriptors=features.descriptors,
                strength=features.strength,
                scale=features.scale,
            )
            stream.flush()
            temporary.replace(file)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
