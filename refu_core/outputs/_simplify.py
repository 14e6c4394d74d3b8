"""Which vertices and triangles a coarse copy of a mesh keeps: half-edge collapses by quadric error, boundary kept.

As Garland and Heckbert 1997, but vertices stay where they are, so a coarse vertex is one of the garment's. Errors are
averaged over several shapes of one mesh, since a garment folds where its wearer bends.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from refu_core.mesh import Connectivity, face_normals, vertex_areas

_EVEN = 0.03
"""An edge costs as much as missing a triangle's plane by this share of the edge's length. Cloth folds elsewhere in each
pose, so triangles should be of about one size; only sharp shapes are worth small ones."""
_RIM = 3.0
"""How much more missing a boundary's line counts than missing a plane by the same distance."""
_LEAST_COSINE = 0.3
"""Cosine of the largest angle by which a triangle may turn in one collapse."""
_LONGEST = 8
"""Most neighbours of a kept vertex: above this, fans of slivers begin."""

Vector = tuple[float, float, float]


class CoarseSheet:
    """A mesh with `faces` (F, 3) in several `shapes` (P, V, 3) [m]; no collapse turns a triangle over in the first."""

    def __init__(self, shapes: NDArray[np.float64], faces: NDArray[np.int32]) -> None:
        mesh = Connectivity.of(faces, shapes.shape[1])
        self.places: list[Vector] = [tuple(row) for row in shapes[0].tolist()]
        self.shapes = np.ascontiguousarray(shapes.transpose(1, 0, 2))
        x, y, z = np.moveaxis(self.shapes, -1, 0)
        terms = (x * x, 2 * x * y, 2 * x * z, 2 * x, y * y, 2 * y * z, 2 * y, z * z, 2 * z, np.ones_like(x))
        self.terms = np.stack(terms, -1).reshape(len(self.shapes), -1)
        """What a quadric is multiplied by to get its value at each vertex, shape (V, 10 P)."""
        self.faces: dict[int, tuple[int, int, int]] = dict(enumerate(map(tuple, faces.tolist())))
        self.fan: list[set[int]] = [set() for _ in self.places]
        self.ring: list[set[int]] = [set() for _ in self.places]
        for number, face in self.faces.items():
            for corner in face:
                self.fan[corner].add(number)
        for a, b in mesh.edges.tolist():
            self.ring[a].add(b)
            self.ring[b].add(a)
        self.rim: list[set[int]] = [set() for _ in self.places]
        """Each vertex's neighbours along the boundary."""
        for a, b in mesh.boundary.tolist():
            self.rim[a].add(b)
            self.rim[b].add(a)
        self.n_rim = len(mesh.boundary)
        every, areas = zip(*(_quadrics(shape, mesh) for shape in shapes), strict=True)
        self.quadrics = np.stack(every, 1).reshape(len(self.shapes), -1) / len(shapes)
        """Each vertex's quadrics in all shapes, divided by the number of shapes, shape (V, 10 P)."""
        self.areas = np.mean(areas, axis=0)

    def collapsed(self, most: int) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
        """Collapses edges until twice the faces and a wall along the boundary are at most `most` triangles, if it can.

        Returns the vertices that are kept, (K,), and faces that index these, (G, 3).
        """
        edges = [(u, v) for u, ring in enumerate(self.ring) for v in ring]
        heap = [(price, u, v, 0) for price, u, v in self._options(edges)]
        heapq.heapify(heap)
        age = [0] * len(self.places)
        while heap and 2 * (len(self.faces) + self.n_rim) > most:
            _, u, v, seen = heapq.heappop(heap)
            if seen != age[u] + age[v] or v not in self.ring[u] or not self._may(u, v):
                continue
            self._collapse(u, v)
            age[u] = -(1 << 40)
            age[v] += 1
            for price, a, b in self._options([pair for w in self.ring[v] for pair in ((v, w), (w, v))]):
                heapq.heappush(heap, (price, a, b, age[a] + age[b]))
        kept, of_corner = np.unique(np.array(list(self.faces.values())), return_inverse=True)
        return kept.astype(np.intp), of_corner.reshape(-1, 3).astype(np.int32)

    def _options(self, edges: Sequence[tuple[int, int]]) -> Iterator[tuple[float, int, int]]:
        """The edges whose first vertex may be drawn to the second, each with what that costs before it."""
        may = [(u, v) for u, v in edges if not self.rim[u] or v in self.rim[u]]
        if not may:
            return
        start, end = np.array(may).T
        cost = np.einsum("kq,kq->k", self.terms[end], self.quadrics[start])
        way = self.shapes[end] - self.shapes[start]
        cost += _EVEN**2 * self.areas[start] * np.einsum("kpi,kpi->k", way, way) / way.shape[1]
        yield from ((price, *edge) for price, edge in zip(cost.tolist(), may, strict=True))

    def _may(self, u: int, v: int) -> bool:
        """Whether u may be drawn to v: the surface stays a manifold, and no triangle is turned over."""
        on_rim = v in self.rim[u]
        if self.rim[u] and (not on_rim or len(self.rim[u]) != 2 or self.rim[u] == {v}):
            return False
        if len(self.ring[u] & self.ring[v]) != (1 if on_rim else 2):
            return False
        if on_rim and self.rim[u] & self.rim[v]:
            return False  # a loop of three
        if len(self.ring[u] | self.ring[v]) - 2 > _LONGEST + len(self.rim[v]):
            return False
        for number in self.fan[u]:
            face = self.faces[number]
            if v in face:
                continue
            before = _normal(*(self.places[c] for c in face))
            after = _normal(*(self.places[v if c == u else c] for c in face))
            dot = sum(a * b for a, b in zip(before, after, strict=True))
            square = sum(a * a for a in before) * sum(a * a for a in after)
            if dot <= 0 or dot * dot < _LEAST_COSINE**2 * square:
                return False
        return True

    def _collapse(self, u: int, v: int) -> None:
        for number in list(self.fan[u]):
            face = self.faces[number]
            if v in face:
                del self.faces[number]
                for corner in face:
                    self.fan[corner].discard(number)
            else:
                self.faces[number] = tuple(v if c == u else c for c in face)  # type: ignore[assignment]
                self.fan[v].add(number)
        for other in self.ring[u]:
            self.ring[other].discard(u)
            if other != v:
                self.ring[other].add(v)
                self.ring[v].add(other)
        if self.rim[u]:
            (other,) = self.rim[u] - {v}
            for end, gone, new in ((other, u, v), (v, u, other)):
                self.rim[end].discard(gone)
                self.rim[end].add(new)
            self.n_rim -= 1
        self.fan[u], self.ring[u], self.rim[u] = set(), set(), set()
        self.quadrics[v] += self.quadrics[u]
        self.areas[v] += self.areas[u]


