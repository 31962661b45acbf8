"""A pair of 100 megapixel images is matched and fitted in bounded memory."""

import subprocess
import sys

import pytest

_SCRIPT = """
import cv2, numpy as np
from pathlib import Path
from pipeline.geometry.cameras import Camera
from pipeline.geometry.poses import RelativePose
from pipeline.matching.features import extract
from pipeline.matching.matcher import SearchLimits, View
from pipeline.matching.matchers import MatcherSetting
from pipeline.matching.pair import match_pair
from pipeline.matching.reach import Band

def most_mib():
    line = next(l for l in Path("/proc/self/status").read_text().splitlines() if l.startswith("VmHWM"))
    return int(line.split()[1]) / 1024

rng = np.random.default_rng(1)
small = cv2.GaussianBlur(rng.integers(0, 256, (2160, 2880)).astype(np.uint8), (0, 0), 2.0)
small = cv2.normalize(small, None, 0, 255, cv2.NORM_MINMAX)
ref = cv2.resize(small, (11520, 8640), interpolation=cv2.INTER_LINEAR)
src = np.roll(ref, -40, axis=1)
camera = Camera("pinhole", 11520, 8640, 8000.0, 8000.0, 5759.5, 4319.5)
# Everything at 30 m, 15 cm apart: 40 px.
pose = RelativePose(np.eye(3), np.array([-0.15, 0.0, 0.0]), np.diag([1e-8] * 3 + [1e-6] * 3))
matcher = MatcherSetting("sift", 1600, 2000).build([])
before = most_mib()
views = [View(camera, image, extract(matcher.extractor, [image])[0]) for image in (ref, src)]
found = match_pair(matcher, *views, pose, SearchLimits(Band(4.0, 0.5, 5.0), 1.5, 1600))
moved = (found.src_px - found.ref_px)[found.inlier]
print(found.inlier.sum(), float(np.median(moved[:, 0])), most_mib() - before)
"""


@pytest.mark.slow
def test_a_pair_of_100_megapixels_needs_little_more_than_itself() -> None:
    done = subprocess.run([sys.executable, "-c", _SCRIPT], capture_output=True, text=True, check=True)
    inliers, moved, more_mib = map(float, done.stdout.split())
    assert inliers > 300
    assert moved == pytest.approx(-40.0, abs=0.2)
    # Both images blurred as a whole would be 760 MiB.
    assert more_mib < 450
