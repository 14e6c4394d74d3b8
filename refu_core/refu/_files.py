"""The ReFU layer on disk: its tensors are stored with those of the backbone that it was trained with."""

from __future__ import annotations

import torch
from torch import Tensor

from refu_core.backbones import Backbone, backbone_from_weights
from refu_core.errors import WeightsError
from refu_core.garments import GarmentTemplate
from refu_core.modes import MAX_MARGIN
from refu_core.refu._layer import Refu
from refu_core.weights import Weights, build_for, naming

_PREFIX = "refu."


def refu_tensors(refu: Refu, *, half: bool = True) -> dict[str, Tensor]:
    """The layer's tensors by the names they have on disk; the card must hold `refu.config` as `refu`."""
    return {_PREFIX + name: t.half() if half else t for name, t in refu.state_dict().items()}


def trained_from_weights(
    weights: Weights, garment: GarmentTemplate, *, device: str | torch.device = "cpu"
) -> tuple[Backbone, Refu | None]:
    """The backbone and the layer (None where it was trained without) in `weights`, ready for use.

    Raises `WeightsError`: they are of another version or garment, or their basis is missing, damaged or the wrong one.
    """
    backbone: Backbone = backbone_from_weights(weights, garment, device=device).requires_grad_(False)
    refu = refu_from_weights(weights, device=device)
    return backbone, None if refu is None else refu.eval().requires_grad_(False)


def refu_from_weights(weights: Weights, *, device: str | torch.device = "cpu") -> Refu | None:
    """The layer in `weights`, None where there is none. Raises `WeightsError` for one that doesn't fit its card."""
    config = weights.card.get("refu")
    if config is None:
        return None
    tensors = {k[len(_PREFIX) :]: v for k, v in weights.tensors.items() if k.startswith(_PREFIX)}
    with naming(f"{weights.path}: its ReFU layer doesn't fit its card"):
        refu = build_for(tensors, lambda: Refu.from_config(config))
        if refu.margin > MAX_MARGIN:
            got = f"{refu.margin:g} m and {refu.config['least']:g}"
            msg = f"wanted a margin of 0 to {MAX_MARGIN} m and a least scale of 0 to 1, got {got}; train it again"
            raise WeightsError(msg)
    return refu.to(device)
