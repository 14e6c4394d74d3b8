"""How far a backbone's garments are from the simulated ones."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from refu_core.backbones import Backbone, BasisDecoder
from refu_core.body import SmplBody
from refu_core.garments import GarmentTemplate
from refu_core.training._data import TrainingSamples, in_chunks

_CHUNK = 32


@torch.no_grad()
def displacements(backbone: Backbone, samples: TrainingSamples) -> Tensor:
    """What a backbone predicts for samples [m], shape (N, V, 3); zero for one without a network."""

    def predict(betas: Tensor, pose: Tensor, style: Tensor, truth: Tensor) -> Tensor:
        predicted = backbone(betas, pose, style)
        return torch.zeros_like(truth) if predicted is None else predicted

    return in_chunks(predict, samples.betas, samples.pose, samples.style, samples.displacement, size=_CHUNK)


@torch.no_grad()
def posed_errors(predicted: Tensor, samples: TrainingSamples, body: SmplBody, garment: GarmentTemplate) -> Tensor:
    """Errors of posed vertices [mm], shape (N, V), for predicted displacements (N, V, 3) [m] (the paper's MPVE)."""

    def error(predicted: Tensor, truth: Tensor, pose: Tensor, betas: Tensor) -> Tensor:
        rotation = garment.vertex_transforms(body(pose, betas).transforms).rotation
        distance: Tensor = (rotation @ (predicted - truth).unsqueeze(-1)).squeeze(-1).norm(dim=-1)
        return 1e3 * distance

    return in_chunks(error, predicted, samples.displacement, samples.pose, samples.betas, size=_CHUNK)


def mpve(predicted: Tensor, samples: TrainingSamples, body: SmplBody, garment: GarmentTemplate) -> float:
    """Mean of `posed_errors` [mm]."""
    return round(float(posed_errors(predicted, samples, body, garment).mean()), 3)


def backbone_figures(
    backbone: Backbone, samples: TrainingSamples, body: SmplBody, garment: GarmentTemplate, *, mean: Tensor
) -> dict[str, Any]:
    """MPVE on the test split [mm], beside baselines to compare it with.

    `skinned_mm` is without a network, `mean_mm` with the best constant displacement (`mean`, shape (V, 3)), and
    `basis_mm` the least that the output basis allows.
    """

    truth, decoder = samples.displacement, getattr(backbone, "decoder", None)
    shown = {
        "mpve_mm": displacements(backbone, samples),
        "skinned_mm": torch.zeros_like(truth),
        "mean_mm": mean.expand_as(truth),
    }
    if isinstance(decoder, BasisDecoder):
        shown["basis_mm"] = decoder(decoder.encode(truth))
    return {"samples": len(samples), **{name: mpve(one, samples, body, garment) for name, one in shown.items()}}
