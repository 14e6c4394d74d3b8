"""Body model files in SMPL's format that aren't SMPL's.

Made from the built-in bodies, and as far from them as SMPL's are: 6,890 vertices in an order of their own, other
triangles, legs nearer together and arms lower in the rest pose, other proportions (bust, hips, belly, head), hip joints
9 cm lower and 5 cm nearer to the middle, skin that is shared otherwise between joints, a shape space of which a part
isn't in the built-in one, and pose blend shapes that move skin by up to a centimetre where a joint bends.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.spatial import cKDTree

from refu_core.body import PARENTS, load_body
from refu_core.mesh import Connectivity, vertex_normals

Array = NDArray[np.float64]
N_VERTICES = 6890
N_FACES = 13776
_JOINT_SHIFT = {
    0: (0, -0.02, 0.01),
    1: (-0.05, -0.09, 0),
    3: (0, -0.06, 0),
    9: (0, -0.06, 0.03),
    13: (0.05, -0.06, -0.03),
}
_JOINT_SHIFT |= {16: (-0.01, -0.02, -0.01), 18: (-0.02, -0.005, -0.01), 7: (-0.01, 0, -0.01), 12: (0, -0.05, -0.03)}
_PAIRS = {1: 2, 4: 5, 7: 8, 10: 11, 13: 14, 16: 17, 18: 19, 20: 21, 22: 23}


@dataclass(frozen=True)
class Proportions:
    """How a file's mean body differs from the built-in one [m]."""

    bust: float = 0.0
    hips: float = 0.0
    belly: float = 0.0
    head: float = 0.0
    legs: float = 0.0
    """Added to their length."""
    betas: float = 0.5
    """Size of its mean body's scores in the built-in space."""
    legs_together: float = 0.06
    """[rad]"""
    arms_down: float = 0.06
    """[rad]"""


FEMALE = Proportions(bust=0.03, hips=0.025, head=0.004, legs=0.02)
MALE = Proportions(belly=0.02, bust=-0.008, head=0.006, legs=-0.015)
NEUTRAL = Proportions(hips=0.01, belly=0.01)
OF: dict[str, Proportions] = {"female": FEMALE, "male": MALE, "neutral": NEUTRAL}


@cache
def smpl_arrays(gender: str = "female", *, n_betas: int = 10, seed: int = 0) -> dict[str, NDArray[Any]]:
    """The arrays of a file, by SMPL's keys."""
    rng = np.random.default_rng(seed)
    how = OF[gender]
    body = load_body(gender, dtype=torch.float64)
    known, mesh = body.arrays, Connectivity.of(body.faces)
    # In another rest pose, of another mean shape.
    pose = np.zeros((1, 24, 3))
    pose[0, 1, 2], pose[0, 2, 2] = -how.legs_together, how.legs_together
    pose[0, 16, 2], pose[0, 17, 2] = -how.arms_down, how.arms_down
    pose[0, 16, 1], pose[0, 17, 1] = how.arms_down, -how.arms_down
    mean = how.betas * rng.uniform(-1, 1, 10)
    rest = body(pose, mean[None])
    turned = torch.einsum("vj,jab->vab", body.weights, rest.transforms.rotation[0]).numpy()
    rest_v, joints = rest.vertices[0].numpy(), rest.joints[0].numpy()
    normals = vertex_normals(rest_v, mesh.faces)
    vertices, joints = _proportioned(rest_v, joints, normals, how)
    shapes = np.einsum("vab,vbk->vak", turned, known.shapedirs)
    shapes = _own_shapes(shapes, vertices, normals, n_betas, rng)
    for joint, shift in _JOINT_SHIFT.items():
        joints[joint] += shift
        if joint in _PAIRS:
            joints[_PAIRS[joint]] += np.array(shift) * (-1, 1, 1)
    weights = _own_weights(known.weights, vertices, mesh, joints)
    poses = _pose_shapes(vertices, normals, joints, rng)
    sample, faces = _other_triangles(vertices, mesh, rng)
    v_template = sample @ vertices
    return {
        "v_template": v_template,
        "f": faces.astype(np.uint32),
        "weights": sample @ weights,
        "J_regressor": _regressor(joints, v_template),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(24)], np.uint32),
        "shapedirs": (sample @ shapes.reshape(len(vertices), -1)).reshape(N_VERTICES, 3, -1),
        "posedirs": (sample @ poses.reshape(len(vertices), -1)).reshape(N_VERTICES, 3, 207),
    }


def write_smpl(
    folder: Path, gender: str = "female", *, n_betas: int = 10, suffix: str = ".npz", **changed: Any
) -> Path:
    """Writes such a file, with some arrays changed; returns its path."""
    path = folder / f"SMPL_{gender.upper()}{suffix}"
    arrays = {**smpl_arrays(gender, n_betas=n_betas), **changed}
    if suffix == ".npz":
        np.savez(path, **arrays)
    else:
        path.write_bytes(pickle.dumps(arrays))
    return path


def _bump(points: Array, centre: Any, width: float) -> Array:
    bump: Array = np.exp(-((points - np.asarray(centre)) ** 2).sum(1) / (2 * width**2))
    return bump


def _both(points: Array, centre: tuple[float, float, float], width: float) -> Array:
    x, y, z = centre
    return _bump(points, (x, y, z), width) + _bump(points, (-x, y, z), width)


