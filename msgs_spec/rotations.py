"""Quaternions, matrices and Euler angles of any batch shape.

Quaternions are wxyz as in MuJoCo; only ROS messages contain xyzw. All functions work on new
contiguous arrays and element by element, so a batch gives the same bits as one call per row. Euler
angles are intrinsic (relative) xyz, as in `gymnasium_robotics.utils.rotations`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from msgs_spec.arrays import Array

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
IDENTITY.flags.writeable = False
_SINGULAR = 4.0 * np.finfo(np.float64).eps


def _parts(array: ArrayLike) -> list[Any]:
    """Split an array along its last axis into contiguous arrays."""
    values = np.asarray(array, dtype=np.float64)
    return [np.array(values[..., index], order='C') for index in range(values.shape[-1])]


def quaternion_multiply(first: ArrayLike, second: ArrayLike) -> Array:
    """Return the Hamilton product of wxyz quaternions, (..., 4) each."""
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
    """Return the conjugate of quaternions wxyz (..., 4), the inverse of unit quaternions."""
    values = np.asarray(quaternion, dtype=np.float64)
    return np.asarray(values * np.array([1.0, -1.0, -1.0, -1.0]))


def quaternion_from_axis_angle(axis: ArrayLike, angle: ArrayLike) -> Array:
    """Return unit quaternions wxyz of axes (..., 3), of any length but 0, and angles (...), rad."""
    direction = np.array(axis, dtype=np.float64)
    direction = direction / _length(direction)
    half = np.asarray(angle, dtype=np.float64)[..., None] / 2.0
    quaternion = np.concatenate([np.cos(half), np.sin(half) * direction], axis=-1)
    return np.asarray(quaternion / _length(quaternion))


def _length(vectors: Array) -> Array:
    """Return lengths (..., 1) of vectors (..., n), one `np.linalg.norm` per vector.

    `np.linalg.norm` of one vector calls BLAS, which rounds differently from a sum along an axis.
    With a sum, one start state in eight would differ from Gymnasium-Robotics in the last bit.
    """
    rows = vectors.reshape(-1, vectors.shape[-1])
    lengths = np.array([np.linalg.norm(row) for row in rows])
    return lengths.reshape(*vectors.shape[:-1], 1)


def quaternion_to_matrix(quaternion: ArrayLike) -> Array:
    """Return rotation matrices (..., 3, 3) of unit quaternions wxyz (..., 4).

    The result equals that of `mju_quat2Mat` in MuJoCo 4 bit for bit: sums have the same order.
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
    """Return intrinsic Euler angles xyz (..., 3), rad, of rotation matrices (..., 3, 3)."""
    values = np.asarray(matrix, dtype=np.float64)
    m = np.ascontiguousarray(np.moveaxis(values, (-2, -1), (0, 1)))
    cy = np.sqrt(m[2, 2] * m[2, 2] + m[1, 2] * m[1, 2])
    regular = cy > _SINGULAR
    x = np.where(regular, -np.arctan2(m[1, 2], m[2, 2]), 0.0)
    y = -np.arctan2(-m[0, 2], cy)
    z = np.where(regular, -np.arctan2(m[0, 1], m[0, 0]), -np.arctan2(-m[1, 0], m[1, 1]))
    return np.stack([x, y, z], axis=-1)


def euler_to_quaternion(euler: ArrayLike) -> Array:
    """Return unit quaternions wxyz (..., 4) of intrinsic Euler angles xyz (..., 3), rad."""
    x, y, z = _parts(euler)
    ai, aj, ak = z / 2, -y / 2, x / 2
    si, sj, sk = np.sin(ai), np.sin(aj), np.sin(ak)
    ci, cj, ck = np.cos(ai), np.cos(aj), np.cos(ak)
    cc, cs, sc, ss = ci * ck, ci * sk, si * ck, si * sk
    return np.stack(
        [cj * cc + sj * ss, cj * cs - sj * sc, -(cj * ss + sj * cc), cj * sc - sj * cs], axis=-1
    )


def quaternion_to_euler(quaternion: ArrayLike) -> Array:
    """Return intrinsic Euler angles xyz (..., 3), rad, of quaternions wxyz (..., 4) of any norm."""
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
    """Return the angles (...), rad, between unit quaternions wxyz (..., 4).

    If `antipodal`, q and -q are the same rotation and angles are in [0, pi]. Otherwise q and -q are
    2 pi apart and angles are in [0, 2 pi], as in Gymnasium-Robotics.
    """
    real = _parts(quaternion_multiply(first, quaternion_conjugate(second)))[0]
    return np.asarray(2.0 * np.arccos(np.clip(np.abs(real) if antipodal else real, -1.0, 1.0)))
