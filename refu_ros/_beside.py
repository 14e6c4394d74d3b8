"""Work beside the stream: loading pipelines, and dressing single frames on request, in threads of their own.

A bag is dressed by `refu replay`, in a process of its own: it may take its time, and can be ended at any time.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters import KEYPOINT_TYPES, check_plausible
from msg_adapters.axes import ros_from_sender, up_of_sender
from refu_core import RefuError, SmplFrame
from refu_core._files import expanded
from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.modes import BUILTIN_GARMENTS
from refu_core.options import PIPELINE_OPTIONS, PipelineOptions, arguments
from refu_core.recordings import SUFFIXES
from refu_ros._settings import NodeSettings

if TYPE_CHECKING:
    from refu_core.outputs import Fittings
    from refu_core.realtime import PipelineOutput

Use = Callable[["Fittings", PipelineOptions], object]
Fail = Callable[[Exception, PipelineOptions], object]
Then = Callable[["PipelineOutput", dict[str, NDArray[np.float64]]], object]

_MOST_GARMENTS = 16
_MOST_WAITING = 8
"""Requests that may wait: anyone who asks faster than frames can be dressed is told so."""
_MOST_PIPELINES = 2
NICE = 10
"""Niceness of work on request above the node's: garments that are due 30 times a second come first."""


def load(options: PipelineOptions, *, threads: int = 1) -> Fittings:
    """Loads a pipeline, which takes some tenths of a second, and computes once all that a subscriber may want.

    Kernels are loaded when they first run; on the stream, frames that came meanwhile would be lost. Raises `RefuError`.
    """
    from refu_core.outputs import DressedPerson, Fittings  # loads torch

    fittings = Fittings(options.load(threads=threads), weights=options.weights or None).prepare()
    frame = SmplFrame(np.zeros((N_JOINTS, 3), np.float32))
    worn = DressedPerson("", frame, fittings.pipeline(frame), fittings, np.eye(3), np.zeros(3))
    for ask in (worn.normals, worn.clearance, worn.sigma, worn.contacts):
        ask()
    return fittings


class PipelineLoader:
    """A thread that loads the pipeline asked for last; earlier requests that it didn't get to are dropped."""

    def __init__(self, use: Use, fail: Fail, *, threads: int) -> None:
        self._use, self._fail, self._threads = use, fail, threads
        self.wanted: PipelineOptions | None = None
        self._pool = ThreadPoolExecutor(1, "loader")

    def request(self, options: PipelineOptions) -> None:
        """Asks for a pipeline; returns at once."""
        self.wanted = options
        self._pool.submit(self._load, options)

    def close(self) -> None:
        """Ends the thread, after the load under way."""
        self.wanted = None
        self._pool.shutdown()

    def _load(self, options: PipelineOptions) -> None:
        if options is not self.wanted:
            return
        try:
            fittings = load(options, threads=self._threads)
            if options is self.wanted:
                self._use(fittings, options)
        except Exception as error:  # missing weights, no CUDA: the running pipeline stays
            self._fail(error, options)


