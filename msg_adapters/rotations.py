"""Rotation vectors and unit quaternions (x, y, z, w); any leading batch dimensions, computed in float64."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float64Array = np.ndarray[Any, np.dtype[np.float64]]

_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
_SMALL = 1e-8  # below it, sin(x)/x equals its limit to the last digit of float64


def quaternion_from_rotvec(rotvec: ArrayLike) -> NDArray[np.float64]:
    """Unit quaternions xyzw, shape (..., 4), of rotation vectors [rad], shape (..., 3)."""
    rotvec = np.asarray(rotvec, dtype=np.float64)
    angle = np.linalg.norm(rotvec, axis=-1, keepdims=True)
    half_sinc = np.where(angle < _SMALL, 0.5, np.sin(0.5 * angle) / np.maximum(angle, _SMALL))
    return np.concatenate([half_sinc * rotvec, np.cos(0.5 * angle)], axis=-1)


def quaternion_product(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions xyzw, shape (..., 4), of first's rotation with second's in its frame, shapes (..., 4)."""
    u, v, a, b = first[..., :3], second[..., :3], first[..., 3:], second[..., 3:]
    cross = u[..., _NEXT] * v[..., _LAST] - u[..., _LAST] * v[..., _NEXT]  # np.cross takes ten times as long for few
    return np.concatenate([a * v + b * u + cross, a * b - (u * v).sum(axis=-1, keepdims=True)], axis=-1)


def rotvec_from_quaternion(quaternion: ArrayLike) -> NDArray[np.float64]:
    """Rotation vectors [rad] no longer than pi, shape (..., 3), of quaternions xyzw of any length > 0, (..., 4)."""
    q = np.asarray(quaternion, dtype=np.float64)
    # Scaling by the largest component first keeps the norm from over- and underflowing.
    q = q / np.max(np.abs(q), axis=-1, keepdims=True)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    q = np.where(q[..., 3:] < 0, -q, q)  # q and -q are one rotation; this one has the shorter vector
    vector, w = q[..., :3], q[..., 3:]
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    scale = np.where(sine < _SMALL, 2.0, 2.0 * np.arctan2(sine, w) / np.maximum(sine, _SMALL))
    result: Float64Array = scale * vector
    return result


def slerp(start: NDArray[np.float64], end: NDArray[np.float64], fraction: ArrayLike) -> NDArray[np.float64]:
    """Unit quaternions on the shorter arc from `start` to `end`, shapes (..., 4); `fraction` in [0, 1], shape (...)."""
    t = np.asarray(fraction, dtype=np.float64)[..., None]
    cosine = np.sum(start * end, axis=-1, keepdims=True)
    end = np.where(cosine < 0, -end, end)
    # The angle from the chord: accurate for close rotations, where arccos isn't.
    angle = 2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(end - start, axis=-1, keepdims=True), 0.0, 1.0))
    sine = np.sin(angle)
    close = sine < _SMALL
    safe = np.where(close, 1.0, sine)
    a = np.where(close, 1.0 - t, np.sin((1.0 - t) * angle) / safe)
    b = np.where(close, t, np.sin(t * angle) / safe)
    q = a * start + b * end
    result: Float64Array = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return result


def matrix_from_quaternion(quaternion: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrices, shape (..., 3, 3), of unit quaternions xyzw, shape (..., 4)."""
    x, y, z, w = np.moveaxis(np.asarray(quaternion, dtype=np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix: Float64Array = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
    return matrix


def quaternion_from_matrix(matrix: ArrayLike) -> NDArray[np.float64]:
    """Unit quaternions xyzw with w >= 0, shape (..., 4), of rotation matrices, shape (..., 3, 3)."""
    m = np.asarray(matrix, dtype=np.float64)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    # 4 q qᵀ, whose entries are sums of those of the matrix: its longest row is q times the largest component, so
    # nothing small is divided by.
    outer = np.empty((*m.shape[:-2], 4, 4))
    outer[..., 0, 0], outer[..., 1, 1] = 1 + xx - yy - zz, 1 - xx + yy - zz
    outer[..., 2, 2], outer[..., 3, 3] = 1 - xx - yy + zz, 1 + xx + yy + zz
    for i, j in ((0, 1), (0, 2), (1, 2)):
        outer[..., i, j] = outer[..., j, i] = m[..., i, j] + m[..., j, i]
    for i, (j, k) in enumerate(((2, 1), (0, 2), (1, 0))):
        outer[..., i, 3] = outer[..., 3, i] = m[..., j, k] - m[..., k, j]
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    q = np.where(q[..., 3:] < 0, -q, q)
    result: Float64Array = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return result
