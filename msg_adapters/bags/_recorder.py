"""Recording beside the live path: a bounded queue, and a thread that writes a bag."""

from __future__ import annotations

import atexit
import itertools
import math
import os
import re
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from weakref import WeakSet

from msg_adapters.bags._metadata import METADATA_FILE, QosProfile
from msg_adapters.bags._reader import BAG_SUFFIXES
from msg_adapters.bags._writer import BagWriter
from msg_adapters.errors import BagError
from refu_core.errors import printable

_MAX_QUEUED_MESSAGES = 10_000
_MOST_TOPICS = 10_000
"""In one bag: people's topics come and go, and running out of MCAP's 16-bit numbers would end the recording."""

_PART = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
"""Name of a folder or file: not hidden, not `..`, not an option of a command."""
_MOST_PARTS = 8


@dataclass(frozen=True)
class RecorderState:
    """The state of a recording."""

    path: Path
    written: int
    queued: int
    dropped: int
    size_bytes: int
    free_bytes: int | None
    """Free space on the disk; None where that can't be known."""
    error: str
    """Why the recording stopped, or empty."""
    at_risk_s: float = 0.0
    """Age of the oldest message that a power cut would lose; 0 where the disk is waited for only at the end."""


@dataclass(frozen=True)
class _Message:
    topic: str
    message_type: str
    qos: QosProfile
    data: bytes
    time_ns: int
    since: float
    """When it was put into the queue, on the monotonic clock."""


_SYNC = _Message("", "", QosProfile(), b"", 0, 0.0)
"""Stands for the moment at which what was written has to be synced to the disk."""


def free_path(path: Path) -> Path:
    """`path` if it is free, else the first free one of `path-1`, `path-2`, … : a recording never replaces another.

    If `path` is a folder with other things than a bag's files, `path/garments` is used instead.

    Raises `BagError` if something that isn't a bag is in the way, or if the name has unprintable characters.
    """
    if not str(path).isprintable():
        raise BagError(f"{path}: wanted a name of printable characters")
    if path.name and path.is_dir() and any(path.iterdir()) and not any(map(_is_of_bag, path.iterdir())):
        path /= "garments"
    names = (f"{path.stem}-{i}{path.suffix}" for i in itertools.count(1))
    for candidate in itertools.chain([path], map(path.with_name, names) if path.name else ()):
        if not candidate.exists() or (candidate.is_dir() and not any(candidate.iterdir())):
            return candidate
        if not (candidate.is_dir() or (path.suffix == ".mcap" and candidate.is_file())):
            break
    raise BagError(f"{path}: {candidate} isn't a bag; wanted a directory, or a .mcap file, that is new")


def _is_of_bag(file: Path) -> bool:
    return file.is_file() and (file.name == METADATA_FILE or file.suffix in BAG_SUFFIXES)


def path_in(folder: str, name: str) -> Path:
    """The path of that name below the folder in the node's parameter `bags`; the name may be anybody's.

    Raises `BagError` for any other path, links out of the folder included, and where there is no folder.
    """
    if not folder:
        raise BagError("a request may name no file: start the node with the parameter bags, a folder for them")
    parts, top = name.split("/"), Path(os.path.realpath(folder))  # Path.resolve raises for links that go in a circle
    if len(parts) <= _MOST_PARTS and all(map(_PART.fullmatch, parts)):
        path = Path(os.path.realpath(top / name))
        if top in path.parents and not path.is_symlink():
            return path
    raise BagError(f"wanted a path below the parameter bags, as today/walk.mcap, got {name!r}")


def _opened(path: Path, open_bag: Callable[[Path], BagWriter]) -> tuple[Path, BagWriter]:
    """Open a bag at `path` or the next free one; tries again if somebody else takes it in the meantime."""
    while True:
        free = free_path(path)
        try:
            return free, open_bag(free)
        except BagError:
            if free_path(path) == free:
                raise