def _proportioned(vertices: Array, joints: Array, normals: Array, how: Proportions) -> tuple[Array, Array]:
    chest, hip, belly = joints[9], joints[0], joints[3]
    out = how.bust * _both(vertices, (0.08, chest[1] - 0.02, chest[2] + 0.15), 0.06)
    out += how.hips * _both(vertices, (0.14, hip[1] - 0.06, hip[2] - 0.03), 0.09)
    out += how.belly * _bump(vertices, (0, belly[1], belly[2] + 0.12), 0.09)
    out += how.head * (vertices[:, 1] > joints[15, 1]) * np.clip((vertices[:, 1] - joints[15, 1]) / 0.03, 0, 1)
    moved = vertices + out[:, None] * normals

    def longer(points: Array) -> Array:
        share = np.clip((joints[0, 1] - 0.1 - points[:, 1]) / 0.8, 0, 1)
        return points - np.array([0, how.legs, 0]) * share[:, None]

    return longer(moved), longer(joints)


def _own_shapes(shapes: Array, vertices: Array, normals: Array, n: int, rng: Any) -> Array:
    """A rotation of the built-in space, and in each direction some millimetres that aren't in it."""
    mix, _ = np.linalg.qr(rng.normal(size=(10, 10)))
    mix = 0.5 * mix + 0.5 * np.diag(rng.choice([-1.0, 1.0], 10))
    found = np.zeros((len(vertices), 3, n))
    found[:, :, :10] = shapes @ mix
    trunk = vertices[np.abs(vertices[:, 0]) < 0.25]
    for k in range(n):
        size = 0.004 if k < 10 else 0.003 * 0.98**k
        for _ in range(3):
            x, y, z = trunk[rng.integers(len(trunk))]
            found[:, :, k] += size * rng.normal() * (_both(vertices, (x, y, z), 0.08)[:, None] * normals)
    return found


def _own_weights(weights: Array, vertices: Array, mesh: Connectivity, joints: Array) -> Array:
    """As if the hip joints were lower: what belongs to a thigh begins farther down; and all a bit blurred."""
    near_hip = _both(vertices, (0.1, joints[0, 1] - 0.05, 0.0), 0.1)
    _, seen = cKDTree(vertices).query(vertices + near_hip[:, None] * np.array([0, 0.04, 0]))
    taken = weights[seen]
    mean = diags_array(1 / np.diff(mesh.ring.start)) @ mesh.adjacency_matrix()
    for _ in range(2):
        taken = 0.5 * taken + 0.5 * (mean @ taken)
    blurred: Array = taken / taken.sum(1, keepdims=True)
    return blurred


def _pose_shapes(vertices: Array, normals: Array, joints: Array, rng: Any) -> Array:
    found = np.zeros((len(vertices), 3, 207))
    for joint in range(1, 22):
        near = _bump(vertices, joints[joint], 0.06)
        for entry in range(9):
            side = (vertices - joints[joint]) @ rng.normal(size=3) / 0.06
            found[:, :, 9 * (joint - 1) + entry] = 0.004 * (near * np.tanh(side))[:, None] * normals
    return found


def _regressor(joints: Array, vertices: Array) -> Array:
    """From the vertices around each joint, rows sum to one."""
    rows = np.zeros((24, len(vertices)))
    tree = cKDTree(vertices)
    for j, place in enumerate(joints):
        _, near = tree.query(place, 200)
        one = np.concatenate([vertices[near].T, np.ones((1, len(near)))])
        uniform = np.full(len(near), 1 / len(near))
        rows[j, near] = uniform + np.linalg.pinv(one) @ (np.array([*place, 1.0]) - one @ uniform)
    return rows


def _other_triangles(vertices: Array, mesh: Connectivity, rng: Any) -> tuple[csr_array, NDArray[np.int64]]:
    """What takes attributes of the vertices to those of another mesh (N_VERTICES, V), and its faces."""
    faces, n = mesh.faces.astype(np.int64).copy(), mesh.n_vertices
    gone, locked = np.zeros(n, bool), np.zeros(n, bool)
    for a, b, _ in faces[rng.permutation(len(faces))]:
        if n - gone.sum() == N_VERTICES:
            break
        around = [np.unique(faces[(faces == v).any(1)]) for v in (a, b)]
        if locked[np.concatenate(around)].any() or len(np.intersect1d(*around)) != 4 or vertices[a, 1] > 0.3:
            continue
        faces[faces == b] = a
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
        gone[b] = locked[np.concatenate(around)] = True
    # Each vertex goes some way towards a point between its neighbours.
    own = Connectivity.of(faces, n).ring
    share = rng.random(len(own.items)) ** 3
    towards = csr_array((share, own.items, own.start), shape=(n, n))
    towards = diags_array(1 / np.maximum(towards.sum(1), 1e-9)) @ towards
    step = rng.uniform(0, 0.5, n) * (vertices[:, 1] < 0.28) * (np.abs(vertices[:, 0]) < 0.65)
    moved = diags_array(1 - step) + diags_array(step) @ towards
    kept = rng.permutation(np.flatnonzero(~gone))
    number = np.empty(n, np.int64)
    number[kept] = np.arange(len(kept))
    order = rng.permutation(len(faces))
    return csr_array(moved.tocsr()[kept]), number[faces][order]
