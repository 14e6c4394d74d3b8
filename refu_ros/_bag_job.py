"""A bag that `refu replay` dresses in a process of its own: it may take its time, and can be ended at any time."""

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
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from msg_adapters import KEYPOINT_TYPES
from refu_core import RefuError
from refu_core.options import PIPELINE_OPTIONS, arguments
from refu_core.recordings import SUFFIXES
from refu_ros._beside import NICE
from refu_ros._settings import NodeSettings

_PATIENCE_S = 10.0
"""Time for a bag to be closed when its replay is ended [s]."""
_INTERRUPTED = 130


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
            os.setpriority(os.PRIO_PROCESS, self._process.pid, NICE)
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
        if code in (_INTERRUPTED, -signal.SIGTERM):
            said = "cancelled before a frame was done"
        raise RefuError((said or f"it ended with {code}").removeprefix("refu: ").removeprefix("error: "))

    def cancel(self) -> None:
        """Ends the process; the bag is closed, with the frames that are done."""
        self._process.terminate()
        last = threading.Timer(_PATIENCE_S, self._process.kill)
        last.daemon = True
        last.start()
