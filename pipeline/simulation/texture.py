"""Procedural noise without the bands a pixel cannot resolve: pictures from any range are sharp and not aliased."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.geometry.arrays import Floats

Singles = NDArray[np.float32]

_SAMPLES = 1024
_SAMPLES_PER_WAVE = 8
# The blur of lens and pixel together: one sigma in footprints. At the Nyquist wavelength 38 % of a wave is left.
_BLUR_FOOTPRINTS = 0.44
# A band weaker than this everywhere is not looked up.
_INVISIBLE = 0.01
# Each band is turned by the golden angle against the last, so that their periods never line up.
_GOLDEN_RAD = 2.399963229728653
_ROW = 1024


@dataclass(frozen=True, slots=True)
class Noise:
    """One octave of noise as a periodic tile, looked up at any scale.

    Args:
        tile: (n + 1, n + 1) float32 of unit variance; the last row and column repeat the first.
        shifts: (64, 2) where each salt starts in the tile, samples.
    """

    tile: Singles
    shifts: Floats

    @classmethod
    def seeded(cls, seed: int) -> Noise:
        """A tile whose spectrum is one octave wide about eight samples a wave."""
        rng = np.random.default_rng([seed, 1])
        spectrum = np.fft.rfft2(rng.standard_normal((_SAMPLES, _SAMPLES)))
        frequency = np.hypot(np.fft.fftfreq(_SAMPLES)[:, None], np.fft.rfftfreq(_SAMPLES)[None, :])
        frequency[0, 0] = 1e-9
        octaves = np.log2(frequency * _SAMPLES_PER_WAVE)
        octave = np.fft.irfft2(spectrum * np.exp(-0.5 * (octaves / 0.45) ** 2), s=(_SAMPLES, _SAMPLES))
        tile: Singles = np.pad(octave / octave.std(), ((0, 1), (0, 1)), mode="wrap").astype(np.float32)
        return cls(tile, rng.uniform(0.0, _SAMPLES, (64, 2)))

    def wave(self, x_m: Floats, y_m: Floats, length_m: float, salt: int) -> Singles:
        """Noise of one wavelength.

        Args:
            x_m: (n,) place on the surface.
            y_m: (n,) place on the surface.
            length_m: Wavelength.
            salt: Chooses among independent noises.

        Returns:
            (n,) of unit variance.
        """
        angle = _GOLDEN_RAD * (salt + 1)
        scale = _SAMPLES_PER_WAVE / length_m
        c, s = scale * np.cos(angle), scale * np.sin(angle)
        shift = self.shifts[salt % len(self.shifts)]
        return look_up(self.tile, _wrap(c * x_m - s * y_m + shift[0]), _wrap(s * x_m + c * y_m + shift[1]))

    def bands(self, x_m: Floats, y_m: Floats, footprint_m: Singles, lengths_m: tuple[float, ...], salt: int) -> Singles:
        """Noise of several wavelengths with equal strength each, as a pixel sees it.

        Args:
            x_m: (n,) place on the surface.
            y_m: (n,) place on the surface.
            footprint_m: (n,) size of a pixel on the surface.
            lengths_m: Wavelengths.
            salt: Chooses among independent noises; each band takes the next.

        Returns:
            (n,) of unit variance per band that the pixel resolves.
        """
        out = np.zeros(len(x_m), np.float32)
        finest = float(footprint_m.min()) if len(footprint_m) else 0.0
        for band, length_m in enumerate(lengths_m):
            if _seen(finest / length_m) < _INVISIBLE:
                continue
            out += _seen(footprint_m / np.float32(length_m)) * self.wave(x_m, y_m, length_m, salt + band)
        return out


def look_up(table: Singles, column: Singles, row: Singles) -> Singles:
    """Bilinear values of a table at (n,) columns and rows, edges repeated."""
    n = len(column)
    rows = max(1, -(-n // _ROW))
    at = np.zeros((2, rows * _ROW), np.float32)
    at[0, :n], at[1, :n] = column, row
    grid = at.reshape(2, rows, _ROW)
    found = cv2.remap(table, grid[0], grid[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    out: Singles = np.asarray(found, np.float32).reshape(-1)[:n]
    return out


def inside(distance_m: Floats | Singles, footprint_m: Singles) -> Singles:
    """Share of a pixel that lies inside an edge.

    Args:
        distance_m: (n,) from the pixel's centre to the edge, positive inside.
        footprint_m: (n,) size of a pixel.

    Returns:
        (n,) 0 to 1.
    """
    out: Singles = np.clip(np.asarray(distance_m, np.float32) / footprint_m + np.float32(0.5), 0.0, 1.0)
    return out


def _seen(footprints_per_wave: Singles | float) -> Singles:
    """What the pixel's blur leaves of a wave."""
    out: Singles = np.exp(np.float32(-2.0 * (np.pi * _BLUR_FOOTPRINTS) ** 2) * np.square(footprints_per_wave))
    return out


def _wrap(sample: Floats) -> Singles:
    wrapped: Singles = (sample - np.floor(sample * (1.0 / _SAMPLES)) * _SAMPLES).astype(np.float32)
    return wrapped
