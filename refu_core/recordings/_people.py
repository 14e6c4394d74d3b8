"""Files that go image by image, with whoever is seen in each: found in any nesting, and sorted by person."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core._pickle_machine import Record
from refu_core.recordings._containers import MOST_DEPTH, Key, entries
from refu_core.recordings._layouts import TRACK_IDS

Array = NDArray[np.float64]
Body = Mapping[Key, Any]

_SAME = 0.75
"""Who is farther from where a person was in the image before is somebody else [m], as for trackers."""
_HOLDERS = (dict, list, tuple, Record)
"""What holds anything; most values of a file are numbers, and aren't looked into."""
_MOST_LOOKS = 200_000
"""Values of a file that are looked at in search of persons: five thousand seconds of somebody at 30 Hz."""


def sequences(root: Any, is_body: Callable[[Body], bool]) -> Iterator[list[list[Body]]]:
    """Whatever has persons in it, frame by frame, from the outside inwards; lists that are shared are seen once.

    People don't outnumber frames: a dictionary of one list isn't a frame with everybody of the list; it is looked into.
    """

    def bodies(value: Any) -> list[Body]:
        """The persons of a frame: it is one, or has some; whoever is first shows which."""
        if type(value) not in _HOLDERS:
            return []
        if id(value) not in persons:
            persons[id(value)] = _persons(value)
        return persons[id(value)]

    def _persons(value: Any) -> list[Body]:
        inside = _mapping(value)
        if inside is not None and is_body(inside):
            return [inside]
        inner = (found for one in _items(value) if type(one) in _HOLDERS and (found := _mapping(one)) is not None)
        first = next(inner, None)
        return [] if first is None or not is_body(first) else [first, *filter(is_body, inner)]

    inside = _mapping(root)
    if inside is not None and is_body(inside):
        yield [[inside]]
        return
    persons: dict[int, list[Body]] = {}
    known: set[int] = set()
    level, looks = [root], 0
    for _ in range(MOST_DEPTH):
        below: list[Any] = []
        for value in level:
            items = _items(value)
            looks += len(items)
            if id(value) in known or looks > _MOST_LOOKS:
                continue
            known.add(id(value))
            frames = [bodies(item) for item in items]
            most = max(map(len, frames), default=0)
            if most and (most <= len(frames) or not isinstance(value, dict)):
                yield frames
            else:
                below += [item for item in items if type(item) in _HOLDERS and len(_items(item))]
        level = below


def name_of(body: Body) -> str:
    """What a tracker calls somebody; empty where it doesn't."""
    return next((str(body[key]) for key in TRACK_IDS if isinstance(body.get(key), (int, str))), "")


def who_is_who(frames: Iterable[Sequence[tuple[str, Array]]]) -> Iterator[list[str]]:
    """Names of those who are seen in each frame, by name and place (3,) [m]: the tracker's, else a number.

    Somebody without a name is who was nearest, if near enough; of no place (NaN), who comes as late in the list.
    """
    last: dict[str, Array] = {}
    for seen in frames:
        free, found = set(last), []
        for rank, (given, place) in enumerate(seen):
            name = given
            if not name and np.isnan(place).any():
                name = str(rank)
            elif not name:
                near = {one: float(np.linalg.norm(last[one] - place)) for one in free}
                name = min(near, key=near.__getitem__, default="")
                name = name if name and near[name] <= _SAME else str(len(last))
            free.discard(name)
            last[name] = place
            found.append(name)
        yield found


def _mapping(value: Any) -> Body | None:
    return None if isinstance(value, (list, tuple)) else entries(value)


def _items(value: Any) -> Sequence[Any]:
    if isinstance(value, Record) and value.kind == "array":  # NumPy's way to save objects
        state = value.state
        held = state[4] if isinstance(state, tuple) and len(state) == 5 and isinstance(state[4], list) else ()
        return _items(held[0]) if len(held) == 1 else held
    inside = _mapping(value)
    if inside is not None:
        return list(inside.values())
    return value if isinstance(value, (list, tuple)) else ()
