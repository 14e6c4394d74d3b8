"""The paper's structure at the paper's sizes, with random instead of trained weights: only its cost is measured."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from refu_core import GarmentTemplate, SmplBody
from refu_core.backbones import Backbone, WithoutWearerCode, backbone_config, build_backbone
from refu_core.frames import N_BETAS, N_STYLES, SmplFrame
from refu_core.realtime import Outfit, Wearable, Wearer, dress
from refu_core.refu import PAPER, ScaleNet, repulse
from refu_core.sdf import SdfNetwork, SdfNetworkConfig, SdfSample, body_frame, with_gradient

_CHUNK = 4096  # vertices whose activations are held at a time


@dataclass(frozen=True, kw_only=True)
class PaperSettings:
    """Sizes; the defaults are the paper's, anything less is for a trial run."""

    pivots: int = 20
    """Number of TailorNet's high-frequency networks."""
    width: int = 1024
    """Width of the layers of h and of the distance network."""
    dtype: torch.dtype = torch.float32
    """Precision of the networks; bfloat16 and float16 are for GPUs."""


class _LowPrecision(WithoutWearerCode):
    def __init__(self, backbone: Backbone, dtype: torch.dtype) -> None:
        self._backbone, self._dtype = backbone, dtype

    def __call__(
        self,
        betas: Tensor,
        pose: Tensor,
        style: Tensor | None,
        *,
        wearer_code: Tensor | None = None,  # noqa: ARG002
    ) -> Tensor | None:
        style = None if style is None else style.to(self._dtype)
        return self._backbone(betas.to(self._dtype), pose.to(self._dtype), style)


class PaperStructure:
    """TailorNet with dense heads, the 9 x 1024 distance network at every vertex, ReFU with a dense k (Sec. 3 and 4).

    On a CPU it takes 2.5 GB for a T-shirt, and seconds a frame.
    """

    def __init__(self, garment: GarmentTemplate, body: SmplBody, *, settings: PaperSettings) -> None:
        """Builds it for a garment and its body, on the body's device."""
        self._dtype = settings.dtype
        self._garment, self._body = garment, body
        backbone = build_backbone(
            backbone_config("tailornet", garment, preset="paper"),
            garment.to(device="cpu"),
            pivots=torch.randn(settings.pivots, N_BETAS + N_STYLES),
        )
        # Sizes of ReFU's networks h and g. Here k is one dense layer, evaluated for all vertices in one product.
        sizes = replace(PAPER, feature_size=settings.width, hidden_size=settings.width, is_compact=True)
        self._distance = SdfNetwork(SdfNetworkConfig(width=settings.width))
        self._scale = ScaleNet(garment.n_vertices, least=0.0, settings=sizes)
        self._k = nn.Linear(settings.width, garment.n_vertices * PAPER.latent_size)
        networks = nn.ModuleList((backbone, self._distance, self._scale, self._k))
        networks.to(body.device, self._dtype).eval().requires_grad_(False)
        self.n_parameters = sum(p.numel() for p in networks.parameters())
        wearable = Wearable(garment, _LowPrecision(backbone, self._dtype), None, margin=0.0)
        self._outfit = Outfit(body, {garment.name: wearable})
        self.stages: list[dict[str, float]] = []
        """Time of each stage in each frame, by whichever clock `time.perf_counter` reads [ms]."""

    @torch.no_grad()
    def __call__(self, frame: SmplFrame) -> NDArray[np.float32]:
        """A meaningless garment [m], shape (V, 3), computed the paper's way."""
        ended = {"start": time.perf_counter()}
        pose = torch.tensor(frame.pose, device=self._body.device)[None]
        betas = torch.tensor(frame.betas, device=self._body.device)[None]
        dressed = dress(
            pose, Wearer.of(self._outfit, betas), lap=lambda stage, _: ended.update({stage: time.perf_counter()})
        )
        points = dressed.turns[0](dressed.drapes[self._garment.name].vertices[0])
        laps = list(ended.values())
        sample = self._sample(points, betas, pose)
        laps.append(time.perf_counter())
        pushed = repulse(points, sample, scale=self._alpha(betas, pose, sample.distance))
        vertices: NDArray[np.float32] = pushed.cpu().numpy()
        laps.append(time.perf_counter())
        spent = (1e3 * np.diff(laps)).tolist()
        self.stages.append(dict(zip(("body", "backbone", "sdf", "refu"), spent, strict=True)))
        return vertices

    def _sample(self, points: Tensor, betas: Tensor, pose: Tensor) -> SdfSample:
        """The distance and, by backpropagation, its gradient at all vertices."""
        rotation, root = body_frame(self._body, pose, betas)
        own = (points - root[0]) @ rotation[0] + root[0]
        condition = (betas.to(self._dtype), pose[:, 1:].to(self._dtype))
        parts = [
            with_gradient(self._distance, chunk[None].to(self._dtype), *condition, keep_graph=False)
            for chunk in torch.split(own, _CHUNK)
        ]
        distance = torch.cat([distance[0] for distance, _ in parts]).float()
        gradient = torch.cat([gradient[0] for _, gradient in parts]).float()
        return SdfSample(distance, gradient @ rotation[0].T)

    def _alpha(self, betas: Tensor, pose: Tensor, distance: Tensor) -> Tensor:
        z = self._scale.feature(betas.to(self._dtype), pose.to(self._dtype), None)
        latent = torch.relu(self._k(z)).view(len(distance), -1)
        alpha: Tensor = self._scale.g(torch.cat((latent, distance[:, None].to(self._dtype)), 1))[:, 0].float()
        return alpha
