"""Recording beside the live path: a bounded queue, and a thread that writes a bag."""

from __future__ import annotations

import itertools
import shutil
import threading
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from msg_adapters import BagError, BagWriter, QosProfile

if TYPE_CHECKING:
    from collections.abc import Callable

MAX_QUEUED_BYTES = 64 << 20
_MAX_QUEUED_MESSAGES = 10_000


@dataclass(frozen=True)
class RecorderState:
    """How a recording goes."""

    path: Path
    written: int
    queued: int
    dropped: int
    size_bytes: int
    """Of the file so far."""
    free_bytes: int | None
    """On the disk; None where that can't be known."""
    error: str
    """Why it stopped, or empty."""


@dataclass(frozen=True)
class _Message:
    topic: str
    message_type: str
    qos: QosProfile
    data: bytes
    time_ns: int


def free_path(path: Path) -> Path:
    """`path` where it can take a bag, else the first of `path-1`, `path-2`, … : a recording never replaces another."""
    for candidate in itertools.chain([path], (path.with_name(f"{path.name}-{i}") for i in itertools.count(1))):
        if not candidate.exists() or (candidate.is_dir() and not any(candidate.iterdir())):
            return candidate
    raise AssertionError  # unreachable: the numbers don't end


class Recorder:
    """Writes messages to a rosbag2 bag in a thread of its own. `put` never blocks: where the disk can't follow,
    messages are dropped and counted. A failure (a full disk) ends the recording, not the caller.

    Raises `BagError` when the bag can't be opened.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        max_queued_bytes: int = MAX_QUEUED_BYTES,
        open_bag: Callable[[Path], BagWriter] = BagWriter,
    ) -> None:
        try:
            self.path = free_path(Path(path).expanduser().absolute())
            self._bag = open_bag(self.path)
        except OSError as error:
            msg = f"{path}: can't be recorded to: {error.strerror or error}"
            raise BagError(msg) from error
        self._max_queued_bytes = max_queued_bytes
        self._changed = threading.Condition()
        self._queue: deque[_Message] = deque()
        self._queued_bytes = 0
        self._dropped = 0
        self._written = 0
        self._error = ""
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="recorder")
        self._thread.start()

    def put(self, topic: str, message_type: str, data: bytes, *, time_ns: int, qos: QosProfile) -> None:
        """Queues a message that was sent or received at `time_ns`."""
        with self._changed:
            if self._stopping or self._error:
                return
            full = self._queued_bytes + len(data) > self._max_queued_bytes or len(self._queue) >= _MAX_QUEUED_MESSAGES
            if full:
                self._dropped += 1
                return
            self._queue.append(_Message(topic, message_type, qos, data, time_ns))
            self._queued_bytes += len(data)
            self._changed.notify()

    def stop(self) -> None:
        """Takes no more messages; what is queued is written and the file closed, in the recorder's own time."""
        with self._changed:
            self._stopping = True
            self._changed.notify()

    def close(self) -> None:
        """`stop`, and wait until all is in the file and the file is closed."""
        self.stop()
        self._thread.join()

    @property
    def running(self) -> bool:
        """Whether messages still go in."""
        with self._changed:
            return not (self._stopping or self._error)

    @property
    def finished(self) -> bool:
        """Whether the file is closed."""
        return not self._thread.is_alive()

    def state(self) -> RecorderState:
        """For the diagnostics."""
        try:
            size = self._bag.file_path.stat().st_size
            free: int | None = shutil.disk_usage(self.path).free
        except OSError:
            size, free = 0, None
        with self._changed:
            return RecorderState(self.path, self._written, len(self._queue), self._dropped, size, free, self._error)

    def _run(self) -> None:
        try:
            while (message := self._next()) is not None:
                self._bag.add_topic(message.topic, message.message_type, qos=message.qos)
                self._bag.write(message.topic, message.data, log_time_ns=message.time_ns)
                with self._changed:
                    self._written += 1
            self._bag.finish()
        except (BagError, OSError) as error:
            with self._changed:
                self._error = str(error)
                self._dropped += 1 + len(self._queue)
                self._queue.clear()
                self._queued_bytes = 0

    def _next(self) -> _Message | None:
        with self._changed:
            while not self._queue and not self._stopping:
                self._changed.wait()
            if not self._queue:
                return None
            message = self._queue.popleft()
            self._queued_bytes -= len(message.data)
            return message
