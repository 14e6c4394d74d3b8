"""A function of tensors on a GPU: captured once as a CUDA graph, then replayed with other contents."""

from __future__ import annotations

import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refu_core._warp import joined_capture

MOST_GRAPHS = 8
"""How many graphs are kept; mostly they differ in the number of persons."""
_WARM_UPS = 2
"""Runs before a capture: they load kernels and give libraries their memory, which a graph can't do."""


class CudaCapture:
    """A `torch.cuda.CUDAGraph`, with the launches of Warp's kernels in it; it leaves its result in `output`."""

    def __init__(self, run: Callable[[], Tensor], device: torch.device) -> None:
        """Calls `run` a few times, then captures it. Raises `RuntimeError` if it can't be captured."""
        here, stream = torch.cuda.current_stream(device), torch.cuda.Stream(device)
        stream.wait_stream(here)
        with torch.cuda.stream(stream):
            for _ in range(_WARM_UPS):
                run()
        here.wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        # Other threads may use the device meanwhile.
        capturing = torch.cuda.graph(self._graph, stream=stream, capture_error_mode="thread_local")
        with capturing, joined_capture(device) as self._kept:
            self.output = run()

    def replay(self) -> None:
        """Runs the graph on the current stream."""
        self._graph.replay()


class StepGraphs:
    """Replays `step`, a function of tensors and of some numbers, and brings its result to the host in one copy.

    The numbers become part of a graph; the tensors' contents don't: they are copied to where the graph reads them,
    unless the tensors are those of the last call. So there is a graph for each number of persons, but not for each
    (β, γ).
    """

    def __init__(
        self,
        step: Callable[[Mapping[str, Tensor], tuple[float, ...]], Tensor],
        device: torch.device,
        *,
        capture: Callable[[Callable[[], Tensor], torch.device], Any] = CudaCapture,
        most: int = MOST_GRAPHS,
    ) -> None:
        """For a step that never waits for the device and returns float32; the `most` graphs used last are kept."""
        self._step, self._device, self._capture, self._most = step, device, capture, most
        self._graphs: OrderedDict[Hashable, _Graph] = OrderedDict()
        self._has_failed = False

    @torch.no_grad()
    def __call__(self, inputs: Mapping[str, Tensor], numbers: tuple[float, ...]) -> NDArray[np.float32]:
        """The step's result, in memory of its own. If a capture fails, calls go launch by launch from then on."""
        if not self._has_failed:
            key = (numbers, tuple(tensor.shape for tensor in inputs.values()))
            try:
                graph = self._graphs.pop(key, None) or self._captured(inputs, numbers)
            except RuntimeError as error:
                self._has_failed = True
                self._graphs.clear()
                msg = f"no CUDA graph could be captured, so every frame is launched anew and takes longer: {error}"
                warnings.warn(msg, RuntimeWarning, stacklevel=2)
            else:
                self._graphs[key] = graph  # the last one used
                return graph(inputs)
        moved = {name: tensor.to(self._device) for name, tensor in inputs.items()}
        result: NDArray[np.float32] = self._step(moved, numbers).cpu().numpy()
        return result

    def _captured(self, inputs: Mapping[str, Tensor], numbers: tuple[float, ...]) -> _Graph:
        while len(self._graphs) >= self._most:
            self._graphs.popitem(last=False)
        held = {name: tensor.to(self._device, copy=True) for name, tensor in inputs.items()}
        return _Graph(held, self._capture(lambda: self._step(held, numbers), self._device))


class _Graph:
    """A captured step, the tensors that it reads, and the memory on the host that its result goes to."""

    def __init__(self, held: Mapping[str, Tensor], captured: Any) -> None:
        self._held, self._captured = held, captured
        self._given: dict[str, Tensor] = {}
        output = captured.output
        self._host = torch.empty(output.shape, dtype=output.dtype, pin_memory=output.is_cuda)

    def __call__(self, inputs: Mapping[str, Tensor]) -> NDArray[np.float32]:
        for name, tensor in inputs.items():
            if self._given.get(name) is not tensor:
                self._held[name].copy_(tensor, non_blocking=True)
        self._given = dict(inputs)
        self._captured.replay()
        self._host.copy_(self._captured.output, non_blocking=True)
        if self._captured.output.is_cuda:
            torch.cuda.current_stream(self._captured.output.device).record_event().synchronize()
        result: NDArray[np.float32] = self._host.numpy().copy()
        return result
