"""How topics are made of dressed people: one for all or one for each, made only where somebody wants it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from msg_adapters.markers import garment_namespace
from msg_adapters.outputs._meshes import COLLISION_OBJECT, encode_collision_object
from msg_adapters.transforms import Placement

if TYPE_CHECKING:
    from refu_core.outputs import DressedPerson, Fittings

_MOST_LAID_OUT = 64
"""The most people in all kept layouts together; one alone may have more. For each person a layout holds the message's
bytes and takes a millisecond to make."""
Messages = Iterator[tuple[str, bytes]]
"""Topics, each with what is to be sent there."""


class Moment(NamedTuple):
    """What an output needs to know besides the people."""

    frame_id: str
    lifetime_ns: int
    """Viewers forget what isn't renewed for so long [ns]; 0: never."""
    points_fields: Sequence[str]
    """Those of `POINT_FIELDS` that points have."""
    planner_rate: float
    """Highest rate of meshes for planners; 0 for no limit [Hz]."""
    watchers: Callable[[str], int]
    now_ns: int


class Output:
    """One row of the table: one topic for all people, if `topics` doesn't say otherwise."""

    topic: str
    message_type: str

    def topics(self, persons: Iterable[str], fittings: Fittings | None) -> list[str]:  # noqa: ARG002
        """Its topics for these people in these garments; None: before anything is known of the garments."""
        return [self.topic]

    def messages(self, worn: Sequence[DressedPerson], moment: Moment) -> Messages:
        """What one tick sends, and where; nothing is computed for a topic that nobody wants."""
        raise NotImplementedError

    def gone(self, persons: Sequence[str], moment: Moment) -> Messages:  # noqa: ARG002
        """Messages that tell viewers that somebody has left."""
        return iter(())

    def forget(self) -> None:
        """To be called when other garments are worn from now on, or other people wear them."""


class Layouts:
    """Message layouts that are kept for reuse, up to `_MOST_LAID_OUT` people."""

    def __init__(self) -> None:
        self._known: dict[Any, Any] = {}
        self._n_people = 0

    def get(self, key: Any, make: Callable[[], Any], *, n_people: int = 1) -> Any:
        """The layout kept for `key`, or else what `make` makes, for `n_people`."""
        if key not in self._known:
            if self._n_people + n_people > _MOST_LAID_OUT:
                self.clear()
            self._known[key] = make()
            self._n_people += n_people
        return self._known[key]

    def clear(self) -> None:
        self._known.clear()
        self._n_people = 0


@dataclass
class Together(Output):
    """One message of all people on one topic, in which each thing has a name: viewers are told which names have gone.

    `encode` makes the message of all people's things, `delete` the one that removes names.
    """

    topic: str
    message_type: str
    names: Callable[[DressedPerson], Sequence[str]]
    encode: Callable[[Sequence[DressedPerson], Moment, Layouts], bytes]
    delete: Callable[[Sequence[str], Moment], bytes]
    layouts: Layouts = field(default_factory=Layouts)
    shown: dict[str, Sequence[str]] = field(default_factory=dict)

    def messages(self, worn: Sequence[DressedPerson], moment: Moment) -> Messages:
        if not moment.watchers(self.topic):
            return
        yield self.topic, self.encode(worn, moment, self.layouts)
        for one in worn:
            names = self.names(one)
            left = sorted(set(self.shown.get(one.person, ())) - set(names))
            self.shown[one.person] = names
            if left:
                yield self.topic, self.delete(left, moment)

    def gone(self, persons: Sequence[str], moment: Moment) -> Messages:
        names = [name for person in persons for name in self.shown.pop(person, ())]
        if names:
            yield self.topic, self.delete(names, moment)

    def forget(self) -> None:
        self.layouts.clear()


@dataclass
class Apart(Output):
    """A topic for each person, and for each part of what they wear: nobody needs to be told that one has gone.

    `encode` makes one message of one person.
    """

    message_type: str
    places: Callable[[Fittings], Iterable[tuple[str, Any]]]
    """Topics below the person's name, each with an argument for `encode`."""
    encode: Callable[[DressedPerson, Any, Moment], bytes]
    slow: bool = False
    """Whether these are planners' meshes, at most `planner_rate` a second; the argument is then the garment."""
    sent: dict[str, float] = field(default_factory=dict)
    """When each topic of planners' meshes was sent last."""

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
                if not self.slow or (one.fittings.has_planner(what) and is_due(self.sent, topic, moment)):
                    yield topic, self.encode(one, what, moment)

    def forget(self) -> None:
        self.sent.clear()


def is_due(sent: dict[str, float], key: str, moment: Moment) -> bool:
    """Whether `key` is due, at the rate of now; if so, it counts as sent. What is due isn't kept: people leave."""
    now, period = time.monotonic(), 1 / moment.planner_rate if moment.planner_rate else 0.0
    for passed in [name for name, at in sent.items() if at + period <= now]:
        del sent[passed]
    if key in sent:
        return False
    sent[key] = now
    return True


class Obstacles(Output):
    """Garments as MoveIt obstacles: each message adds a whole one, replacing the one that was there.

    So it doesn't matter if a receiver has missed messages or restarted: to `move` what isn't there would be an error.
    Garments that planners can't have are left out (`Fittings.without_planner`).
    """

    message_type = COLLISION_OBJECT
    topic = "collision_object"

    def __init__(self) -> None:
        self._sent: dict[str, list[str]] = {}
        self._sent_at: dict[str, float] = {}

    def messages(self, worn: Sequence[DressedPerson], moment: Moment) -> Messages:
        if not moment.watchers(self.topic):
            return
        for one in worn:
            known, before = one.fittings, self._sent.get(one.person, ())
            names = {
                garment_namespace(name, one.person): name for name in known.names if name not in known.without_planner
            }
            yield from self._remove([name for name in before if name not in names], moment)
            ready = {name: garment for name, garment in names.items() if known.has_planner(garment)}
            self._sent[one.person] = [*dict.fromkeys((*(name for name in before if name in names), *ready))]
            if not ready or not is_due(self._sent_at, one.person, moment):
                continue
            for name, garment in ready.items():
                data = encode_collision_object(
                    name,
                    stamp_ns=one.stamp_ns,
                    frame_id=moment.frame_id,
                    placement=Placement(translation=one.offset),
                    mesh=one.solid(garment),
                    subframes={at.name: Placement(at.rotation, at.centre) for at in one.openings[garment]},
                )
                yield self.topic, data

    def gone(self, persons: Sequence[str], moment: Moment) -> Messages:
        for person in persons:
            yield from self._remove(self._sent.pop(person, ()), moment)

    def _remove(self, names: Iterable[str], moment: Moment) -> Messages:
        for name in names:
            yield self.topic, encode_collision_object(name, stamp_ns=moment.now_ns, frame_id=moment.frame_id)
