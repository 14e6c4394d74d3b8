"""Pieces of a mesh that aren't one garment: its wearer, panels that aren't sewn, clothes worn together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from refu_core.body import JOINT_NAMES
from refu_core.errors import GarmentError
from refu_core.fitting._clean import clean, components, open_pieces, partners, rim_vertices
from refu_core.fitting._mesh_file import F64, Ints, SurfaceMesh
from refu_core.fitting._posed import PosedBody
from refu_core.fitting._surround import sample
from refu_core.frames import N_JOINTS
from refu_core.mesh import Connectivity, face_normals, linked

_ENDS = tuple(JOINT_NAMES.index(name) for name in ("head", "left_hand", "right_hand", "left_foot", "right_foot"))
_ON_SKIN = 0.02
"""At least half of a body lies nearer than this to the skin [m]; of an overall with hood and gloves, less does."""
_EYE = 0.1
"""Eyes, teeth and brows are smaller than this [m]; a sock is larger."""
_N_NEAR = 5000
"""Points drawn on a wearer and on clothes, 2 cm from each other: a button is nearer to its cloth than the skin is."""
_SLAB = 0.1
"""A floor is thinner than this share of its width, and what stands on it is not."""
_SEAM = 0.01
"""Rims of two pieces nearer to each other than this were meant to be sewn [m]: panels are laid out that way."""
_SHARE = 0.1
"""Least share of a piece's rim that has to be that near to another piece's rim."""
_LARGE = 0.05
"""Least share of a mesh's area that each of several garments in it has."""
_THIN, _SIDE = 0.1, 0.4
"""Cloth is thinner than `_THIN` of the edge of a square of its area, a ball has 0.27; each of its two sides has
more than `_SIDE` of all its area, and its hems have the rest."""
_N_AROUND = 24
"""How many of `_N_NEAR` points on a mesh tell how cloth lies around a face: those within some 4 cm."""
_ALONG = 0.8
"""Least cosine between a face's normal and theirs, either way: faces of a hem have less. 0.7 to 0.9 found both sides of
garments 1.5 to 12 mm thick, with jagged hems; with 0.5, a face of a hem joined the sides of most."""
_SHORT = 0.1
"""A mesh has slivers if a hundredth of its edges is shorter than this share of their median. In a T-shirt cut out of a
grid it is 0.05, and none of 32 attempts to simulate it passed. With vertices nearer than 5 mm merged it is 0.4, and 3
of 22 passed; in the T-shirts that ship it is 0.8."""
_SPECK = 0.05
"""Specks of a scan are smaller than this share of the largest piece, and farther from all that is larger; a glove is a
ninth of a dress."""
_BETWEEN = 0.02
"""Parts farther than this from each other [m] along the body are two garments."""


def _boxes(mesh: SurfaceMesh) -> tuple[Ints, F64, F64]:
    """The piece of each vertex, shape (V,), and from where to where each piece reaches, (P, 3) each."""
    n_pieces, label = components(mesh.faces, len(mesh.vertices))
    low, high = np.full((n_pieces, 3), np.inf), np.full((n_pieces, 3), -np.inf)
    np.minimum.at(low, label, mesh.vertices)
    np.maximum.at(high, label, mesh.vertices)
    return label, low, high


def without_floor(mesh: SurfaceMesh) -> tuple[SurfaceMesh, list[str]]:
    """The mesh, in any unit and axes, without a slab that all the rest stands on or before, and a note of it."""
    label, low, high = _boxes(mesh)
    widest = int(np.prod(np.partition(high - low, 1, axis=1)[:, 1:], axis=1).argmax())
    others = np.arange(len(low)) != widest
    if not others.any():
        return mesh, []
    rest_low, rest_high = low[others].min(0), high[others].max(0)
    size, rest = high[widest] - low[widest], rest_high - rest_low
    axis = int(size.argmin())
    across = np.arange(3) != axis
    is_thin = size[axis] < _SLAB * size[across].min() and rest[axis] > max(2 * size[axis], _SLAB * rest.max())
    is_wider = ((low[widest] < rest_low) & (high[widest] > rest_high))[across].all()
    middle = (low[widest] + high[widest])[axis] / 2
    is_beside = not rest_low[axis] + rest[axis] / 4 < middle < rest_high[axis] - rest[axis] / 4
    if not (is_thin and is_wider and is_beside):
        return mesh, []
    note = "a flat piece, wider than all the rest, was taken for a floor and left out"
    return mesh.only(others[label[mesh.faces[:, 0]]]).compact(), [note]


