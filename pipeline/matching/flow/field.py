"""Dense matches under a known pose: the motion that pose and a coarse pass leave, found tile by tile.

Each tile of ref is compared with src resampled into its pixels, so that the estimator has only a few pixels to find.
Nothing of the size of the images is kept: a tile's motion is gone when the pixels asked for in it are answered.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np

from pipeline.engine.errors import InputError
from pipeline.geometry.arrays import Bools, Bytes, Floats, Ints, Singles
from pipeline.geometry.poses import RelativePose
from pipeline.matching.flow.estimators import FlowEstimator
from pipeline.matching.flow.start import FlowView, Start, bilinear, find_start, resampled
from pipeline.matching.images import to_full_pixels
from pipeline.matching.tiles import Tile, tiles

# Of the places in src, every so many px; between them straight lines serve, as the same lines resample the image.
_NODE_PX = 8
# Tiles whose motion is found together, for devices that run many at once.
_TOGETHER = 4


@dataclass(frozen=True, slots=True)
class FlowSetting:
    """How dense motion is found.

    Args:
        longest_px: Longest side images are matched at.
        nearest_m: Range of the nearest point looked for.
        coarse_px: Longest side of the images in the pass over the whole image.
        margin_px: By how much tiles overlap: the largest motion left by that pass, and the context of its edge.
    """

    longest_px: int
    nearest_m: float
    coarse_px: int = 512
    margin_px: int = 48


@dataclass(frozen=True, slots=True)
class DenseMatches:
    """Where pixels of ref are in src.

    Args:
        ref_px: (n, 2) px of the ref image as given.
        src_px: (n, 2) px of the src image as given; NaN where there is none.
        discrepancy_px: (n,) px of the size matched at: how far from the pixel the way there and back ends; NaN where
            there is none.
        valid: (n,) whether the place is in front of src and inside its image.
    """

    ref_px: Floats
    src_px: Floats
    discrepancy_px: Floats
    valid: Bools


@dataclass(frozen=True, slots=True)
class FlowField:
    """The motion from ref to src, to be asked for at any pixels; see `dense_field`.

    Args:
        ref: At the size matched at.
        src: At a resolution like that.
        ref_size: Width and height of the ref image as given.
        src_size: Width and height of the src image as given.
        start: From the pass over the whole image.
        estimator: Of the motion.
        margin_px: By how much tiles overlap.
    """

    ref: FlowView
    src: FlowView
    ref_size: tuple[int, int]
    src_size: tuple[int, int]
    start: Start
    estimator: FlowEstimator
    margin_px: int

    def sample(self, ref_px: Floats) -> DenseMatches:
        """The matches of pixels; tiles without any are left out.

        Args:
            ref_px: (n, 2) px of the ref image as given.
        """
        camera = self.ref.camera
        pixels = to_full_pixels(np.asarray(ref_px, np.float64), self.ref_size, (camera.width, camera.height))
        src_px = np.full((len(pixels), 2), np.nan)
        discrepancy = np.full(len(pixels), np.nan)
        pieces = self._asked(pixels)
        while asked := list(islice(pieces, _TOGETHER)):
            cuts = [_Cut.of(tile, self) for tile, _ in asked]
            flows = iter(self.estimator.flows([pair for cut in cuts for pair in cut.pairs]))
            for cut, (_, rows) in zip(cuts, asked, strict=True):
                if cut.pairs:
                    src_px[rows], discrepancy[rows] = cut.matches(pixels[rows], next(flows), next(flows))
        small = (self.src.camera.width, self.src.camera.height)
        src_px[~self.src.camera.holds(src_px)] = np.nan
        valid = np.isfinite(src_px).all(axis=1) & np.isfinite(discrepancy)
        src_px[~valid], discrepancy[~valid] = np.nan, np.nan
        return DenseMatches(ref_px, to_full_pixels(src_px, small, self.src_size), discrepancy, valid)

    def _asked(self, pixels: Floats) -> Iterator[tuple[Tile, Ints]]:
        """The tiles that pixels were asked for in, with the rows of these."""
        camera, longest = self.ref.camera, self.estimator.tile_px
        if max(camera.width, camera.height) > longest:
            longest -= 2 * self.margin_px
        for tile in tiles(camera.width, camera.height, longest, self.margin_px):
            rows = np.flatnonzero(tile.owns(pixels))
            if rows.size:
                yield tile, rows


@dataclass(frozen=True, slots=True)
class _Cut:
    """A tile of ref with src resampled into it.

    Args:
        tile: Of ref.
        nodes: (k, l, 2) px of src, every `_NODE_PX` px from that far before the tile's first.
        known: (k, l, 1) 1 where they are numbers.
        pairs: Images there and back; none where the tile sees nothing of src.
    """

    tile: Tile
    nodes: Floats
    known: Floats
    pairs: tuple[tuple[Bytes, Bytes], ...]

    @classmethod
    def of(cls, tile: Tile, field: FlowField) -> _Cut:
        width, height = tile.right - tile.left, tile.bottom - tile.top
        # From before the first pixel to beyond the last: pixels reach half a pixel beyond their centres.
        columns, rows = (np.arange(-(-size // _NODE_PX) + 2) * _NODE_PX - _NODE_PX for size in (width, height))
        at = np.stack(np.meshgrid(columns + tile.left, rows + tile.top), axis=-1).astype(np.float64)
        small, camera = field.start.camera, field.ref.camera
        coarse = to_full_pixels(at, (camera.width, camera.height), (small.width, small.height))
        nodes = field.start.in_src(coarse, field.src.camera)
        known = np.isfinite(nodes[..., :1] + nodes[..., 1:]).astype(np.float64)
        nodes = np.where(known > 0.0, nodes, 0.0)
        weights = _between(height, len(rows)), _between(width, len(columns))
        places = _spread(nodes, *weights)
        inside = field.src.camera.holds(places) & (_spread(known, *weights)[..., 0] > 1.0 - 1e-9)
        if not inside.any():
            return cls(tile, nodes, known, ())
        channels = field.estimator.channels
        ref = FlowView(tile.cut(field.ref.image), camera).with_channels(channels).image
        piece = resampled(field.src.image, places, inside, tile.cut(field.ref.image))
        src = FlowView(piece, camera).with_channels(channels).image
        return cls(tile, nodes, known, ((ref, src), (src, ref)))

    def matches(self, pixels: Floats, there: Singles, back: Singles) -> tuple[Floats, Floats]:
        """Places in src, and how far the way there and back ends from where it began."""
        own = pixels - (self.tile.left, self.tile.top)
        step = bilinear(there, own)
        landing = own + step
        size = (there.shape[1] - 0.5, there.shape[0] - 0.5)
        lost = ~np.all((landing >= -0.5) & (landing <= size), axis=1)
        at = landing / _NODE_PX + 1.0
        lost |= bilinear(self.known, at)[:, 0] < 1.0 - 1e-9
        places = bilinear(self.nodes, at)
        places[lost] = np.nan
        return places, np.linalg.norm(step + bilinear(back, landing), axis=1)


def _between(size: int, nodes: int) -> Floats:
    """(size, nodes): the weights of nodes at every pixel."""
    apart = np.abs(np.arange(size)[:, None] / _NODE_PX + 1.0 - np.arange(nodes)[None])
    return np.maximum(0.0, 1.0 - apart)


def _spread(nodes: Floats, rows: Floats, columns: Floats) -> Floats:
    """(h, w, k): values at nodes brought to every pixel."""
    return np.stack([rows @ nodes[..., i] @ columns.T for i in range(nodes.shape[2])], axis=-1)


def dense_field(
    ref: FlowView, src: FlowView, pose: RelativePose, estimator: FlowEstimator, setting: FlowSetting
) -> FlowField:
    """The motion from ref to src under a pose.

    Args:
        ref: The image that gets the depth, as given.
        src: The other, as given; of any size and lens.
        pose: src_from_ref.
        estimator: Of the motion.
        setting: Sizes and reach.

    Raises:
        InputError: An image is not of its camera's size.
    """
    for name, view in (("ref", ref), ("src", src)):
        height, width = view.image.shape[:2]
        if (width, height) != (view.camera.width, view.camera.height):
            raise InputError(
                "E-FLOW-01",
                f"the {name} image is not of its camera's size",
                found=f"image {width}x{height}",
                expected=f"camera {view.camera.width}x{view.camera.height}",
            )
    colourful = estimator.channels == 3 and ref.image.ndim == src.image.ndim == 3
    small_ref = _at_size(ref, setting.longest_px, colourful=colourful)
    # Finer than ref's pixels, src would only be sampled with gaps.
    detail = small_ref.camera.focal_px / src.camera.focal_px
    longest = min(float(setting.longest_px), np.ceil(detail * max(src.camera.width, src.camera.height)))
    small_src = _at_size(src, max(1, int(longest)), colourful=colourful)
    coarse_px = min(setting.coarse_px, estimator.tile_px)
    start = find_start(small_ref, small_src, pose, estimator, setting.nearest_m, coarse_px)
    ref_size, src_size = ((view.camera.width, view.camera.height) for view in (ref, src))
    return FlowField(small_ref, small_src, ref_size, src_size, start, estimator, setting.margin_px)


def _at_size(view: FlowView, longest_px: int, *, colourful: bool) -> FlowView:
    """A view shrunk, and grey where not both are looked at in colours; an estimator of colours repeats it by tile."""
    small = view.shrunk(longest_px)
    return small if colourful else small.with_channels(1)
