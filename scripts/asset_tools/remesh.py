"""Isotropic remeshing after Botsch and Kobbelt (2004), with a sizing field and boundaries that stay where they are."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh
from numpy.typing import NDArray

from asset_tools.surfaces import Faces, Vertices, boundary_loops, compact
from refu_core.mesh import face_normals, vertex_normals

Sizing = Callable[[Vertices], NDArray[np.float64]]
"""Wanted edge length [m] at points (N, 3): shape (N,)."""

Face = tuple[int, int, int]

_SPLIT, _COLLAPSE = 4 / 3, 4 / 5
_FLIP_NORMAL = 0.3  # cosine: no operation may turn a face farther than this


def remesh(v: Vertices, f: Faces, *, sizing: Sizing) -> tuple[Vertices, Faces]:
    """Even triangles of the wanted size on the same surface; the boundary polylines are resampled at the same size."""
    surface = trimesh.Trimesh(v, f, process=False)
    curves = [v[np.append(loop, loop[0])] for loop in boundary_loops(f)]
    mesh = _Mesh(v, f, sizing)
    for _ in range(8):
        mesh.split_long_edges()
        mesh.collapse_short_edges()
        mesh.flip_edges()
        mesh.relax(surface, curves)
    mesh.flip_edges()
    return mesh.arrays()


def closest_on_polyline(points: Vertices, curve: Vertices) -> tuple[Vertices, NDArray[np.float64]]:
    """The closest points on an open polyline (N, 3), and their distances."""
    a, d = curve[:-1], np.diff(curve, axis=0)
    t = np.einsum("psk,sk->ps", points[:, None] - a, d) / np.maximum((d * d).sum(1), 1e-30)
    candidates = a + np.clip(t, 0, 1)[..., None] * d
    distance = np.linalg.norm(candidates - points[:, None], axis=2)
    best = distance.argmin(1)
    rows = np.arange(len(points))
    return candidates[rows, best], distance[rows, best]


class _Mesh:
    """A manifold mesh that is being edited: faces by number, and the faces of every vertex."""

    def __init__(self, v: Vertices, f: Faces, sizing: Sizing) -> None:
        self.points: list[NDArray[np.float64]] = list(np.asarray(v, dtype=np.float64))
        self.faces: dict[int, Face] = {i: (int(a), int(b), int(c)) for i, (a, b, c) in enumerate(f)}
        self.around: list[set[int]] = [set() for _ in v]
        for i, face in self.faces.items():
            for vertex in face:
                self.around[vertex].add(i)
        self.sizing = sizing
        self.size: list[float] = list(sizing(v))
        self.next_face = len(f)
        self.border = {int(x) for loop in boundary_loops(np.asarray(f)) for x in loop}

    # -- queries

    def length(self, a: int, b: int) -> float:
        d = self.points[a] - self.points[b]
        return float(np.sqrt(d @ d))

    def wanted(self, a: int, b: int) -> float:
        return (self.size[a] + self.size[b]) / 2

    def edges(self) -> list[tuple[int, int]]:
        return sorted(
            {(a, b) if a < b else (b, a) for x, y, z in self.faces.values() for a, b in ((x, y), (y, z), (z, x))}
        )

    def edge_faces(self, a: int, b: int) -> list[int]:
        return sorted(self.around[a] & self.around[b])

    def neighbours(self, a: int) -> set[int]:
        return {x for face in self.around[a] for x in self.faces[face]} - {a}

    def normal(self, face: Face, moved: dict[int, NDArray[np.float64]] | None = None) -> NDArray[np.float64]:
        p = [moved[x] if moved and x in moved else self.points[x] for x in face]
        return _cross(p[1] - p[0], p[2] - p[0])

    # -- edits

    def remove(self, i: int) -> None:
        for vertex in self.faces.pop(i):
            self.around[vertex].discard(i)

    def add(self, face: Face) -> None:
        self.faces[self.next_face] = face
        for vertex in face:
            self.around[vertex].add(self.next_face)
        self.next_face += 1

    def split_long_edges(self) -> None:
        long = [(self.length(a, b) / self.wanted(a, b), a, b) for a, b in self.edges()]
        for _, a, b in sorted((entry for entry in long if entry[0] > _SPLIT), reverse=True):
            faces = self.edge_faces(a, b)
            if not faces or self.length(a, b) <= _SPLIT * self.wanted(a, b):
                continue
            middle = len(self.points)
            self.points.append((self.points[a] + self.points[b]) / 2)
            self.size.append(self.wanted(a, b))
            self.around.append(set())
            if len(faces) == 1:
                self.border.add(middle)
            for i in faces:
                x, y, z = self.faces[i]
                while {x, y} != {a, b}:
                    x, y, z = y, z, x
                self.remove(i)
                self.add((x, middle, z))
                self.add((middle, y, z))

    def collapse_short_edges(self) -> None:
        short = [(self.length(a, b) / self.wanted(a, b), a, b) for a, b in self.edges()]
        for _, a, b in sorted(entry for entry in short if entry[0] < _COLLAPSE):
            if self.around[a] and self.around[b]:
                self._collapse(a, b)

    def _collapse(self, a: int, b: int) -> None:
        faces = self.edge_faces(a, b)
        if not faces or self.length(a, b) >= _COLLAPSE * self.wanted(a, b):
            return
        on_border = (a in self.border) + (b in self.border)
        if on_border == 2 and len(faces) == 2:  # would pinch the surface
            return
        opposite = {x for i in faces for x in self.faces[i]} - {a, b}
        if self.neighbours(a) & self.neighbours(b) != opposite:  # link condition
            return
        if b in self.border and a not in self.border:
            a, b = b, a
        place = self.points[a] if on_border == 1 else (self.points[a] + self.points[b]) / 2
        for x in (self.neighbours(a) | self.neighbours(b)) - {a, b}:
            d = self.points[x] - place
            if np.sqrt(d @ d) > _SPLIT * (self.size[a] + self.size[x]) / 2:
                return
        for i in (self.around[a] | self.around[b]) - set(faces):
            before, after = self.normal(self.faces[i]), self.normal(self.faces[i], {a: place, b: place})
            if before @ after <= _FLIP_NORMAL * np.sqrt((before @ before) * (after @ after)):
                return
        for i in faces:
            self.remove(i)
        for i in sorted(self.around[b]):
            face = self.faces[i]
            self.remove(i)
            x, y, z = (a if q == b else q for q in face)
            self.add((x, y, z))
        self.points[a] = place
        self.size[a] = self.wanted(a, b)

    def flip_edges(self) -> None:
        """Flips towards Delaunay's criterion: opposite angles that sum to at most 180 degrees."""
        pending = self.edges()
        for _ in range(5):
            changed: set[tuple[int, int]] = set()
            for a, b in pending:
                changed |= self._flip(a, b)
            pending = sorted(changed)

    def _flip(self, a: int, b: int) -> set[tuple[int, int]]:
        faces = self.edge_faces(a, b)
        if len(faces) != 2:
            return set()
        x, y, z = self.faces[faces[0]]
        while {x, y} != {a, b}:
            x, y, z = y, z, x
        a, b, c = x, y, z  # face (a, b, c); the other is (b, a, d)
        d = next(q for q in self.faces[faces[1]] if q not in (a, b))
        if self._cotangent(c, a, b) + self._cotangent(d, a, b) >= -1e-9 or c in self.neighbours(d):
            return set()
        n1, n2 = self.normal((a, b, c)), self.normal((b, a, d))
        m1, m2 = self.normal((c, d, b)), self.normal((d, c, a))
        for m in (m1, m2):
            for n in (n1, n2):
                if m @ n <= 0.5 * np.sqrt((m @ m) * (n @ n)):
                    return set()
        for i in faces:
            self.remove(i)
        self.add((c, d, b))
        self.add((d, c, a))
        return {(min(p, q), max(p, q)) for p, q in ((a, c), (c, b), (b, d), (d, a))}

    def _cotangent(self, at: int, a: int, b: int) -> float:
        """Cotangent of a corner's angle: the sum over an edge's two sides is negative exactly where Delaunay fails."""
        u, w = self.points[a] - self.points[at], self.points[b] - self.points[at]
        n = _cross(u, w)
        return float(u @ w / max(np.sqrt(n @ n), 1e-18))

    def relax(self, surface: trimesh.Trimesh, curves: list[Vertices]) -> None:
        """Moves vertices within the surface to the centres of their faces, boundary ones along the boundary."""
        v, f, used = self._local()
        normals = vertex_normals(v, f)
        centres = v[f].mean(1)
        size = np.array([self.size[i] for i in used])
        # Relative to the wanted area, so that the sizing field isn't blurred.
        weight = np.linalg.norm(face_normals(v, f), axis=1) / size[f].mean(1) ** 2
        total = np.bincount(f.ravel(), np.repeat(weight, 3), len(v))
        moved = np.stack([np.bincount(f.ravel(), np.repeat(weight * centres[:, k], 3), len(v)) for k in range(3)], 1)
        step = moved / np.maximum(total, 1e-30)[:, None] - v
        step -= normals * np.einsum("vk,vk->v", step, normals)[:, None]
        inner = np.ones(len(v), bool)
        for loop in boundary_loops(f):
            inner[loop] = False
            p = v[loop]
            centre = (np.roll(p, 1, 0) + np.roll(p, -1, 0)) / 2
            curve = min(curves, key=lambda c: closest_on_polyline(p[:1], c)[1][0])
            v[loop] = closest_on_polyline((p + centre) / 2, curve)[0]
        v[inner] = trimesh.proximity.closest_point(surface, (v + 0.8 * step)[inner])[0]
        for i, p, s in zip(used, v, self.sizing(v), strict=True):
            self.points[i], self.size[i] = p, float(s)

    def _local(self) -> tuple[Vertices, Faces, NDArray[np.int64]]:
        used, f = compact(np.array([self.faces[i] for i in sorted(self.faces)], dtype=np.int64))
        return np.array([self.points[i] for i in used]), f, used

    def arrays(self) -> tuple[Vertices, Faces]:
        return self._local()[:2]


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    # np.cross costs ten times this for one pair.
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