class Recorder:
    """Writes messages to a rosbag2 bag in a thread of its own.

    `put` never blocks: where the disk can't keep up, messages are dropped and counted. A failure (a full disk) ends the
    recording, not the caller.

    A power cut loses at most the last `sync_period` seconds of messages, as long as the disk completes a sync within
    half of that; `RecorderState.at_risk_s` says whether it does. At 0 the disk is waited for only when the recording
    ends.

    The bag is open when the constructor returns. So start a new recording before you stop the old one: if that fails,
    the old one isn't affected.

    Raises `BagError` when the bag can't be opened, whatever `path` is.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        sync_period: float = 1.0,
        max_queued_bytes: int = 64 << 20,
        open_bag: Callable[[Path], BagWriter] = BagWriter,
        ended: Callable[[RecorderState], object] = lambda _: None,
    ) -> None:
        """`ended` is called by the recorder's thread when the file is closed, or can't be written any more."""
        try:
            self.path, self._bag = _opened(Path(path).expanduser().absolute(), open_bag)
        except BagError:
            raise
        except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: an unknown ~user
            raise BagError(f"{path}: can't be recorded to: {getattr(error, 'strerror', None) or error}") from error
        self._sync_after = 0.5 * sync_period if sync_period else math.inf
        self._max_queued_bytes = max_queued_bytes
        self._changed = threading.Condition()
        self._queue: deque[_Message] = deque()
        self._queued_bytes = 0
        self._dropped = 0
        self._written = 0
        self._unsynced: float | None = None
        """When the oldest message came that is written but not known to be on the disk; None if there is none."""
        self._synced = -math.inf
        """When the last sync began. It spaces syncs out: in a backlog every message has waited long enough for one."""
        self._space: tuple[int, int | None] = 0, None
        """Size of the file, and of what is free beside it. Only the recorder's thread asks the disk: it may stall."""
        self._error = ""
        self._stopping = False
        self._ended = ended
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        _RECORDERS.add(self)
        self._thread.start()

    def put(self, topic: str, message_type: str, data: bytes, *, time_ns: int, qos: QosProfile) -> None:
        """Queues a message that was sent or received at `time_ns`."""
        with self._changed:
            if self._stopping or self._error:
                return
            if self._queued_bytes + len(data) > self._max_queued_bytes or len(self._queue) >= _MAX_QUEUED_MESSAGES:
                self._dropped += 1
                return
            self._queue.append(_Message(topic, message_type, qos, data, time_ns, time.monotonic()))
            self._queued_bytes += len(data)
            self._changed.notify()

    def stop(self) -> None:
        """Accepts no more messages; the recorder's thread writes what is queued and closes the file in its own time."""
        with self._changed:
            self._stopping = True
            self._changed.notify()

    def close(self) -> None:
        """`stop`, and wait until everything is in the file and the file is closed."""
        self.stop()
        self._thread.join()

    @property
    def running(self) -> bool:
        """Whether messages are still accepted."""
        with self._changed:
            return not (self._stopping or self._error)

    @property
    def finished(self) -> bool:
        """Whether the file is closed, and `ended` has been called."""
        return not self._thread.is_alive()

    def state(self) -> RecorderState:
        """The recording's state, for the diagnostics; without waiting for the disk."""
        with self._changed:
            now, oldest, (size, free) = time.monotonic(), self._unsynced, self._space
            if oldest is None:
                oldest = self._queue[0].since if self._queue else now
            return RecorderState(
                path=self.path,
                written=self._written,
                queued=len(self._queue),
                dropped=self._dropped,
                size_bytes=size,
                free_bytes=free,
                at_risk_s=now - oldest if self._sync_after < math.inf else 0.0,
                error=self._error,
            )

    def _measure(self) -> None:
        try:
            self._space = self._bag.file_path.stat().st_size, shutil.disk_usage(self.path).free
        except OSError:
            self._space = 0, None

    def _run(self) -> None:
        message: _Message | None = None
        try:
            with self._bag:
                while (message := self._next()) is not None:
                    self._measure()
                    if message is _SYNC:
                        self._bag.sync()
                        self._unsynced = None
                    elif message.topic not in (topics := self._bag.topics) and len(topics) >= _MOST_TOPICS:
                        self._dropped += 1
                    else:
                        self._bag.add_topic(message.topic, message.message_type, qos=message.qos)
                        self._bag.write(message.topic, message.data, log_time_ns=message.time_ns)
                        self._written += 1
            self._unsynced = None
        except Exception as error:  # whatever it is, it ends only the recording
            with self._changed:
                self._error = printable(error) or type(error).__name__
                kept = self._bag.n_whole
                self._dropped += self._written - kept + (message not in (None, _SYNC)) + len(self._queue)
                self._written = kept
                self._queue.clear()
        self._measure()
        self._ended(self.state())

    def _next(self) -> _Message | None:
        """The next message, `_SYNC` when a written one has waited for the disk long enough, or None at the end."""
        with self._changed:
            while True:
                now = time.monotonic()
                since = math.inf if self._unsynced is None else max(self._unsynced, self._synced)
                left = since + self._sync_after - now
                if left <= 0:
                    self._synced = now
                    return _SYNC
                if self._queue:
                    message = self._queue.popleft()
                    self._unsynced = message.since if self._unsynced is None else self._unsynced
                    self._queued_bytes -= len(message.data)
                    return message
                if self._stopping:
                    return None
                self._changed.wait(left if left < math.inf else None)


