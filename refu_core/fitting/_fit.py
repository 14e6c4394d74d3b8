"""From a mesh to a garment: placed, cleared of the body, bound to its joints and to its shapes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from refu_core.body import BUILTIN_BODIES, JOINT_NAMES, SmplBody, blend_transforms, load_body, unapply_transforms
from refu_core.errors import GarmentError, require_type
from refu_core.fitting._clean import (
    MAX_VERTICES,
    clean,
    components,
    no_opening,
    open_pieces,
    split_long_edges,
    turned_over,
)
from refu_core.fitting._found import Place
from refu_core.fitting._mesh_file import F64, Ints, SurfaceMesh
from refu_core.fitting._pieces import apart, outer_sides, slivers, unsewn, without_bodies, without_floor, without_specks
from refu_core.fitting._place import MISFIT, find_places
from refu_core.fitting._placing import UNITS, Placing
from refu_core.fitting._posed import PosedBody
from refu_core.fitting._transfer import Transfer
from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.garments import GarmentCard, GarmentTemplate, require_name
from refu_core.mesh import Connectivity, face_normals

HOLDS: tuple[str, ...] = ("waist", "shoulders")
LONGEST_EDGE = 0.02
"""Longer edges are split [m]: the body would come through between their ends. The paper's garments have none."""
CLEARANCE = 0.005
"""Least distance from the mean body in the T-pose [m]; the styles of the paper's garments keep as much."""

_INFLUENCES = 6
_SKIN_LENGTH = 0.012
"""Skinning weights are smooth over this length at least [m]; in the paper's garments over 12 rings, 3 cm."""
_SHAPE_LENGTH = 0.03
"""The same for what β moves [m]."""
_DEEP, _MOST_DEEP = 0.03, 0.04
"""A garment of which more than a share `_MOST_DEEP` is deeper than `_DEEP` [m] in the body, in the T-pose, was made for
another body or pose."""
_FARTHEST, _MOST_FAR = 0.06, 0.003
"""If more than a share `_MOST_FAR` of the vertices has to move farther than `_FARTHEST` [m] to be outside the body, a
limb went through the cloth. A few may have to, by twice as much at most: between toes or fingers there is no room for
cloth."""
_STRETCHED, _MOST_STRETCHED = 2.0, 0.02
"""When cloth is brought into the T-pose, at most a share `_MOST_STRETCHED` of its edges should become more than
`_STRETCHED` times as long; in sleeves from an A-pose, those under the arms do."""
_TORN = 0.15
"""Of clothes that were taken to lie around hanging arms and don't, more than this share of the edges is that long then:
0.19 to 0.66. A poncho that does lie around them has 0.07."""
_FELT = 0.02
"""A garment depends on a joint that has more than this skinning weight at some vertex."""
_SHOULDERS = tuple(
    JOINT_NAMES.index(name)
    for name in ("head", "neck", "left_collar", "right_collar", "left_shoulder", "right_shoulder")
)
_ROUNDS = 20
_MOST_PIECES = 1000
"""A coat with its buttons has some dozens; loose triangles that nearly touch are thousands, and take minutes."""
_AS_TALL = 0.01
"""A wearer whose height is within this share of the body's is as tall: his clothes keep their unit."""
_FLAT, _PRESSED = 0.75, 0.15
"""A mesh is laid out flat if more than a share `_FLAT` of it faces along one line (of 90 garments, 0.66 at most; of
cloth on a table, 0.85 and more), and its depth along it is less than `_PRESSED` of its size (of clothes pressed to a
fifth of their depth, 0.14 at most; of worn ones, 0.22 and more). Of a poncho it is 0.78, and 0.23."""


@dataclass(frozen=True)
class GarmentDetails:
    """What a mesh doesn't say about a garment; None for what follows from its place on the body."""

    layer: int = 1
    color: tuple[float, float, float] = (0.55, 0.52, 0.62)
    """sRGB, 0 to 1."""
    held_at: str | None = None
    """`waist` or `shoulders`."""
    provenance: str = "a mesh of the user's"


