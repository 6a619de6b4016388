"""Quaternions, matrices and Euler angles of any batch shape; the one place of wxyz and xyzw.

MuJoCo writes quaternions wxyz, ROS messages xyzw. Everything in this project is wxyz except inside
a message. All functions work on fresh contiguous arrays and element by element, so a batch gives
the same bits as one call per row. Euler angles are Gymnasium-Robotics' relative xyz convention
(`gymnasium_robotics.utils.rotations`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from msgs_spec.arrays import Array

# The quaternion of no rotation.
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
IDENTITY.flags.writeable = False
_SINGULAR = 4.0 * np.finfo(np.float64).eps


def wxyz_to_xyzw(quaternion: ArrayLike) -> Array:
    """Returns MuJoCo quaternions (..., 4) in the order of ROS messages."""
    return np.ascontiguousarray(np.roll(np.asarray(quaternion, dtype=np.float64), -1, axis=-1))


def xyzw_to_wxyz(quaternion: ArrayLike) -> Array:
    """Returns quaternions (..., 4) from ROS messages in MuJoCo's order."""
    return np.ascontiguousarray(np.roll(np.asarray(quaternion, dtype=np.float64), 1, axis=-1))


def _parts(array: ArrayLike) -> list[Any]:
    """The components along the last axis, each a contiguous array."""
    values = np.asarray(array, dtype=np.float64)
    return [np.array(values[..., index], order='C') for index in range(values.shape[-1])]


def quaternion_multiply(first: ArrayLike, second: ArrayLike) -> Array:
    """Hamilton product of wxyz quaternions, (..., 4) each."""
    w0, x0, y0, z0 = _parts(first)
    w1, x1, y1, z1 = _parts(second)
    return np.stack(
        [
            w0 * w1 - x0 * x1 - y0 * y1 - z0 * z1,
            w0 * x1 + x0 * w1 + y0 * z1 - z0 * y1,
            w0 * y1 + y0 * w1 + z0 * x1 - x0 * z1,
            w0 * z1 + z0 * w1 + x0 * y1 - y0 * x1,
        ],
        axis=-1,
    )


def quaternion_conjugate(quaternion: ArrayLike) -> Array:
    """Inverse of unit quaternions wxyz, (..., 4)."""
    values = np.asarray(quaternion, dtype=np.float64)
    return np.asarray(values * np.array([1.0, -1.0, -1.0, -1.0]))


def quaternion_from_axis_angle(axis: ArrayLike, angle: ArrayLike) -> Array:
    """Unit quaternions wxyz from axes (..., 3) of any length and angles (...) in radians."""
    direction = np.array(axis, dtype=np.float64)
    direction = direction / _length(direction)
    half = np.asarray(angle, dtype=np.float64)[..., None] / 2.0
    quaternion = np.concatenate([np.cos(half), np.sin(half) * direction], axis=-1)
    return np.asarray(quaternion / _length(quaternion))


def _length(vectors: Array) -> Array:
    """Lengths (..., 1) of vectors (..., n), each taken alone as `np.linalg.norm` does.

    That is BLAS, which on many processors rounds once less than a sum along an axis: one start in
    eight would otherwise differ from Gymnasium-Robotics in its last bit, and soon in all.
    """
    rows = vectors.reshape(-1, vectors.shape[-1])
    lengths = np.array([np.linalg.norm(row) for row in rows])
    return lengths.reshape(*vectors.shape[:-1], 1)


