"""Local features of one image, extracted once and kept by content and settings."""

from __future__ import annotations

import hashlib
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from pipeline.geometry.arrays import Bytes, Floats
from pipeline.matching.images import read_grey, shrunk_size, to_full_pixels


@dataclass(frozen=True, slots=True)
class Features:
    """Features of an image.

    Args:
        pixels: (n, 2) px of the image as given.
        descriptors: (n, d) uint8; RootSIFT is the square root of their L1-normalised values.
    """

    pixels: Floats
    descriptors: Bytes


class Extractor(Protocol):
    """Finds features in one image."""

    @property
    def settings(self) -> str:
        """All that the result depends on besides the image, as text."""

    def extract(self, grey: Bytes) -> Features:
        """Features of a grey image (height, width)."""


@dataclass(frozen=True, slots=True)
class SiftExtractor:
    """SIFT, the strongest features first.

    Args:
        max_image_px: Longest side the image is matched at.
        max_features: Most features kept.
        contrast: Detection threshold.
    """

    max_image_px: int
    max_features: int = 8192
    contrast: float = 0.02

    @property
    def settings(self) -> str:
        """As `Extractor.settings`."""
        return f"sift-4 {cv2.__version__} {self.max_image_px} {self.max_features} {self.contrast}"

    def extract(self, grey: Bytes) -> Features:
        """As `Extractor.extract`."""
        height, width = grey.shape
        size = shrunk_size(width, height, self.max_image_px)
        small = grey if size == (width, height) else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
        # Without the precise upscale every keypoint lies a quarter of a pixel too far right and down.
        detector = cv2.SIFT.create(
            nfeatures=self.max_features, contrastThreshold=self.contrast, enable_precise_upscale=True
        )
        keypoints, descriptors = detector.detectAndCompute(np.asarray(small, np.uint8), None)
        if descriptors is None or not keypoints:
            return Features(np.empty((0, 2)), np.empty((0, 128), np.uint8))
        pixels = np.array([point.pt for point in keypoints], np.float64)
        return Features(to_full_pixels(pixels, size, (width, height)), descriptors.astype(np.uint8))


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
    name = hashlib.sha256(f"{digest} {extractor.settings}".encode()).hexdigest()
    file = cache / "features" / name[:2] / f"{name}.npz"
    try:
        with np.load(file, allow_pickle=False) as stored:
            return Features(stored["pixels"], stored["descriptors"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        # Absent, or cut short by a full disk or a kill: made again.
        features = extractor.extract(read_grey(path))
    file.parent.mkdir(parents=True, exist_ok=True)
    # A name of its own: two photos of the same bytes may be worked on at once.
    with tempfile.NamedTemporaryFile(dir=file.parent, prefix=".", suffix=".tmp", delete=False) as stream:
        temporary = Path(stream.name)
        try:
            np.savez(stream, pixels=features.pixels, descriptors=features.descriptors)
            stream.flush()
            temporary.replace(file)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    return features
