"""The node's recordings: one at a time; those before it close their files in their own time."""

from __future__ import annotations

import time
from typing import Any

from msg_adapters import QosProfile
from msg_adapters.bags import Recorder, RecorderState
from refu_core import RefuError
from refu_core.errors import printable


class Recording:
    """All of it belongs to the executor's thread, but for `put` and `running`; `logger` is the node's."""

    def __init__(self, logger: Any, *, sync_period: float) -> None:
        self._logger = logger
        self._sync_period = sync_period
        self._recorder: Recorder | None = None
        self._closing: list[Recorder] = []
        self._error = ""

    @property
    def running(self) -> bool:
        """Whether messages go in."""
        recorder = self._recorder
        return recorder is not None and recorder.running

    def start(self, path: str) -> None:
        """Records to a new bag, which is opened before the running one is ended; to none where `path` is empty.

        Raises `BagError` for a path that can't be recorded to: then nothing has changed.
        """
        recorder = Recorder(path, sync_period=self._sync_period) if path else None
        self._stop()
        if recorder is not None:
            self._recorder = recorder
            self._logger.info(printable(f"recording to {recorder.path}"))

    def try_start(self, path: str) -> None:
        """As `start`, but what is wrong with the path is told by `state` from then on."""
        try:
            self.start(path)
        except RefuError as error:
            self._error = printable(error)

    def switch(self, path: str, *, on: bool, refusal: str) -> tuple[bool, str, str]:
        """Answers a service: whether it has been done, what has been done or stands in the way, and the bag."""
        recorder = self._recorder
        if not on:
            self._stop()
            return _no("nothing is recorded") if recorder is None else _done("{} is being closed", recorder)
        if refusal:
            return _no(refusal)
        if recorder is not None and recorder.running:
            return _no(f"already recording to {recorder.path}")
        if not path:
            return _no("no directory: set the parameter record to one, which also starts the recording")
        try:
            self.start(path)
        except RefuError as error:
            return _no(error)
        assert self._recorder is not None
        return _done("recording to {}", self._recorder)

    def put(self, topic: str, message_type: str, data: bytes, qos: QosProfile) -> None:
        """Queues a message that was sent or received now."""
        recorder = self._recorder
        if recorder is not None:
            recorder.put(topic, message_type, data, time_ns=time.time_ns(), qos=qos)

    def state(self) -> tuple[RecorderState | None, str]:
        """How it goes, and why it doesn't though it was asked for."""
        if self._recorder is None:
            return None, self._error
        state = self._recorder.state()
        return state, printable(state.error)

    def tell_closed(self) -> None:
        """Logs the recordings whose files have been closed since the last call; `state` tells what went wrong then."""
        for recorder in [recorder for recorder in self._closing if recorder.finished]:
            self._closing.remove(recorder)
            state = recorder.state()
            if state.error:
                self._error = printable(state.error)
                self._logger.error(printable(f"recorded up to {state.written} messages, then: {state.error}"))
            else:
                self._logger.info(printable(f"recorded {state.written} messages to {state.path}"))

    def close(self) -> None:
        """Waits until everything is in the files."""
        self._stop()
        for recorder in self._closing:
            recorder.close()
        self.tell_closed()

    def _stop(self) -> None:
        recorder, self._recorder, self._error = self._recorder, None, ""
        if recorder is not None:
            recorder.stop()
            self._closing.append(recorder)


def _done(text: str, recorder: Recorder) -> tuple[bool, str, str]:
    return True, printable(text.format(recorder.path)), str(recorder.path)


def _no(reason: object) -> tuple[bool, str, str]:
    return False, printable(reason), ""
