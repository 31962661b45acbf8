"""The images of pairs as views to be matched: each decoded once for the pairs that follow one another."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.geometry.arrays import Bytes
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import Pose
from pipeline.matching.features import Features, ahead, cached_features
from pipeline.matching.images import read_colour, read_grey
from pipeline.matching.matcher import Matcher, View

# Decoded images at hand: pairs come in the order of their ref frame, and its neighbours are theirs too.
_AT_HAND = 4


@dataclass(frozen=True, slots=True)
class Source:
    """An image that can be matched.

    Args:
        path: File or URL.
        digest: SHA-256 of its bytes.
        camera: Its camera.
        pose: Its logged pose.
    """

    path: str
    digest: str
    camera: Camera
    pose: Pose


def views(pairs: Sequence[tuple[Source, Source]], matcher: Matcher, cache: Path) -> Iterator[tuple[View, View]]:
    """Views of pairs in order, the next pair's made while the caller works on the last one.

    Args:
        pairs: Ref and src image of each.
        matcher: Tells whether it looks at colours, and what finds the features.
        cache: Folder of cached features.

    Raises:
        InputError: An image cannot be read.
    """
    decoded: OrderedDict[str, Bytes] = OrderedDict()
    read = read_colour if matcher.colour else read_grey

    def image(path: str) -> Bytes:
        found = decoded.pop(path, None)
        decoded[path] = read(path) if found is None else found
        while len(decoded) > _AT_HAND:
            decoded.popitem(last=False)
        return decoded[path]

    def view(source: Source) -> View:
        extractor = matcher.extractor
        features = (
            cached_features(source.path, source.digest, extractor, cache) if extractor is not None else Features.none()
        )
        return View(source.camera, image(source.path), features)

    return ahead(lambda pair: (view(pair[0]), view(pair[1])), pairs)
