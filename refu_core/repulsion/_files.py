"""The ReFU layer on disk: its tensors lie with the backbone's that it was trained with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from refu_core.errors import WeightsError
from refu_core.repulsion._refu import Refu
from refu_core.weights import build_for, load_weights

_PREFIX = "refu."


def refu_tensors(refu: Refu, *, half: bool = True) -> dict[str, Tensor]:
    """The layer's tensors by the names they have on disk; beside them the card needs `refu.config` as `refu`."""
    return {_PREFIX + name: t.half() if half else t for name, t in refu.state_dict().items()}


def read_refu(
    stem: str | Path, *, expect: Mapping[str, Any] | None = None, device: str | torch.device = "cpu"
) -> Refu | None:
    """Reads the layer of the weights `stem`, ready for use; None where they were trained without one.

    Raises:
        WeightsError: missing, damaged, not as expected (`refu_core.weights.load_weights`), or of another version.
    """
    weights = load_weights(stem, expect=expect)
    config = weights.card.get("refu")
    if config is None:
        return None
    tensors = {k[len(_PREFIX) :]: v.float() for k, v in weights.tensors.items() if k.startswith(_PREFIX)}
    try:
        refu = build_for(tensors, lambda: Refu.from_config(config))
    except WeightsError as error:
        msg = f"{weights.path}: its ReFU layer doesn't fit its card: {error}"
        raise WeightsError(msg) from error
    return refu.to(device).eval().requires_grad_(False)
