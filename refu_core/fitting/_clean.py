"""Makes one orientable manifold surface from a file's triangles, or says why that can't be done."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from refu_core.errors import GarmentError
from refu_core.fitting._mesh_file import F64, Ints, SurfaceMesh
from refu_core.garments import UvMap
from refu_core.mesh import Connectivity, face_normals, linked

_SAME_PLACE = 1e-5
"""Vertices closer to each other than this are merged, as a share of the mesh's extent: 10 µm for a dress."""
_FAR_OFF = 20.0
"""Faces this many times as far out as nearly all of a mesh don't belong to it."""
_MOST_TURNS = 0.01
"""Most faces that are left out because inside becomes outside on them, as a share of all: of six scans and garments
with bows and laces 0.03 to 3.9 ‰. A Möbius strip has more, unless it is over 100 faces long."""
_PINHOLES = 0.15
"""Rims shorter than this, as a share of the square root of a piece's area, are pinholes, and it is closed: panels with
both their sides had 0.03 to 0.07, a sock has 0.9, and cloth all over a body, open at its face, would have 0.3."""
MAX_VERTICES = 60_000
"""Most vertices of a garment that is worn; with edges of 10 mm a garment has about a tenth of that many."""


def clean(mesh: SurfaceMesh) -> tuple[SurfaceMesh, list[str]]:
    """The mesh welded, without double faces, manifold and consistently oriented, and what was done to it.

    Vertices that no face uses are left out. Seams along which UVs cut a mesh open are closed; its UVs stay as they are.
    Where more than two faces meet at an edge, the two that continue each other stay together.

    Raises `GarmentError`: no surface is left, or it has one side only (a Möbius strip).
    """
    notes: list[str] = []
    if mesh.uv is not None and not np.isfinite(mesh.uv.coordinates).all():
        notes.append("the texture coordinates were left out: some are NaN or infinite")
        mesh = replace(mesh, uv=None)
    mesh = _without_double_faces(_without_strays(mesh, notes), notes)
    mesh = _welded(mesh, notes)
    n_crowded = partners(mesh)[1]
    mesh = _cut_apart(_oriented(mesh, notes))
    if n_crowded:
        notes.append(
            f"{n_crowded} edges had more than two faces and were cut open; simulated cloth would come apart there"
        )
    return mesh, notes


def components(faces: Ints, n: int) -> tuple[int, Ints]:
    """The number of pieces, and the piece of each of the n vertices."""
    return linked(np.concatenate((faces[:, :2], faces[:, 1:])), n)


def rim_vertices(f: Ints) -> Ints:
    """Vertices of edges that have only one face."""
    return np.unique(Connectivity.of(f).boundary).astype(np.int64)


def open_pieces(v: F64, f: Ints, label: Ints) -> NDArray[np.bool_]:
    """Whether each piece (P,) has an opening, and so one side; `label` (V,) is the piece of each vertex."""
    a, b = Connectivity.of(f, len(v)).boundary.T
    n = int(label.max()) + 1
    rims = np.bincount(label[a], np.linalg.norm(v[a] - v[b], axis=1), n)
    area = np.bincount(label[f[:, 0]], np.linalg.norm(face_normals(v, f), axis=1) / 2, n)
    return rims > _PINHOLES * np.sqrt(area)


def no_opening(f: Ints) -> str:
    """A hint if the largest piece is closed and no hole goes through it: no limb can. Two-sided cloth has holes."""
    used, f = np.unique(f, return_inverse=True)
    f = f.reshape(-1, 3)
    _, label = components(f, len(used))
    largest = int(np.bincount(label).argmax())
    f = f[label[f[:, 0]] == largest]
    euler = int((label == largest).sum()) - len(_edges(f)[0]) + len(f)
    return ". It has no opening: if faces close its neck, sleeves, legs or hem, delete those" if euler == 2 else ""


