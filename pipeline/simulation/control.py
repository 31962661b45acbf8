"""Control points as OpenDroneMap's gcp_list.txt: painted marks, surveyed, and their pixels in the photos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipeline.geometry.cameras import Camera
from pipeline.simulation.flight import Trajectory, frame_id
from pipeline.simulation.grid import HORIZONTAL_CRS, grid_from_enu
from pipeline.simulation.site import Site

# A surveyor marks a point only where its quarters can be told apart, and not at the image's border.
_FARTHEST_M = 90.0
_BORDER_PX = 25.0
# All of the mark must be in sight, not only its middle: east and north of places on it, m.
_ON_MARK_M = ((0.0, 0.0), (0.4, 0.4), (0.4, -0.4), (-0.4, -0.4), (-0.4, 0.4))


@dataclass(frozen=True, slots=True)
class Observation:
    """A control point in a photo.

    Args:
        point: Index of the point.
        frame: Index of the frame.
        u: Column, px; pixel (0, 0) is the centre of the top-left pixel.
        v: Row, px.
    """

    point: int
    frame: int
    u: float
    v: float


def observe(site: Site, camera: Camera, true_poses: Trajectory) -> list[Observation]:
    """Where the control points are seen, under the true poses.

    Args:
        site: The site.
        camera: The camera.
        true_poses: The truth.

    Returns:
        Observations by point, then frame.
    """
    found: list[Observation] = []
    p = site.control_in_enu_m
    level = [p[:, :2] + offset for offset in _ON_MARK_M]
    marks = [np.column_stack([xy, site.terrain.height(xy[:, 0], xy[:, 1])]) for xy in level]
    rotations = true_poses.rotation_enu_from_cam
    for frame, centre in enumerate(true_poses.centre_in_enu_m):
        in_cam = (p - centre) @ rotations[frame]
        pixels = camera.project(in_cam)
        low, high = _BORDER_PX, np.array([camera.width, camera.height]) - 1.0 - _BORDER_PX
        clear = np.all((pixels > low) & (pixels < high), axis=1) & (np.linalg.norm(in_cam, axis=1) < _FARTHEST_M)
        for place in marks:
            clear &= site.sees(centre, place)
        found += [Observation(int(k), frame, *map(float, pixels[k])) for k in np.flatnonzero(clear)]
    return sorted(found, key=lambda o: (o.point, o.frame))


def gcp_list(site: Site, observations: list[Observation]) -> str:
    """The text of gcp_list.txt; heights are above NAVD 88.

    Source: OpenDroneMap documentation, "Ground Control Points": easting northing height column row image name.
    """
    xyz = grid_from_enu(site.frame, site.control_in_enu_m)
    lines = [HORIZONTAL_CRS]
    for o in observations:
        x, y, z = xyz[o.point]
        lines.append(f"{x:.4f}\t{y:.4f}\t{z:.4f}\t{o.u:.3f}\t{o.v:.3f}\t{frame_id(o.frame)}.JPG\tgcp{o.point + 1:02d}")
    return "\n".join(lines) + "\n"
