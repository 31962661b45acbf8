"""The truth beside the photos: true poses, exact depth maps and the site's parameters."""

from __future__ import annotations

import csv
import io
import json
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.geometry.arrays import Floats
from pipeline.geometry.cameras import Camera
from pipeline.geometry.rotations import quaternion_from_rotation
from pipeline.simulation.control import Observation
from pipeline.simulation.flight import PoseNoise, Trajectory, frame_id
from pipeline.simulation.grid import COMPOUND_CRS
from pipeline.simulation.site import UNDULATION_M, Site

# Bits of a float32's mantissa that are kept: a relative error of 1.2e-4 at most, and maps a third of the size.
_MANTISSA_BITS, _KEPT_BITS = 23, 12
POSE_COLUMNS = (
    *("frame_id", "leg", "time", "east_m", "north_m", "up_m", "qw", "qx", "qy", "qz", "yaw_deg", "pitch_deg"),
    *("roll_deg", "latitude_deg", "longitude_deg", "height_m"),
)


def save_depth(path: Path, depth_m: Floats) -> None:
    """Writes a depth map as .npz with the array `depth_m`, float32 rounded to 12 bits; the same bytes every time.

    Args:
        path: Where.
        depth_m: (height, width) z in the camera frame, inf for the sky.
    """
    bits = depth_m.astype(np.float32).view(np.uint32)
    spare = np.uint32(_MANTISSA_BITS - _KEPT_BITS)
    rounded = ((bits + (np.uint32(1) << (spare - np.uint32(1)))) >> spare) << spare
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        data = io.BytesIO()
        np.lib.format.write_array(data, rounded.view(np.float32), allow_pickle=False)
        archive.writestr(zipfile.ZipInfo("depth_m.npy"), data.getvalue(), zipfile.ZIP_DEFLATED, 1)


def poses_csv(site: Site, true_poses: Trajectory) -> str:
    """The true poses: ENU of the site's frame, attitude enu_from_cam (RDF), heights ellipsoidal.

    Args:
        site: The site, for its frame.
        true_poses: The truth.

    Returns:
        A table with `POSE_COLUMNS`.
    """
    quaternions = quaternion_from_rotation(true_poses.rotation_enu_from_cam)
    latitude, longitude, height = site.frame.geodetic_from_enu(true_poses.centre_in_enu_m)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(POSE_COLUMNS)
    for i in range(len(true_poses)):
        numbers = (*true_poses.centre_in_enu_m[i], *quaternions[i], *np.degrees(true_poses.angles_rad[i]))
        writer.writerow(
            [
                *(frame_id(i), true_poses.leg[i], true_poses.exposure(i).isoformat(timespec="milliseconds")),
                *(f"{value:.12g}" for value in numbers),
                *(f"{latitude[i]:.12f}", f"{longitude[i]:.12f}", f"{height[i]:.6f}"),
            ]
        )
    return out.getvalue()


def site_json(
    site: Site, camera: Camera, noise: PoseNoise, true_poses: Trajectory, observations: list[Observation]
) -> str:
    """Everything the example was made from, as JSON."""
    facts: dict[str, Any] = {
        "seed": site.seed,
        "frames": len(true_poses),
        "first_exposure": true_poses.exposure(0).isoformat(),
        "frame_enu": asdict(site.frame) | {"height_datum": "ellipsoid"},
        "crs": COMPOUND_CRS,
        "undulation_m": UNDULATION_M,
        "pixel_convention": "pixel (0, 0) is the centre of the top-left pixel",
        "depth": "z in the camera frame (right-down-forward), m, at the pixels' centres; inf for the sky",
        "camera": asdict(camera),
        "pose_noise": asdict(noise),
        "hills": [asdict(hill) for hill in site.terrain.hills],
        "solids": [{"kind": type(solid).__name__.lower()} | asdict(solid) for solid in site.solids],
        "control_points": [
            {
                "name": f"gcp{k + 1:02d}",
                "p_in_enu_m": [float(x) for x in p],
                "frames": [frame_id(o.frame) for o in observations if o.point == k],
            }
            for k, p in enumerate(site.control_in_enu_m)
        ],
    }
    return json.dumps(facts, indent=1, default=np.ndarray.tolist) + "\n"