def without_specks(mesh: SurfaceMesh) -> tuple[SurfaceMesh, list[str]]:
    """The mesh without specks that float about a scan, and a note of them; buttons are nearer to their cloth."""
    label, low, high = _boxes(mesh)
    size = (high - low).max(1)
    is_small, gap = size < _SPECK * size.max(), np.full(len(size), np.inf)
    if not is_small.any():
        return mesh, []
    of_face = label[mesh.faces[:, 0]]
    cloth = cKDTree(sample(mesh.only(~is_small[of_face]), _N_NEAR).points)
    np.minimum.at(gap, label, cloth.query(mesh.vertices)[0])
    is_speck = is_small & (gap > _SPECK * size.max())
    if not is_speck.any():
        return mesh, []
    note = f"{int(is_speck.sum())} tiny pieces that float far from all the rest, as a scan's specks do, were left out"
    return mesh.only(~is_speck[of_face]).compact(), [note]


def without_bodies(mesh: SurfaceMesh, vertices: F64, posed: PosedBody) -> tuple[SurfaceMesh, list[str], float]:
    """The mesh without pieces that are bodies themselves, a note of each, and their height; zero if there are none.

    Its `vertices` (V, 3) are on a body [m], and so is the height.

    Characters come in one file with their clothes. A piece is a body if it has a head, hands and feet and lies on the
    skin. Its eyes and teeth are small pieces that are nearer to it than to the clothes.

    Raises `GarmentError`: nothing else is left.
    """
    n_pieces, label = components(mesh.faces, len(vertices))
    joint = posed.body.weights.argmax(1).numpy()[posed.body.faces[:, 0].numpy()]
    near, has = joint[posed.closest(vertices)[0]], np.zeros((n_pieces, N_JOINTS), np.bool_)
    is_high = vertices[:, 1] > float(posed.body.joint_template[_ENDS[0], 1])
    counts = (near != _ENDS[0]) | is_high  # a collar at the chin is no head
    has[label[counts], near[counts]] = True
    is_body = np.all(has[:, _ENDS], axis=1)
    for piece in np.flatnonzero(is_body):
        is_body[piece] = np.median(np.abs(posed(vertices[label == piece])[0])) < _ON_SKIN
    if not is_body.any():
        return mesh, [], 0.0
    notes = ["a piece with head, hands and feet was taken for the wearer's body and left out"] * int(is_body.sum())
    is_small = np.array([np.ptp(vertices[label == piece], axis=0).max() for piece in range(n_pieces)]) < _EYE
    of_face = label[mesh.faces[:, 0]]
    clothes = ~(is_body | is_small)[of_face]
    if not clothes.any():
        msg = "it is a body with head, hands and feet, and no garment: wanted clothes (--body says who wears them)"
        raise GarmentError(msg)
    placed = replace(mesh, vertices=vertices)
    skin, cloth = (cKDTree(sample(placed.only(f), _N_NEAR).points) for f in (is_body[of_face], clothes))
    gone = is_body.copy()
    for piece in np.flatnonzero(is_small & ~is_body):
        points = vertices[label == piece]
        gone[piece] = np.median(skin.query(points)[0]) < np.median(cloth.query(points)[0])
    if n_eyes := int((gone & ~is_body).sum()):
        notes.append(f"{n_eyes} small pieces nearer to it than to its clothes, as eyes are, were left out, too")
    height = float(np.ptp(vertices[is_body[label], 1]))
    return mesh.only(~gone[of_face]).compact(), notes, height


