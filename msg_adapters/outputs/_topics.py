"""How topics come of dressed people: one of all, or one of each, made only where somebody wants it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

if TYPE_CHECKING:
    from refu_core.outputs import Dressed, Fittings

_MAX_LAYOUTS = 16
"""Sets of persons whose message layout is kept; making one takes a millisecond."""
Messages = Iterator[tuple[str, bytes]]
"""Topics, and what is to be sent there."""


class Wishes(Protocol):
    """How everything is to be sent."""

    @property
    def frame_id(self) -> str:
        """Of every header."""

    @property
    def lifetime_ns(self) -> int:
        """Viewers forget what isn't renewed for so long [ns]; 0: never."""

    @property
    def points_fields(self) -> Sequence[str]:
        """What points have besides their place, of `POINT_FIELDS`."""

    @property
    def planner_rate(self) -> float:
        """Meshes for planners, at most so many a second; 0 for no limit [Hz]."""


class Moment(NamedTuple):
    """What an output has to know besides the people."""

    wishes: Wishes
    watchers: Callable[[str], int]
    """How many want a topic."""
    now_ns: int


class Output(Protocol):
    """One row of the table."""

    message_type: str

    def topics(self, persons: Iterable[str], fittings: Fittings | None) -> list[str]:
        """Where it goes for these people in these garments; None: before anything is known of them."""

    def messages(self, worn: Sequence[Dressed], moment: Moment) -> Messages:
        """What is to be sent of one tick, and where; nothing is computed for a topic that nobody wants."""

    def gone(self, persons: Sequence[str], moment: Moment) -> Messages:
        """What tells viewers that somebody has left."""

    def forget(self) -> None:
        """Other garments are worn from now on, or other people wear them."""


def _topic_of(person: str, place: str) -> str:
    return f"{person}/{place}" if person else place


class Layouts:
    """Message layouts, kept as long as the same is to be laid out."""

    def __init__(self) -> None:
        self._known: dict[Any, Any] = {}

    def get(self, key: Any, make: Callable[[], Any]) -> Any:
        if key not in self._known:
            if len(self._known) >= _MAX_LAYOUTS:
                self._known.clear()
            self._known[key] = make()
        return self._known[key]

    def clear(self) -> None:
        self._known.clear()


class Together:
    """One message of all people on one topic, in which each thing has a name: viewers are told which of them have gone.

    Args:
        topic, message_type: of the output.
        names: of the things of one person.
        encode: all of them, as one message.
        delete: the message that takes names away.
    """

    def __init__(
        self,
        topic: str,
        message_type: str,
        names: Callable[[Dressed], Sequence[str]],
        encode: Callable[[Sequence[Dressed], Wishes, Layouts], bytes],
        delete: Callable[[Sequence[str], Moment], bytes],
    ) -> None:
        self.topic, self.message_type = topic, message_type
        self._names, self._encode, self._delete = names, encode, delete
        self._layouts = Layouts()
        self._shown: dict[str, Sequence[str]] = {}

    def topics(self, persons: Iterable[str], fittings: Fittings | None) -> list[str]:  # noqa: ARG002 - one topic for all
        return [self.topic]

    def messages(self, worn: Sequence[Dressed], moment: Moment) -> Messages:
        if not moment.watchers(self.topic):
            return
        yield self.topic, self._encode(worn, moment.wishes, self._layouts)
        for one in worn:
            names = self._names(one)
            left = sorted(set(self._shown.get(one.person, ())) - set(names))
            self._shown[one.person] = names
            if left:
                yield self.topic, self._delete(left, moment)

    def gone(self, persons: Sequence[str], moment: Moment) -> Messages:
        names = [name for person in persons for name in self._shown.pop(person, ())]
        if names:
            yield self.topic, self._delete(names, moment)

    def forget(self) -> None:
        self._layouts.clear()


@dataclass
class Apart:
    """A topic for each person, and for each part of what they wear: nobody has to be told that it has gone.

    Args:
        message_type: of the output.
        places: topics below the person's, each with what `encode` is told.
        encode: one message of one person.
        slow: of planners' meshes, what `encode` is told being the garment: no more than `planner_rate` a second.
    """

    message_type: str
    places: Callable[[Fittings], Iterable[tuple[str, Any]]]
    encode: Callable[[Dressed, Any, Wishes], bytes]
    slow: bool = False

    def __post_init__(self) -> None:
        self._due: dict[str, float] = {}

    def topics(self, persons: Iterable[str], fittings: Fittings | None) -> list[str]:
        if fittings is None:
            return []
        return [_topic_of(person, place) for person in persons for place, _ in self.places(fittings)]

    def messages(self, worn: Sequence[Dressed], moment: Moment) -> Messages:
        for one in worn:
            for place, what in self.places(one.fittings):
                topic = _topic_of(one.person, place)
                if moment.watchers(topic) and (not self.slow or self._is_due(one, what, topic, moment)):
                    yield topic, self.encode(one, what, moment.wishes)

    def _is_due(self, one: Dressed, garment: str, topic: str, moment: Moment) -> bool:
        return one.fittings.has_planner(garment) and is_due(self._due, topic, moment.wishes)

    def gone(self, persons: Sequence[str], moment: Moment) -> Messages:  # noqa: ARG002
        return iter(())

    def forget(self) -> None:
        self._due.clear()


def is_due(due: dict[str, float], key: str, wishes: Wishes) -> bool:
    """Whether so much time has gone by; if so, it begins anew."""
    now = time.monotonic()
    if now < due.get(key, 0.0):
        return False
    due[key] = now + (1 / wishes.planner_rate if wishes.planner_rate else 0.0)
    return True
