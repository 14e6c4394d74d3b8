"""Garments as obstacles in MoveIt's planning scene."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from msg_adapters.markers import garment_namespace
from msg_adapters.outputs._meshes import COLLISION_OBJECT, encode_collision_object
from msg_adapters.outputs._topics import Output, is_due
from msg_adapters.transforms import Placement

if TYPE_CHECKING:
    from msg_adapters.outputs._topics import Messages, Moment
    from refu_core.outputs import DressedPerson, Fittings


class Obstacles(Output):
    """Garments as MoveIt obstacles: each message adds a whole one, replacing the one that was there.

    So it doesn't matter if a receiver has missed messages or restarted: to `move` what isn't there would be an error.
    Garments that planners can't have are left out (`Fittings.without_planner`).
    """

    message_type = COLLISION_OBJECT
    topic = "collision_object"

    def __init__(self) -> None:
        self._sent: dict[str, list[str]] = {}
        self._due: dict[str, float] = {}

    def topics(self, persons: Iterable[str], fittings: Fittings | None) -> list[str]:  # noqa: ARG002 - one topic for all
        return [self.topic]

    def messages(self, worn: Sequence[DressedPerson], moment: Moment) -> Messages:
        if not moment.watchers(self.topic):
            return
        if not all(_is_prepared(one.fittings, name) for one in worn for name in one.fittings.names):
            return  # not before all are ready
        for one in worn:
            if not is_due(self._due, one.person, moment):
                continue
            garments = [name for name in one.fittings.names if name not in one.fittings.without_planner]
            names = [garment_namespace(name, one.person) for name in garments]
            yield from self._remove([name for name in self._sent.get(one.person, ()) if name not in names], moment)
            self._sent[one.person] = names
            for name, garment in zip(names, garments, strict=True):
                openings = {
                    opening.name: Placement(opening.rotation, opening.centre) for opening in one.openings[garment]
                }
                yield (
                    self.topic,
                    encode_collision_object(
                        name,
                        stamp_ns=one.stamp_ns,
                        frame_id=moment.frame_id,
                        placement=Placement(translation=one.offset),
                        mesh=one.solid(garment),
                        subframes=openings,
                    ),
                )

    def gone(self, persons: Sequence[str], moment: Moment) -> Messages:
        for person in persons:
            yield from self._remove(self._sent.pop(person, ()), moment)

    def _remove(self, names: Iterable[str], moment: Moment) -> Messages:
        for name in names:
            yield self.topic, encode_collision_object(name, stamp_ns=moment.now_ns, frame_id=moment.frame_id)


def _is_prepared(fittings: Fittings, garment: str) -> bool:
    """Whether a garment's mesh for planners is ready, or known to be impossible."""
    return fittings.has_planner(garment) or garment in fittings.without_planner
