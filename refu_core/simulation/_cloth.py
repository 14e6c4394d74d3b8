"""One garment on one moving body: the state of the cloth, its contacts, and a frame of simulated time.

Loops in Numba are imported where they are called: settings and data sets are read where it isn't installed, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from refu_core.errors import MeshError
from refu_core.mesh import Connectivity, linked, vertex_areas
from refu_core.sdf import ExactSdf

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class ClothTopology:
    """The pairs of vertices that the constraints on a garment of N vertices connect."""

    mesh: Connectivity
    edges: NDArray[np.int32]
    """Edges of the mesh sorted by colour, shape (E, 2): edges of one colour share no vertex, which keeps a processor's
    pipeline full."""
    bends: NDArray[np.int32]
    """The two vertices opposite each inner edge, also sorted by colour, shape (B, 2)."""

    @property
    def ends(self) -> NDArray[np.int32]:
        """The vertices of all C distance constraints, shape (C, 2). Bends come first: the stiffer edges have the last
        word in each sweep."""
        return np.concatenate((self.bends, self.edges))

    def softness(self, settings: ClothSettings) -> F32:
        """Each constraint's compliance over the square of a time step [1/kg], shape (C,)."""
        both = settings.bend_compliance, settings.stretch_compliance
        compliance = np.repeat(both, (len(self.bends), len(self.edges)))
        return (compliance / settings.substep**2).astype(np.float32)

    @staticmethod
    def of(mesh: Connectivity) -> ClothTopology:
        """The topology of a garment. Raises `MeshError` for edges of more than two faces and vertices of none."""
        opposite = mesh.faces[:, [2, 0, 1]].reshape(-1)
        count = mesh.n_faces_of_edge
        if count.max(initial=0) > 2:
            raise MeshError(f"a garment's edges need one or two faces, got {count.max()} on one edge: clean the mesh")
        if n_unused := mesh.n_vertices - len(np.unique(mesh.faces)):  # they would fall for ever
            raise MeshError(f"{n_unused} of a garment's vertices belong to no face: leave them out")
        by_edge = opposite[np.argsort(mesh.edge_of_corner.ravel(), kind="stable")]
        first = np.concatenate(([0], np.cumsum(count)))[:-1]
        inner = count == 2
        bends = np.stack((by_edge[first[inner]], by_edge[first[inner] + 1]), 1)
        return ClothTopology(mesh, _by_colour(mesh.edges), _by_colour(bends))

    def boundary_loops(self) -> list[NDArray[np.intp]]:
        """Vertices of each hem (waist, cuff, neckline), each sorted by index, in the order of their lowest index."""
        rim, n = self.mesh.boundary, self.mesh.n_vertices
        _, label = linked(rim, n)
        on_rim = np.zeros(n, bool)
        on_rim[rim] = True
        return [np.flatnonzero((label == k) & on_rim) for k in dict.fromkeys(label[on_rim])]

    def distance_from(self, vertices: NDArray[Any], sources: NDArray[np.intp]) -> NDArray[np.float64]:
        """Shortest path along the edges from any of `sources` to each of `vertices` (N, 3) [m], shape (N,)."""
        i, j = self.mesh.edges.T
        length = np.linalg.norm(vertices[i] - vertices[j], axis=1) + 1e-9
        graph = coo_array((length, (i, j)), shape=(len(vertices),) * 2).tocsr()
        return np.asarray(dijkstra(graph, directed=False, indices=sources, min_only=True))


def _by_colour(pairs: NDArray[np.int32]) -> NDArray[np.int32]:
    """The pairs sorted by a greedy colouring: pairs of one colour share no vertex."""
    taken: dict[int, int] = {}  # bit mask of the colours around a vertex
    colour = np.empty(len(pairs), np.int64)
    for k, (i, j) in enumerate(pairs.tolist()):
        free = ~(taken.get(i, 0) | taken.get(j, 0))
        bit = free & -free
        taken[i] = taken.get(i, 0) | bit
        taken[j] = taken.get(j, 0) | bit
        colour[k] = bit.bit_length()
    return pairs[np.argsort(colour, kind="stable")]


_Contacts = tuple[I32, F32, F32, F32]
"""Vertices, or both ends of edges; and for each the place on the skin, its normal and its motion in a substep."""