@dataclass(frozen=True, eq=False)
class FittedGarment:
    """A garment, and what was done to the mesh."""

    template: GarmentTemplate
    notes: list[str]
    """What was found out about the mesh and changed in it, one sentence each."""
    warnings: list[str]
    """Reasons why it may not be worn as it was meant, one sentence each; empty if there are none."""


def fit_garment(
    mesh: SurfaceMesh,
    body: SmplBody,
    *,
    name: str,
    placing: Placing | None = None,
    details: GarmentDetails | None = None,
    longest_edge: float = LONGEST_EDGE,
) -> FittedGarment:
    """Makes a garment from a mesh that was made for roughly this body: it can be worn at once, without networks.

    The `mesh` is as `read_surface` reads it, the `body` one of the built-in ones. `placing` tells what is
    known about the mesh's unit, axes, place and pose; by default all of it is found out. Edges longer than
    `longest_edge` [m] are split. Raises `GarmentError` for a mesh that can't be worn, with why, and what to do.
    """
    require_type(mesh, SurfaceMesh, "a SurfaceMesh, such as read_surface gives", error=GarmentError)
    require_type(body, SmplBody, "an SmplBody, such as load_body gives", error=GarmentError)
    details = GarmentDetails() if details is None else details
    if details.held_at not in (None, *HOLDS):
        raise GarmentError(f"a garment is held at {' or '.join(HOLDS)}, got {details.held_at!r}")
    require_name(name)
    built_in = load_body(body.name) if body.name in BUILTIN_BODIES else None  # in float32, on the CPU
    if built_in is None or body.fingerprint != built_in.fingerprint:  # a file may be called as a built-in body
        raise GarmentError(
            f"a garment is cut for a built-in body ({', '.join(BUILTIN_BODIES)}), got another, {body.name}: add it for "
            f"the one that is most like it; a replay or pipeline with {body.name} as its body (--body) wears it, too"
        )
    body = built_in
    cleaned, notes = clean(mesh)
    if len(cleaned.vertices) > MAX_VERTICES:
        msg = f"it has {len(cleaned.vertices)} vertices, at most {MAX_VERTICES} are worn: decimate the mesh"
        raise GarmentError(msg)
    for without in (without_floor, without_specks):
        cleaned, left_out = without(cleaned)
        notes += left_out
    _require_worn(cleaned)
    faults: list[GarmentError] = []
    makeshift: _Worn | None = None
    most = np.inf
    for clothes, place in _places(cleaned, body, replace(placing or Placing(), held_at=details.held_at)):
        cost = place.cost(float(np.ptp(clothes.vertices, axis=0).max()))
        if cost > most:
            continue
        try:
            worn = _put_on(clothes, place, body, longest_edge)
        except GarmentError as error:  # a limb goes through it there: is there another place?
            faults.append(error)
            most = min(most, MISFIT * cost)  # a mesh that can't be where it belongs is worn nowhere else
            continue
        if worn.moved <= _FARTHEST and not worn.is_torn:
            return _bound(worn, body, name, details, notes)
        if not faults and makeshift is None:
            makeshift = worn
        most = min(most, cost if worn.is_torn else MISFIT * cost)  # torn cloth may fit better elsewhere
    if makeshift is None:
        raise faults[0]  # `find_places` finds a place, or raises
    return _bound(makeshift, body, name, details, notes)


def _places(mesh: SurfaceMesh, body: SmplBody, placing: Placing) -> Iterator[tuple[SurfaceMesh, Place]]:
    """The mesh without its wearer, and where it may belong, as `find_places` finds it.

    Clothes are as large for the body as they were for him: together, they would be made to fit his skin, not his size.
    """
    for place in find_places(mesh, body, placing):
        posed = PosedBody(body, place.pose)
        clothes, notes, height = without_bodies(mesh, place(mesh.vertices), posed)
        if notes:
            unit = place.unit * float(np.ptp(posed.vertices[:, 1].numpy())) / height
            near = min(UNITS.values(), key=lambda known: abs(np.log(known / unit)))
            if abs(np.log(near / unit)) < _AS_TALL:
                unit = near
            elif placing.unit is None:
                notes.append("its clothes were scaled with it to the body's height")
            for there in find_places(clothes, body, replace(placing, unit=placing.unit or unit)):
                yield clothes, replace(there, notes=[*notes, *there.notes])
            return
        yield mesh, place


