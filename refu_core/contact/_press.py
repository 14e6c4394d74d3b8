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
        ring, self._ends = mesh.ring, np.ascontiguousarray(mesh.edges.T)
        self._all = wp.array(np.arange(n, dtype=np.int32), dtype=wp.int32, device=device)
        self._ring = [wp.array(one.astype(np.int32), dtype=wp.int32, device=device) for one in (ring.start, ring.items)]
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
            for mesh, limb in zip(self._meshes, self._limbs, strict=True):
                mesh.refit()
                inputs = [limb, as_warp(self._skin, wp.vec3), as_warp(self._points, wp.vec3), self._settings.press_room]
                outputs = [as_warp(self._push, wp.vec3), as_warp(self._count, wp.int32)]
                wp.launch(kernels.press_kernel, len(limb.foreign), inputs, outputs, device=str(self.device))
            if self._is_serial and not self._count:
                return points
            return points + self._spread(self._reached() if self._is_serial else self._all)

    def _reached(self) -> Any:
        """What is pressed, and as far as sweeps reach; a GPU isn't waited for to know."""
        first, second = self._ends
        reached = self._push.any(dim=1).numpy()
        for _ in range(2 * self._settings.press_pairs):
            beside = reached[first] | reached[second]
            reached[first[beside]] = reached[second[beside]] = True
        return wp.array(np.flatnonzero(reached).astype(np.int32), dtype=wp.int32, device="cpu")

    def _spread(self, rows: Any) -> Tensor:
        """How far the vertices `rows` go, shape (N, 3): neighbours follow what is pressed."""
        self._fields.zero_()
        self._fields[0].copy_(self._push)
        fields = [as_warp(one, wp.vec3) for one in self._fields]
        for sweep in range(2 * self._settings.press_pairs):
            step = self._settings.blend_steps[sweep % 2]
            inputs = [rows, *self._ring, as_warp(self._push, wp.vec3), step, fields[sweep % 2]]
            outputs = [fields[1 - sweep % 2]]
            wp.launch(kernels.spread_press_kernel, len(rows), inputs, outputs, device=str(self.device))
        return self._fields[0]
