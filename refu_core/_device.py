"""Devices: checks of their names, torch's threads and settings, and signs that a device is lost."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch

from refu_core.errors import RefuError

_LOSSES = ("CUDA error", "Warp CUDA error", "HIP error", "cudaError")
"""Signs of a driver's error in messages of torch and warp: not in all versions do these errors have a common class."""


def checked_device(name: str | torch.device) -> torch.device:
    """The torch device of this name. Raises `RefuError` if there is no such device."""
    try:
        device = torch.device(name)
    except (RuntimeError, ValueError, TypeError) as error:
        raise RefuError(f"no device {name!r}: wanted cpu or cuda") from error
    if device.type not in ("cpu", "cuda"):
        raise RefuError(f"no device {name!r}: wanted cpu or cuda")
    if device.type == "cuda" and not torch.cuda.is_available():
        raise RefuError(f"no device {name!r}: this torch build or machine has no CUDA; use cpu")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise RefuError(f"no device {name!r}: the last one is cuda:{torch.cuda.device_count() - 1}")
    return torch.device("cpu") if device.type == "cpu" else device  # there is only one CPU device, whatever its index


@contextmanager
def one_thread() -> Iterator[None]:
    """Runs torch on one thread, as the node does: a frame is too little work to share, and others need the cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def without_autocast(kind: str) -> AbstractContextManager[object]:
    """No autocast on a kind of device: millimetres need float32. Nothing is entered where it is off already."""
    return torch.autocast(kind, enabled=False) if torch.is_autocast_enabled(kind) else nullcontext()


@contextmanager
def own_settings() -> Iterator[None]:
    """Torch with this project's own settings, whatever the caller has set.

    There is no inference mode, no autocast and no gradient, and the default device is the CPU.
    """
    is_cpu = torch.empty(0).device.type == "cpu"  # a third of the time of asking for the default device
    on_cpu = nullcontext() if is_cpu else torch.device("cpu")
    with torch.inference_mode(False), torch.no_grad(), without_autocast("cpu"), without_autocast("cuda"), on_cpu:
        yield


def is_device_loss(error: BaseException) -> bool:
    """Whether an error of torch or warp says that the device itself has failed, so that it can't compute any more.

    Running out of memory isn't such an error; the next frame may find some.
    """
    if isinstance(error, torch.OutOfMemoryError):
        return False
    return isinstance(error, RuntimeError) and any(sign in str(error) for sign in _LOSSES)
