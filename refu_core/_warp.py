"""Warp, imported once and quietly, and the bridges between its arrays and torch's."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import operator
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NoReturn, TypeVar

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from refu_core._kernel_cache import guard, no_cache
from refu_core.errors import RefuError

Result = TypeVar("Result")


@contextlib.contextmanager
def _no_stderr() -> Iterator[None]:
    """Silences the file descriptor itself: that is where Warp's native code writes, below `sys.stderr`."""
    saved, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(null)


def _start_quietly() -> None:
    # Warp's banner, and its message that a machine has no GPU, would end up in a node's log and in a command's output.
    if hasattr(wp.config, "log_level"):
        wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    else:  # releases before the logger
        wp.config.quiet = True
    is_silent = torch.cuda.is_available() or sys.stderr is None
    with warnings.catch_warnings(), contextlib.nullcontext() if is_silent else _no_stderr():
        warnings.filterwarnings("ignore", "Support for Python", FutureWarning)  # from future releases: pip sees to that
        try:
            wp.init()
        except OSError as error:
            raise no_cache(error) from error
    guard()


_start_quietly()


class Unpicklable:
    """Holds addresses of memory that Warp works in: no other process and no copy can have them."""

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        """Raises `RefuError`, for copies too."""
        name = type(self).__name__
        raise RefuError(
            f"{name} can't be copied, pickled or sent to a process: make another one there, of the same arguments"
        )


def as_warp(tensor: Tensor, dtype: Any) -> Any:
    """A Warp array over the memory of a contiguous `tensor`: nothing is copied, no gradient is carried."""
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def as_torch(array: Any) -> Tensor:
    """A tensor over the memory of a Warp array, whatever torch's default device is."""
    with torch.device(str(array.device)):
        tensor: Tensor = wp.to_torch(array)
    return tensor


def memory(*shape: int, device: Any = "cpu", dtype: torch.dtype = torch.float32) -> Tensor:
    """A tensor of zeros to compute in, call after call.

    Its type, its device and whether it is an inference tensor don't depend on the caller's settings of torch.
    """
    with torch.inference_mode(False):
        return torch.zeros(*shape, device=device, dtype=dtype)


def readable(counts: Tensor) -> NDArray[Any]:
    """What kernels have counted, for a CPU, which reads it at once; nothing of a GPU, which would be waited for."""
    return counts.numpy() if counts.device.type == "cpu" else np.zeros(0, np.int32)


def refit(trees: Sequence[Any], device: torch.device) -> None:
    """Refits trees to their points; on a GPU, all at the same time."""
    side_by_side([tree.refit for tree in trees], device)


def ints(values: Any, device: Any) -> Any:
    """Whole numbers as a Warp array."""
    return wp.array(np.ascontiguousarray(values, np.int32), dtype=wp.int32, device=str(device))


class Recorded:
    """A recorded launch, to be repeated on whatever its arrays hold by then.

    On a CPU Warp packs all arguments anew for each launch, which takes longer than many a kernel. Here they are packed
    once, as Warp's releases from 1.15 to 1.19 do it; with any other release, Warp launches.
    """

    def __init__(self, kernel: Any, dim: int | Sequence[int], inputs: Sequence[Any], device: Any) -> None:
        self._command = command = wp.launch(kernel, dim, inputs, device=str(device), record_cmd=True)
        self.kept: Any = inputs  # the command knows only their addresses
        self._names = [argument.label for argument in kernel.adj.args]
        self._arguments: Any = None
        if not command.device.is_cuda and _packs_once():
            bounds, *values = command.params
            kinds = [(name, type(value)) for name, value in zip(self._names, values, strict=True)]
            self._arguments = type("Arguments", (ctypes.Structure,), {"_fields_": kinds})(*values)
            self._addresses = ctypes.byref(bounds), ctypes.byref(self._arguments)

    def launch(self) -> None:
        """Launches it; on a GPU, on Warp's current stream."""
        if self._arguments is None:
            self._command.launch()
        else:
            self._command.hooks.forward(*self._addresses)

    def argument(self, index: int) -> Any:
        """An array among the arguments, as Warp's C code knows it; what is changed in it holds for the next launch."""
        if self._arguments is None:
            return self._command.params[1 + index]
        return getattr(self._arguments, self._names[index])

    def set_argument(self, index: int, value: int) -> None:
        """Changes a number among the arguments."""
        self._command.set_param_at_index(index, value)
        if self._arguments is not None:
            setattr(self._arguments, self._names[index], self._command.params[1 + index])


def _packs_once() -> bool:
    """Whether this is a release of Warp whose kernels on a CPU take their arguments in one C struct, by address."""
    major, minor = map(int, wp.__version__.split(".")[:2])
    return (1, 15) <= (major, minor) < (1, 20)


