"""The transfer kernel beside cv2.triangulatePoints, on the same points and one thread each.

Timings are ratios: both sides run in turn, round after round, and the median of the rounds' ratios is reported.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from functools import partial

from pipeline.engine.threads import limit_threads

# Before numpy is imported: its thread pools are sized then.
limit_threads()

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from pipeline.geometry.arrays import Floats  # noqa: E402
from pipeline.geometry.poses import Pose, PoseSigmas, RelativePose, relative_pose  # noqa: E402
from pipeline.geometry.rotations import enu_from_cam  # noqa: E402
from pipeline.geometry.transfer import PixelNoise, VirtualView, transfer, transfer_with_sigma  # noqa: E402

POINTS, ROUNDS = 200_000, 11
FOCAL_PX, SIGMA_PX = 1120.0, 0.5
NEAREST_M, FARTHEST_M, BASELINE_M = 15.0, 100.0, 5.0


def scene() -> tuple[Floats, Floats, RelativePose]:
    """A forward pair of a consumer drone, 20 degrees down, with half a pixel of noise.

    Returns:
        (2, n) ideal image-plane coordinates in ref and in src, and src_from_ref with a full covariance.
    """
    rng = np.random.default_rng(1)
    own = PoseSigmas(np.full(3, 0.053), np.radians([0.25, 0.08, 0.08]))
    common = PoseSigmas(np.full(3, 0.25), np.radians([0.25, 0.0, 0.0]))
    angles = np.radians([30.0, -20.0, 0.0])
    back = -BASELINE_M * np.array([np.sin(angles[0]), np.cos(angles[0]), 0.0])
    ref = Pose(enu_from_cam(*angles), np.zeros(3), own, common)
    src = Pose(enu_from_cam(*(angles + np.radians([0.8, -0.5, 0.3]))), back, own, common)
    pose = relative_pose(ref, src)
    half = np.array([[800.0], [600.0]]) / FOCAL_PX
    ref_xy = rng.uniform(-half, half, (2, POINTS))
    points = np.vstack([ref_xy, np.ones(POINTS)]) * rng.uniform(NEAREST_M, FARTHEST_M, POINTS)
    in_src = pose.rotation @ points + pose.translation[:, None]
    jitter = rng.normal(0.0, SIGMA_PX / FOCAL_PX, (2, 2, POINTS))
    return ref_xy + jitter[0], in_src[:2] / in_src[2] + jitter[1], pose


def seconds(work: Callable[[], object]) -> float:
    """Wall time of one call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def main() -> None:
    """Prints the table."""
    cv2.setNumThreads(1)
    ref_xy, src_xy, pose = scene()
    noise = PixelNoise.isotropic(SIGMA_PX, FOCAL_PX)
    ref_matrix = np.eye(3, 4)
    src_matrix = np.concatenate([pose.rotation, pose.translation[:, None]], axis=1)
    peer = partial(cv2.triangulatePoints, ref_matrix, src_matrix, ref_xy, src_xy)
    ours: dict[str, tuple[Callable[[], object], str]] = {
        "adaptive, depth only": (partial(transfer, ref_xy, src_xy, pose, VirtualView.ADAPTIVE), ">= 20"),
        "lateral, depth only": (partial(transfer, ref_xy, src_xy, pose, VirtualView.LATERAL), ">= 20"),
        "adaptive with sigmas": (
            partial(transfer_with_sigma, ref_xy, src_xy, pose, VirtualView.ADAPTIVE, noise),
            ">= 5",
        ),
    }
    homogeneous = peer()
    difference = np.abs(transfer(ref_xy, src_xy, pose, VirtualView.ADAPTIVE) * homogeneous[3] / homogeneous[2] - 1.0)
    for work, _ in ours.values():
        work()
    ratios: dict[str, list[float]] = {name: [] for name in ours}
    for _ in range(ROUNDS):
        for name, (work, _) in ours.items():
            ratios[name].append(seconds(peer) / seconds(work))
    print(f"Points per second, as multiples of cv2.triangulatePoints {cv2.__version__}'s")
    print(f"({POINTS:,} points, one thread each, {ROUNDS} rounds in turn; the depths of the two agree to")
    print(f"{np.median(difference):.1%} in the median, half a pixel of noise and all)\n")
    print(f"{'':24}{'median':>8}{'min':>8}{'max':>8}   target")
    for name, found in ratios.items():
        print(f"{name:24}{statistics.median(found):8.1f}{min(found):8.1f}{max(found):8.1f}   {ours[name][1]}")


if __name__ == "__main__":
    main()