@dataclass(frozen=True)
class ClothSettings:
    """Material, contact and solver settings of the cloth; the defaults were tuned together."""

    density: float = 0.15
    """Mass of the cloth [kg/m²]."""
    stretch_compliance: float = 1e-7
    """Compliance of the length of an edge [m/N]."""
    bend_compliance: float = 2e-3
    """Compliance of the distance across an edge [m/N]."""
    friction: float = 0.3
    """Coulomb's coefficient between cloth and skin."""
    margin: float = 0.004
    """Distance that vertices keep from the skin [m]."""
    edge_margin: float = 0.003
    """Distance that edge midpoints keep from the skin [m]."""
    thickness: float = 0.003
    """Distance that vertices keep from other parts of the cloth [m]."""
    substep: float = 1 / 2400
    """Time step [s]."""
    substeps: int = 40
    """Time steps per frame."""
    refresh: int = 10
    """Time steps between two searches for contacts."""
    iterations: int = 1
    """Sweeps over all constraints per time step: many steps of one sweep stretch less than fewer steps of several."""
    most_ease: float = 0.15
    """Share by which an edge may lengthen freely, so that joints can move."""
    most_crease: float = 0.3
    """Share by which an edge may shorten freely, in the crook of a bent elbow."""
    anchor_stiffness: float = 0.2
    """Share of a waistband's distance from its place on the skin that is closed in one sweep."""


REACH = 0.04  # [m]: a vertex's distance to the skin is known up to this
NEAR = 0.012  # [m]: vertices closer than this have a contact
SLIDE = 0.003  # [m]: a contact's tangent plane is used until the vertex has moved this far
PAIR_REACH = 0.007  # [m]: a vertex this close to another part of the cloth gets a self-contact
PAIR_SLACK = 0.003  # [m]: pairs are searched this much farther out, and anew when a vertex has moved half of it
PAST_EDGE = 0.02  # share of a face's height: a vertex just past its edge counts for the faces on both sides
MAX_SPEED = 6.0  # [m/s]
_APART = 10.0  # [m]: separate pieces are taken to be this far apart at rest, so they are never neighbours


@dataclass(frozen=True, eq=False)
class ClothCut:
    """A garment as cloth: what one shape and style of it has, in any pose, for C distance constraints."""

    told_apart: F32
    """The rest shape, with separate pieces far apart [m], shape (N, 3)."""
    shortest: F32
    """Between these two lengths a constraint gives way freely [m], shape (C,)."""
    longest: F32
    edge_length: float
    """Median length of an edge [m]."""
    inverse_mass: F32
    """[1/kg], shape (N,)."""
    anchored: I32
    """Vertices that are held at the skin, shape (A,)."""
    anchors: tuple[I32, F32, F32]
    """For each of them the face of the body (A,), weights of its corners (A, 3), distance from it [m] (A, 1)."""

    @property
    def pair_reach(self) -> float:
        """How near a vertex the centres of faces are that it may touch before it has moved by half of the slack [m]."""
        return float(np.float32(PAIR_REACH + 0.85 * self.edge_length) + np.float32(PAIR_SLACK))

    @property
    def rest_apart(self) -> float:
        """Faces whose centres are nearer than this at rest are the vertex's neighbours and not touched [m]."""
        return 2.2 * self.edge_length

    def stretch(self, topology: ClothTopology, positions: F32) -> float:
        """99.9th percentile of edge length over the length reached freely, of `positions` (N, 3) [m]."""
        i, j = topology.edges.T
        length = np.linalg.norm(positions[i] - positions[j], axis=1)
        return float(np.percentile(length / self.longest[-len(length) :], 99.9))


@dataclass(frozen=True)
class CourseStep:
    """One frame of simulated time."""

    before: int
    """Number of the body at its start: the body goes straight from one to the other."""
    after: int
    """Number of the body at its end; the same where the body rests."""
    gravity: F32
    """Acceleration [m/s²], shape (3,)."""
    drag: float
    """Rate at which the velocity fades [1/s]."""
    is_careful: bool = False
    """Whether contacts of edge midpoints are solved, too, and contacts searched for as often as on a moving body."""


class _Skin:
    """The closest place on the skin to each of N points, as of the point's last query."""

    def __init__(self, n: int) -> None:
        self.face = np.full(n, -1, np.int32)
        self.weights: F32 = np.zeros((n, 3), np.float32)
        self.normal: F32 = np.zeros((n, 3), np.float32)
        self.asked_at: F32 = np.full((n, 3), 1e6, np.float32)  # far away: everything is stale
        self.distance: F32 = np.zeros(n, np.float32)

    def stale(self, points: F32) -> I32:
        """Which of the points (N, 3) must be queried again: those that have moved too far since their last query."""
        near, slide = np.float32(NEAR), np.float32(SLIDE)
        allowed = np.where(self.distance > near + slide, self.distance - near, slide)
        return np.flatnonzero(np.square(points - self.asked_at).sum(1) > allowed * allowed).astype(np.int32)