def quaternion_to_matrix(quaternion: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions wxyz.

    The order of the sums is that of MuJoCo 4 (`mju_quat2Mat`), whose bits it gives.
    """
    w, x, y, z = _parts(quaternion)
    ww, wx, wy, wz = w * w, w * x, w * y, w * z
    xx, xy, xz = x * x, x * y, x * z
    yy, yz, zz = y * y, y * z, z * z
    rows = [
        [(ww - yy) + (xx - zz), 2 * (xy - wz), 2 * (xz + wy)],
        [2 * (xy + wz), (ww + yy) - (xx + zz), 2 * (yz - wx)],
        [2 * (xz - wy), 2 * (yz + wx), (ww - yy) - (xx - zz)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_euler(matrix: ArrayLike) -> Array:
    """Euler angles xyz (..., 3), radians, of rotation matrices (..., 3, 3)."""
    values = np.asarray(matrix, dtype=np.float64)
    m = np.ascontiguousarray(np.moveaxis(values, (-2, -1), (0, 1)))
    cy = np.sqrt(m[2, 2] * m[2, 2] + m[1, 2] * m[1, 2])
    regular = cy > _SINGULAR
    x = np.where(regular, -np.arctan2(m[1, 2], m[2, 2]), 0.0)
    y = -np.arctan2(-m[0, 2], cy)
    z = np.where(regular, -np.arctan2(m[0, 1], m[0, 0]), -np.arctan2(-m[1, 0], m[1, 1]))
    return np.stack([x, y, z], axis=-1)


def euler_to_matrix(euler: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of Euler angles xyz (..., 3) in radians."""
    x, y, z = _parts(euler)
    si, sj, sk = np.sin(-z), np.sin(-y), np.sin(-x)
    ci, cj, ck = np.cos(-z), np.cos(-y), np.cos(-x)
    cc, cs, sc, ss = ci * ck, ci * sk, si * ck, si * sk
    rows = [
        [cj * ci, cj * si, -sj],
        [sj * cs - sc, sj * ss + cc, cj * sk],
        [sj * cc + ss, sj * sc - cs, cj * ck],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def euler_to_quaternion(euler: ArrayLike) -> Array:
    """Quaternions wxyz (..., 4) of Euler angles xyz (..., 3) in radians."""
    x, y, z = _parts(euler)
    ai, aj, ak = z / 2, -y / 2, x / 2
    si, sj, sk = np.sin(ai), np.sin(aj), np.sin(ak)
    ci, cj, ck = np.cos(ai), np.cos(aj), np.cos(ak)
    cc, cs, sc, ss = ci * ck, ci * sk, si * ck, si * sk
    return np.stack(
        [cj * cc + sj * ss, cj * cs - sj * sc, -(cj * ss + sj * cc), cj * sc - sj * cs], axis=-1
    )


def quaternion_to_euler(quaternion: ArrayLike) -> Array:
    """Euler angles xyz (..., 3), radians, of quaternions wxyz (..., 4) of any norm."""
    w, x, y, z = _parts(quaternion)
    norm = w * w + x * x + y * y + z * z
    scale = 2.0 / np.where(norm > 0.0, norm, 1.0)
    xs, ys, zs = x * scale, y * scale, z * scale
    wx, wy, wz = w * xs, w * ys, w * zs
    xx, xy, xz = x * xs, x * ys, x * zs
    yy, yz, zz = y * ys, y * zs, z * zs
    rows = [
        [1.0 - (yy + zz), xy - wz, xz + wy],
        [xy + wz, 1.0 - (xx + zz), yz - wx],
        [xz - wy, yz + wx, 1.0 - (xx + yy)],
    ]
    matrix = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    degenerate = norm <= np.finfo(np.float64).eps
    return matrix_to_euler(np.where(degenerate[..., None, None], np.eye(3), matrix))


def rotation_angle(first: ArrayLike, second: ArrayLike, antipodal: bool) -> Array:
    """Angle between unit quaternions wxyz (..., 4), radians.

    Args:
        first: Quaternions.
        second: Quaternions.
        antipodal: True measures the rotation, in [0, pi]: q and -q are the same. False compares the
            raw quaternions as Gymnasium-Robotics does, in [0, 2 pi]: q and -q are 2 pi apart.
    """
    real = _parts(quaternion_multiply(first, quaternion_conjugate(second)))[0]
    return np.asarray(2.0 * np.arccos(np.clip(np.abs(real) if antipodal else real, -1.0, 1.0)))
