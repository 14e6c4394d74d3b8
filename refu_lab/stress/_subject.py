"""The pipeline under test, and the references that its results are compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from refu_core.frames import N_STYLES, SmplFrame
from refu_core.metrics import CollisionChecker
from refu_core.modes import SdfMode
from refu_core.realtime import ContactStage, GarmentPipeline, Outfit, Wearer, dress
from refu_core.sdf import ApproxSdf, BandSdf, BodySdf, ExactSdf


@dataclass(frozen=True, kw_only=True)
class Wardrobe:
    """Garments for one body, and how they are predicted."""

    garments: tuple[str, ...]
    backbone: str = "skinned"
    sdf: str = "accurate"

    @property
    def mode(self) -> str:
        """`<backbone>/<sdf>`."""
        return f"{self.backbone}/{self.sdf}"


class Subject:
    """One wardrobe's pipeline and its references, each made at first use."""

    def __init__(self, wardrobe: Wardrobe, *, weights: Path | None = None, collider: bool = True) -> None:
        """Loads the pipeline; raises what `GarmentPipeline.load` raises."""
        self.wardrobe = wardrobe
        self._weights, self._collider = weights, collider
        self.pipeline = self.load()

    @cached_property
    def on_skin(self) -> Subject:
        """The same wardrobe on the skin, without a collider."""
        return Subject(self.wardrobe, weights=self._weights, collider=False)

    def load(self, *garments: str) -> GarmentPipeline:
        """A pipeline that has never seen a frame, for these garments or all."""
        return GarmentPipeline.load(
            garments or self.wardrobe.garments,
            backbone=self.wardrobe.backbone,
            sdf=self.wardrobe.sdf,
            weights=self._weights,
            collider=self._collider,
        )

    @property
    def one_by_one(self) -> dict[str, GarmentPipeline]:
        """A pipeline for each garment alone: worn together, they would also be lifted off each other."""
        names = self.wardrobe.garments
        return self._alone if len(names) > 1 else {names[0]: self.pipeline}

    @cached_property
    def _alone(self) -> dict[str, GarmentPipeline]:
        return {name: self.load(name) for name in self.wardrobe.garments}

    @cached_property
    def checker(self) -> CollisionChecker:
        """Exact collisions, by winding number."""
        return CollisionChecker(self.pipeline.body.faces)

    @cached_property
    def distances(self) -> dict[str, BodySdf]:
        """The exact signed distance by tree and by cells, and the approximate one."""
        body = self.pipeline.body
        return {"exact": ExactSdf(body.faces), "band": BandSdf(body.faces), "approx": ApproxSdf(body)}

    @cached_property
    def contact_stage(self) -> ContactStage:
        """Collision handling as in the pipeline; with the exact distance if the pipeline has none."""
        mode = SdfMode(self.wardrobe.sdf)
        return ContactStage(self.pipeline.outfit, sdf=SdfMode.ACCURATE if mode is SdfMode.NONE else mode)

    @cached_property
    def outfit64(self) -> Outfit:
        """What the pipeline wears in float64, with its own copy of the networks: the reference for float32."""
        return self.pipeline.outfit.to(torch.float64)


@torch.no_grad()
def predicted(outfit: Outfit, frames: Sequence[SmplFrame]) -> list[NDArray[np.floating]]:
    """Bodies, then garments before collision handling, in the outfit's precision: B frames [m], (B, V, 3) each."""
    none = np.zeros(N_STYLES, np.float32)
    columns = zip(*((f.pose, f.betas, none if f.style is None else f.style) for f in frames), strict=True)
    pose, betas, style = (torch.as_tensor(np.stack(one)).to(outfit.body.v_template.dtype) for one in columns)
    wearer = Wearer.of(outfit, betas, style if any(frame.style is not None for frame in frames) else None)
    dressed = dress(pose, wearer)
    return [
        torch.stack([turn(one) for turn, one in zip(dressed.turns, found, strict=True)]).numpy()
        for found in (dressed.body, *(drape.vertices for drape in dressed.drapes.values()))
    ]


def distance_to_mesh(
    points: NDArray[np.floating], vertices: NDArray[np.floating], faces: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Distance of `points` [m], shape (N, 3), to a mesh, shape (N,), over all triangles, in float64.

    A triangle without area counts by its edges.
    """
    corners = torch.as_tensor(np.asarray(vertices, np.float64)[faces])
    best = []
    for chunk in torch.split(torch.as_tensor(np.asarray(points, np.float64)), 16):  # bounds memory: N × F × 3 numbers
        squared = torch.full((len(chunk),), torch.inf, dtype=torch.float64)
        for k in range(3):
            squared = torch.minimum(squared, _to_segments(chunk, corners[:, k], corners[:, (k + 1) % 3]))
        best.append(torch.minimum(squared, _to_planes(chunk, corners)).sqrt())
    return torch.cat(best).numpy() if best else np.zeros(0)


def _to_segments(points: torch.Tensor, start: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
    """Squared distance of each point (N, 3) to the closest of F segments."""
    along = end - start
    length2 = along.square().sum(-1)
    away = points[:, None] - start
    t = ((away * along).sum(-1) / length2.clamp_min(1e-300)).clamp(0, 1)
    return (away - t[..., None] * along).square().sum(-1).amin(1)


def _to_planes(points: torch.Tensor, corners: torch.Tensor) -> torch.Tensor:
    """Squared distance of each point (N, 3) to the closest of F triangles (F, 3, 3) that it projects into."""
    a, b, c = corners.unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    area = torch.linalg.vector_norm(normal, dim=-1)
    unit = normal / area.clamp_min(1e-300)[:, None]
    above = torch.ones(len(points), len(a), dtype=torch.bool)
    for p, q in ((a, b), (b, c), (c, a)):
        above &= ((points[:, None] - p) * torch.linalg.cross(unit, q - p)).sum(-1) >= 0
    height2 = ((points[:, None] - a) * unit).sum(-1).square()
    return torch.where(above & (area > 0), height2, torch.inf).amin(1)
