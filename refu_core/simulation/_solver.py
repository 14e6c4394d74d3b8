"""The inner loops of the cloth, in Numba: extended position-based dynamics (Macklin et al. 2016), Gauss-Seidel.

Everything runs on one thread and in a fixed order: a result is the same bit for bit on the same machine. Positions,
velocities and lengths are float32 in metres and seconds; arrays that aren't described are shaped as in
`SimulatedCloth`.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from refu_core.simulation._cloth import PAST_EDGE

_TINY = np.float32(1e-12)

_Floats = NDArray[np.float32]
_Ints = NDArray[np.int32]
_Vector = tuple[np.float32, np.float32, np.float32]


@numba.njit(cache=True, fastmath=True)
def _between(x: _Floats, i: np.int32, j: np.int32) -> _Vector:
    """The vector to row i from row j."""
    return x[i, 0] - x[j, 0], x[i, 1] - x[j, 1], x[i, 2] - x[j, 2]


@numba.njit(cache=True, fastmath=True)
def _dot(u: _Vector, v: _Vector) -> np.float32:
    product: np.float32 = u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
    return product


@numba.njit(cache=True, fastmath=True)
def _cross(u: _Vector, v: _Vector) -> _Vector:
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@numba.njit(cache=True, fastmath=True)
def _shift(x: _Floats, i: np.int32, step: np.float32, way: _Vector) -> None:
    """Moves row i by a step along a way."""
    x[i, 0] += step * way[0]
    x[i, 1] += step * way[1]
    x[i, 2] += step * way[2]


@numba.njit(cache=True, fastmath=True)
def substep(
    x: _Floats,  # positions (N, 3), updated
    v: _Floats,  # velocities (N, 3), updated
    previous: _Floats,  # scratch (N, 3)
    inverse_mass: _Floats,  # (N,)
    ends: NDArray[np.uint32],  # vertices of the distance constraints (E, 2)
    shortest: _Floats,  # between these two lengths a constraint gives way freely (E,)
    longest: _Floats,
    softness: _Floats,  # compliance over h² (E,)
    h: np.float32,
    gravity: _Floats,  # (3,)
    damping: np.float32,
    contact_vertex: _Ints,  # (C,)
    contact_point: _Floats,  # (C, 3), advanced by contact_motion once
    contact_normal: _Floats,  # (C, 3)
    contact_motion: _Floats,  # motion of the skin in this substep (C, 3)
    margin: np.float32,
    friction: np.float32,
    anchor_vertex: _Ints,  # (A,)
    anchor_point: _Floats,  # (A, 3), advanced by anchor_motion once
    anchor_motion: _Floats,  # (A, 3)
    anchor_stiffness: np.float32,  # share of the way to the anchor closed by an iteration
    pair_vertex: _Ints,  # self-contacts (S,)
    pair_face: _Ints,  # (S, 3) vertices
    pair_side: _Floats,  # (S,) side of the face that the vertex was on when the pair was found
    thickness: np.float32,
    edge_ends: _Ints,  # contacts of edge midpoints (M, 2)
    edge_point: _Floats,  # (M, 3), advanced by edge_motion once
    edge_normal: _Floats,  # (M, 3)
    edge_motion: _Floats,  # (M, 3)
    edge_margin: np.float32,
    iterations: int,
    max_step: np.float32,  # no vertex moves further in one substep; keeps a bad contact from throwing the cloth away
) -> None:
    one = np.float32(1.0)
    half = np.float32(0.5)
    n = x.shape[0]
    for i in range(n):
        for k in range(3):
            previous[i, k] = x[i, k]
            v[i, k] = v[i, k] * damping + h * gravity[k]
            x[i, k] += h * v[i, k]
    contact_point += contact_motion
    anchor_point += anchor_motion
    edge_point += edge_motion

    for _ in range(iterations):
        for c in range(anchor_vertex.shape[0]):
            i = anchor_vertex[c]
            for k in range(3):
                x[i, k] += anchor_stiffness * (anchor_point[c, k] - x[i, k])
        for e in range(ends.shape[0]):
            i = ends[e, 0]
            j = ends[e, 1]
            way = _between(x, i, j)
            length = np.sqrt(_dot(way, way)) + _TINY
            wi = inverse_mass[i]
            wj = inverse_mass[j]
            s = (min(max(length, shortest[e]), longest[e]) - length) / ((wi + wj + softness[e]) * length)
            _shift(x, i, s * wi, way)
            _shift(x, j, -s * wj, way)
        _separate_pairs(x, inverse_mass, pair_vertex, pair_face, pair_side, thickness)
        for c in range(contact_vertex.shape[0]):
            i = contact_vertex[c]
            normal = (contact_normal[c, 0], contact_normal[c, 1], contact_normal[c, 2])
            depth = (
                margin
                - (x[i, 0] - contact_point[c, 0]) * normal[0]
                - (x[i, 1] - contact_point[c, 1]) * normal[1]
                - (x[i, 2] - contact_point[c, 2]) * normal[2]
            )
            if depth > 0:
                _shift(x, i, depth, normal)
                # Coulomb friction on the sliding over the moving skin since the start of the substep.
                sx = x[i, 0] - previous[i, 0] - contact_motion[c, 0]
                sy = x[i, 1] - previous[i, 1] - contact_motion[c, 1]
                sz = x[i, 2] - previous[i, 2] - contact_motion[c, 2]
                along = _dot((sx, sy, sz), normal)
                slide = (sx - along * normal[0], sy - along * normal[1], sz - along * normal[2])
                s = min(one, friction * depth / (np.sqrt(_dot(slide, slide)) + _TINY))
                _shift(x, i, -s, slide)
        for c in range(edge_ends.shape[0]):
            i = edge_ends[c, 0]
            j = edge_ends[c, 1]
            depth = edge_margin
            for k in range(3):
                depth -= (half * (x[i, k] + x[j, k]) - edge_point[c, k]) * edge_normal[c, k]
            if depth > 0:
                wi = inverse_mass[i]
                wj = inverse_mass[j]
                s = half * depth * (one + one) / (wi + wj)
                for k in range(3):
                    x[i, k] += s * wi * edge_normal[c, k]
                    x[j, k] += s * wj * edge_normal[c, k]

    for i in range(n):
        step2 = np.float32(0.0)
        for k in range(3):
            d = x[i, k] - previous[i, k]
            step2 += d * d
        s = one
        if step2 > max_step * max_step:
            s = max_step / np.sqrt(step2)
        for k in range(3):
            d = (x[i, k] - previous[i, k]) * s
            x[i, k] = previous[i, k] + d
            v[i, k] = d / h


@numba.njit(cache=True, fastmath=True)
def _separate_pairs(
    x: _Floats, inverse_mass: _Floats, pair_vertex: _Ints, pair_face: _Ints, pair_side: _Floats, thickness: np.float32
) -> None:
    """Pushes a vertex and a face of the cloth apart to `thickness`, on the side where the vertex was found."""
    one = np.float32(1.0)
    slack = np.float32(PAST_EDGE)
    for c in range(pair_vertex.shape[0]):
        i = pair_vertex[c]
        a = pair_face[c, 0]
        b = pair_face[c, 1]
        d = pair_face[c, 2]
        u, v, r = _between(x, b, a), _between(x, d, a), _between(x, i, a)
        normal = _cross(u, v)
        area2 = _dot(normal, normal) + _TINY * _TINY
        area = np.sqrt(area2)
        side = pair_side[c]
        distance = _dot(r, normal) / area * side
        if distance >= thickness or distance < -thickness - thickness:
            continue
        wb = _dot(_cross(r, v), normal) / area2
        wd = _dot(_cross(u, r), normal) / area2
        wa = one - wb - wd
        if wa < -slack or wb < -slack or wd < -slack:
            continue
        mass = (
            inverse_mass[i] + inverse_mass[a] * wa * wa + inverse_mass[b] * wb * wb + inverse_mass[d] * wd * wd
        ) * area
        s = np.float32(0.5) * (thickness - distance) / mass * side
        _shift(x, i, s * inverse_mass[i], normal)
        _shift(x, a, -s * inverse_mass[a] * wa, normal)
        _shift(x, b, -s * inverse_mass[b] * wb, normal)
        _shift(x, d, -s * inverse_mass[d] * wd, normal)


@numba.njit(cache=True)
def refresh_points(
    x: _Floats,
    face: _Ints,
    weights: _Floats,
    asked_distance: _Floats,
    normal: _Floats,
    stale: _Ints,
    body_faces: _Ints,
    body: _Floats,
    motion: _Floats,
    moving: bool,
    near: np.float32,
) -> tuple[_Ints, _Floats, _Floats, _Floats]:
    """Contacts of the points near the skin: index of the point, place on the skin, its normal, its motion in a substep.

    `normal` (N, 3) keeps the direction from the skin to each point as of the point's last query; that of the `stale`
    points is computed here.
    """
    for i in stale:
        f = face[i]
        if f < 0:
            continue
        a, b, c = body_faces[f, 0], body_faces[f, 1], body_faces[f, 2]
        length2 = np.float32(0.0)
        for k in range(3):
            skin = weights[i, 0] * body[a, k] + weights[i, 1] * body[b, k] + weights[i, 2] * body[c, k]
            normal[i, k] = x[i, k] - skin
            length2 += normal[i, k] * normal[i, k]
        length = np.sqrt(length2)
        if length > 1e-4:
            sign = np.float32(1.0) if asked_distance[i] >= 0 else np.float32(-1.0)
            for k in range(3):
                normal[i, k] *= sign / length
        else:  # on the skin the difference has no direction: the face's normal
            across = _cross(_between(body, b, a), _between(body, c, a))
            area = np.sqrt(_dot(across, across)) + _TINY
            normal[i, 0], normal[i, 1], normal[i, 2] = across[0] / area, across[1] / area, across[2] / area
    which = np.flatnonzero((face >= 0) & (asked_distance < near + near)).astype(np.int32)
    point = np.zeros((len(which), 3), np.float32)
    out_motion = np.zeros((len(which), 3), np.float32)
    for s, i in enumerate(which):
        f = face[i]
        for k in range(3):
            for corner in range(3):
                point[s, k] += weights[i, corner] * body[body_faces[f, corner], k]
                if moving:
                    out_motion[s, k] += weights[i, corner] * motion[body_faces[f, corner], k]
    return which, point, normal[which], out_motion


@numba.njit(cache=True, fastmath=True)
def _is_candidate(
    x: _Floats, rest: _Floats, i: int, here: _Floats, s: int, near2: np.float32, apart2: np.float32
) -> np.bool_:
    """Whether a face is near vertex i, and apart at rest; column s of `here` (6, F) has its centre, now and at rest."""
    p = (x[i, 0] - here[0, s], x[i, 1] - here[1, s], x[i, 2] - here[2, s])
    q = (rest[i, 0] - here[3, s], rest[i, 1] - here[4, s], rest[i, 2] - here[5, s])
    return (_dot(p, p) <= near2) & (_dot(q, q) >= apart2)


@numba.njit(cache=True, fastmath=True)
def find_candidates(
    x: _Floats, faces: _Ints, rest: _Floats, rest_apart: np.float32, cell: np.float32
) -> tuple[_Ints, _Ints]:
    """Pairs of a vertex and a face whose centre is at most `cell` away, and at least `rest_apart` in the rest shape.

    Faces are binned by their centres in a grid of cells of that size. Returns vertices and faces, (C,) each, by vertex.
    """
    n = x.shape[0]
    m = faces.shape[0]
    third = np.float32(1.0 / 3.0)
    low = np.empty(3, np.float32)
    size = np.empty(3, np.int64)
    for k in range(3):
        a, b = x[0, k], x[0, k]
        for i in range(n):
            a, b = min(a, x[i, k]), max(b, x[i, k])
        low[k] = a - cell * np.float32(1.5)  # a rim of empty cells: no neighbour lies outside the grid
        size[k] = np.int64((b - low[k]) / cell) + 2
    key = np.empty(m, np.int32)
    start = np.zeros(size[0] * size[1] * size[2] + 1, np.int32)
    centre = np.empty((m, 6), np.float32)  # of the present and of the rest shape
    for f in range(m):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        for k in range(3):
            centre[f, k] = (x[a, k] + x[b, k] + x[c, k]) * third
            centre[f, k + 3] = (rest[a, k] + rest[b, k] + rest[c, k]) * third
        bucket = np.int64((centre[f, 0] - low[0]) / cell)
        bucket = bucket * size[1] + np.int64((centre[f, 1] - low[1]) / cell)
        bucket = bucket * size[2] + np.int64((centre[f, 2] - low[2]) / cell)
        key[f] = bucket
        start[bucket + 1] += 1
    for c in range(len(start) - 1):
        start[c + 1] += start[c]
    fill = start[:-1].copy()
    member = np.empty(m, np.int32)
    here = np.empty((6, m), np.float32)  # the centres by cell, one row per coordinate, for SIMD
    for f in range(m):
        s = fill[key[f]]
        fill[key[f]] += 1
        member[s] = f
        for k in range(6):
            here[k, s] = centre[f, k]

    vertex = np.empty(4096, np.int32)
    face = np.empty(4096, np.int32)
    count = 0
    cell2 = cell * cell
    apart2 = rest_apart * rest_apart
    for i in range(n):
        ci = np.int64((x[i, 0] - low[0]) / cell)
        cj = np.int64((x[i, 1] - low[1]) / cell)
        ck = np.int64((x[i, 2] - low[2]) / cell)
        for di in range(ci - 1, ci + 2):
            for dj in range(cj - 1, cj + 2):
                row = (di * size[1] + dj) * size[2] + ck
                first, last = np.uint64(start[row - 1]), np.uint64(start[row + 2])  # three consecutive cells
                hits = 0  # counted first, without a branch: nearly all rows have none
                for s in range(first, last):
                    hits += int(_is_candidate(x, rest, i, here, s, cell2, apart2))
                if hits == 0:
                    continue
                for s in range(first, last):
                    if not _is_candidate(x, rest, i, here, s, cell2, apart2):
                        continue
                    if count == len(vertex):
                        vertex = np.concatenate((vertex, np.empty(count, np.int32)))
                        face = np.concatenate((face, np.empty(count, np.int32)))
                    vertex[count] = i
                    face[count] = member[s]
                    count += 1
    return vertex[:count], face[:count]


@numba.njit(cache=True, fastmath=True)
def near_pairs(x: _Floats, faces: _Ints, vertex: _Ints, face: _Ints, reach: np.float32) -> tuple[_Ints, _Ints, _Floats]:
    """The candidates (C,) whose vertex is within `reach` of the plane of its face.

    Returns the vertex (S,), the face's vertices (S, 3) and the side of the face that the vertex is on (S,), by vertex.
    """
    n = vertex.shape[0]
    which = np.empty(n, np.int32)
    side = np.empty(n, np.float32)
    count = 0
    for s in range(n):
        i, f = vertex[s], face[s]
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        normal = _cross(_between(x, b, a), _between(x, c, a))
        height = _dot(_between(x, i, a), normal)
        if abs(height) < reach * np.sqrt(_dot(normal, normal)):
            which[count] = s
            side[count] = 1.0 if height >= 0 else -1.0
            count += 1
    return vertex[which[:count]], faces[face[which[:count]]], side[:count]