def outer_sides(mesh: SurfaceMesh, posed: PosedBody) -> tuple[SurfaceMesh, list[str]]:
    """The mesh, in metres on a body, with the outer sides alone of pieces that are cloth with two sides, and a note.

    Contact would bring both sides to the same distance from the skin, where the inner one shows through the outer; and
    simulated sides pass through each other, because what is near at rest makes no contact.

    Such a piece is closed and thin. Its sides are joined by hems, whose faces stand across the cloth around them.
    """
    faces, (n_pieces, label) = mesh.faces, components(mesh.faces, len(mesh.vertices))
    piece, is_closed = label[faces[:, 0]], ~open_pieces(mesh.vertices, faces, label)
    normals, centres = face_normals(mesh.vertices, faces), mesh.vertices[faces].mean(1)
    twice = np.linalg.norm(normals, axis=1)
    area = np.bincount(piece, twice) / 2
    thickness = np.abs(np.bincount(piece, ((centres - centres.mean(0)) * normals).sum(1))) / 3 / area
    thick = np.flatnonzero(is_closed & (thickness < _THIN * np.sqrt(area / 2)))
    if not len(thick):
        return mesh, []
    points = sample(mesh, _N_NEAR)
    around = points.normals[cKDTree(points.points).query(centres, k=_N_AROUND)[1]]
    across = np.linalg.eigh(np.swapaxes(around, 1, 2) @ around)[1][:, :, -1]
    is_side = np.abs((normals * across).sum(1)) > _ALONG * twice
    pairs = partners(mesh)[0] // 3
    n_parts, part = linked(pairs[np.equal(*is_side[pairs].T)], len(faces))
    gone = np.zeros(len(faces), np.bool_)
    for k in thick:
        own = piece == k
        size = np.bincount(part[own & is_side], twice[own & is_side], n_parts) / 2
        sides = np.argsort(-size)[:2]
        if size[sides].min() > _SIDE * area[k]:
            off = [np.average(posed(centres[part == side])[0], weights=twice[part == side]) for side in sides]
            outer = sides[int(np.argmax(off))]
            ends = part[pairs[own[pairs[:, 0]]]]
            ends = np.concatenate((ends, ends[:, ::-1]))[np.tile(np.not_equal(*ends.T), 2)]
            beside, between = ends[ends[:, 1] == outer, 0], ends[ends[:, 1] != outer, 0]
            gone |= own & ~np.isin(part, [outer, *np.setdiff1d(beside, between)])  # creases stay, hems don't
    if not gone.any():
        return mesh, []
    note = f"cloth with two sides, of which the outer one is worn ({len(np.unique(piece[gone]))} of {n_pieces} pieces)"
    mesh, notes = clean(mesh.only(~gone).compact())  # panels that only touched have rims now, and are sewn
    return mesh, [note, *notes]


def unsewn(mesh: SurfaceMesh) -> list[str]:
    """A note of pieces whose rims lie along each other, for a mesh in metres."""
    _, label = components(mesh.faces, len(mesh.vertices))
    rim = rim_vertices(mesh.faces)
    label = label[rim]
    gap = _gaps(mesh.vertices[rim], label)
    near = np.bincount(label, weights=gap < _SEAM)
    is_along = near > _SHARE * np.bincount(label)
    n_along = int(is_along.sum())
    if not n_along:
        return []
    what = f"{n_along} pieces lie along each other" if n_along > 1 else "a piece lies along another"
    sewn = "and aren't sewn" if n_along > 1 else "and isn't sewn to it"
    apart = 1e3 * float(np.median(gap[is_along[label] & (gap < _SEAM)]))
    return [f"{what}, {apart:.1f} mm apart, {sewn}: weld their seams, or simulated cloth comes apart there"]


def slivers(mesh: SurfaceMesh) -> list[str]:
    """A note of many very short edges, for a mesh in metres."""
    a, b = mesh.vertices[Connectivity.of(mesh.faces, len(mesh.vertices)).edges].transpose(1, 0, 2)
    short, median = np.percentile(1e3 * np.linalg.norm(a - b, axis=1), (1, 50))
    if short > _SHORT * median:
        return []
    what = f"it has slivers: 1 % of its edges are shorter than {short:.1f} mm, half are longer than {median:.0f}"
    return [f"{what}; simulated cloth may cross itself there: remesh it evenly before you simulate it"]


def _gaps(points: F64, label: Ints) -> F64:
    """How far each point is from the nearest one with another label [m], infinity if that is `_SEAM` or more."""
    tree, labels = cKDTree(points), np.append(label, -1)
    gap, left, k = np.full(len(points), np.inf), np.arange(len(points)), 4
    while len(left):  # points that have seen only their own label, with more in reach
        distance, other = tree.query(points[left], k=k, distance_upper_bound=_SEAM)
        is_there = np.isfinite(distance)
        of_others = is_there & (labels[other] != label[left, None])
        gap[left] = np.where(of_others, distance, np.inf).min(axis=1)
        left, k = left[is_there[:, -1] & ~of_others.any(axis=1)], 4 * k
    return gap


def apart(mesh: SurfaceMesh) -> list[str]:
    """A note of clothes one above the other that touch nowhere, for a mesh in metres, y up: a top and shorts, say."""
    label, lows, highs = _boxes(mesh)
    low, high = lows[:, 1], highs[:, 1]
    area = np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1)
    share = np.bincount(label[mesh.faces[:, 0]], area, len(low)) / area.sum()
    large = np.flatnonzero(share > _LARGE)
    large = large[np.argsort(low[large])]
    gaps = low[large[1:]] - np.maximum.accumulate(high[large])[:-1]
    n = 1 + int((gaps > _BETWEEN).sum())
    if n == 1:
        return []
    return [f"{n} parts of it are one above the other and touch nowhere: add each as a garment of its own"]