def split_long_edges(mesh: SurfaceMesh, longest: float) -> SurfaceMesh:
    """The same surface with edges of at most `longest`: long ones are halved until none is left."""
    n = len(mesh.vertices)
    while True:
        v, f = mesh.vertices, mesh.faces
        edges, of_corner = _edges(f)
        long = np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1) > longest
        if not long.any():
            return mesh
        uv = mesh.uv
        new_v = np.concatenate((v, v[edges[long]].mean(1)))
        if len(new_v) > MAX_VERTICES:
            msg = f"with edges of at most {1e3 * longest:.0f} mm the garment has more than {MAX_VERTICES} vertices, "
            msg += f"{n} of them its own: is it larger than a garment? (--unit); or decimate it, or allow longer edges "
            msg += "(--longest-edge)"
            raise GarmentError(msg)
        middle = np.where(long, len(v) + np.cumsum(long) - 1, -1)
        faces = _split(f, middle[of_corner])
        if uv is not None:
            uv_edges, uv_of_corner = _edges(uv.faces)
            is_long = np.zeros(len(uv_edges), bool)
            is_long[uv_of_corner[long[of_corner]]] = True
            uv_middle = np.where(is_long, len(uv.coordinates) + np.cumsum(is_long) - 1, -1)
            # An edge of the texture may belong to two edges of the mesh: it is split where the face is, and only there.
            corners = np.where(long[of_corner], uv_middle[uv_of_corner], -1)
            coordinates = np.concatenate((uv.coordinates, uv.coordinates[uv_edges[is_long]].mean(1)))
            uv = UvMap(coordinates.astype(np.float32), _split(uv.faces, corners))
        mesh = SurfaceMesh(new_v, faces, uv)


_CUTS = ("012", "032 312", "140 420", "314 034 042", "251 501", "503 253 231", "425 145 150", "035 314 542 345")
"""Triangles that a face becomes by which of its edges (0, 1), (1, 2), (2, 0) are cut, as bits: corners are 0 to 2, cuts
3 to 5."""


def _split(f: Ints, middle: Ints) -> Ints:
    """Triangles, in order, of faces (F, 3) cut at `middle`: vertices on edges (0, 1), (1, 2), (2, 0), -1 for none."""
    places, cut = np.concatenate((f, middle), 1), (middle >= 0) @ [1, 2, 4]
    parts = [(np.flatnonzero(cut == k), [*map(int, part)]) for k, parts in enumerate(_CUTS) for part in parts.split()]
    triangles = np.concatenate([places[rows][:, corners] for rows, corners in parts])
    # By face, and then as listed, so that UVs, which are split separately, come out in the same order.
    return triangles[np.argsort(np.concatenate([rows for rows, _ in parts]), kind="stable")]


def _edges(f: Ints) -> tuple[NDArray[np.int32], Ints]:
    """Each edge once (E, 2), and the numbers of the edges (0, 1), (1, 2), (2, 0) of each face (F, 3)."""
    known = Connectivity(f.astype(np.int32), int(f.max(initial=0)) + 1)
    return known.edges, known.edge_of_corner


def _without_strays(mesh: SurfaceMesh, notes: list[str]) -> SurfaceMesh:
    """The mesh without faces so far off that the garment would be a speck beside them."""
    v = mesh.vertices
    low, middle, high = np.percentile(v[mesh.faces].reshape(-1, 3), (2, 50, 98), axis=0)
    reach = _FAR_OFF * float(np.maximum(high - middle, middle - low).max())
    kept = (np.abs(v - middle) <= reach).all(axis=1)[mesh.faces].all(axis=1)
    if kept.all():
        return mesh
    notes.append(f"{int((~kept).sum())} faces far off all others were left out")
    return mesh.only(kept)


