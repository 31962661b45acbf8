"""The inliers of a pair as rays, and what they say of a relative pose: the epipolar residual and its derivatives."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from pipeline.flight import PairRow, columns
from pipeline.geometry.arrays import Floats, Ints
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import RelativePose


@dataclass(frozen=True, slots=True)
class Rays:
    """Matched rays, z = 1; all arrays may have the same leading axes.

    Args:
        ref: (..., n, 3) in ref.
        src: (..., n, 3) in src.
        noise: (..., n, 3) covariance xx, xy, yy on src's image plane.
    """

    ref: Floats
    src: Floats
    noise: Floats

    def some(self, rows: Ints) -> Rays:
        """Some of the matches: rows (..., m), which become the leading axes."""
        return Rays(self.ref[rows], self.src[rows], self.noise[rows])


@dataclass(frozen=True, slots=True)
class Matched:
    """The inliers of a pair.

    Args:
        pair: The pair.
        n_matches: Matches made, outliers included.
        ref_px: (n, 2) pixels of ref as given.
        src_px: (n, 2) pixels of src as given.
        rays: The same as rays.
        focal_px: Of src: what a radian of its rays is in pixels.
    """

    pair: PairRow
    n_matches: int
    ref_px: Floats
    src_px: Floats
    rays: Rays
    focal_px: float

    def __len__(self) -> int:
        return len(self.ref_px)

    @classmethod
    def of(cls, pair: PairRow, matches: pa.Table, cameras: Mapping[str, Camera]) -> Matched:
        """From rows of `matches`.

        Args:
            pair: The pair.
            matches: Its rows.
            cameras: Camera by frame.
        """
        kept = matches.filter(matches.column("inlier"))
        ref_px, src_px = columns(kept, ("ref_u", "ref_v")), columns(kept, ("src_u", "src_v"))
        ref, src = cameras[pair.ref].rays(ref_px), cameras[pair.src].rays(src_px)
        noise = cameras[pair.src].plane_covariance(src, columns(kept, ("cov_uu", "cov_uv", "cov_vv")))
        rays = Rays(ref, src, np.ascontiguousarray(noise.T))
        return cls(pair, matches.num_rows, ref_px, src_px, rays, cameras[pair.src].focal_px)

    def through(self, ref: Camera, src: Camera) -> Matched:
        """The same pixels through other lenses; the noise is kept, for these hardly change it."""
        return replace(self, rays=replace(self.rays, ref=ref.rays(self.ref_px), src=src.rays(self.src_px)))

    def some(self, rows: Ints) -> Matched:
        """Some of the matches."""
        return replace(self, ref_px=self.ref_px[rows], src_px=self.src_px[rows], rays=self.rays.some(rows))

    def without_matches(self) -> Matched:
        """The pair alone."""
        return self.some(np.empty(0, np.int64))

    def residuals_px(self, pose: RelativePose) -> Floats:
        """(n,) absolute epipolar residuals under a pose, as pixels of src."""
        return np.abs(epipolar(self.rays, pose.rotation.T, pose.centre).sine) * self.focal_px


@dataclass(frozen=True, slots=True)
class Epipolar:
    """Residuals of matches under relative poses; all arrays may have leading axes, one per pose.

    Args:
        sine: (..., n) of the angle between each src ray and the plane of its ref ray and the baseline, signed.
        sigma: (..., n) its sigma by the noise of the matched position.
        jacobian: (..., n, 6) of sine, by src's turn and the shift of its centre on ref's axes.
    """

    sine: Floats
    sigma: Floats
    jacobian: Floats


def epipolar(rays: Rays, ref_from_src: Floats, centre: Floats) -> Epipolar:
    """The epipolar residuals of matches.

    With d the ref ray, u the unit src ray on ref's axes and c the src centre, the residual is u . m, m the unit normal
    (c x d) / |c x d|. A turn a of src gives it a . (u x m), a shift e of its centre e . (d x u - (u . m) d x m) / |c x
    d|. It does not change with the baseline's length.

    Args:
        rays: The matches.
        ref_from_src: (..., 3, 3).
        centre: (..., 3) m, src's in ref.
    """
    unit = rays.src / np.linalg.norm(rays.src, axis=-1, keepdims=True)
    turned = unit @ np.swapaxes(ref_from_src, -1, -2)
    plane = _cross(centre[..., None, :], rays.ref)
    length = np.maximum(np.linalg.norm(plane, axis=-1, keepdims=True), 1e-12)
    plane = plane / length
    sine = np.sum(plane * turned, axis=-1)
    by_shift = (_cross(rays.ref, turned) - sine[..., None] * _cross(rays.ref, plane)) / length
    in_src = plane @ ref_from_src
    across = (in_src - sine[..., None] * unit)[..., :2] * unit[..., 2:]
    xx, xy, yy = np.moveaxis(rays.noise, -1, 0)
    variance = across[..., 0] * (across[..., 0] * xx + 2.0 * across[..., 1] * xy) + across[..., 1] ** 2 * yy
    jacobian = np.concatenate([_cross(turned, plane), by_shift], axis=-1)
    return Epipolar(sine, np.sqrt(np.maximum(variance, 1e-24)), jacobian)


def _cross(a: Floats, b: Floats) -> Floats:
    """(..., 3) cross products; numpy's own takes several times as long for many small ones."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    out: Floats = np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)
    return out


def by_pair(matches: pa.Table) -> Iterator[tuple[str, pa.Table]]:
    """The rows of each pair, in the table's order."""
    if not matches.num_rows:
        return
    ids = matches.column("pair_id").combine_chunks().dictionary_encode()
    codes = ids.indices.to_numpy()
    ends = np.flatnonzero(np.diff(codes, append=-1)) + 1
    for start, end in zip(np.concatenate([[0], ends[:-1]]), ends, strict=True):
        yield ids.dictionary[int(codes[start])].as_py(), matches.slice(start, end - start)
