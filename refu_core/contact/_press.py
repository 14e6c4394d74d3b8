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


class Press:
    """Keeps a garment between the skin that it lies on and the limbs that it doesn't lie on.

    A hand that hangs beside a thigh goes through a wide skirt. Along the gradient half of the cloth in it would leave
    in front and half behind, with edges through the hand between them. So a vertex is looked at from the skin that it
    lies on: where another limb comes in between, it stays on this side, and its neighbours follow. A collider has room
    there.
    """

    def __init__(
        self, garment: GarmentTemplate, body: SmplBody, *, settings: ContactSettings = DEFAULT_CONTACT
    ) -> None:
        """For a garment and the body that it is worn on, on one device."""
        self._settings, self.device = settings, body.device
        self._is_serial = self.device.type == "cpu"
        n, device = garment.n_vertices, str(self.device)
        own = (weight_of_parts(garment.weights, _LIMBS) > settings.own_weight).cpu().numpy()
        of_face = part_of_faces(body.weights, body.faces, _LIMBS).cpu().numpy()
        faces = body.faces.cpu().numpy()
        self._body = torch.zeros_like(body.v_template).copy_(body.v_template)
        mesh = Connectivity.of(garment.faces.cpu(), n)
        ring = mesh.ring
        # Rows of one length: those of fewer neighbours name the vertex itself, too.
        sizes = np.diff(ring.start)
        self._around = np.repeat(np.arange(n)[:, None], sizes.max(), axis=1)
        self._around[ring.owner, np.arange(len(ring.items)) - ring.start[ring.owner]] = ring.items
        self._rows = torch.arange(n, dtype=torch.int32, device=self.device)
        rings = [wp.array(one.astype(np.int32), dtype=wp.int32, device=device) for one in (ring.start, ring.items)]
        self._meshes: list[Any] = []
        self._limbs: list[Any] = []
        for k in range(len(_LIMBS)):
            foreign = np.flatnonzero(~own[:, k])
            if not len(foreign):
                continue
            limb = kernels.Limb()
            corners = wp.array(faces[of_face == k].ravel().astype(np.int32), dtype=wp.int32, device=device)
            self._meshes.append(wp.Mesh(as_warp(self._body, wp.vec3), corners))
            limb.mesh = self._meshes[-1].id
            limb.foreign = wp.array(foreign.astype(np.int32), dtype=wp.int32, device=device)
            self._limbs.append(limb)
        self._skin, self._points, self._push = (torch.zeros(n, 3, device=self.device) for _ in range(3))
        self._fields = torch.zeros(2, n, 3, device=self.device)
        self._count = torch.zeros(1, dtype=torch.int32, device=self.device)
        skin, points, push, *fields = (
            as_warp(one, wp.vec3) for one in (self._skin, self._points, self._push, *self._fields)
        )
        count, rows = as_warp(self._count, wp.int32), as_warp(self._rows, wp.int32)
        self._looks = [
            self._command(
                kernels.press_kernel, len(limb.foreign), [limb, skin, points, settings.press_room, push, count]
            )
            for limb in self._limbs
        ]
        self._sweeps = [
            self._command(
                kernels.spread_press_kernel, n, [rows, *rings, push, settings.blend_steps[k], fields[k], fields[1 - k]]
            )
            for k in range(2)
        ]

    @torch.no_grad()
    def __call__(self, points: Tensor, skin: Tensor, body: Tensor) -> Tensor:
        """The garment (N, 3) [m], pressed to `skin` (N, 3) [m], where it lies on the body (V, 3) [m].

        Not differentiable; a GPU isn't waited for.
        """
        self._body.copy_(body)
        self._points.copy_(points)
        self._skin.copy_(skin)
        self._push.zero_()
        self._count.zero_()
        with torch_stream(self.device):
            for mesh, look in zip(self._meshes, self._looks, strict=True):
                mesh.refit()
                look.launch()
            if self._is_serial:
                if not self._count:
                    return points
                self._list_reached()
            self._fields.zero_()
            self._fields[0].copy_(self._push)
            for sweep in range(2 * self._settings.press_pairs):
                self._sweeps[sweep % 2].launch()
        return points + self._fields[0]

    def _list_reached(self) -> None:
        """What is pressed, and as far as sweeps reach; a GPU isn't waited for to know, and goes through all."""
        reached = self._push.any(dim=1).numpy()
        front = np.flatnonzero(reached)
        for _ in range(2 * self._settings.press_pairs):
            around = self._around[front].ravel()
            front = np.unique(around[~reached[around]])
            reached[front] = True
        rows = np.flatnonzero(reached)
        self._rows[: len(rows)] = torch.from_numpy(rows)
        for sweep in self._sweeps:
            sweep.set_dim(len(rows))

    def _command(self, kernel: Any, dim: int, inputs: list[Any]) -> Any:
        return wp.launch(kernel, dim, inputs, device=str(self.device), record_cmd=True)
