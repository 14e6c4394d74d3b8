"""Reduces models with fingers and faces (SMPL-H, SMPL-X) to SMPL's 24 joints: all that hangs from a wrist is a hand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.frames import N_JOINTS
from refu_core.skeleton import PARENTS

_SHARED = 22
"""Joints that the models have in common: all but SMPL's two hands."""
_WRISTS = (20, 21)
N_WITH_FINGERS = (52, 55)
"""Joints of SMPL-H and of SMPL-X."""


def without_fingers(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """The arrays of such a model reduced to 24 joints; those of any other model unchanged.

    A hand's joint is the mean of the knuckles at its wrist, and moves all that the fingers moved; jaw and eyes go with
    the head. Finger poses no longer move anything, nor do their blend shapes.
    """
    found = dict(arrays)
    tree = np.asarray(arrays["kintree_table"])
    if tree.ndim != 2 or tree.shape[1] not in N_WITH_FINGERS or tuple(tree[0, 1:_SHARED]) != PARENTS[1:_SHARED]:
        return found
    n, parents = tree.shape[1], tree[0].astype(np.int64)
    weights, regressor = np.asarray(arrays["weights"]), np.asarray(arrays["J_regressor"])
    if weights.shape[1:] != (n,) or regressor.shape[:1] != (n,) or (parents[_SHARED:] >= np.arange(_SHARED, n)).any():
        return found  # the later check of shapes reports it
    goes_with = np.arange(n)
    for joint in range(_SHARED, n):
        parent = int(parents[joint])
        goes_with[joint] = _SHARED + _WRISTS.index(parent) if parent in _WRISTS else goes_with[parent]
    share = np.zeros((n, N_JOINTS))
    share[np.arange(n), goes_with] = 1
    knuckles = [_SHARED + np.flatnonzero(parents[_SHARED:] == wrist) for wrist in _WRISTS]
    if not all(map(len, knuckles)):
        return found
    found["weights"] = weights @ share
    found["J_regressor"] = np.concatenate((regressor[:_SHARED], np.stack([regressor[one].mean(0) for one in knuckles])))
    found["kintree_table"] = np.array([[-1, *PARENTS[1:]], range(N_JOINTS)])
    poses = np.asarray(arrays.get("posedirs"))
    if poses.ndim == 3 and poses.shape[2] == 9 * (n - 1):
        rest = np.zeros((*poses.shape[:2], 9 * (N_JOINTS - _SHARED)))
        found["posedirs"] = np.concatenate((poses[:, :, : 9 * (_SHARED - 1)], rest), axis=2)
    return found