def _groups_of_place(v: F64, extent: float) -> Ints:
    """For each vertex the first one at the same place, shape (V,), in a mesh of some extent."""
    # Vertices in one tiny cell are merged before pairs are looked for: a crowd would make countless pairs.
    cell = np.floor((v - v.min(0)) / (_SAME_PLACE * extent / np.sqrt(3)))
    _, first, of_cell = np.unique(cell, axis=0, return_index=True, return_inverse=True)
    pairs = cKDTree(v[first]).query_pairs(_SAME_PLACE * extent, output_type="ndarray")
    label = linked(pairs, len(first))[1][of_cell.ravel()]
    _, first, of_group = np.unique(label, return_index=True, return_inverse=True)
    return first[of_group].astype(np.int64)


def _without_double_faces(mesh: SurfaceMesh, notes: list[str]) -> SurfaceMesh:
    extent = float(np.linalg.norm(np.ptp(mesh.compact().vertices, axis=0)))
    n = len(mesh.faces)
    # Faces without area go first: their corners may all be at one place, and make countless pairs.
    has_area = np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1) >= (1e-7 * extent) ** 2
    mesh = mesh.only(has_area).compact()
    place = _groups_of_place(mesh.vertices, extent)[mesh.faces]
    has_area = (place != np.roll(place, 1, 1)).all(1)
    mesh, place = mesh.only(has_area).compact(), place[has_area]
    if n > len(mesh.faces):
        notes.append(f"{n - len(mesh.faces)} faces without area were left out")
    _, first = np.unique(np.sort(place, 1), axis=0, return_index=True)
    if len(first) < len(place):
        notes.append(f"{len(place) - len(first)} faces were there twice and are there once")
    return mesh.only(np.isin(np.arange(len(place)), first))


def _welded(mesh: SurfaceMesh, notes: list[str]) -> SurfaceMesh:
    """Merges vertices of open edges that are at one place; sheets that only touch stay apart."""
    on_rim = rim_vertices(mesh.faces)
    target = np.arange(len(mesh.vertices))
    if len(on_rim):
        extent = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
        target[on_rim] = on_rim[_groups_of_place(mesh.vertices[on_rim], extent)]
    n_welded = int((target != np.arange(len(target))).sum())
    if n_welded:
        notes.append(f"{n_welded} vertices lay on others, along seams, and were welded to them")
    return mesh.compact(target[mesh.faces])