def _require_worn(mesh: SurfaceMesh) -> None:
    """Raises `GarmentError` for a mesh that is laid out flat, or that is in shreds."""
    n_pieces, _ = components(mesh.faces, len(mesh.vertices))
    if n_pieces > _MOST_PIECES:
        advice = "merge the vertices that nearly lie on each other, or leave out what is tiny, as sequins are"
        raise GarmentError(f"it is in {n_pieces} pieces, at most {_MOST_PIECES} are worn: {advice}")
    normals = face_normals(mesh.vertices, mesh.faces)
    area = np.linalg.norm(normals, axis=1)
    share, axes = np.linalg.eigh(normals.T @ (normals / np.maximum(area, 1e-300)[:, None]))
    size = np.ptp(mesh.vertices @ axes, axis=0)
    if share[-1] > _FLAT * area.sum() and size[-1] < _PRESSED * size.max():
        what = "it is flat, as a sewing pattern is, or cloth on a table"
        raise GarmentError(f"{what}: wanted a garment as it is worn; sew and drape it first")


class _Worn(NamedTuple):
    """A mesh on the body in the T-pose, what was done to it, and what there is to warn of."""

    mesh: SurfaceMesh
    notes: list[str]
    warnings: list[str]
    moved: float
    """The farthest that a vertex had to move to be outside of the body [m]."""
    is_torn: bool
    """Whether it isn't meant to be brought into the T-pose from there: much of it is stretched then."""


def _put_on(mesh: SurfaceMesh, place: Place, body: SmplBody, longest_edge: float) -> _Worn:
    """The mesh on the body at some place; raises `GarmentError` where it can't be there."""
    posed = PosedBody(body, place.pose)
    mesh = replace(mesh, vertices=place(mesh.vertices))
    notes, warnings, is_torn = [*place.notes, *apart(mesh)], [], False
    fit = place.fit
    if not (fit.is_good or fit.is_ring or fit.is_tight):
        where = f"{1e3 * fit.distance:.0f} mm off, {100 * fit.facing:.0f} % faces outward"
        warnings.append(f"it hardly surrounds the body ({where}): look at it (--picture)")
    n = len(mesh.vertices)
    mesh = split_long_edges(mesh, longest_edge)
    if len(mesh.vertices) > n:
        added = len(mesh.vertices) - n
        notes.append(f"edges longer than {1e3 * longest_edge:.0f} mm were split: {added} vertices were added to {n}")
    mesh, sides = outer_sides(mesh, posed)
    notes += [*sides, *unsewn(mesh), *slivers(mesh)]
    mesh = _outward(mesh, posed)
    if place.pose.any():
        unposed = _unposed(mesh, posed)
        long = float((stretch(mesh.faces, mesh.vertices, unposed) > _STRETCHED).mean())
        is_torn = long > _TORN
        if long > _MOST_STRETCHED:
            what = f"stretched {100 * long:.0f} % of its edges to more than {_STRETCHED:g} times their length"
            warnings.append(f"bringing it into the T-pose {what}: was it modelled in that pose? --pose says in which")
        mesh = replace(mesh, vertices=unposed)
        posed = PosedBody(body, np.zeros((N_JOINTS, 3)))
    cleared = _cleared(mesh, posed, notes)
    moved = float(np.linalg.norm(cleared - mesh.vertices, axis=1).max())
    if moved > _FARTHEST:
        doubt = "does it lie as it is worn? --unit, --up or --pose may help"
        warnings.append(f"it reached {1e3 * moved:.0f} mm into the body: {doubt}")
    return _Worn(replace(mesh, vertices=cleared), notes, warnings, moved, is_torn)


