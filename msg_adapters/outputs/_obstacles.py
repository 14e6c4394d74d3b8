"""Garments as MoveIt's planning scene has obstacles."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from msg_adapters.markers import garment_namespace
from msg_adapters.outputs._meshes import COLLISION_OBJECT, encode_collision_object
from msg_adapters.outputs._topics import is_due
from msg_adapters.transforms import Placement

if TYPE_CHECKING:
    from msg_adapters.outputs._topics import Messages, Moment, Wishes
    from refu_core.outputs import Dressed, Fittings


class Obstacles:
    """Garments as MoveIt has obstacles: put in anew when their shape has changed, moved when only their place has.

    Whoever subscribes later is sent everything: to move what isn't there is an error. What planners can't have is left
    out (`Fittings.without_planner`).
    """

    message_type = COLLISION_OBJECT
    topic = "collision_object"

    def __init__(self) -> None:
        self._sent: dict[str, dict[str, bytes]] = {}
        self._watchers = 0
        self._due: dict[str, float] = {}

    def topics(self, persons: Iterable[str], fittings: Fittings | None) -> list[str]:  # noqa: ARG002 - one topic for all
        return [self.topic]

    def messages(self, worn: Sequence[Dressed], moment: Moment) -> Messages:
        before, watchers = self._watchers, moment.watchers(self.topic)
        if watchers and not all(_is_prepared(one.fittings, name) for one in worn for name in one.fittings.names):
            return  # soon
        self._watchers = watchers
        if watchers > before:
            self._due.clear()
            for sent in self._sent.values():
                sent.update(dict.fromkeys(sent, b""))
        for one in worn if watchers else ():
            if not is_due(self._due, one.person, moment.wishes):
                continue
            garments = [name for name in one.fittings.names if name not in one.fittings.without_planner]
            names = [garment_namespace(name, one.person) for name in garments]
            sent = self._sent.setdefault(one.person, {})
            for name in [name for name in sent if name not in names]:
                del sent[name]
                yield self.topic, self._remove(name, moment)
            for name, garment in zip(names, garments, strict=True):
                shape = one.output[garment].local.tobytes() + one.rotation.tobytes()
                is_moved = sent.get(name) == shape
                sent[name] = shape
                yield self.topic, self._put(one, name, garment, moment.wishes, is_moved=is_moved)

    @staticmethod
    def _put(one: Dressed, name: str, garment: str, wishes: Wishes, *, is_moved: bool) -> bytes:
        subframes = {opening.name: Placement(opening.rotation, opening.centre) for opening in one.openings[garment]}
        return encode_collision_object(
            name,
            "move" if is_moved else "add",
            stamp_ns=one.stamp_ns,
            frame_id=wishes.frame_id,
            placement=Placement(np.eye(3), one.offset),
            mesh=None if is_moved else one.solid(garment),
            subframes=None if is_moved else subframes,
        )

    @staticmethod
    def _remove(name: str, moment: Moment) -> bytes:
        frame_id = moment.wishes.frame_id
        return encode_collision_object(name, "remove", stamp_ns=moment.now_ns, frame_id=frame_id)

    def gone(self, persons: Sequence[str], moment: Moment) -> Messages:
        for person in persons:
            self._due.pop(person, None)
            for name in self._sent.pop(person, ()):
                yield self.topic, self._remove(name, moment)

    def forget(self) -> None:
        """Nothing: what has gone is seen by its name."""


def _is_prepared(fittings: Fittings, garment: str) -> bool:
    """Whether it is known how planners have a garment, or that they can't."""
    return fittings.has_planner(garment) or garment in fittings.without_planner
