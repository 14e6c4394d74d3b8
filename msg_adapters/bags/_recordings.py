"""Recordings, one at a time: the next is opened before the last is stopped, which closes its file in its own time."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from msg_adapters.bags._metadata import QosProfile
from msg_adapters.bags._recorder import Recorder, RecorderState
from msg_adapters.errors import BagError
from refu_core.errors import printable


class RunningRecording:
    """The current recording, if any. Other threads may only use `put` and `running`; `logger` is told the outcome."""

    def __init__(self, logger: Any, *, sync_period: float) -> None:
        self._logger = logger
        self._sync_period = sync_period
        self._recorder: Recorder | None = None
        self._closing: list[Recorder] = []
        self._error = ""

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
        self.stop()
        self._recorder, self._error = recorder, ""
        self._logger.info(printable(f"recording to {recorder.path}"))
        return recorder.path

    def try_start(self, path: str) -> None:
        """Like `start`, but if something is wrong with the path, `state` says so from then on."""
        try:
            self.start(path)
        except BagError as error:
            self._error = printable(error)

    def switch(self, path: str, *, on: bool) -> tuple[str, str]:
        """Starts or stops on request; returns what has been done, and the bag. Raises `BagError` where it can't."""
        refusal, recorder = "", self._recorder
        if not on and recorder is None:
            refusal = "nothing is recorded"
        elif on and recorder is not None and recorder.running:
            refusal = f"already recording to {recorder.path}"
        elif on and not path:
            refusal = "no directory: set the parameter record to one, which also starts the recording"
        if refusal:
            raise BagError(refusal)
        bag = self.start(path) if on else self.end()
        return printable(f"recording to {bag}" if on else f"{bag} is being closed"), str(bag)

    def stop(self) -> Path | None:
        """Ends the recording; returns the bag that is being closed, if there is one."""
        recorder, self._recorder, self._error = self._recorder, None, ""
        if recorder is None:
            return None
        recorder.stop()
        if error := recorder.state().error:  # an error that has ended it already
            self._error = printable(error)
        self._closing = [*(one for one in self._closing if not one.finished), recorder]
        return recorder.path

    def end(self) -> Path | None:
        """Like `stop`, on request: nobody needs to hear of an error in a recording that isn't wanted any more."""
        bag, self._error = self.stop(), ""
        return bag

    def put(self, topic: str, message_type: str, data: bytes, qos: QosProfile) -> None:
        """Queues a message that was sent or received now."""
        if (recorder := self._recorder) is not None:
            recorder.put(topic, message_type, data, time_ns=time.time_ns(), qos=qos)

    def state(self) -> tuple[RecorderState | None, str]:
        """The recording's state (None: nothing is recorded), and why it failed, or empty."""
        state = None if self._recorder is None else self._recorder.state()
        return state, self._error if state is None else printable(state.error)

    def close(self) -> None:
        """Waits until everything is in the files."""
        self.stop()
        for recorder in self._closing:
            recorder.close()

    def _ended(self, state: RecorderState) -> None:
        if state.error:
            self._error = printable(state.error)
            self._logger.error(printable(f"recorded up to {state.written} messages, then: {state.error}"))
        else:
            self._logger.info(printable(f"recorded {state.written} messages to {state.path}"))