def stretch(faces: Ints, before: F64, after: F64) -> F64:
    """How many times its former length each edge has, shape (E,)."""
    a, b = Connectivity.of(faces, len(before)).edges.T
    was, now = (np.linalg.norm(v[a] - v[b], axis=1) for v in (before, after))
    found: F64 = now / np.maximum(was, 1e-9)
    return found


def _bound(worn: _Worn, body: SmplBody, name: str, details: GarmentDetails, notes: list[str]) -> FittedGarment:
    """Makes the garment from a mesh that is on the body: what it follows, and what is known about it."""
    mesh, notes = worn.mesh, notes + worn.notes
    vertices, posed = mesh.vertices, PosedBody(body, np.zeros((N_JOINTS, 3)))
    transfer = Transfer.of(vertices, mesh.faces, posed)
    weights = few_influences(transfer(body.weights.double().numpy(), length=_SKIN_LENGTH))
    shaped = body.rest_vertices(torch.eye(N_BETAS)) - body.v_template  # how a unit of each beta moves the skin [m]
    of_skin = shaped.permute(1, 2, 0).reshape(body.n_vertices, -1).double().numpy()
    shapedirs = transfer(of_skin, length=_SHAPE_LENGTH)
    share = (transfer.mass @ weights) / transfer.mass.sum()
    at_shoulders = share[list(_SHOULDERS)].sum() > 0.04
    held_at = details.held_at or ("shoulders" if at_shoulders else "waist")
    if details.held_at is None:
        notes.append(f"held at the {held_at}")
    if held_at == "waist" and not len(Connectivity.of(mesh.faces, len(vertices)).boundary):
        raise GarmentError("a garment that is held at the waist needs an open rim there: its mesh is closed")
    joints = tuple(int(j) for j in np.flatnonzero(weights.max(0) > _FELT))
    try:
        card = GarmentCard(details.layer, details.color, joints, held_at == "waist", (), details.provenance)
    except ValueError as error:
        raise GarmentError(str(error)) from error
    template = GarmentTemplate(
        name=name,
        body=body.name,
        card=card,
        faces=torch.from_numpy(mesh.faces.copy()),
        weights=torch.from_numpy(weights).float(),
        v_template=torch.from_numpy(vertices).float(),
        shapedirs=torch.from_numpy(shapedirs).float().view(-1, N_BETAS),
        styledirs=None,
        uv=mesh.uv,
    )
    return FittedGarment(template, notes, worn.warnings)


def _outward(mesh: SurfaceMesh, body: PosedBody) -> SurfaceMesh:
    """The mesh with faces counter-clockwise from outside: they face away from the body, or out of a closed piece."""
    v, f = mesh.vertices, mesh.faces
    _, label = components(f, len(v))
    piece = label[f[:, 0]]
    is_open = open_pieces(v, f, label)[piece]
    normals = face_normals(v, f)
    centres = v[f].mean(1)
    distance, gradient = body(centres)
    # Cloth near the skin says more: on a wide hem, either side may face the nearest leg.
    from_body = (normals * gradient).sum(1) / (0.02 + np.abs(distance))
    from_middle = (normals * (centres - v.mean(0))).sum(1)
    side = np.bincount(piece, np.where(is_open, from_body, from_middle))
    return turned_over(mesh, side[piece] < 0)


def _unposed(mesh: SurfaceMesh, posed: PosedBody) -> F64:
    """The mesh brought from the pose of a body to its T-pose [m], shape (V, 3)."""
    transfer = Transfer.of(mesh.vertices, mesh.faces, posed)
    weights = torch.from_numpy(few_influences(transfer(posed.body.weights.double().numpy(), length=_SKIN_LENGTH)))
    transforms = type(posed.transforms)(*(part.double() for part in posed.transforms))
    points = torch.from_numpy(mesh.vertices)[None]
    return unapply_transforms(points, blend_transforms(weights, transforms))[0].numpy()


