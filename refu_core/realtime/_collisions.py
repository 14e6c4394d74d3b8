"""Which signed distance a mode uses, and how a garment's vertices are asked for it and pushed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from refu_core.body import SmplBody
from refu_core.garments import GarmentTemplate
from refu_core.repulsion import Limbs, Resolution, Resolver, VertexScale
from refu_core.sdf import ApproxSdf, BandSdf, ExactSdf, Links, RestFaces


@dataclass(frozen=True, eq=False)
class _Fabric:
    """What collision handling must know of a garment, once and for all poses."""

    links: Links | None
    """Where the band is asked by them."""
    resolver: Resolver

    @classmethod
    def of(cls, garment: GarmentTemplate, body: SmplBody, rest: ExactSdf, *, has_links: bool) -> _Fabric:
        """Of a garment on a body, whose rest pose `rest` was updated with."""
        clearance = rest.query(garment.v_template).distance
        return cls(
            Links.of(garment.edges, garment.n_vertices) if has_links else None,
            Resolver(Limbs.of(body.weights, body.faces, garment.weights, garment.faces, clearance=clearance)),
        )


class Collisions:
    """Brings garments off one posed body at a time."""

    def __init__(
        self, body: SmplBody, garments: Mapping[str, GarmentTemplate], *, is_accurate: bool, uses_band: bool = True
    ) -> None:
        """With the exact signed distance to `body`, within a band of its skin or everywhere, or the approximate one."""
        self._band: BandSdf | None = None
        self._rest_faces: RestFaces | None = None
        self._sdf: BandSdf | ExactSdf | ApproxSdf
        if not is_accurate:
            self._sdf = ApproxSdf(body)
            self._rest_faces = RestFaces(body)
        elif body.device.type == "cpu" and uses_band:
            self._sdf = self._band = BandSdf(body.faces, rest=body.v_template)
        else:  # thousands of threads walk the tree faster than one sorts what needn't
            self._sdf = ExactSdf(body.faces, device=body.device)
        rest = ExactSdf(body.faces, device=body.device)
        rest.update(body.v_template)
        has_links = self._band is not None
        self._fabrics = {name: _Fabric.of(one, body, rest, has_links=has_links) for name, one in garments.items()}

    def near(self, unposed: Tensor) -> Tensor | None:
        """A face of the body near each vertex of unposed garments of the mean shape (B, V, 3), where that is of use."""
        return None if self._rest_faces is None else self._rest_faces(unposed)

    def update(self, vertices: Tensor) -> None:
        """Takes over the body's new pose, shape (V, 3) [m]. Raises `MeshError` for one that isn't finite."""
        self._sdf.update(vertices)

    def resolve(
        self, name: str, points: Tensor, *, margin: float, scale: float | VertexScale, near: Tensor | None
    ) -> tuple[Resolution, int]:
        """The garment of that name, with vertices [m], shape (N, 3), off the body (`refu_core.repulsion.Resolver`).

        Also how many vertices weren't asked for their distance.
        """
        fabric = self._fabrics[name]
        if self._band is not None and fabric.links is not None and margin + 2e-3 <= self._band.band:
            start = self._band.clipped(points, fabric.links)
            n_skipped = int(torch.count_nonzero(start.distance == self._band.band))
        else:
            start = self._sdf.query(points, near=near)
            n_skipped = 0
        return fabric.resolver(points, self._sdf, start, margin=margin, scale=scale), n_skipped

    def queued(
        self, name: str, points: Tensor, *, margin: float, scale: float | VertexScale, near: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """The same of a GPU that isn't waited for (`refu_core.repulsion.Resolver.queued`)."""
        assert not isinstance(self._sdf, BandSdf)  # which is for a CPU
        start = self._sdf.query(points, near=near)
        return self._fabrics[name].resolver.queued(points, self._sdf, start, margin=margin, scale=scale)