class SimulatedCloth:
    """The simulated garment. Positions are relative to the body's root, in SMPL axes [m]; one thread, deterministic."""

    def __init__(
        self, topology: ClothTopology, sdf: ExactSdf, *, piece: NDArray[np.intp], settings: ClothSettings
    ) -> None:
        """A garment of this topology against the body behind `sdf`.

        `piece` (N,) is the number of each vertex's piece. Pieces stay apart however near they are at rest.

        `sdf` must have its BVH built on the same vertices whenever the same drape is simulated, and must not rebuild it
        by itself: the tree decides which of two equally close faces is found, and with it the last bit of the result.
        """
        self.settings = settings
        self.topology = topology
        self._sdf = sdf
        self._body_faces = sdf.faces.cpu().numpy().astype(np.int32)
        n = topology.mesh.n_vertices
        self._ends = topology.ends.astype(np.uint32)  # unsigned: no check for indices that count from the end
        self._softness = topology.softness(settings)
        self._piece = piece
        self.positions: F32 = np.zeros((n, 3), np.float32)
        self.velocities: F32 = np.zeros((n, 3), np.float32)
        self._previous: F32 = np.zeros((n, 3), np.float32)

    def tailored(
        self, rest: F32, *, eased: Sequence[F32], crooks: Sequence[F32], waist: NDArray[np.intp], body_rest: F32
    ) -> ClothCut:
        """The cloth of a garment whose rest shape is `rest` (N, 3) [m].

        Where an edge is longer in one of the shapes `eased`, (N, 3) each, it may lengthen freely to that length, within
        limits; where it is shorter in one of `crooks`, it may shorten freely to that length.

        `waist` vertices are held at the place on the skin that is closest to them in the rest pose: the body at rest is
        `body_rest` (V, 3).
        """
        n_edges = len(self.topology.mesh.edges)
        length = self._lengths(rest)
        longest = np.maximum.reduce([length, *(self._lengths(shape) for shape in eased)])
        shortest = np.minimum.reduce([length, *(self._lengths(shape) for shape in crooks)])
        area = vertex_areas(rest, self.topology.mesh.faces)
        # Slivers would get next to no mass and soak up every correction of their neighbours.
        area = np.maximum(area, 0.25 * np.median(area))
        self._sdf.update(torch.from_numpy(body_rest))
        found = self._sdf.closest(torch.from_numpy(rest[waist]))
        offset = np.maximum(found.distance.numpy() * found.sign.numpy(), self.settings.margin + 0.002)
        return ClothCut(
            told_apart=rest + np.float32(_APART) * self._piece[:, None].astype(np.float32),
            shortest=np.maximum(shortest, length * np.float32(1 - self.settings.most_crease)),
            longest=np.minimum(longest, length * np.float32(1 + self.settings.most_ease)),
            edge_length=float(np.median(length[-n_edges:])),
            inverse_mass=(1 / (self.settings.density * area)).astype(np.float32),
            anchored=waist.astype(np.int32),
            anchors=(found.face.numpy(), found.barycentrics.numpy(), offset[:, None].astype(np.float32)),
        )

    def start(self, cut: ClothCut, positions: F32) -> None:
        """Puts cloth of this cut at `positions` (N, 3) [m], at rest."""
        n = len(positions)
        self.cut = cut
        self._skin, self._middles = _Skin(n), _Skin(len(self.topology.mesh.edges))
        self._searched_at: F32 = np.full((n, 3), 1e6, np.float32)  # far away: the first call searches
        self.positions[:] = positions
        self.velocities[:] = 0

    def _lengths(self, shape: F32) -> F32:
        """Lengths of the distance constraints in a shape (N, 3)."""
        ends = shape[self._ends]
        length: F32 = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).astype(np.float32)
        return length

    def _anchor_points(self, body: F32) -> F32:
        face, weights, offset = self.cut.anchors
        a, b, c = body[self._body_faces[face]].transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
        points: F32 = weights[:, :1] * a + weights[:, 1:2] * b + weights[:, 2:] * c + offset * normal
        return points

    def frame(self, body_from: F32, body_to: F32, *, gravity: F32, drag: float, careful: bool = False) -> float:
        """Simulates `settings.substeps` time steps while the body moves straight from one mesh (V, 3) to the other.

        Returns the root mean square speed of the vertices at the end [m/s].

        Args:
            body_from: body vertices at the start [m], shape (V, 3).
            body_to: the same at the end; the very same object where the body rests.
            gravity: acceleration [m/s²], shape (3,).
            drag: rate at which the velocity fades [1/s].
            careful: solve contacts of edge midpoints, too, and search for contacts as often as on a moving body.
        """
        from refu_core.simulation._solver import substep

        s = self.settings
        moving = body_from is not body_to
        refresh = s.refresh if moving or careful else s.substeps
        h = np.float32(s.substep)
        motion = (body_to - body_from) / np.float32(s.substeps) if moving else None
        anchor = np.ascontiguousarray(self._anchor_points(body_from))
        anchor_motion = np.ascontiguousarray((self._anchor_points(body_to) - anchor) / np.float32(s.substeps))
        none = np.zeros((0, 3), np.float32)
        for first in range(0, s.substeps, refresh):
            body = body_from if motion is None else body_from + np.float32(first) * motion
            is_all = moving and first == 0
            stale = np.arange(len(self.positions), dtype=np.int32) if is_all else self._skin.stale(self.positions)
            contacts = self._touch(self._skin, self.positions, stale, body, motion)
            edges = self._edge_contacts(body, motion) if careful else (np.zeros((0, 2), np.int32), none, none, none)
            pairs = self._pairs()
            for _ in range(min(refresh, s.substeps - first)):
                substep(
                    self.positions, self.velocities, self._previous, self.cut.inverse_mass,
                    self._ends, self.cut.shortest, self.cut.longest, self._softness,
                    h, gravity, np.float32(np.exp(-drag * s.substep)),
                    *contacts, np.float32(s.margin), np.float32(s.friction),
                    self.cut.anchored, anchor, anchor_motion, np.float32(s.anchor_stiffness),
                    *pairs, np.float32(s.thickness),
                    *edges, np.float32(s.edge_margin),  # type: ignore[arg-type]  # mypy loses count after two unpackings
                    s.iterations, np.float32(MAX_SPEED * s.substep),
                )  # fmt: skip
        return float(np.sqrt((self.velocities**2).sum(1).mean()))

    def _pairs(self) -> tuple[I32, I32, F32]:
        """Vertices near a face that they aren't near in the rest shape, the face, and the vertex's side of it."""
        from refu_core.simulation._solver import find_candidates, near_pairs

        faces = self.topology.mesh.faces
        if float(np.sqrt(np.square(self.positions - self._searched_at).sum(1).max())) > PAIR_SLACK / 2:
            ways = np.float32(self.cut.rest_apart), np.float32(self.cut.pair_reach)
            self._candidates = find_candidates(self.positions, faces, self.cut.told_apart, *ways)
            self._searched_at[:] = self.positions
        return near_pairs(self.positions, faces, *self._candidates, np.float32(PAIR_REACH))

    def _edge_contacts(self, body: F32, motion: F32 | None) -> _Contacts:
        edges, skin = self.topology.mesh.edges, self._middles
        near = self._skin.distance[edges].max(1) < NEAR
        middle = self.positions[edges].mean(1)
        stale = skin.stale(middle)
        which, point, direction, moved = self._touch(skin, middle, stale[near[stale]], body, motion)
        kept = near[which]
        return edges[which[kept]], point[kept], direction[kept], moved[kept]

    def _touch(self, skin: _Skin, points: F32, stale: I32, body: F32, motion: F32 | None) -> _Contacts:
        """Contacts of `points` (N, 3) with the body (V, 3), whose distance field is queried for the `stale` ones."""
        from refu_core.simulation._solver import refresh_points

        if len(stale):
            asked = points[stale]
            self._sdf.update(torch.from_numpy(body))
            near = torch.from_numpy(skin.face[stale])
            found = self._sdf.closest(torch.from_numpy(asked), max_distance=REACH, near=near)
            skin.face[stale] = found.face.numpy()
            skin.weights[stale] = found.barycentrics.numpy()
            skin.asked_at[stale] = asked
            skin.distance[stale] = np.minimum(found.distance.numpy(), REACH) * found.sign.numpy()
        return refresh_points(
            points, skin.face, skin.weights, skin.distance, skin.normal, stale,
            self._body_faces, body, body if motion is None else motion, motion is not None, np.float32(NEAR),
        )  # fmt: skip
