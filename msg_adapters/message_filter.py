"""Frames that wait for their transform, as messages do in tf2's MessageFilter."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

from msg_adapters.errors import TransformError
from msg_adapters.scene import MOST_WAITING
from msg_adapters.statistics import Statistics
from msg_adapters.transforms import Placement, TransformBuffer
from refu_core import SmplFrame
from refu_core.keypoints import MOST_PEOPLE

_MOST_HELD = 32
"""Frames of a person that may wait: a second of them at 30 Hz. Of more, the oldest are given up."""


@dataclass(frozen=True, eq=False)
class Held:
    """A person's frame, and the coordinate frame that it was sent in."""

    person: str
    frame: SmplFrame
    frame_id: str
    received_ns: int
    """By the node's clock [ns]."""


class MessageFilter:
    """Holds each person's frames until their transform has come, or for as long as the tolerance. Not thread-safe.

    Of a person's frames whose wait ends at once, the newest count, as many as the scene has room for. The others are
    counted as `superseded`; those that came before any transform could, as `first_transforms`.
    """

    def __init__(self, statistics: Statistics, *, most: int = MOST_PEOPLE) -> None:
        self._statistics, self._most = statistics, most
        self._held: dict[str, deque[Held]] = {}

    def __len__(self) -> int:
        """How many people have frames here that wait."""
        return len(self._held)

    def put(self, one: Held) -> None:
        """Takes a frame, which `ready` gives back: the next time, if its transform has come already."""
        if one.person not in self._held and len(self) >= self._most:
            self._statistics.drop("crowd", f"{self._most} people wait for their transforms")
            return
        self._held.setdefault(one.person, deque()).append(one)

    def ready(
        self, buffer: TransformBuffer, target: str, now_ns: int, tolerance_ns: int
    ) -> Iterator[tuple[Held, Placement]]:
        """The frames that wait no longer, each person's in the order in which they came, with their placements.

        One that has waited in vain is placed by a transform that is no older than the tolerance, or else dropped.
        """
        for one in self._take(buffer, target, now_ns, tolerance_ns):
            try:
                placement = buffer.lookup(target, one.frame_id, one.frame.stamp_ns, tolerance_ns=tolerance_ns)
            except TransformError as error:
                if buffer.is_new:
                    self._statistics.count("skip.first_transforms")
                else:
                    self._statistics.drop("transform", f"{one.person}: {error}" if one.person else str(error))
                continue
            if placement.is_late:
                self._statistics.count("late_transform")
            yield one, placement

    def _take(self, buffer: TransformBuffer, target: str, now_ns: int, tolerance_ns: int) -> list[Held]:
        known = dict.fromkeys((one.frame_id for row in self._held.values() for one in row), -1)
        for frame_id in known:
            with suppress(TransformError):
                known[frame_id] = buffer.known_until(target, frame_id)
        found: list[Held] = []
        for person, row in [*self._held.items()]:
            n = len(row) - _MOST_HELD
            for i, one in enumerate(row, 1):
                waited = now_ns - one.received_ns  # less than nothing where the clock was set back
                if one.frame.stamp_ns <= known[one.frame_id] or not 0 <= waited < tolerance_ns:
                    n = max(n, i)
            gone = [row.popleft() for _ in range(n)]
            for _ in gone[:-MOST_WAITING]:
                self._statistics.count("skip.superseded")
            found += gone[-MOST_WAITING:]
            if not row:
                del self._held[person]
        return found
