"""Recordings, one at a time: the next one is open before the last is ended, which closes its file in its own time."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from msg_adapters.bags._metadata import QosProfile
from msg_adapters.bags._recorder import Recorder, RecorderState
from msg_adapters.errors import BagError
from refu_core.errors import printable


class RunningRecording:
    """All of it belongs to one thread, but for `put` and `running`; `logger` is told what has been recorded."""

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

    def start(self, path: str) -> Path:
        """Records to a new bag, whose path may be another than asked for.

        Raises `BagError` for a path that can't be recorded to: then nothing has changed.
        """
        recorder = Recorder(path, sync_period=self._sync_period, ended=self._ended)
        self.stop()
        self._recorder, self._error = recorder, ""
        self._logger.info(printable(f"recording to {recorder.path}"))
        return recorder.path

    def try_start(self, path: str) -> None:
        """As `start`, but what is wrong with the path is told by `state` from then on."""
        try:
            self.start(path)
        except BagError as error:
            self._error = printable(error)

    def switch(self, path: str, *, on: bool) -> tuple[str, str]:
        """Starts or stops on somebody's request: what has been done, and the bag. Raises `BagError` where it can't."""
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
        """Ends the recording; the bag that is being closed, if there is one."""
        recorder, self._recorder, self._error = self._recorder, None, ""
        if recorder is None:
            return None
        recorder.stop()
        if error := recorder.state().error:  # that it has ended with already
            self._error = printable(error)
        self._closing = [*(one for one in self._closing if not one.finished), recorder]
        return recorder.path

    def end(self) -> Path | None:
        """As `stop`, on somebody's request: a recording that isn't wanted any more isn't missed."""
        bag, self._error = self.stop(), ""
        return bag

    def put(self, topic: str, message_type: str, data: bytes, qos: QosProfile) -> None:
        """Queues a message that was sent or received now."""
        if (recorder := self._recorder) is not None:
            recorder.put(topic, message_type, data, time_ns=time.time_ns(), qos=qos)

    def state(self) -> tuple[RecorderState | None, str]:
        """How it goes, and why it doesn't though it was asked for."""
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
