"""Cloth that other limbs press to the skin it lies on: a hand beside a skirt, a forearm at the hip."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from refu_core._warp import Recorded, Unpicklable, as_warp, ints, memory, readable, refit, torch_stream
from refu_core.body import ARMS, LEGS, SmplBody, joints_of, part_of_faces, weight_of_parts
from refu_core.body._bundle_kernels import bound_kernel, enclose_kernel
from refu_core.body._bundles import bundled
from refu_core.contact import _press_kernels as kernels
from refu_core.contact._settings import DEFAULT_CONTACT, ContactSettings
from refu_core.garments import GarmentTemplate
from refu_core.mesh import grouped_at_rest

_LIMBS = (joints_of("trunk", "head"), *ARMS, LEGS[0] + LEGS[1])
"""Joints of each limb; both legs are one, as a skirt lies on either."""


class LimbMeshes(Unpicklable):
    """The limbs of one posed body, each a mesh of its own, shared by all garments on it."""

    def __init__(self, body: SmplBody, limbs: Collection[tuple[int, ...]] = _LIMBS) -> None:
        """For poses of this body, on its device; each of the limbs is given by its joints."""
        self._device = str(body.device)
        self._vertices = memory(*body.v_template.shape, device=body.device).copy_(body.v_template)
        self._late = 0
        """Which meshes aren't fitted to the pose, as bits."""
        points = as_warp(self._vertices, wp.vec3)
        limb_of = part_of_faces(body.weights, body.faces, limbs).cpu().numpy()
        faces = body.faces.cpu().numpy()
        of_limbs = [faces[limb_of == k].astype(np.int32) for k in range(len(limbs))]
        self.meshes = [wp.Mesh(points, ints(one.ravel(), self._device)) for one in of_limbs]
        self.trees = wp.array([mesh.id for mesh in self.meshes], dtype=wp.uint64, device=self._device)
        """The meshes as kernels take them."""
        self.bundles = bundled(body.v_template.cpu().numpy(), of_limbs, body.device)
        """Boxes around their faces that are close together."""
        self._fit = [
            Recorded(bound_kernel, len(self.bundles.low), [points, self.bundles], self._device),
            Recorded(enclose_kernel, len(self.meshes), [self.bundles], self._device),
        ]

    def update(self, body: Tensor) -> None:
        """Takes over a pose: vertices (V, 3) [m]. A GPU isn't waited for."""
        self._vertices.copy_(body)
        self._late = -1
        with torch_stream(self._vertices.device):
            for command in self._fit:
                command.launch()

    def pose(self, which: int) -> None:
        """Refits the meshes of the limbs `which`, given as bits, unless they are fitted already."""
        late = which & self._late
        refit([mesh for k, mesh in enumerate(self.meshes) if (late >> k) & 1], self._vertices.device)
        self._late &= ~late


class Press(Unpicklable):
    """Keeps a garment between the skin that it lies on and the limbs that it doesn't lie on (docs/architecture.md).

    Where another limb comes between a vertex and its skin, the vertex is drawn back to the skin's side of it, and its
    neighbours with it. All of this is continuous: the nearer a limb is to the line from skin to vertex, the farther
    back the vertex goes.
    """

    def __init__(
        self,
        garment: GarmentTemplate,
        limbs: LimbMeshes,
        *,
        knows_arms: bool = False,
        settings: ContactSettings = DEFAULT_CONTACT,
    ) -> None:
        """For a garment, and the limbs of the body that it is worn on; `knows_arms` is as in `Wearable`."""
        self._settings = settings
        self._limbs = limbs  # their memory is read
        n, self.device = garment.n_vertices, garment.v_template.device
        self._is_serial = self.device.type == "cpu"
        self._skin, self._points = memory(2, n, 3, device=self.device)
        self._cut = memory(2, n, device=self.device)
        self._counts = memory(kernels.N_COUNTS, dtype=torch.int32, device=self.device)
        self._read_counts = readable(self._counts)
        own = weight_of_parts(garment.weights, _LIMBS) > 0
        foreign = (~own).cpu().numpy() @ (1 << np.arange(len(_LIMBS)))
        order, ring = grouped_at_rest(garment.v_template.cpu().numpy()), garment.mesh.ring
        fabric = kernels.Fabric()
        fabric.skin, fabric.points = as_warp(self._skin, wp.vec3), as_warp(self._points, wp.vec3)
        fabric.cut, fabric.spread = (as_warp(one, wp.float32) for one in self._cut)
        fabric.counts = as_warp(self._counts, wp.int32)
        lists = {
            "start": [*range(0, n, _PIECE if self._is_serial else 1), n],
            "vertex": order,
            "foreign": foreign,
            "ring_start": ring.start,
            "ring": ring.items,
            "front": np.zeros(2 * n),
        } | dict.fromkeys(("boxed", "near", "in_front", "rows"), np.zeros(n))
        for name, values in lists.items():
            setattr(fabric, name, ints(values, self.device))
        beside = garment.edge_length if knows_arms else settings.limb_reach / 2
        self._commands = self._launches(fabric, beside)

    def _launches(self, fabric: Any, beside: float) -> dict[str, Any]:
        """The recorded steps, by name: cloth feels limbs up to `beside` [m] to its side."""
        settings, meshes, n = self._settings, self._limbs.trees, len(self._points)
        feel = kernels.Feel()
        feel.room, feel.lies, feel.beside = settings.gap, settings.limb_reach, beside
        sweeps, near = settings.around, settings.near
        launches: dict[str, tuple[Any, int, list[Any]]] = {
            "look": (kernels.look_kernel, len(fabric.start) - 1, [fabric, self._limbs.bundles, feel]),
            "press all": (kernels.press_all_kernel, 1, [fabric, meshes, feel, sweeps, near]),
            "press": (kernels.press_kernel, n, [fabric, meshes, feel]),
            "lower": (kernels.lower_kernel, n, [fabric, feel]),
        }
        for sweep in range(sweeps):
            fields = [fabric.cut, fabric.spread] if sweep % 2 == 0 else [fabric.spread, fabric.cut]
            launches[f"spread {sweep}"] = kernels.spread_kernel, n, [fabric, 0.0 if sweep < near else 1.0, *fields]
        return {name: Recorded(*launch, self.device) for name, launch in launches.items()}

    @torch.no_grad()
    def __call__(self, points: Tensor, skin: Tensor) -> Tensor:
        """The garment (N, 3) [m], pressed by the limbs to the `skin` (N, 3) [m] that it lies on.

        Where no limb comes between, a CPU returns the very same points.
        """
        self._points.copy_(points)
        self._skin.copy_(skin)
        self._counts.zero_()
        with torch_stream(self.device):
            self._commands["look"].launch()
            wanted = int(self._read_counts[kernels.WANTED]) if self._is_serial else -1
            if not wanted:
                return points
            self._limbs.pose(wanted)
            if self._is_serial:
                self._commands["press all"].launch()
                if not self._read_counts[kernels.PRESSED]:
                    return points
            else:
                self._cut.zero_()
                self._commands["press"].launch()
                for sweep in range(self._settings.around):
                    self._commands[f"spread {sweep}"].launch()
                self._commands["lower"].launch()
        pressed: Tensor = self._points.clone()
        return pressed


_PIECE = 32
"""Vertices of a garment that are looked at together; on a GPU each is looked at alone."""
