"""Names of devices, checked where they come in."""

from __future__ import annotations

import torch

from refu_core.errors import RefuError


def checked_device(name: str) -> torch.device:
    """The torch device of a name. Raises `RefuError` for one that there isn't."""
    try:
        device = torch.device(name)
    except RuntimeError as error:
        msg = f"no device {name!r}: wanted cpu or cuda"
        raise RefuError(msg) from error
    if device.type == "cuda" and not torch.cuda.is_available():
        msg = f"no device {name!r}: this torch build or machine has no CUDA; use cpu"
        raise RefuError(msg)
    return device
