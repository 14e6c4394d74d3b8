"""How topics come of dressed people: one of all, or one of each, made only where somebody wants it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from msg_adapters.markers import garment_namespace

if TYPE_CHECKING:
    from refu_core.outputs import DressedPerson, Fittings

_MOST_LAID_OUT = 64
"""People in all layouts that are kept, but for one of more; of each a layout has the bytes, and takes a millisecond."""
Messages = Iterator[tuple[str, bytes]]
"""Topics, and what is to be sent there."""


class Moment(NamedTuple):
    """What an output has to know besides the people."""

    frame_id: str
    """Of every header."""
    lifetime_ns: int
    """Viewers forget what isn't renewed for so long [ns]; 0: never."""
    points_fields: Sequence[str]
    """What points have besides their place, of `POINT_FIELDS`."""
    planner_rate: float
    """Meshes for planners, at most so many a second; 0 for no limit [Hz]."""
    watchers: Callable[[str], int]
    """How many want a topic."""
    now_ns: int


class Output:
    """One row of the table."""

    message_type: str

    def topics(self, persons: Iterable[str], fittings: Fittings | None) -> list[str]:
        """Where it goes for these people in these garments; None: before anything is known of them."""
        raise NotImplementedError

    def messages(self, worn: Sequence[DressedPerson], moment: Moment) -> Messages:
        """What is to be sent of one tick, and where; nothing is computed for a topic that nobody wants."""
        raise NotImplementedError

    def gone(self, persons: Sequence[str], moment: Moment) -> Messages:  # noqa: ARG002
        """What tells viewers that somebody has left."""
        return iter(())

    def forget(self) -> None:
        """Other garments are worn from now on, or other people wear them."""


class Layouts:
    """Message layouts, kept as long as the same is to be laid out."""

    def __init__(self) -> None:
        self._known: dict[Any, Any] = {}
        self._n_people = 0

    def get(self, key: Any, make: Callable[[], Any], *, n_people: int = 1) -> Any:
        """What `make` makes, of so many people, or made the last time."""
        if key not in self._known:
            if self._n_people + n_people > _MOST_LAID_OUT:
                self.clear()
            self._known[key] = make()
            self._n_people += n_people
        return self._known[key]

    def clear(self) -> None:
        self._known.clear()
        self._n_people = 0


class Together(Output):
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
        names: Callable[[DressedPerson], Sequence[str]],
        encode: Callable[[Sequence[DressedPerson], Moment, Layouts], bytes],
        delete: Callable[[Sequence[str], Moment], bytes],
    ) -> None:
        self.topic, self.message_type = topic, message_type
        self._names, self._encode, self._delete = names, encode, delete
        self._layouts = Layouts()
        self._shown: dict[str, Sequence[str]] = {}

    def topics(self, persons: Iterable[str], fittings: Fittings | None) -> list[str]:  # noqa: ARG002 - one topic for all
        return [self.topic]

    def messages(self, worn: Sequence[DressedPerson], moment: Moment) -> Messages:
        if not moment.watchers(self.topic):
            return
        yield self.topic, self._encode(worn, moment, self._layouts)
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
class Apart(Output):
    """A topic for each person, and for each part of what they wear: nobody has to be told that it has gone.

    Args:
        message_type: of the output.
        places: topics below the person's, each with what `encode` is told.
        encode: one message of one person.
        slow: of planners' meshes, what `encode` is told being the garment: no more than `planner_rate` a second.
    """

    message_type: str
    places: Callable[[Fittings], Iterable[tuple[str, Any]]]
    encode: Callable[[DressedPerson, Any, Moment], bytes]
    slow: bool = False
    due: dict[str, float] = field(default_factory=dict)
    """When each topic of planners' meshes is next."""

    def topics(self, persons: Iterable[str], fittings: Fittings | None) -> list[str]:
        if fittings is None:
            return []
        return [garment_namespace(place, person) for person in persons for place, _ in self.places(fittings)]

    def messages(self, worn: Sequence[DressedPerson], moment: Moment) -> Messages:
        for one in worn:
            for place, what in self.places(one.fittings):
                topic = garment_namespace(place, one.person)
                if not moment.watchers(topic):
                    continue
                if not self.slow or (one.fittings.has_planner(what) and is_due(self.due, topic, moment)):
                    yield topic, self.encode(one, what, moment)

    def forget(self) -> None:
        self.due.clear()


def is_due(due: dict[str, float], key: str, moment: Moment) -> bool:
    """Whether so much time has gone by; if so, it begins anew. Nothing is kept of what is due: people leave."""
    now = time.monotonic()
    for passed in [name for name, at in due.items() if at <= now]:
        del due[passed]
    if key in due:
        return False
    due[key] = now + (1 / moment.planner_rate if moment.planner_rate else 0.0)
    return True
