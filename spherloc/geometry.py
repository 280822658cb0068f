"""Rotations, rigid poses and gravity alignment.

A pose is ``cam_from_map``, a (3, 4) matrix [R | t] in metres with p_cam = R p_map + t.
"""

import numpy as np
from numpy.typing import ArrayLike

from spherloc.types import FloatArray

DOWN = np.array([0.0, 1.0, 0.0])
"""Gravity in every aligned frame: the y axis points down."""


def yaw_rotation(yaw_rad: float) -> FloatArray:
    """Rotation (3, 3) about y, Eq. 1: x' = x cos + z sin, z' = -x sin + z cos."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def yaw_of(rotation: FloatArray) -> float:
    """Yaw (rad, in [-pi, pi]) of the rotation about y closest to ``rotation`` (3, 3)."""
    return float(np.arctan2(rotation[0, 2] - rotation[2, 0], rotation[0, 0] + rotation[2, 2]))


def wrap_angle(angle_rad: ArrayLike) -> FloatArray:
    """Angles brought into [-pi, pi)."""
    wrapped = (np.asarray(angle_rad, dtype=np.float64) + np.pi) % (2 * np.pi) - np.pi
    return np.where(wrapped >= np.pi, -np.pi, wrapped)  # rounding may reach pi


def skew(vector: FloatArray) -> FloatArray:
    """Matrix (3, 3) with skew(a) b = a x b."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def so3_exp(rotation_vector: FloatArray) -> FloatArray:
    """Rotation (3, 3) of a rotation vector (3,), radians (Rodrigues, exact to rounding at zero)."""
    angle = float(np.linalg.norm(rotation_vector))
    k = skew(rotation_vector)
    half = np.sinc(angle / (2 * np.pi))
    return np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * half * half * (k @ k)


def rotation_angle(rotation: FloatArray) -> float:
    """Angle (rad) of a rotation (3, 3), accurate near zero and near pi (atan2 form)."""
    axis = 0.5 * np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return float(np.arctan2(np.linalg.norm(axis), 0.5 * (np.trace(rotation) - 1.0)))


def align_to_down(gravity: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that takes the unit vector ``gravity`` (3,) to +y."""
    axis = np.cross(gravity, DOWN)
    sine, cosine = float(np.linalg.norm(axis)), float(gravity @ DOWN)
    if sine < 1e-12:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    return so3_exp(axis / sine * np.arctan2(sine, cosine))


def tangent_basis(directions: FloatArray) -> FloatArray:
    """Two unit vectors (N, 2, 3) as rows, orthogonal to each other and to each of the unit ``directions`` (N, 3)."""
    # The coordinate axis farthest from the direction keeps the cross product well conditioned.
    helper = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    first: FloatArray = np.cross(directions, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second: FloatArray = np.cross(directions, first)
    return np.stack([first, second], axis=1)


def pose(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """[R | t] (3, 4) of a rotation (3, 3) and a translation (3,) or (3, 1)."""
    matrix = np.empty((3, 4))
    matrix[:, :3], matrix[:, 3] = rotation, np.reshape(translation, 3)
    return matrix


def level_poses(yaws_rad: FloatArray, translations: FloatArray) -> FloatArray:
    """The poses (P, 3, 4) of rotations by yaws (P,) about y (Eq. 1) and translations (P, 3), m."""
    poses = np.zeros((len(yaws_rad), 3, 4))
    poses[:, 0, 0] = poses[:, 2, 2] = np.cos(yaws_rad)
    poses[:, 0, 2] = np.sin(yaws_rad)
    poses[:, 2, 0] = -poses[:, 0, 2]
    poses[:, 1, 1] = 1.0
    poses[:, :, 3] = translations
    return poses


def camera_centre(cam_from_map: FloatArray) -> FloatArray:
    """Camera position (3,) in the map frame: -R^T t."""
    return -cam_from_map[:, :3].T @ cam_from_map[:, 3]


def inverse_pose(cam_from_map: FloatArray) -> FloatArray:
    """The pose (3, 4) that undoes one (3, 4)."""
    return pose(cam_from_map[:, :3].T, camera_centre(cam_from_map))


def transform(cam_from_map: FloatArray, points: FloatArray) -> FloatArray:
    """Points (N, 3) of the map in the camera frame."""
    return points @ cam_from_map[:, :3].T + cam_from_map[:, 3]
