"""Many garments of one kind, each on its own moving body, simulated at once: as many lanes of a GPU.

The method is that of `SimulatedCloth`. Constraints that share no vertex are solved at the same time, colour by colour,
in the order in which a CPU solves them; self-contacts are solved all at once, and their pushes added up. A drape
differs from a CPU's as from that of a pose a fraction of a degree away; in which lane it is changes its last bits, and
cloth makes as much of that.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from refu_core._warp import Recorded, as_warp, ints, memory, torch_stream
from refu_core.errors import SimulationError
from refu_core.simulation import _cloth as cloth
from refu_core.simulation import _lane_contact_kernels as near_kernels
from refu_core.simulation import _lane_kernels as kernels
from refu_core.simulation._cloth import F32, I32, ClothCut, ClothSettings, ClothTopology, CourseStep

_MOST_NEAR = 48
"""Most faces beside a vertex that are looked at. Where a shirt is folded most tightly there are 54."""
_GRID = 128
"""Cells of the grid of faces along each axis; farther on they repeat."""
_BETWEEN = 4.0
"""Distance between the bodies of two lanes, which share one tree of triangles [m]."""
_SUMS = 64
"""Sums that a lane's speed is added up from."""


class ClothLanes:
    """Lanes that each hold a garment of one topology, of any cut, on a body of its own; frames are of all lanes."""

    def __init__(
        self,
        topology: ClothTopology,
        body: F32,
        body_faces: NDArray[Any],
        *,
        anchored: I32,
        lanes: int,
        most_bodies: int,
        device: torch.device,
        settings: ClothSettings,
    ) -> None:
        """For garments of this topology, of which the vertices `anchored` (A,) are held at the skin.

        `body` (V, 3) [m] is any body of the faces (F, 3); no course may have more than `most_bodies`.

        Raises `SimulationError` for settings with several sweeps in a time step, or searches for contacts at other
        steps than every so many of a frame.
        """
        if settings.iterations != 1 or settings.substeps % settings.refresh:
            wanted = "one sweep in a time step, and a whole number of searches in a frame"
            got = f"{settings.iterations}, and a search every {settings.refresh} of {settings.substeps} steps"
            raise SimulationError(f"lanes take {wanted}, got {got}: take shorter steps, or the cpu")
        self._device, self._settings, self._topology = device, settings, topology
        n, n_body, n_faces = topology.mesh.n_vertices, len(body), len(topology.mesh.faces)
        n_ends, n_anchors = len(topology.bends) + len(topology.edges), len(anchored)
        self._x, self._v, self._previous, self._rest, self._searched = (self._new(n, lanes, 3) for _ in range(5))
        self._mass, self._shortest, self._longest = (self._new(rows, lanes) for rows in (n, n_ends, n_ends))
        self._cell, self._apart, self._damping = (self._new(lanes) for _ in range(3))
        self._gravity, self._total = self._new(lanes, 3), self._new(_SUMS, lanes)
        self._held_face = self._new(n_anchors, lanes, dtype=torch.int32)
        self._held_weights, self._held_offset = self._new(n_anchors, lanes, 3), self._new(n_anchors, lanes)
        names = ("before", "after", "refreshed", "moved_on", "careful", "wandered")
        self._of_lane = {name: self._new(lanes, dtype=torch.int32) for name in names}
        self._asked = [self._new_asked(rows, lanes) for rows in (n, len(topology.edges))]
        # Bodies and cloth of all lanes stand side by side, on a grid in space: float32 is finest around its middle.
        side = math.ceil(lanes ** (1 / 3))
        place = np.stack(np.unravel_index(np.arange(lanes), (side,) * 3), 1) - (side - 1) / 2
        self._origin = torch.from_numpy((place * _BETWEEN).astype(np.float32)).to(device)
        self._course = self._new(lanes, most_bodies, n_body, 3)
        self._course[:, 0] = torch.from_numpy(body).to(device)
        self._placed, self._centre = self._course[:, 0] + self._origin[:, None], self._new(lanes, n_faces, 3)
        self._stream = (
            contextlib.nullcontext() if device.type == "cpu" else torch.cuda.stream(torch.cuda.Stream(device))
        )
        if device.type == "cuda":
            torch.cuda.synchronize(device)  # from here on all is done on the one stream
        with self._stream, torch_stream(device):
            triangles = np.asarray(body_faces, np.int32) + n_body * np.arange(lanes, dtype=np.int32)[:, None, None]
            self._mesh = wp.Mesh(as_warp(self._placed.view(-1, 3), wp.vec3), ints(triangles.ravel(), device))
            self._grid = wp.HashGrid(_GRID, _GRID, _GRID, device=str(device))
            self._prepare(anchored, np.asarray(body_faces, np.int32))

    def _new(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return memory(*shape, device=self._device, dtype=dtype)

    def _new_asked(self, n: int, lanes: int) -> dict[str, Tensor]:
        face = self._new(n, lanes, dtype=torch.int32)
        vectors = {name: self._new(n, lanes, 3) for name in ("at", "weights", "normal")}
        return {"face": face, "distance": self._new(n, lanes), **vectors}

    def _prepare(self, anchored: I32, body_faces: I32) -> None:
        """Makes the launches of a frame, which are the same in every frame."""
        s, topology, lanes, n = self._settings, self._topology, len(self._origin), len(self._x)
        vec3, device, faces = wp.vec3, self._device, ints(self._topology.mesh.faces, self._device)
        h, step = s.substep, 1 / s.substeps
        x, v, previous, rest, searched = (
            as_warp(one, vec3) for one in (self._x, self._v, self._previous, self._rest, self._searched)
        )
        mass, shortest, longest = (as_warp(one, wp.float32) for one in (self._mass, self._shortest, self._longest))
        flag = {name: as_warp(values, wp.int32) for name, values in self._of_lane.items()}
        origin, course = as_warp(self._origin, vec3), as_warp(self._course, vec3)
        skin = near_kernels.LaneSkin()
        skin.mesh, skin.faces, skin.origin = self._mesh.id, ints(body_faces, device), origin
        skin.vertices, skin.motion = (as_warp(self._new(*self._placed.shape), vec3) for _ in range(2))
        skin.reach, skin.near, skin.slide = cloth.REACH, cloth.NEAR, cloth.SLIDE
        asked, contacts = [], []
        for known in self._asked:
            one, touching = near_kernels.Asked(), near_kernels.Contacts()
            for name, values in known.items():
                setattr(one, name, as_warp(values, wp.int32 if name == "face" else _KIND[values.ndim]))
            for name in ("point", "normal", "motion"):
                setattr(touching, name, as_warp(self._new(*known["at"].shape), vec3))
            asked.append(one)
            contacts.append(touching)
        count = as_warp(self._new(n, lanes, dtype=torch.int32), wp.int32)
        near = as_warp(self._new(_MOST_NEAR, n, lanes, dtype=torch.int32), wp.int32)
        side = as_warp(self._new(_MOST_NEAR, n, lanes, dtype=torch.int8), wp.int8)
        pushes = as_warp(self._new(3, n, lanes, dtype=torch.int32), wp.int32)
        centre, edges = as_warp(self._centre, vec3), ints(topology.edges, device)
        cell, apart = as_warp(self._cell, wp.float32), as_warp(self._apart, wp.float32)
        ends = ints(topology.ends, device)
        softness = wp.array(topology.softness(s), dtype=wp.float32, device=str(device))
        held = ints(anchored, device)
        point, motion = (as_warp(self._new(len(anchored), lanes, 3), vec3) for _ in range(2))
        held_at = [as_warp(self._held_face, wp.int32), as_warp(self._held_weights, vec3)]
        held_at.append(as_warp(self._held_offset, wp.float32))

        def launch(kernel: Any, dim: Sequence[int], *inputs: Any) -> Recorded:
            return Recorded(kernel, dim, inputs, device)

        each, every_face = (n, lanes), (lanes, len(topology.mesh.faces))
        goes = course, flag["before"], flag["after"]
        place = (*goes, 0.0, step, origin, skin.vertices, skin.motion, as_warp(self._placed, vec3))
        self._place = launch(near_kernels.place_kernel, self._placed.shape[:2], *place)
        anchor = (*goes, step, skin.faces, *held_at, point, motion)
        self._anchor = [launch(near_kernels.anchor_kernel, (len(anchored), lanes), *anchor)] if len(anchored) else []
        whom = flag["refreshed"], flag["moved_on"]
        self._touch = launch(near_kernels.touch_kernel, each, x, *whom, skin, asked[0], contacts[0])
        middles = x, edges, flag["careful"], skin, asked[0], asked[1], contacts[1]
        self._touch_edges = launch(near_kernels.touch_edges_kernel, (len(topology.edges), lanes), *middles)
        since = x, searched, flag["refreshed"], cloth.PAIR_SLACK / 2, flag["wandered"]
        self._wandered = launch(near_kernels.wandered_kernel, each, *since)
        self._centres = launch(near_kernels.centre_kernel, every_face, x, faces, origin, centre)
        found = flag["wandered"], count, near, searched
        search = (x, rest, faces, centre, origin, self._grid.id, cell, apart, *found)
        self._search = launch(near_kernels.search_kernel, (lanes, n), *search)
        sides = x, faces, count, near, flag["refreshed"], cloth.PAIR_REACH, side
        self._sides = launch(near_kernels.side_kernel, each, *sides)
        self._sum = launch(kernels.speed_kernel, (_SUMS, lanes), v, as_warp(self._total, wp.float32))

        gravity, damping = as_warp(self._gravity, vec3), as_warp(self._damping, wp.float32)
        of_edge = edges, flag["careful"], mass, contacts[1], x
        colours = [_runs(pairs) for pairs in (topology.bends, topology.edges)]
        first_edge = len(topology.bends)
        lengths = [*colours[0], *((first + first_edge, count) for first, count in colours[1])]
        of_length = ends, shortest, longest, softness, mass, x
        holding = [
            launch(kernels.hold_kernel, (len(held), lanes), s.anchor_stiffness, held, motion, point, x)
            for _ in self._anchor
        ]
        self._substep = [
            launch(kernels.fall_kernel, each, h, gravity, damping, contacts[0], x, v, previous),
            *holding,
            *(launch(kernels.length_kernel, (size, lanes), first, *of_length) for first, size in lengths),
            launch(kernels.pair_kernel, each, s.thickness, faces, count, near, side, mass, x, pushes),
            launch(kernels.contact_kernel, each, s.margin, s.friction, contacts[0], previous, pushes, x),
            *(launch(kernels.edge_kernel, (size, lanes), first, s.edge_margin, *of_edge) for first, size in colours[1]),
            launch(kernels.finish_kernel, each, h, cloth.MAX_SPEED * h, previous, x, v),
        ]  # fmt: skip
        self._graph: Any = None
        self._width = cloth.PAIR_REACH + cloth.PAIR_SLACK  # of a cell of the grid [m]: the largest reach of any lane
        if device.type == "cuda":
            for one_launch in self._substep:
                one_launch.launch()  # a graph can't load its kernels
            with wp.ScopedCapture(device=str(device), force_module_load=False) as capture:
                self._substeps()
            self._graph = capture.graph

    def _substeps(self) -> None:
        """The time steps between two searches for contacts."""
        for _ in range(self._settings.refresh):
            for launch in self._substep:
                launch.launch()

    def load(self, lane: int, cut: ClothCut, positions: F32, bodies: F32) -> None:
        """Puts cloth of this cut at `positions` (N, 3), at rest, into a lane; its course is `bodies` (T, V, 3) [m]."""
        face, weights, offset = cut.anchors
        columns: list[tuple[Tensor, NDArray[Any]]] = [
            (self._x, positions), (self._rest, cut.told_apart), (self._mass, cut.inverse_mass),
            (self._shortest, cut.shortest), (self._longest, cut.longest),
            (self._held_face, face), (self._held_weights, weights), (self._held_offset, offset[:, 0]),
        ]  # fmt: skip
        with self._stream:
            for whole, values in columns:
                whole[:, lane] = torch.from_numpy(np.ascontiguousarray(values)).to(self._device)
            self._course[lane, : len(bodies)] = torch.from_numpy(np.ascontiguousarray(bodies)).to(self._device)
            self._v[:, lane] = 0
            self._searched[:, lane] = 1e6  # far away: everything is searched and asked
            for known in self._asked:
                known["at"][:, lane] = 1e6
                known["distance"][:, lane] = 0
                known["face"][:, lane] = -1
            self._cell[lane] = cut.pair_reach
            self._width = max(self._width, cut.pair_reach)
            self._apart[lane] = cut.rest_apart

    def positions(self, lane: int) -> F32:
        """Where a lane's cloth is [m], shape (N, 3)."""
        with self._stream:
            found: F32 = self._x[:, lane].clone().cpu().numpy()  # a CPU would give its own memory
        return found

    def frame(self, steps: Sequence[CourseStep | None]) -> NDArray[np.float64]:
        """Takes each lane a step further on its course; an idle one has None.

        Returns the root mean square speed of each lane's cloth at the end [m/s], shape (lanes,).
        """
        s = self._settings
        given = [_IDLE if step is None else step for step in steps]
        moving = np.array([step.before != step.after for step in given])
        busy = moving | np.array([step.is_careful for step in given])
        is_there = np.array([step is not None for step in steps])
        with self._stream, torch_stream(self._device):
            self._set("before", [step.before for step in given])
            self._set("after", [step.after for step in given])
            self._set("careful", [step.is_careful for step in given])
            self._gravity.copy_(torch.from_numpy(np.stack([step.gravity for step in given]).astype(np.float32)))
            self._damping.copy_(torch.from_numpy(np.exp([-step.drag * s.substep for step in given]).astype(np.float32)))
            for anchor in self._anchor:
                anchor.launch()
            for first in range(0, s.substeps, s.refresh):
                if not first or busy.any():
                    self._refresh(first, busy if first else is_there, moving & (first == 0))
                if self._graph is None:
                    self._substeps()
                else:
                    wp.capture_launch(self._graph)
            self._sum.launch()
            total = self._total.cpu().numpy().astype(np.float64).sum(0)
        speeds: NDArray[np.float64] = np.sqrt(total / len(self._x))
        return speeds

    def _set(self, name: str, values: Any) -> None:
        self._of_lane[name].copy_(torch.from_numpy(np.asarray(values, np.int32)))

    def _refresh(self, first: int, whose: NDArray[np.bool_], moved_on: NDArray[np.bool_]) -> None:
        """Searches for contacts after `first` time steps of a frame."""
        self._set("refreshed", whose)
        self._set("moved_on", moved_on)
        self._place.set_argument(3, first)
        self._place.launch()
        self._mesh.refit()
        self._touch.launch()
        self._touch_edges.launch()
        self._wandered.launch()
        self._centres.launch()
        self._grid.build(as_warp(self._centre.view(-1, 3), wp.vec3), self._width)
        self._search.launch()
        self._of_lane["wandered"].zero_()
        self._sides.launch()


_IDLE = CourseStep(0, 0, np.zeros(3, np.float32), 0.0)
_KIND = {2: wp.float32, 3: wp.vec3}


def _runs(pairs: I32) -> list[tuple[int, int]]:
    """First pair and number of pairs of each colour; a new colour begins where a vertex comes again."""
    runs, start = [], 0
    seen: set[int] = set()
    for k, pair in enumerate(pairs.tolist()):
        if not seen.isdisjoint(pair):
            runs.append((start, k - start))
            start, seen = k, set()
        seen.update(pair)
    return [*runs, (start, len(pairs) - start)]
