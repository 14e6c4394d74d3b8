"""Cloth that other limbs press to the skin it lies on: a hand beside a skirt, a forearm at the hip."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from refu_core._warp import as_warp, torch_stream
from refu_core.body import ARMS, LEGS, SmplBody, joints_of, part_of_faces, weight_of_parts
from refu_core.contact import _press_kernels as kernels
from refu_core.contact._settings import DEFAULT_CONTACT, ContactSettings
from refu_core.garments import GarmentTemplate
from refu_core.mesh import Connectivity

_LIMBS = (joints_of("trunk", "head"), *ARMS, LEGS[0] + LEGS[1])
"""Joints of each limb; both legs are one, as a skirt lies on either."""


class LimbMeshes:
    """The limbs of one posed body, each a mesh of its own: one for all garments on it."""

    def __init__(self, body: SmplBody) -> None:
        """For poses of this body, on its device."""
        self._device = str(body.device)
        self._vertices = torch.zeros_like(body.v_template).copy_(body.v_template)
        points = as_warp(self._vertices, wp.vec3)
        limb_of = part_of_faces(body.weights, body.faces, _LIMBS).cpu().numpy()
        faces = body.faces.cpu().numpy()
        self.meshes = [
            wp.Mesh(points, wp.array(faces[limb_of == k].ravel().astype(np.int32), dtype=wp.int32, device=self._device))
            for k in range(len(_LIMBS))
        ]

    def update(self, body: Tensor) -> None:
        """Takes over a pose: vertices (V, 3) [m]. A GPU isn't waited for."""
        self._vertices.copy_(body)
        with torch_stream(self._vertices.device):
            for mesh in self.meshes:
                mesh.refit()


class Press:
    """Keeps a garment between the skin that it lies on and the limbs that it doesn't lie on.

    A hand that hangs beside a thigh goes through a wide skirt. Along the gradient half of the cloth in it would leave
    in front and half behind, with edges through the hand between them. So a vertex is looked at from the skin that it
    lies on: where another limb comes in between, it has room on this side only, and its neighbours have little more.
    How much is a minimum over the cloth around, which falls off along its edges. So a vertex that a limb comes before
    is drawn back from where its neighbours are already.
    """

    def __init__(
        self, garment: GarmentTemplate, limbs: LimbMeshes, *, settings: ContactSettings = DEFAULT_CONTACT
    ) -> None:
        """For a garment and the limbs of the body that it is worn on, on one device."""
        self._limbs = limbs  # their memory is read
        n, self.device = garment.n_vertices, garment.v_template.device
        self._is_serial = self.device.type == "cpu"
        device = str(self.device)
        ring = Connectivity.of(garment.faces.cpu(), n).ring
        # Rows of one length: those of fewer neighbours name the vertex itself, too.
        self._around = np.repeat(np.arange(n)[:, None], np.diff(ring.start).max(), axis=1)
        self._around[ring.owner, np.arange(len(ring.items)) - ring.start[ring.owner]] = ring.items
        self._rows = torch.arange(n, dtype=torch.int32, device=self.device)
        self._skin, self._points = torch.zeros(2, n, 3, device=self.device)
        self._room = torch.zeros(2, n, device=self.device)
        self._count = torch.zeros(1, dtype=torch.int32, device=self.device)

        def command(kernel: Any, dim: int, inputs: list[Any]) -> Any:
            return wp.launch(kernel, dim, inputs, device=device, record_cmd=True)

        skin, points = as_warp(self._skin, wp.vec3), as_warp(self._points, wp.vec3)
        room = [as_warp(one, wp.float32) for one in self._room]
        count, rows = as_warp(self._count, wp.int32), as_warp(self._rows, wp.int32)
        rings = [wp.array(one.astype(np.int32), dtype=wp.int32, device=device) for one in (ring.start, ring.items)]
        own = (weight_of_parts(garment.weights, _LIMBS) > settings.own_weight).cpu().numpy()
        self._looks = []
        for k, mesh in enumerate(limbs.meshes):
            foreign = np.flatnonzero(~own[:, k])
            if len(foreign):
                limb = kernels.Limb()
                limb.mesh = mesh.id
                limb.foreign = wp.array(foreign.astype(np.int32), dtype=wp.int32, device=device)
                inputs = [limb, skin, points, settings.press_room, room[0], count]
                self._looks.append(command(kernels.press_kernel, len(foreign), inputs))
        self._sweeps = []
        for sweep in range(settings.press_sweeps):
            slope = 0.0 if sweep < settings.press_reach else settings.press_slope
            fields = [room[sweep % 2], room[1 - sweep % 2]]
            self._sweeps.append(command(kernels.spread_room_kernel, n, [rows, *rings, points, slope, *fields]))
        self._lower = command(kernels.lower_kernel, n, [rows, skin, room[settings.press_sweeps % 2], points])

    @torch.no_grad()
    def __call__(self, points: Tensor, skin: Tensor) -> Tensor:
        """The garment (N, 3) [m], pressed to `skin` (N, 3) [m], which it lies on, by the limbs as they are.

        Not differentiable; a GPU isn't waited for.
        """
        self._points.copy_(points)
        self._skin.copy_(skin)
        self._room.fill_(torch.inf)
        self._count.zero_()
        with torch_stream(self.device):
            for look in self._looks:
                look.launch()
            if self._is_serial:
                if not self._count:
                    return points
                self._list_reached()
            for sweep in self._sweeps:
                sweep.launch()
            self._lower.launch()
        pressed: Tensor = self._points.clone()
        return pressed

    def _list_reached(self) -> None:
        """What is pressed, and as far as sweeps reach; a GPU isn't waited for to know, and goes through all."""
        reached = torch.isfinite(self._room[0]).numpy()
        front = np.flatnonzero(reached)
        for _ in self._sweeps:
            around = self._around[front].ravel()
            front = np.unique(around[~reached[around]])
            reached[front] = True
        rows = np.flatnonzero(reached)
        self._rows[: len(rows)] = torch.from_numpy(rows)
        for command in (*self._sweeps, self._lower):
            command.set_dim(len(rows))
