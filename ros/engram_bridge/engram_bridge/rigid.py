"""Rigid transforms as (4, 4) float64 matrices, target first: ``odom_from_base``."""

from __future__ import annotations

import numpy as np


def inverse(a_from_b):
    """``b_from_a``."""
    rotation, translation = a_from_b[:3, :3], a_from_b[:3, 3]
    b_from_a = np.eye(4)
    b_from_a[:3, :3] = rotation.T
    b_from_a[:3, 3] = -rotation.T @ translation
    return b_from_a


def of_xyz_rpy(values):
    """From x, y, z in metres and fixed-axis roll, pitch, yaw in radians, as URDF states them."""
    x, y, z, roll, pitch, yaw = (float(one) for one in values)
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in (roll, pitch, yaw))
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    matrix[:3, 3] = x, y, z
    return matrix


def of_turn(vector_rad):
    """A turn around an axis by its length, as a rotation vector (3,) states it; no shift."""
    x, y, z = vector_rad
    half = 0.5 * float(np.linalg.norm(vector_rad))
    # sin(half) / half without its sine: as good at none at all, where a gyroscope rests.
    share = 0.5 * float(np.sinc(half / np.pi))
    return of_quaternion([share * x, share * y, share * z, np.cos(half)], [0.0, 0.0, 0.0])


def quaternion(a_from_b):
    """x, y, z, w of the rotation, unit length, w not negative."""
    r = a_from_b[:3, :3]
    # The largest of the four is found first: dividing by a small one loses digits.
    squares = [
        1 + r[0, 0] - r[1, 1] - r[2, 2],
        1 - r[0, 0] + r[1, 1] - r[2, 2],
        1 - r[0, 0] - r[1, 1] + r[2, 2],
        1 + r[0, 0] + r[1, 1] + r[2, 2],
    ]
    x2, y2, z2, w2 = squares
    most = int(np.argmax(squares))
    rows = {
        0: [x2, r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
        1: [r[0, 1] + r[1, 0], y2, r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
        2: [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], z2, r[1, 0] - r[0, 1]],
        3: [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], w2],
    }
    q = np.array(rows[most], np.float64)
    q /= np.linalg.norm(q)
    return q if q[3] >= 0 else -q


def adjoint(a_from_b):
    """(6, 6): takes a left perturbation [translation, rotation] in b to one in a."""
    rotation, t = a_from_b[:3, :3], a_from_b[:3, 3]
    skew = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = matrix[3:, 3:] = rotation
    matrix[:3, 3:] = skew @ rotation
    return matrix


def at_its_own_origin(a_from_b, covariance):
    """The covariance as ROS states it: of b's origin, along the axes of a.

    Args:
        a_from_b: (4, 4).
        covariance: (6, 6) of `a_from_b`, left perturbation, [translation, rotation].
    """
    shift = np.eye(4)
    shift[:3, 3] = -a_from_b[:3, 3]
    moved = adjoint(shift)
    return moved @ covariance @ moved.T


def of_quaternion(xyzw, translation):
    """From a unit quaternion and a translation in metres."""
    x, y, z, w = np.array(xyzw, np.float64) / np.linalg.norm(xyzw)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = translation
    return matrix
