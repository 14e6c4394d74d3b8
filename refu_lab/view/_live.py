"""A live film: the newest that a running node publishes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

import numpy as np

import msg_adapters as adapters
from refu_core import RefuError
from refu_lab.view._film import SceneMesh
from refu_lab.view._recorded import MarkerScene

TOPICS = ("garments", "body")
_LOOK_S = 0.2
"""While waiting for the first garments, how often to check whether to end [s]."""
_TOGETHER_S = 2.0
"""How long to wait for the other topics after the first [s]."""


class LiveFilm:
    """Garments and bodies of marker topics; call `wait` before it is shown, and `close` afterwards.

    Raises `RefuError` if rclpy isn't there, and for names that no topic can have.
    """

    def __init__(self, topics: Sequence[str] = TOPICS) -> None:
        from refu_ros.listening import LiveTopics

        self.title = f"live: {', '.join(topics)}"
        self.notes: list[str] = []
        self.front, self.times = 0.0, np.zeros(1)  # the only moment is now
        self.told: Callable[[], object] = lambda: None
        """Called from another thread when there is something new."""
        self._changed = threading.Condition()
        self._scene: MarkerScene[SceneMesh] = MarkerScene(lambda shape: shape)
        self._stamp_ns = self._n_frames = self._n_bad = 0
        self._since: float | None = None
        self._heard = {*topics}
        self._topics = LiveTopics(dict.fromkeys(topics, adapters.MARKER_ARRAY), self._take)

    def wait(self, until: Callable[[], bool]) -> bool:
        """Waits for the first meshes, of all topics if they come soon; returns whether any came before `until` held."""
        with self._changed:
            while not until():
                here, is_late = self._scene.topics, time.monotonic() > (self._since or np.inf) + _TOGETHER_S
                if here and (is_late or here == self._heard):  # the ground is put under all feet
                    break
                self._changed.wait(_LOOK_S)
            return bool(self._scene.topics)

    def shapes(self, index: int) -> Sequence[SceneMesh]:  # noqa: ARG002
        """What each topic published last, without meshes that are gone."""
        with self._changed:
            return self._scene.shown(time.monotonic_ns())

    def facts(self, index: int) -> list[str]:  # noqa: ARG002
        """Stamp, rate and number of the meshes received."""
        with self._changed:
            passed = time.monotonic() - (self._since or time.monotonic())
            rate = f"{self._n_frames / passed:.0f} Hz" if passed > 1 else "…"
            bad = [f"{self._n_bad} messages or meshes can't be drawn"] if self._n_bad else []
            return [
                f"stamp {1e-9 * self._stamp_ns:.2f} s, {rate}",
                f"{len(self._scene.shown(time.monotonic_ns()))} meshes, as published",
                *bad,
            ]

    def close(self) -> None:
        self._topics.close()

    def _take(self, topic: str, data: bytes) -> None:
        with self._changed:
            try:
                stamp_ns, n_odd = self._scene.take(topic, data, time.monotonic_ns())
            except RefuError:
                stamp_ns, n_odd = 0, 1
            self._n_bad += n_odd
            if stamp_ns:
                self._n_frames += stamp_ns != self._stamp_ns
                self._stamp_ns, self._since = stamp_ns, self._since or time.monotonic()
            self._changed.notify_all()
        self.told()