class Repeated(threading.local):
    """A kernel that is launched again and again, each time with other arrays of the same shapes.

    Preparing a launch's arguments in Python takes as long as a small launch itself. So they are made once for each
    size, and from then on are only given new addresses. Every thread has its own.
    """

    def __init__(self, kernel: Any, kinds: Sequence[Any], fixed: Sequence[Any] = ()) -> None:
        """The kernel takes the `fixed` arguments, then arrays of the Warp types `kinds`, outputs included."""
        self._kernel, self._kinds, self._fixed = kernel, kinds, fixed
        self._known: dict[Any, tuple[Recorded, list[Any]]] = {}

    def __call__(self, dim: Sequence[int], *tensors: Tensor) -> None:
        """Launches with contiguous tensors of one device, which are kept alive until the next launch of these sizes.

        Does nothing if a size in `dim` is zero.
        """
        if not all(dim):
            return
        device = tensors[0].device
        key = (device, *dim, *map(_shape_and_dtype, tensors))
        command, arrays = self._known.get(key) or self._prepared(key, dim, tensors)
        command.kept = self._fixed, tensors
        for array, tensor in zip(arrays, tensors, strict=True):
            array.data = tensor.data_ptr()
        with torch_stream(device):
            command.launch()

    def _prepared(self, key: Any, dim: Sequence[int], tensors: Sequence[Tensor]) -> tuple[Recorded, list[Any]]:
        """The launch for these sizes, and the arrays among its arguments."""
        if len(self._known) >= _MOST_SIZES:
            self._known.clear()
        given = [
            wp.from_torch(tensor.detach(), dtype=kind, requires_grad=False, return_ctype=True)
            for tensor, kind in zip(tensors, self._kinds, strict=True)
        ]
        command = Recorded(self._kernel, dim, [*self._fixed, *given], tensors[0].device)
        self._known[key] = command, [command.argument(len(self._fixed) + i) for i in range(len(given))]
        return self._known[key]


_shape_and_dtype = operator.attrgetter("shape", "dtype")


@functools.cache
def strips(n: int, device: torch.device, *, at_least: int = 1) -> tuple[int, Tensor]:
    """How many strips a kernel's n items are cut into, and how many items each strip has, int32, shape (1,).

    A thread takes a strip. A CPU's compiler keeps more in registers within a loop than from thread to thread, so a CPU
    gets one strip of all items. On a GPU each strip has `at_least` items; the last one may be shorter.
    """
    n_strips, each = (1, max(n, 1)) if device.type == "cpu" else (-(-n // at_least), at_least)
    with torch.inference_mode(False):
        return n_strips, torch.tensor([each], dtype=torch.int32, device=device)


IN_ROW = 32
"""Items that a GPU's thread adds up by itself before all threads add to one number, one after another."""
_MOST_SIZES = 64
"""How many sizes of a kernel's arguments are remembered."""


def is_plain(*tensors: Tensor) -> bool:
    """Whether a kernel may compute with the tensors: float32, no derivative is wanted, and torch compiles nothing."""
    tracks = torch.is_grad_enabled()
    return not torch.compiler.is_compiling() and all(
        t.dtype == torch.float32 and not (tracks and t.requires_grad) for t in tensors
    )


def torch_stream(device: torch.device) -> contextlib.AbstractContextManager[Any]:
    """Queues Warp's work on torch's current CUDA stream, so that the two keep their order; nothing to do on a CPU."""
    if device == _CPU or device.type != "cuda":  # to ask for its type takes ten times as long
        return _NO_STREAM
    stream = _same_stream(torch.cuda.current_stream(device))
    # While torch captures a graph, work on another stream can't be waited for.
    scope: contextlib.AbstractContextManager[Any] = wp.ScopedStream(
        stream, sync_enter=not torch.cuda.is_current_stream_capturing()
    )
    return scope


_CPU = torch.device("cpu")
_NO_STREAM = contextlib.nullcontext()


@functools.cache
def _same_stream(stream: torch.cuda.Stream) -> Any:
    """Warp's object for one of torch's few streams, kept: once the first such object goes, Warp forgets the stream."""
    return wp.stream_from_torch(stream)


def side_by_side(works: Sequence[Callable[[], Result]], device: torch.device) -> list[Result]:
    """Runs works in order; on a GPU, each on its own stream, as the small launches of one leave most of it idle."""
    if device.type != "cuda" or len(works) < 2:
        return [work() for work in works]
    here = torch.cuda.current_stream(device)
    streams, done = _beside(here, len(works)), []
    for stream, work in zip(streams, works, strict=True):
        stream.wait_stream(here)
        with torch.cuda.stream(stream), torch_stream(device):
            done.append(work())
    for stream in streams:
        here.wait_stream(stream)
    return done


@functools.cache
def _beside(stream: torch.cuda.Stream, n: int) -> list[torch.cuda.Stream]:
    """Streams for works that run side by side, kept for later calls."""
    return [torch.cuda.Stream(stream.device) for _ in range(n)]


@contextlib.contextmanager
def joined_capture(device: torch.device) -> Iterator[Any]:
    """Tells Warp that torch is capturing a CUDA graph; what this yields must live as long as the graph does."""
    with torch_stream(device), wp.ScopedCapture(external=True, force_module_load=False) as capture:
        yield capture
