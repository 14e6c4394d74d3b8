"""A bag, dressed by `refu replay` in a process of its own: it may take what it takes, and can be ended at any time."""

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
from pathlib import Path
from typing import Any

from refu_core import RefuError
from refu_core.errors import printable
from refu_core.modes import BetasSource
from refu_ros._dresser import NICE
from refu_ros._settings import PIPELINE_SETTINGS, NodeSettings

_PATIENCE_S = 10.0
"""Time for a bag to be closed when its replay is ended [s]."""
_INTERRUPTED = 130


class BagJob:
    """`wait` for it in a thread; `cancel` from any. Raises `RefuError` where the process can't be started."""

    def __init__(self, bag: Path, output: Path, settings: NodeSettings) -> None:
        self.output = output
        self._folder = tempfile.TemporaryDirectory(prefix="refu-replay-")
        self._result, errors = (Path(self._folder.name, name) for name in ("result.json", "errors.txt"))
        self._errors = errors
        command = [sys.executable, "-m", "refu_lab.cli", "replay", str(bag), f"--output={output}", "--progress=lines"]
        command += [f"--json={self._result}", *_options(settings)]
        try:
            with errors.open("wb") as file:
                self._process = subprocess.Popen(
                    command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=file, start_new_session=True
                )
            os.setpriority(os.PRIO_PROCESS, self._process.pid, NICE)
        except ProcessLookupError:  # it has ended already: `wait` says why
            pass
        except OSError as error:
            msg = f"no bag can be replayed: {error}"
            raise RefuError(msg) from error

    def wait(self, told: Callable[[int, int], object]) -> dict[str, Any]:
        """The result of `refu replay --json`; meanwhile `told` how many frames are done, and of how many.

        Raises `RefuError` for a bag that can't be replayed, with the reason that the command gives.
        """
        assert self._process.stdout is not None
        with self._folder, self._process.stdout as lines:
            for line in lines:
                if line.startswith(b"progress "):
                    told(*map(int, line.split()[1:]))
            code = self._process.wait()
            with contextlib.suppress(OSError, ValueError):
                result: dict[str, Any] = json.loads(self._result.read_bytes())
                return result
            with self._errors.open("rb") as file:
                file.seek(max(0, self._errors.stat().st_size - 4096))
                said = file.read().decode(errors="replace").strip().splitlines() or [f"it ended with {code}"]
        reason = "cancelled before a frame was done" if code in (_INTERRUPTED, -signal.SIGTERM) else said[-1]
        raise RefuError(printable(reason.removeprefix("refu: ").removeprefix("error: ")))

    def cancel(self) -> None:
        """Ends it; the bag is closed, with the frames that are done."""
        self._process.terminate()
        last = threading.Timer(_PATIENCE_S, self._process.kill)
        last.daemon = True
        last.start()


def _options(settings: NodeSettings) -> list[str]:
    """The node's settings as the command has them."""
    names = [name for name in PIPELINE_SETTINGS if name not in ("garments", "collider", "threads")]
    given: dict[str, Any] = {name.replace("_", "-"): getattr(settings, name) for name in (*names, "margin", "frame_id")}
    given["garments"] = ",".join(settings.garments)
    given["style"] = ",".join(map(str, settings.style)) if any(settings.style) else ""
    if settings.betas_source == BetasSource.FIXED:
        given["betas"] = ",".join(map(str, settings.betas))
    else:
        given["betas-source"] = settings.betas_source
    options = [f"--{name}={value}" for name, value in given.items() if value != ""]
    return [*options, *([] if settings.collider else ["--no-collider"])]