def partners(mesh: SurfaceMesh) -> tuple[Ints, int]:
    """Pairs of corners, 3 f + k for the edge from corner k of face f, across which faces continue; (P, 2).

    Also how many edges have more than two faces. Of these faces, the two that fold least stay together.
    """
    edges, of_corner = _edges(mesh.faces)
    order = np.argsort(of_corner.ravel(), kind="stable")
    count = np.bincount(of_corner.ravel(), minlength=len(edges))
    start = np.concatenate(([0], np.cumsum(count)))[:-1]
    plain = start[count == 2]
    pairs = [np.stack((order[plain], order[plain + 1]), 1)]
    centre = mesh.vertices[mesh.faces].mean(1)
    crowded = np.flatnonzero(count > 2)
    for edge in crowded:
        corners = order[start[edge] : start[edge] + count[edge]]
        a, b = mesh.vertices[edges[edge]]
        along = (b - a) / np.linalg.norm(b - a)
        away = centre[corners // 3] - a
        away -= (away @ along)[:, None] * along
        away /= np.linalg.norm(away, axis=1, keepdims=True) + 1e-300
        i, j = np.unravel_index(np.argmin(away @ away.T), (len(corners),) * 2)
        pairs.append(np.array([[corners[i], corners[j]]]))
    return np.concatenate(pairs), len(crowded)


def _oriented(mesh: SurfaceMesh, notes: list[str]) -> SurfaceMesh:
    """The mesh with each piece facing one way, as most of its faces do, without faces on which inside becomes outside.

    Raises `GarmentError` if those are more than a few: it has one side only.
    """
    n = len(mesh.faces)
    while True:
        flipped, is_turn = _sides(mesh.faces, partners(mesh)[0])
        if not is_turn.any():
            break
        mesh = mesh.only(~is_turn)  # where more than two faces met, others become neighbours
        if n - len(mesh.faces) > _MOST_TURNS * n:
            msg = "the mesh has one side only: following it round (a Möbius strip), inside becomes outside; cut it open"
            raise GarmentError(msg)
    if n > len(mesh.faces):
        notes.append(f"{n - len(mesh.faces)} faces on which inside became outside were left out")
    if flipped.any():
        notes.append(f"{int(flipped.sum())} faces faced the other way than their neighbours and were turned over")
    return turned_over(mesh, flipped)


def _sides(f: Ints, pairs: Ints) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which faces have to be turned over to face as the others of their piece, and which still don't then, (F,) each.

    Each follows its neighbours on the way from its piece's first face that turns over the fewest faces, and is the
    shortest of those: a file's faces agree nearly everywhere, and those that don't then are few.
    """
    start, n = f.ravel()[pairs], len(f)
    agrees = start[:, 0] != start[:, 1]  # the shared edge is run through in opposite directions
    a, b = (pairs // 3).T
    first = np.unique(linked(pairs // 3, n)[1], return_index=True)[1]
    _, once = np.unique(np.minimum(a, b) * n + np.maximum(a, b), return_index=True)
    graph = coo_array((np.where(agrees, 1.0, n)[once], (a[once], b[once])), shape=(n, n)).tocsr()
    ways: Any = dijkstra(graph, False, first, return_predecessors=True, min_only=True)
    tree = once[(ways[1][a[once]] == b[once]) | (ways[1][b[once]] == a[once])]
    # Each face is there twice, as it is (k) and turned over (n + k), and linked to neighbours that face the same way.
    same, other = (np.where(agrees, b, b + n)[tree], np.where(agrees, b + n, b)[tree])
    _, label = linked(np.concatenate((np.stack((a[tree], same), 1), np.stack((a[tree] + n, other), 1))), 2 * n)
    as_is, turned = label[:n], label[n:]
    votes = np.bincount(as_is, minlength=label.max() + 1)
    # On a tie, the piece's first face stays: labels count up from the first face on.
    flipped: NDArray[np.bool_] = (votes[as_is] < votes[turned]) | ((votes[as_is] == votes[turned]) & (as_is > turned))
    is_turn = np.zeros(n, np.bool_)
    is_turn[a[(flipped[a] == flipped[b]) != agrees]] = True
    return flipped, is_turn


def turned_over(mesh: SurfaceMesh, flipped: NDArray[np.bool_]) -> SurfaceMesh:
    """The mesh with the `flipped` faces turned over; each still begins at its first corner."""

    def turned(f: Ints) -> Ints:
        return np.where(flipped[:, None], f[:, [0, 2, 1]], f)

    uv = None if mesh.uv is None else replace(mesh.uv, faces=turned(mesh.uv.faces))
    return replace(mesh, faces=turned(mesh.faces), uv=uv)


def _cut_apart(mesh: SurfaceMesh) -> SurfaceMesh:
    """The mesh with a vertex for each fan of faces that edges hold together."""
    f = mesh.faces
    n = f.size
    following = np.arange(n).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    one, other = partners(mesh)[0].T
    # Faces are oriented alike, so an edge begins in one face where it ends in the other.
    links = np.concatenate((np.stack((one, following[other]), 1), np.stack((following[one], other), 1)))
    count, label = linked(links, n)
    first = np.full(count, n, np.int64)
    np.minimum.at(first, label, f.ravel())
    rank = np.argsort(np.argsort(first, kind="stable"))  # the file's order, where nothing was cut
    faces, vertices = rank[label].reshape(-1, 3), np.empty((count, 3))
    vertices[faces] = mesh.vertices[f]
    return replace(mesh, vertices=vertices, faces=faces)
