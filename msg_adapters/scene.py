"""Who is in the scene and what each person sent last; the meeting point of the executor and the inference thread.

Before, frames wait for their transforms, as messages do in tf2's MessageFilter.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from msg_adapters.errors import TransformError
from msg_adapters.statistics import Statistics
from msg_adapters.transforms import Placement, TransformBuffer
from refu_core.frames import SET_BACK_NS, SmplFrame
from refu_core.keypoints import MOST_PEOPLE

if TYPE_CHECKING:
    from refu_core.outputs import PinholeCamera

MOST_WAITING = 2
"""Waiting frames of a person. With one, 171 of 900 frames at 30 Hz were lost where each takes 30 ms; with two, none."""
_PAUSES = 3
"""Of so many pauses between a person's frames the longest counts: two frames in a burst say nothing about the next."""
_LONGEST_PAUSE = 2.0
"""Pauses of up to so many time-outs are a sender's own: viewers keep a garment for that long, too (`lifetime_ns`)."""
_PATIENCE = 3.0
"""People who send seldom leave after so many of their pauses: at 1 Hz, 20 ms of jitter removed them 8 times in 20 s."""

_MOST_HELD = 32
"""Frames of a person that may wait: a second of them at 30 Hz. Of more, the oldest are given up."""


@dataclass(frozen=True, eq=False)
class Arrival:
    """A frame and when it came."""

    frame: SmplFrame
    received: float
    """On the scene's clock [s]."""
    placement: Placement
    """From the sender's frame to that of the messages."""
    camera: PinholeCamera | None
    """The camera that sees the person, in the frame of the messages."""
    told_in: object
    """The messages' frame and the sender's axes that it was placed by; None: those of now."""


class Scene:
    """The newest frames of each person: the one to work on next, and the one that came meanwhile.

    So a frame that takes a little too long costs no other one, as long as the next ones make up for it. When two are
    waiting and another one comes, only the newest is kept, so that nobody stays behind.

    A frame that comes after a newer one would show its person where they were, and end the motion that cloth swings by.

    Thread-safe. Frames that are left out are counted: as `max_rate` while the rate limit holds them back, as `crowd`
    if there is no room for the person beside `most` others, as `late` after a newer one, otherwise as `stale`.
    """

    def __init__(
        self, statistics: Statistics, *, most: int = MOST_PEOPLE, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._statistics = statistics
        self._most = most
        self._clock = clock
        self._changed = threading.Condition()
        self._pending: dict[str, list[Arrival]] = {}
        self._seen: dict[str, float] = {}
        self._came: dict[str, deque[float]] = {}
        """When the newest frames came of those who are here, or have just left."""
        self._stamps: dict[str, int] = {}
        self._held = False
        self._closed = False

    def put(
        self,
        person: str,
        frame: SmplFrame,
        placement: Placement | None = None,
        camera: PinholeCamera | None = None,
        told_in: object = None,
    ) -> None:
        """Adds a person's frame, with the sender's placement (the messages' own frame if not given) and the camera."""
        now = self._clock()
        with self._changed:
            if person not in self._seen and len(self._seen) >= self._most:
                self._statistics.drop("crowd", f"{self._most} people are here already")
                return
            if (late := self._stamps.get(person, 0) - frame.stamp_ns) > 0:
                self._statistics.count("back_in_time")
                if late < SET_BACK_NS:
                    self._statistics.count("skip.late")
                    return
            waiting = self._pending.setdefault(person, [])
            if self._held or len(waiting) == MOST_WAITING:
                self._keep(0, waiting)
            self._stamps[person] = frame.stamp_ns
            waiting.append(Arrival(frame, now, placement or Placement(), camera, told_in))
            self._seen[person] = now
            self._came.setdefault(person, deque(maxlen=_PAUSES + 1)).append(now)
            self._changed.notify()

    def take(self, *, not_before: float = 0.0, timeout: float = 0.1) -> dict[str, Arrival]:
        """Everybody's next frame, as soon as there is one, but not before `not_before`; empty after `timeout` [s]."""
        deadline = self._clock() + timeout
        with self._changed:
            while not self._closed:
                now = self._clock()
                self._held = now < not_before
                if self._held:
                    for waiting in self._pending.values():
                        self._keep(1, waiting)
                elif self._pending:
                    taken = {person: waiting.pop(0) for person, waiting in self._pending.items()}
                    self._pending = {person: waiting for person, waiting in self._pending.items() if waiting}
                    return taken
                wake = min(deadline, not_before) if self._pending else deadline
                if now >= deadline:
                    break
                self._changed.wait(wake - now)
        return {}

    def _keep(self, newest: int, waiting: list[Arrival]) -> None:
        """Leaves out all but the newest few."""
        while len(waiting) > newest:
            del waiting[0]
            if self._held:
                self._statistics.count("skip.max_rate")
            else:
                self._statistics.drop("stale")

    def leave(self, timeout: float) -> list[str]:
        """Removes those who haven't sent for `timeout` [s], and returns their names.

        People who send seldom get longer: three of their own pauses, as long as these are no longer than two time-outs.
        """
        with self._changed:
            now, longest = self._clock(), _LONGEST_PAUSE * timeout
            self._came = {
                one: came for one, came in self._came.items() if one in self._seen or came[-1] >= now - longest
            }
            gone = []
            for person, seen in self._seen.items():
                pauses = (later - one for one, later in pairwise(self._came[person]))
                own = max((pause for pause in pauses if pause <= longest), default=0.0)
                if seen < now - max(timeout, _PATIENCE * own) and person not in self._pending:
                    gone.append(person)
            for person in gone:
                del self._seen[person], self._stamps[person]
            return gone

    @property
    def persons(self) -> tuple[str, ...]:
        with self._changed:
            return tuple(self._seen)

    def wake(self) -> None:
        """Ends a `take` under way, and all later ones at once."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


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
