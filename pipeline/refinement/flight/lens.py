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

    def rays(self, stars: Stars, change: Floats) -> Stars:
        """The stars as changed lenses see them."""
        now = self.changed(change)
        ref, src = self._rays(stars, now)
        return replace(stars, ray=ref, xy=src)

    def derivatives(self, stars: Stars, change: Floats) -> LensChange | None:
        """How the stars' rays move with the unknown parameters; None where there are none."""
        columns = []
        for k in self.unknown:
            step = np.zeros_like(change)
            step[k] = _STEP
            up, down = (self._rays(stars, self.changed(change + sign * step)) for sign in (1.0, -1.0))
            columns.append([(a - b) / (2.0 * _STEP) for a, b in zip(up, down, strict=True)])
        if not columns:
            return None
        ref, src = (np.stack(of_role, axis=2) for of_role in zip(*columns, strict=True))
        return LensChange(ref[:, :2], src)

    def _rays(self, stars: Stars, cameras: Sequence[Camera]) -> tuple[Floats, Floats]:
        of_stars = self.of_frame[stars.frames]
        src = np.empty_like(stars.src_px)
        for place in np.unique(stars.of):
            rows = stars.of == place
            src[rows] = cameras[of_stars[place]].rays(stars.src_px[rows])[:, :2]
        return cameras[of_stars[0]].rays(stars.ref_px), src


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
