"""How far a backbone's garments are from the simulated ones."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from refu_core.backbones import Backbone, BasisDecoder
from refu_core.body import SmplBody
from refu_core.garments import GarmentTemplate
from refu_core.training._data import Samples, asked_only

_CHUNK = 32


@torch.no_grad()
def displacements(backbone: Backbone, samples: Samples) -> Tensor:
    """What a backbone predicts for samples [m], shape (N, V, 3); zero for one without a network."""
    parts = []
    for start in range(0, len(samples), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        predicted = backbone(samples.betas[chunk], samples.pose[chunk], samples.style[chunk]).displacement
        parts.append(torch.zeros_like(samples.displacement[chunk]) if predicted is None else predicted)
    return torch.cat(parts)


@torch.no_grad()
def posed_errors(predicted: Tensor, samples: Samples, body: SmplBody, garment: GarmentTemplate) -> Tensor:
    """Distances of posed vertices [mm], shape (N, V), of predicted displacements (N, V, 3) [m] (the paper's MPVE)."""
    parts = []
    for start in range(0, len(samples), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        transforms = garment.vertex_transforms(body(samples.pose[chunk], samples.betas[chunk]).transforms)
        error = predicted[chunk] - samples.displacement[chunk]
        parts.append(1e3 * (transforms.rotation @ error.unsqueeze(-1)).squeeze(-1).norm(dim=-1))
    return torch.cat(parts)


def backbone_figures(
    backbone: Backbone, samples: Samples, body: SmplBody, garment: GarmentTemplate, *, mean: Tensor
) -> dict[str, Any]:
    """MPVE on the test split [mm], beside what it is to be measured against.

    `mpve_mm` is on the simulated poses. `asked_mm` is on the poses that were asked where limbs were held back: the
    distance to the garment of the simulated pose, posed as was asked. `skinned_mm` is without a network, `mean_mm`
    (`mean`, shape (V, 3)) the best constant, and `basis_mm` the least that the output basis allows.
    """

    def mpve(predicted: Tensor, of: Samples) -> float:
        return round(float(posed_errors(predicted, of, body, garment).mean()), 3)

    truth = samples.displacement
    figures: dict[str, Any] = {
        "samples": len(samples),
        "mpve_mm": mpve(displacements(backbone, samples), samples),
        "skinned_mm": mpve(torch.zeros_like(truth), samples),
        "mean_mm": mpve(mean.expand_as(truth), samples),
    }
    decoder = getattr(backbone, "decoder", None)
    if isinstance(decoder, BasisDecoder):
        figures["basis_mm"] = mpve(decoder(decoder.encode(truth)), samples)
    asked = asked_only(samples)
    if len(asked):
        figures["asked_samples"] = len(asked)
        figures["asked_mm"] = mpve(displacements(backbone, asked), asked)
    return figures