def few_influences(weights: F64, least: float = 2e-3) -> F64:
    """The weights of at most six joints per vertex, without those below the `least`."""
    kept = weights.clip(0).copy()
    np.put_along_axis(kept, np.argsort(-kept, axis=1)[:, _INFLUENCES:], 0.0, axis=1)
    kept[kept < least] = 0.0
    found: F64 = kept / kept.sum(1, keepdims=True)
    return found


def _cleared(mesh: SurfaceMesh, body: PosedBody, notes: list[str]) -> F64:
    """Vertices brought `CLEARANCE` off the mean body, middles of edges too; their neighbours move by less."""
    connectivity = Connectivity.of(mesh.faces, len(mesh.vertices))
    edges = connectivity.edges
    adjacent = connectivity.adjacency_matrix()
    degree = np.maximum(adjacent.sum(axis=1), 1)[:, None]
    start = v = mesh.vertices
    distance, _ = body(v)
    deep = float((distance < -_DEEP).mean())
    if deep > _MOST_DEEP:
        near = _near(v[distance < -_DEEP], body)
        raise GarmentError(
            f"{100 * deep:.0f} % of the garment is more than {1e3 * _DEEP:.0f} mm inside the body {body.body.name}, "
            f"most of it near the {near}: it was made for another body or pose; say its --pose, or try --body"
            f"{no_opening(mesh.faces)}"
        )
    ends = np.concatenate((np.arange(len(v)).repeat(2).reshape(-1, 2), edges))  # a vertex, as the middle of no edge
    lacks, asked = np.zeros((len(ends), 3)), np.ones(len(ends), np.bool_)
    for _ in range(_ROUNDS):
        distance, away = body(v[ends[asked]].mean(1))
        lacks[asked] = np.maximum(CLEARANCE - distance, 0)[:, None] * away
        lift = lift_of(lacks[: len(v)], lacks[len(v) :], edges)
        if np.linalg.norm(lift, axis=1).max() < 1e-4:
            break
        step = larger(lift, 0.9 * (adjacent @ lift) / degree)
        v = v + step
        asked = (step[ends] != 0).any((1, 2))  # what stays where it is lacks what it did
    moved = np.linalg.norm(v - start, axis=1)
    if (moved > _FARTHEST).mean() > _MOST_FAR or moved.max() > 2 * _FARTHEST:
        near = _near(v[moved > _FARTHEST], body)
        raise GarmentError(
            f"to be outside the body {body.body.name} the garment had to move by {1e3 * moved.max():.0f} mm near the "
            f"{near}: it was made for another body or pose, or has cloth inside; say its --pose or --up, delete a "
            f"lining or what goes on inside its collar, or try another --body{no_opening(mesh.faces)}"
        )
    if moved.max() > 1e-3:
        notes.append(
            f"{100 * float((moved > 1e-3).mean()):.0f} % of the vertices were brought {1e3 * CLEARANCE:.0f} mm off the "
            f"skin, by {1e3 * moved.max():.0f} mm at most"
        )
    return v


def lift_of(vertices: F64, middles: F64, edges: NDArray[np.integer]) -> F64:
    """For each vertex the longest of what it lacks (V, 3), and what the middles of its edges (E, 2) lack, (E, 3)."""
    order = np.argsort(np.linalg.norm(middles, axis=1))
    for end in (0, 1):
        most = np.zeros_like(vertices)
        most[edges[order, end]] = middles[order]  # the last one written to a vertex is its longest
        vertices = larger(vertices, most)
    return vertices


def larger(a: F64, b: F64) -> F64:
    """Row by row the longer of two vectors."""
    return np.where((np.linalg.norm(a, axis=1) >= np.linalg.norm(b, axis=1))[:, None], a, b)


def _near(points: F64, body: PosedBody) -> str:
    """The joint that the skin near these points follows most, in words."""
    face, _ = body.closest(points)
    corners = body.body.faces[torch.from_numpy(face)].flatten()
    return JOINT_NAMES[int(body.body.weights[corners].sum(0).argmax())].replace("_", " ")
