"""Where dense motion starts: src resampled into ref's pixels by the pose, and one pass over the whole image.

A ref pixel p at an inverse depth w is seen by src at M(p). With one w for the whole image the turn of the camera is
gone, both lenses are, and what is left is the parallax of depths other than 1 / w. That w is the one, between
infinity and the nearest range looked for, from which a quick look at small images explains most of them. The pass
over the whole image then finds F, so that p is seen by src at M(p + F(p)).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.geometry.arrays import Bools, Bytes, Floats, Singles
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import RelativePose
from pipeline.matching.flow.estimators import DisFlow, FlowEstimator
from pipeline.matching.images import resized, shrunk_size

# The sweep over inverse depths: size of the images, px of parallax between two of them, and the window in which images
# are compared. So small, the search reaches over a step and over a pose wrong by some degrees besides.
_SWEEP_PX, _SWEEP_STEP_PX, _MOST_STEPS, _WINDOW_PX = 160, 6.0, 24, 9
_SWEEP = DisFlow(finest_scale=1)
# Variance of grey values below which a window has nothing to compare.
_FLAT = 4.0
# The second pass sees src nearly as ref does, and finds what the first had to reach for.
_PASSES = 2
_CONSISTENT_PX = 1.0


@dataclass(frozen=True, slots=True)
class FlowView:
    """One image of a pair.

    Args:
        image: (h, w) grey or (h, w, 3) red, green, blue.
        camera: Of that image's size.
    """

    image: Bytes
    camera: Camera

    def shrunk(self, longest_px: int) -> FlowView:
        """The view with its longest side brought down to a size."""
        camera = self.camera
        size = shrunk_size(camera.width, camera.height, longest_px)
        if size == (camera.width, camera.height):
            return self
        return FlowView(resized(self.image, size), camera.scaled(*size))

    def with_channels(self, channels: int) -> FlowView:
        """The view in grey (1) or in colour (3)."""
        if channels == 1 and self.image.ndim == 3:
            return FlowView(np.asarray(cv2.cvtColor(self.image, cv2.COLOR_RGB2GRAY), np.uint8), self.camera)
        if channels == 3 and self.image.ndim == 2:
            return FlowView(np.repeat(self.image[:, :, None], 3, axis=2), self.camera)
        return self


@dataclass(frozen=True, slots=True)
class Start:
    """How ref pixels are seen by src, as far as the pose and the pass over the whole image tell.

    Args:
        camera: Ref's, of the size of the pass.
        pose: src_from_ref.
        inverse_m: Inverse depth of M.
        flow: (h, w, 2) px of the pass: F.
    """

    camera: Camera
    pose: RelativePose
    inverse_m: float
    flow: Singles

    def in_src(self, pixels: Floats, src: Camera) -> Floats:
        """M(p + F(p)).

        Args:
            pixels: (..., 2) px of the size of the pass.
            src: Src's camera, of the size wanted.

        Returns:
            (..., 2) px of src; NaN where src does not see the point.
        """
        moved = pixels + bilinear(self.flow, pixels)
        return seen_at(self.camera.rays(moved), self.pose, self.inverse_m, src)


def seen_at(rays: Floats, pose: RelativePose, inverse_m: float, src: Camera) -> Floats:
    """Src pixels of points at one inverse depth on ref rays.

    Args:
        rays: (..., 3) of ref, z = 1.
        pose: src_from_ref.
        inverse_m: Inverse depth; 0 is infinity.
        src: Src's camera.

    Returns:
        (..., 2) px.
    """
    return src.project(rays @ pose.rotation.T + inverse_m * pose.translation)


def bilinear(field: Singles | Floats, pixels: Floats) -> Floats:
    """A field between its pixels, and as at its edge beyond it.

    Args:
        field: (h, w, k).
        pixels: (..., 2); one that is no number gives NaN.

    Returns:
        (..., k).
    """
    height, width = field.shape[:2]
    # Not OpenCV's remap: that rounds positions to 1/32 px.
    place = np.clip(pixels, 0.0, (width - 1, height - 1))
    known: Bools = np.isfinite(place[..., 0]) & np.isfinite(place[..., 1])
    place = np.where(known[..., None], place, 0.0)
    low = np.minimum(place.astype(np.int64), np.maximum(0, np.array([width - 2, height - 2])))
    share = place - low
    u, v = low[..., 0], low[..., 1]
    right, below = np.minimum(u + 1, width - 1), np.minimum(v + 1, height - 1)
    a, b = share[..., :1], share[..., 1:]
    upper = (1.0 - a) * field[v, u] + a * field[v, right]
    lower = (1.0 - a) * field[below, u] + a * field[below, right]
    out: Floats = np.where(known[..., None], (1.0 - b) * upper + b * lower, np.nan)
    return out


def pixel_grid(width: int, height: int) -> Floats:
    """(h, w, 2): u and v of every pixel."""
    v, u = np.mgrid[:height, :width]
    return np.stack([u, v], axis=-1).astype(np.float64)


def resampled(src: Bytes, places: Floats, inside: Bools, ref: Bytes) -> Bytes:
    """Src as ref's pixels see it; ref itself where they do not.

    Nothing moves where the two are the same: an empty part would draw the flow near it, and shift the statistics
    that networks normalise by.

    Args:
        src: (h', w'[, 3]).
        places: (h, w, 2) px of src.
        inside: (h, w) whether these lie in src.
        ref: (h, w[, 3]).

    Returns:
        As ref.
    """
    if not inside.any():
        return ref.copy()
    low = np.maximum(np.floor(places[inside].min(axis=0)).astype(int) - 2, 0)
    high = np.ceil(places[inside].max(axis=0)).astype(int) + 3
    piece = np.ascontiguousarray(src[low[1] : high[1], low[0] : high[0]])
    seen = _taken(piece, np.where(inside[..., None], places - low, 0.0))
    return np.where(inside[..., None] if ref.ndim == 3 else inside, seen, ref).astype(np.uint8)


def _taken(image: Bytes, places: Floats) -> Bytes:
    """An image at places (h, w, 2) of it."""
    # As two arrays: with the empty second one that its stubs ask for, OpenCV 5 takes other places.
    u, v = (np.ascontiguousarray(places[..., i], np.float32) for i in (0, 1))
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def find_start(
    ref: FlowView, src: FlowView, pose: RelativePose, estimator: FlowEstimator, nearest_m: float, longest_px: int
) -> Start:
    """The passes over the whole image.

    Args:
        ref: The view whose pixels are asked for.
        src: The other.
        pose: src_from_ref.
        estimator: Of the motion.
        nearest_m: Range of the nearest point looked for.
        longest_px: Longest side of the images in these passes.
    """
    ref, src = (view.shrunk(longest_px) for view in (ref, src))
    camera = ref.camera
    start = Start(
        camera, pose, likeliest_inverse(ref, src, pose, nearest_m), np.zeros((camera.height, camera.width, 2), "f4")
    )
    ref_image, src_image = (view.with_channels(estimator.channels).image for view in (ref, src))
    pixels = pixel_grid(camera.width, camera.height)
    for _ in range(_PASSES):
        places = start.in_src(pixels, src.camera)
        inside = src.camera.holds(places)
        seen = resampled(src_image, places, inside, ref_image)
        there, apart = _there_and_back(estimator, ref_image, seen)
        sure = inside & (apart < _CONSISTENT_PX)
        step = _smoothed(there, sure)
        flow = step + bilinear(start.flow, pixels + step)
        start = Start(camera, pose, start.inverse_m, flow.astype(np.float32))
    return start


def _there_and_back(estimator: FlowEstimator, ref: Bytes, seen: Bytes) -> tuple[Singles, Floats]:
    """The motion (h, w, 2), and how far (h, w) the way there and back ends from where it began."""
    there, back = estimator.flows([(ref, seen), (seen, ref)])
    landing = pixel_grid(there.shape[1], there.shape[0]) + there
    apart: Floats = np.linalg.norm(there + bilinear(back, landing), axis=-1)
    return there, apart


def _smoothed(flow: Singles, sure: Bools) -> Floats:
    """A flow without its noise, carried from where it is sure to where it is not; 0 where it is sure nowhere."""
    weight = sure.astype(np.float32)
    median = np.stack([cv2.medianBlur(np.ascontiguousarray(flow[..., i]), 5) for i in (0, 1)], axis=-1)
    weighted = np.concatenate([median * weight[..., None], weight[..., None]], axis=-1)
    far = max(flow.shape[:2]) / 16.0
    # What is near counts most, what is far where nothing is near.
    near, wide = (np.asarray(cv2.GaussianBlur(weighted, (0, 0), sigma), np.float64) for sigma in (2.0, far))
    total = near + 1e-3 * wide
    out: Floats = total[..., :2] / (total[..., 2:] + 1e-6)
    return out


def likeliest_inverse(ref: FlowView, src: FlowView, pose: RelativePose, nearest_m: float) -> float:
    """The inverse depth from which motion explains most of small images of the two views.

    Args:
        ref: The view whose pixels are asked for.
        src: The other.
        pose: src_from_ref.
        nearest_m: Range of the nearest point looked for; nearer than the baseline none is.

    Returns:
        1/m, from 0 to that of the nearest range.
    """
    ref, src = (view.shrunk(_SWEEP_PX).with_channels(1) for view in (ref, src))
    baseline = float(np.linalg.norm(pose.translation))
    largest = 1.0 / max(nearest_m, baseline)
    parallax_px = ref.camera.focal_px * baseline * largest
    count = min(_MOST_STEPS, round(parallax_px / _SWEEP_STEP_PX)) + 1
    rays = ref.camera.rays(pixel_grid(ref.camera.width, ref.camera.height))
    candidates = np.linspace(0.0, largest, count)
    scores = [_explained(ref.image, src, seen_at(rays, pose, inverse, src.camera)) for inverse in candidates]
    return float(candidates[int(np.argmax(scores))])


def _explained(ref: Bytes, src: FlowView, places: Floats) -> float:
    """How many pixels of ref are found in src from a start, each by how alike the two places look."""
    inside = src.camera.holds(places)
    if not inside.any():
        return 0.0
    seen = resampled(src.image, places, inside, ref)
    there, apart = _there_and_back(_SWEEP, ref, seen)
    landing = pixel_grid(ref.shape[1], ref.shape[0]) + there
    sure = inside & (apart < _CONSISTENT_PX) & (bilinear(inside[..., None].astype(np.float32), landing)[..., 0] > 0.99)
    return float(_correlation(ref, _taken(seen, landing))[sure].sum(dtype=np.float64))


def _correlation(a: Bytes, b: Bytes) -> Singles:
    """(h, w): the correlation of two images in a window about each pixel."""
    one, two = a.astype(np.float32), b.astype(np.float32)
    products = (one, two, one * one, two * two, one * two)
    mean_a, mean_b, aa, bb, ab = (np.asarray(cv2.blur(i, (_WINDOW_PX, _WINDOW_PX)), np.float32) for i in products)
    spread = ((aa - mean_a**2).clip(0.0) + _FLAT) * ((bb - mean_b**2).clip(0.0) + _FLAT)
    return np.asarray((ab - mean_a * mean_b) / np.sqrt(spread), np.float32)
