"""The lens as an unknown: focal length and the first two radial terms, one set per camera of the flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.geometry.arrays import Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.refinement.flight.stars import Stars

NAMES = ("focal", "k1", "k2")
# What a lens from EXIF or an old calibration may be off by: two percent of focal length, some pixels at the corners.
PRIOR_SIGMA: Floats = np.array([0.02, 0.05, 0.05])
_STEP = 1e-5
# Where more than this is left of the prior's sigma, what was found is too much the prior's.
_OBSERVED = 0.3
_FAR = 3.0


@dataclass(frozen=True, slots=True)
class LensChange:
    """How the stars' rays change with the lenses, on the image plane.

    Args:
        ref: (n, 2, c) of the stars' ref rays.
        src: (m, 2, c) of their observations.
    """

    ref: Floats
    src: Floats


@dataclass(frozen=True, slots=True)
class Lenses:
    """The lenses of a flight, three unknowns each.

    Args:
        cameras: As given.
        of_frame: (n,) the camera of every frame.
        sigma: (3 c,) of the priors; zero for what is not an unknown.
    """

    cameras: tuple[Camera, ...]
    of_frame: Ints
    sigma: Floats

    @classmethod
    def of(cls, cameras: Sequence[Camera], *, unknown: bool) -> Lenses:
        """The lenses of frames.

        Args:
            cameras: Of every frame.
            unknown: Whether they are to be found.
        """
        different = tuple(dict.fromkeys(cameras))
        number = {camera: i for i, camera in enumerate(different)}
        sigma = np.tile(PRIOR_SIGMA, len(different)) * unknown
        return cls(different, np.array([number[camera] for camera in cameras], np.int64), sigma)

    @property
    def unknown(self) -> Ints:
        """Which of the 3 c parameters are unknown."""
        return np.flatnonzero(self.sigma > 0.0)

    def changed(self, change: Floats) -> tuple[Camera, ...]:
        """The cameras after changes (3 c,)."""
        each = zip(self.cameras, change.reshape(-1, len(NAMES)), strict=True)
        return tuple(changed(camera, of_one) for camera, of_one in each)

    def observed(self, change: Floats, sigma: Floats) -> Lenses:
        """With only those unknown that the images determine and a lens may have.

        Args:
            change: (3 c,) as found.
            sigma: (3 c,) posterior sigmas.
        """
        keep = sigma < _OBSERVED * self.sigma
        # What is found far from anything a lens is off by stands for something else: a principal point, a shutter.
        odd = (np.abs(change) > _FAR * self.sigma).reshape(-1, len(NAMES)).any(axis=1)
        return replace(self, sigma=np.where(keep & ~np.repeat(odd, len(NAMES)), self.sigma, 0.0))

    def through(self, which: Ints, pixels: Floats, change: Floats) -> Floats:
        """Pixels on the image planes of changed lenses.

        Args:
            which: (m,) the camera of each pixel.
            pixels: (m, 2) as given.
            change: (3 c,) of the lenses.

        Returns:
            (m, 2).
        """
        now = self.changed(change)
        out = np.empty((len(pixels), 2))
        for k in np.unique(which):
            rows = which == k
            out[rows] = now[k].rays(pixels[rows])[:, :2]
        return out

    def by_unknowns(self, which: Ints, pixels: Floats, change: Floats) -> Floats:
        """(m, 2, u) how pixels move on the image planes with the unknown parameters; arguments as in `through`."""
        out = np.zeros((len(pixels), 2, len(self.unknown)))
        for column, parameter in enumerate(self.unknown):
            step = np.zeros_like(change)
            step[parameter] = _STEP
            # Another camera's parameter moves none of its pixels.
            rows = which == parameter // len(NAMES)
            up, down = (self.through(which[rows], pixels[rows], change + sign * step) for sign in (1.0, -1.0))
            out[rows, :, column] = (up - down) / (2.0 * _STEP)
        return out

    def rays(self, stars: Stars, change: Floats) -> Stars:
        """The stars as changed lenses see them."""
        ref, src = (self.through(*seen, change) for seen in self._seen(stars))
        return replace(stars, ray=np.column_stack([ref, np.ones(len(ref))]), xy=src)

    def derivatives(self, stars: Stars, change: Floats) -> LensChange | None:
        """How the stars' rays move with the unknown parameters; None where there are none."""
        if not len(self.unknown):
            return None
        return LensChange(*(self.by_unknowns(*seen, change) for seen in self._seen(stars)))

    def _seen(self, stars: Stars) -> tuple[tuple[Ints, Floats], tuple[Ints, Floats]]:
        """Cameras and pixels of the stars in ref, and of their observations."""
        which = self.of_frame[stars.frames]
        return (np.full(len(stars.ref_px), which[0]), stars.ref_px), (which[stars.of], stars.src_px)


def changed(camera: Camera, change: Floats) -> Camera:
    """A camera whose focal length is longer by a share, and whose first two radial terms are larger.

    Args:
        camera: As given; a pinhole gets a Brown lens, once it has a distortion.
        change: (3,) of NAMES.
    """
    share, k1, k2 = (float(value) for value in change)
    fx, fy = camera.fx * (1.0 + share), camera.fy * (1.0 + share)
    if k1 == 0.0 and k2 == 0.0:
        return replace(camera, fx=fx, fy=fy)
    model = "brown" if camera.model == "pinhole" else camera.model
    terms = [*camera.distortion, *([0.0] * (5 - len(camera.distortion)))] if model == "brown" else [*camera.distortion]
    terms[0] += k1
    terms[1] += k2
    return replace(camera, model=model, distortion=tuple(terms), fx=fx, fy=fy)
