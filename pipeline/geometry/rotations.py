"""Rotations: quaternions (w, x, y, z), rotation vectors, and the attitude conventions of drones.

A camera's axes are right-down-forward (RDF); a gimbal's are forward-right-down (FRD) with x along the optical axis,
measured against local north-east-down (NED) in the order yaw, pitch, roll (intrinsic ZYX). World is east-north-up
(ENU).
"""

from __future__ import annotations

import numpy as np

from pipeline.geometry.arrays import Floats

ENU_FROM_NED: Floats = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# FRD axes of a camera body written in RDF: forward is z, right is x, down is y.
FRD_FROM_RDF: Floats = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def skew(v: Floats) -> Floats:
    """The cross-product matrix of v.

    Args:
        v: (..., 3).

    Returns:
        (..., 3, 3) with skew(v) @ w = v x w.
    """
    v = np.asarray(v, np.float64)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def rotation_from_vector(v: Floats) -> Floats:
    """The rotation exp([v]x) (Rodrigues).

    Args:
        v: (..., 3) rotation vector, rad.

    Returns:
        (..., 3, 3).
    """
    v = np.asarray(v, np.float64)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    k = skew(v)
    small = angle < 1e-8
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle**2 / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    out: Floats = np.eye(3) + a * k + b * (k @ k)
    return out


def rotation_from_quaternion(q_wxyz: Floats) -> Floats:
    """The rotation matrix of a unit quaternion.

    Args:
        q_wxyz: (..., 4), scalar first; normalised here.

    Returns:
        (..., 3, 3).
    """
    q = np.asarray(q_wxyz, np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, v = q[..., :1, None], q[..., 1:]
    vv = v[..., :, None] * v[..., None, :]
    dot = np.sum(v * v, axis=-1)[..., None, None]
    out: Floats = (w**2 - dot) * np.eye(3) + 2.0 * vv + 2.0 * w * skew(v)
    return out


def quaternion_from_rotation(rotation: Floats) -> Floats:
    """The unit quaternion of a rotation matrix, scalar part not negative.

    Args:
        rotation: (..., 3, 3).

    Returns:
        (..., 4), w first. Shepperd's method: the largest of the four squares is divided by, so no case is ill-
        conditioned.
    """
    r = np.asarray(rotation, np.float64)
    trace = np.trace(r, axis1=-2, axis2=-1)
    diagonal = np.diagonal(r, axis1=-2, axis2=-1)
    # Rows of 4 q q^T, one for each choice of pivot.
    k = np.empty((*r.shape[:-2], 4, 4))
    k[..., 0, 0] = 1.0 + trace
    for i in range(3):
        k[..., i + 1, i + 1] = 1.0 - trace + 2.0 * diagonal[..., i]
    for i, (a, b) in enumerate(((2, 1), (0, 2), (1, 0))):
        k[..., 0, i + 1] = k[..., i + 1, 0] = r[..., a, b] - r[..., b, a]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        k[..., i + 1, j + 1] = k[..., j + 1, i + 1] = r[..., i, j] + r[..., j, i]
    pivot = np.argmax(np.diagonal(k, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(k, pivot[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    out: Floats = np.where(q[..., :1] < 0.0, -q, q)
    return out


def ned_from_frd(yaw_rad: Floats | float, pitch_rad: Floats | float, roll_rad: Floats | float) -> Floats:
    """The attitude of an FRD body in NED from yaw, pitch, roll (intrinsic ZYX).

    Args:
        yaw_rad: (...) clockwise from true north.
        pitch_rad: (...) nose up positive.
        roll_rad: (...) right side down positive.

    Returns:
        (..., 3, 3).
    """
    yaw, pitch, roll = np.broadcast_arrays(*(np.asarray(a, np.float64) for a in (yaw_rad, pitch_rad, roll_rad)))
    cy, sy, cp, sp, cr, sr = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def enu_from_cam(yaw_rad: Floats | float, pitch_rad: Floats | float, roll_rad: Floats | float) -> Floats:
    """The attitude of an RDF camera in ENU from a gimbal's yaw, pitch and roll.

    Pitch -90 deg at yaw 0 looks straight down with the image's top to the north and its right edge to the east.

    Args:
        yaw_rad: (...) of the optical axis, clockwise from true north.
        pitch_rad: (...) of the optical axis above the horizon.
        roll_rad: (...) about the optical axis.

    Returns:
        (..., 3, 3).
    """
    out: Floats = ENU_FROM_NED @ ned_from_frd(yaw_rad, pitch_rad, roll_rad) @ FRD_FROM_RDF
    return out


def gimbal_angles(rotation_enu_from_cam: Floats) -> Floats:
    """Yaw, pitch and roll of a camera; the inverse of `enu_from_cam` with |pitch| <= 90 deg.

    Straight up or down yaw and roll are not separate; roll is then 0.

    Args:
        rotation_enu_from_cam: (..., 3, 3).

    Returns:
        (..., 3) yaw, pitch, roll in rad.
    """
    r = ENU_FROM_NED.T @ np.asarray(rotation_enu_from_cam, np.float64) @ FRD_FROM_RDF.T
    pitch = -np.arcsin(np.clip(r[..., 2, 0], -1.0, 1.0))
    level = np.hypot(r[..., 0, 0], r[..., 1, 0])
    vertical = level < 1e-9
    yaw = np.where(vertical, np.arctan2(-r[..., 0, 1], r[..., 1, 1]), np.arctan2(r[..., 1, 0], r[..., 0, 0]))
    roll = np.where(vertical, 0.0, np.arctan2(r[..., 2, 1], r[..., 2, 2]))
    return np.stack([yaw, pitch, roll], axis=-1)


def gimbal_error_axes(rotation_enu_from_cam: Floats) -> Floats:
    """The world axes about which small yaw, pitch and roll errors turn a camera on a gimbal.

    A drone's gimbal turns about the vertical first, then about the level forward axis, then about the camera's own
    right axis; those are the axes. Euler angles would not do: straight down, yaw and roll fall together, and no error
    would be left about the level forward axis, which a gimbal has all the same.

    Args:
        rotation_enu_from_cam: (..., 3, 3).

    Returns:
        (..., 3, 3), columns the yaw, pitch and roll axis in ENU; a camera off by small angles (dyaw, dpitch, droll) is
        turned by the world rotation vector axes @ (dyaw, dpitch, droll).
    """
    right = np.asarray(rotation_enu_from_cam, np.float64)[..., :, 0]
    down = np.broadcast_to(np.array([0.0, 0.0, -1.0]), right.shape)
    forward = np.cross(np.array([0.0, 0.0, 1.0]), right)
    # A camera rolled on its side has its right axis on the vertical; any level axis then serves for roll.
    length = np.linalg.norm(forward, axis=-1, keepdims=True)
    forward = np.where(length > 1e-9, forward / np.maximum(length, 1e-9), np.array([0.0, 1.0, 0.0]))
    return np.stack([down, right, forward], axis=-1)


def vector_from_rotation(rotation: Floats) -> Floats:
    """The rotation vector of a rotation matrix; the inverse of `rotation_from_vector` below half a turn.

    Args:
        rotation: (..., 3, 3).

    Returns:
        (..., 3) rad.
    """
    q = quaternion_from_rotation(rotation)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    out: Floats = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0) * q[..., 1:]
    return out
