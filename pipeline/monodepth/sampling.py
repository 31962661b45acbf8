"""Values of a depth map between its pixels."""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import Floats, Singles


def sampled(depth_map: Singles, pixels: Floats) -> Floats:
    """Depths at pixels, bilinear between pixel centres.

    The image ends half a pixel outside of its outermost centres; in that margin the outermost depths hold.

    Args:
        depth_map: (height, width) depths (m).
        pixels: (n, 2) x and y (px); (0, 0) is the centre of the top-left pixel.

    Returns:
        (n,) depths (m); NaN outside of the image, and where a depth that takes part is not finite or not positive.
    """
    height, width = depth_map.shape
    most = np.array([width - 1, height - 1])
    inside = np.all((pixels >= -0.5) & (pixels <= most + 0.5), axis=1)
    within = np.clip(pixels[inside], 0.0, most)
    low = np.floor(within).astype(np.int64)
    high = np.minimum(low + 1, most)
    share = within - low
    total = np.zeros(len(within))
    for x, share_x in ((low[:, 0], 1.0 - share[:, 0]), (high[:, 0], share[:, 0])):
        for y, share_y in ((low[:, 1], 1.0 - share[:, 1]), (high[:, 1], share[:, 1])):
            depth = depth_map[y, x].astype(np.float64)
            weight = share_x * share_y
            usable = np.where(np.isfinite(depth) & (depth > 0.0), depth, np.nan)
            # A neighbour without weight takes no part, whatever it holds.
            total += np.where(weight > 0.0, weight * usable, 0.0)
    out = np.full(len(pixels), np.nan)
    out[inside] = total
    return out