def _normal(a: Vector, b: Vector, c: Vector) -> Vector:
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


def _quadrics(vertices: NDArray[np.float64], mesh: Connectivity) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Each vertex's sum of squared distances from the planes around it as a form (V, 10), and its area [m²], (V,).

    Planes are weighted by area; boundaries add planes of their own.
    """
    normal = face_normals(vertices, mesh.faces)
    double = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(double, 1e-18)[:, None]
    forms = np.zeros((len(vertices), 4, 4))
    plane = np.concatenate((normal, -(normal * vertices[mesh.faces[:, 0]]).sum(1, keepdims=True)), axis=1)
    third = double / 6
    for corner in range(3):
        np.add.at(forms, mesh.faces[:, corner], third[:, None, None] * plane[:, :, None] * plane[:, None])
    for corner in range(3):
        rim = mesh.n_faces_of_edge[mesh.edge_of_corner[:, corner]] == 1
        start, end = mesh.faces[rim, corner], mesh.faces[rim, (corner + 1) % 3]
        out = np.cross(vertices[end] - vertices[start], normal[rim])
        length = np.linalg.norm(out, axis=1)
        out /= np.maximum(length, 1e-18)[:, None]
        wall = np.concatenate((out, -(out * vertices[start]).sum(1, keepdims=True)), axis=1)
        form = (_RIM * length**2)[:, None, None] * wall[:, :, None] * wall[:, None]
        np.add.at(forms, start, form)
        np.add.at(forms, end, form)
    upper = forms[:, [0, 0, 0, 0, 1, 1, 1, 2, 2, 3], [0, 1, 2, 3, 1, 2, 3, 2, 3, 3]]
    return upper, vertex_areas(vertices, mesh.faces)