class RequestDresser:
    """Dresses single frames, independently of what comes on the node's topics. `ask` belongs to one thread."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._waiting = threading.BoundedSemaphore(_MOST_WAITING)
        self._load = lru_cache(_MOST_PIPELINES)(load)

    def ask(self, frame: SmplFrame, settings: NodeSettings, then: Then) -> Future[object]:
        """A future of what `then` makes of the output and each garment's vertices in the messages' frame [m], (V, 3).

        Raises `RefuError` where too many wait.
        """
        if not self._waiting.acquire(blocking=False):
            raise RefuError(f"{_MOST_WAITING} requests wait already: ask again when one has been answered")
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, "dresser", initializer=_give_way)
        asked = self._pool.submit(self._dress, self._pool, frame, settings, then)
        asked.add_done_callback(lambda _: self._waiting.release())
        return asked

    def close(self) -> None:
        """Waits for the frame that is being dressed; requests that wait are refused. Further ones may follow."""
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown()
        self._load.cache_clear()

    def _dress(self, pool: ThreadPoolExecutor, frame: SmplFrame, settings: NodeSettings, then: Then) -> object:
        if pool is not self._pool:
            raise RefuError("the node was shut down or failed before this request's turn: ask again when it runs")
        pipeline = self._load(settings.pipeline).pipeline
        up = up_of_sender(settings.axes, settings.frame_id, np.eye(3))
        frame = replace(settings.applied(frame), up=up)
        output = pipeline(frame, margin=settings.margin)
        rotation = ros_from_sender(settings.axes)
        placed = {name: (mesh.local + frame.transl) @ rotation.T for name, mesh in output.items()}
        if not all(np.isfinite(points).all() for points in placed.values()):
            raise RefuError("a garment isn't finite in this pose")
        return then(output, placed)


def _give_way() -> None:
    import torch

    torch.set_num_threads(1)
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), os.nice(0) + NICE)  # to Linux a thread is a process


def asked_frame(request: Any) -> SmplFrame:
    """The frame of a `refu_msgs/srv/Dress` request. Raises `FrameError` for numbers that no body has."""
    betas = np.asarray(request.betas, np.float32)
    stamp = request.header.stamp
    frame = SmplFrame(
        pose=np.asarray(request.pose),
        betas=np.pad(betas, (0, max(0, N_BETAS - len(betas)))),
        transl=np.asarray(request.transl),
        style=np.asarray(request.style) if len(request.style) else None,
        stamp_ns=stamp.sec * 10**9 + stamp.nanosec,
    )
    check_plausible(frame)
    return frame


def asked_settings(request: Any, settings: NodeSettings) -> NodeSettings:
    """The settings with a request's garments and collision mode. Raises `RefuError` if they make no sense.

    Garments are files: a request may name those that ship and those the operator has chosen, but no path.
    """
    names, sdf = tuple(map(expanded, request.garments[:_MOST_GARMENTS])), request.sdf or settings.sdf
    known = list(dict.fromkeys([*settings.garments, *BUILTIN_GARMENTS]))
    if unknown := [name for name in names if name not in known] or request.garments[_MOST_GARMENTS:]:
        raise RefuError(f"garments: wanted up to {_MOST_GARMENTS} of {', '.join(known)}, got {unknown[0]!r}")
    # The style belongs to the garments in the parameters: others may have none.
    style = settings.style if names in ((), settings.garments) else (0.0,) * len(settings.style)
    asked = replace(settings, garments=names or settings.garments, sdf=sdf, style=style)
    asked.check_files()
    return asked


_PATIENCE_S = 10.0
"""Time for a bag to be closed when its replay is ended [s]."""
NOT_BEGUN = "cancelled before a frame was done"


class BagJob:
    """Dresses a bag; a thread calls `told` with the frames done and their total. `cancel` it from any thread.

    Raises `RefuError` where the process can't be started.
    """

    def __init__(
        self, bag: Path, output: Path, settings: NodeSettings, told: Callable[[int, int], object], *, topic: str = ""
    ) -> None:
        self.output = output
        self._folder = tempfile.TemporaryDirectory(prefix="refu-replay-")
        self._result = Path(self._folder.name, "result.json")
        command = [sys.executable, "-m", "refu_lab", "replay", str(bag), f"--output={output}", "--progress=lines"]
        given = ["betas_source", *["betas"] * bool(settings.known_betas), *["style"] * any(settings.style)]
        if bag.suffix.lower() not in SUFFIXES:  # a file of motion says itself how it is to be read
            given += ["input_axes", *["input_type", "keypoints"] * (settings.input_type in KEYPOINT_TYPES)]
        command += [f"--topic={topic}"] * bool(topic)
        command += [f"--json={self._result}", *arguments(settings, *PIPELINE_OPTIONS, "margin", "frame_id", *given)]
        pipes: Any = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        try:
            self._process = subprocess.Popen(command, **pipes, start_new_session=True)
            os.setpriority(os.PRIO_PROCESS, self._process.pid, os.nice(0) + NICE)
        except ProcessLookupError:  # it has ended already: `_wait` says why
            pass
        except OSError as error:
            raise RefuError(f"no bag can be replayed: {error}") from error
        pool = ThreadPoolExecutor(1, "bag")
        self.done = pool.submit(self._wait, told)
        """The result of `refu replay --json`, or a `RefuError` with the reason that the command gives."""
        pool.shutdown(wait=False)

    def _wait(self, told: Callable[[int, int], object]) -> dict[str, Any]:
        assert self._process.stdout is not None
        said = ""
        with self._folder, self._process.stdout as lines:
            for line in lines:
                if line.startswith(b"progress "):
                    told(*map(int, line.split()[1:]))
                else:
                    said = line.decode(errors="replace").strip() or said
            code = self._process.wait()
            with contextlib.suppress(OSError, ValueError):
                result: dict[str, Any] = json.loads(self._result.read_bytes())
                return result
        if code in (128 + signal.SIGINT, -signal.SIGTERM):
            said = NOT_BEGUN
        raise RefuError((said or f"it ended with {code}").removeprefix("refu: ").removeprefix("error: "))

    def cancel(self) -> None:
        """Ends the process; the bag is closed, with the frames that are done."""
        self._process.terminate()
        last = threading.Timer(_PATIENCE_S, self._process.kill)
        last.daemon = True
        last.start()
