"""Finds pieces of a cloth that are near each other now but far apart in the rest shape, in Numba."""

import numba
import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float32]
_Ints = NDArray[np.int32]


@numba.njit(cache=True, fastmath=True)
def find_candidates(x: _Floats, faces: _Ints, rest: _Floats, rest_apart: float, cell: float) -> tuple[_Ints, _Ints]:
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
    cx, cy, cz, rx, ry, rz = here[0], here[1], here[2], here[3], here[4], here[5]

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
                    px, py, pz = x[i, 0] - cx[s], x[i, 1] - cy[s], x[i, 2] - cz[s]
                    qx, qy, qz = rest[i, 0] - rx[s], rest[i, 1] - ry[s], rest[i, 2] - rz[s]
                    is_near = px * px + py * py + pz * pz <= cell2
                    hits += is_near & (qx * qx + qy * qy + qz * qz >= apart2)
                if hits == 0:
                    continue
                for s in range(first, last):
                    px, py, pz = x[i, 0] - cx[s], x[i, 1] - cy[s], x[i, 2] - cz[s]
                    qx, qy, qz = rest[i, 0] - rx[s], rest[i, 1] - ry[s], rest[i, 2] - rz[s]
                    if px * px + py * py + pz * pz > cell2 or qx * qx + qy * qy + qz * qz < apart2:
                        continue
                    if count == len(vertex):
                        vertex = np.concatenate((vertex, np.empty(count, np.int32)))
                        face = np.concatenate((face, np.empty(count, np.int32)))
                    vertex[count] = i
                    face[count] = member[s]
                    count += 1
    return vertex[:count], face[:count]


@numba.njit(cache=True, fastmath=True)
def near_pairs(x: _Floats, faces: _Ints, vertex: _Ints, face: _Ints, reach: float) -> tuple[_Ints, _Ints, _Floats]:
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
        ux, uy, uz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
        vx, vy, vz = x[c, 0] - x[a, 0], x[c, 1] - x[a, 1], x[c, 2] - x[a, 2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        height = (x[i, 0] - x[a, 0]) * nx + (x[i, 1] - x[a, 1]) * ny + (x[i, 2] - x[a, 2]) * nz
        if abs(height) < reach * np.sqrt(nx * nx + ny * ny + nz * nz):
            which[count] = s
            side[count] = 1.0 if height >= 0 else -1.0
            count += 1
    return vertex[which[:count]], faces[face[which[:count]]], side[:count]