_RECORDERS = WeakSet[Recorder]()


@atexit.register
def _close_all() -> None:
    """A program that ends without `close`, at an error for instance, has whole bags; else it would never end."""
    for one in [*_RECORDERS]:
        if not one.finished:  # as they are after a fork
            one.close()


class RunningRecording:
    """The current recording, if any; `logger` is told the outcome. Other threads may only use `put` and `running`.

    The next one is opened before the last is stopped, which closes its file in its own time.
    """

    def __init__(self, logger: Any, *, sync_period: float) -> None:
        self._logger = logger
        self._sync_period = sync_period
        self._recorder: Recorder | None = None
        self._closing: list[Recorder] = []
        self._error = ""
        self.asked = ""
        """The path that was asked for last; the bag's may be another, which was free."""

    @property
    def running(self) -> bool:
        """Whether messages are recorded."""
        recorder = self._recorder
        return recorder is not None and recorder.running

    def start(self, path: str) -> Path:
        """Starts recording to a new bag; returns its path, which may differ from the one asked for.

        Raises `BagError` for a path that can't be recorded to; nothing has changed then.
        """
        recorder = Recorder(path, sync_period=self._sync_period, ended=self._ended)
        self.end()
        self._recorder, self.asked = recorder, path
        self._logger.info(printable(f"recording to {recorder.path}"))
        return recorder.path

    def try_start(self, path: str) -> None:
        """Like `start`, but if something is wrong with the path, `state` says so from then on."""
        try:
            self.start(path)
        except BagError as error:
            self._error = str(error)

    def switch(self, path: str, *, on: bool) -> tuple[str, str]:
        """Starts or stops on request; returns what has been done, and the bag. Raises `BagError` where it can't."""
        recorder = self._recorder
        if not on:
            if recorder is None:
                raise BagError("nothing is recorded")
            self.end()
            return printable(f"{recorder.path} is being closed"), str(recorder.path)
        if recorder is not None and recorder.running:
            raise BagError(f"already recording to {recorder.path}")
        if not path:
            raise BagError("no directory: set the parameter record to one, which also starts the recording")
        bag = self.start(path)
        return printable(f"recording to {bag}"), str(bag)

    def end(self) -> None:
        """Ends the recording; nobody needs to hear any more of an error in it."""
        recorder, self._recorder, self._error = self._recorder, None, ""
        if recorder is not None:
            recorder.stop()
            self._closing = [*(one for one in self._closing if not one.finished), recorder]

    def put(self, topic: str, message_type: str, data: bytes, qos: QosProfile) -> None:
        """Queues a message that was sent or received now."""
        if (recorder := self._recorder) is not None:
            recorder.put(topic, message_type, data, time_ns=time.time_ns(), qos=qos)

    def state(self) -> tuple[RecorderState | None, str]:
        """The recording's state (None: nothing is recorded), and why it failed, or empty."""
        state = None if self._recorder is None else self._recorder.state()
        return state, self._error if state is None else state.error

    def close(self) -> None:
        """Ends the recording, and waits until everything is in the files; why it failed stays told."""
        last = self._recorder
        self.end()
        for recorder in self._closing:
            recorder.close()
        if last is not None:
            self._error = last.state().error or self._error

    def _ended(self, state: RecorderState) -> None:
        if state.error:
            self._error = state.error
            self._logger.error(printable(f"recorded up to {state.written} messages, then: {state.error}"))
        else:
            self._logger.info(printable(f"recorded {state.written} messages to {state.path}"))
