"""Files that list everybody in each image, rearranged as one dictionary per person."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core._pickle_machine import Record
from refu_core.recordings import _layouts as table
from refu_core.recordings._containers import MOST_DEPTH, Content, Key, entries, held_by
from refu_core.recordings._recording import MAX_FRAMES, interpolated
from refu_core.recordings._rotations import is_one_frame
from refu_core.recordings._tables import number_of

_SAME = 0.75
"""Anybody farther than this from where a person was last seen is somebody else [m]; the same as for trackers."""
_MOST_LOST = 100
"""Most frames in all for each one in which the person is seen [1]; numbers that claim more, as time stamps do, would
fill the memory."""
_HOLDERS = (dict, list, tuple, Record)
"""Types that hold other values; most values of a file are numbers, and aren't searched."""
_MOST_LOOKS = 200_000
"""Most values of a file that are searched for persons: five thousand seconds of one person at 30 Hz."""
_IMAGES = (".jpg", ".jpeg", ".png", ".bmp", ".webp")


def frames_of(content: Content) -> Mapping[Any, Any]:
    """The persons of a file that has one pose per person and frame; none if a file isn't arranged frame by frame.

    Estimators that see single images write a list of dictionaries, a list of lists, or a dictionary by image name.

    Raises `ValueError` for frames that don't fit each other.
    """
    content = _rows_apart(content)
    sequences = _sequences(content.root, lambda node: _layout_of(content, node) is not None)
    found = [frames for frames in sequences if len(frames) > 1]
    tracks: dict[str, Any] = {}
    for k, frames in enumerate(found):
        people = _people(content, frames)
        for name, track in people.items():
            tracks[name if len(found) == 1 else str(k) if len(people) == 1 else f"{k}.{name}"] = track
    return tracks


def _people(content: Content, frames: list[list[Mapping[Key, Any]]]) -> dict[str, Any]:
    if len(frames) > MAX_FRAMES:
        raise ValueError(f"{len(frames)} frames, at most {MAX_FRAMES} are read; cut the clip")
    layout = next(_layout_of(content, bodies[0]) for bodies in frames if bodies)
    assert layout is not None
    named = _who_is_who(
        [(_name_of(content, body), _place_of(content, body, layout)) for body in bodies] for bodies in frames
    )
    persons: dict[str, list[tuple[int, Mapping[Key, Any]]]] = {}
    for number, (bodies, names) in enumerate(zip(frames, named, strict=True)):
        for name, body in zip(names, bodies, strict=True):
            if persons.get(name, [(-1, body)])[-1][0] != number:
                persons.setdefault(name, []).append((number, body))
    return {name: _stacked(content, layout, seen) for name, seen in persons.items()}


def places_in_time(frames: NDArray[Any] | None, n: int, notes: list[str]) -> NDArray[np.int64] | None:
    """Where n frames are in time, counted from 0, by their frame numbers; None if no frame is missing.

    Also None for numbers that can't be those of one person's frames in time; the reason is added to `notes`.
    """
    if frames is None:
        return None
    given = frames.reshape(-1)
    if given.dtype.kind not in "iu" or len(given) != n:
        what = f"{given.dtype} {frames.shape}, wanted whole numbers ({n},)"
    elif len(falls := np.flatnonzero(given[1:] <= given[:-1])):
        first = falls[0]
        what = f"{given[first]} is followed by {given[first + 1]}; wanted one person's, rising"
    elif n and int(given[-1]) - int(given[0]) >= (most := min(MAX_FRAMES, _MOST_LOST * n)):
        what = f"from {given[0]} to {given[-1]}, at most {most} for {n} frames are read"
    else:
        at: NDArray[np.int64] = (given - given[:1]).astype(np.int64)
        return None if n < 2 or at[-1] == n - 1 else at
    notes.append(f"the frames' numbers are left out of account, and the frames taken as they come: {what}")
    return None


def filled(
    poses: NDArray[np.float64], transl: NDArray[np.float64], frames: NDArray[Any] | None, notes: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The motion with the frames that a tracker lost filled in, on the shorter arc between those around them."""
    at = places_in_time(frames, len(poses), notes)
    if at is None:
        return poses, transl
    wanted = np.arange(at[-1] + 1)
    lost = f"{len(wanted) - len(at)} of {len(wanted)} frames are missing"
    if not (np.isfinite(poses).all() and np.isfinite(transl).all()):
        notes.append(f"{lost} and left out, since others aren't finite: the motion is too fast there")
        return poses, transl
    notes.append(f"{lost}: interpolated")
    return interpolated(poses, transl, at, wanted)


def _rows_apart(content: Content) -> Content:
    """Makes frames with one row per person into a list of people per image; other content stays as it is.

    Such frames are PHALP's `smpl` and `tid`, and dictionaries by image name, with arrays or lists in them.
    """
    frames = entries(content.root) or {}
    insides = [entries(frame) or {} for frame in frames.values()]
    if frames and all("smpl" in inside and "tid" in inside for inside in insides):
        return Content(dict(zip(frames, (_identified(content, inside) for inside in insides), strict=True)))
    for _, node in content.nodes():
        if not node or not all(isinstance(key, str) and key.lower().endswith(_IMAGES) for key in node):
            continue
        return Content({image: _rows(content, entries(seen) or {}) for image, seen in node.items()})
    return content


def _identified(content: Content, frame: Mapping[Key, Any]) -> list[dict[Key, Any]]:
    bodies = [entries(body) or {} for body in (entries(frame["smpl"]) or {}).values()]
    names = _ids(content, frame["tid"]) if bodies else []
    return [{**body, "track_id": name} for name, body in zip(names, bodies, strict=False)]


def _rows(content: Content, seen: Mapping[Key, Any]) -> Any:
    layout = next((one for one in table.LAYOUTS if one.is_in(seen)), None)
    if layout is None or _layout_of(content, seen) is not None:
        return seen
    arrays = {name: content.array(seen[name]) for name in layout.arrays if seen.get(name) is not None}
    n = next(iter(arrays[layout.pose[0]].shape), 0)
    split = {name: array for name, array in arrays.items() if array.ndim > 1 and len(array) == n}
    bodies: list[dict[Key, Any]] = [{name: array[i] for name, array in split.items()} for i in range(n)]
    for key in (*table.TRACK_IDS, "track_ids"):
        if seen.get(key) is not None and len(ids := _ids(content, seen[key])) == n:
            for body, one in zip(bodies, ids, strict=True):
                body["track_id"] = one
    return bodies


def _ids(content: Content, value: Any) -> list[int]:
    """The numbers that a tracker gives to people. Raises `ValueError` for anything else."""
    given = content.array(value).reshape(-1)
    if given.dtype.kind not in "biuf" or not np.isfinite(given).all():
        raise ValueError(f"people's numbers must be whole, got {given.dtype} {given[:4].tolist()}; leave them out")
    return [int(number) for number in given]


def _layout_of(content: Content, node: Mapping[Key, Any]) -> table.Layout | None:
    """The layout of which a mapping holds one frame; None if there is none."""
    for layout in table.LAYOUTS:
        if layout.is_time_last or not layout.is_in(node):
            continue
        shapes = content.shapes(node, layout.pose)
        if shapes and all(map(is_one_frame, shapes, layout.joints)):
            return layout
    return None


def _place_of(content: Content, body: Mapping[Key, Any], layout: table.Layout) -> np.ndarray[Any, Any]:
    """The translation, NaN where there is none, shape (3,)."""
    value = next((body[name] for name in layout.transl if body.get(name) is not None), None)
    place = np.full(3, np.nan) if value is None else content.array(value)
    return place.reshape(3).astype(np.float64) if place.size == 3 and place.dtype.kind in "iuf" else np.full(3, np.nan)


def _stacked(content: Content, layout: table.Layout, seen: list[tuple[int, Mapping[Key, Any]]]) -> dict[Key, Any]:
    """One person's arrays, one row per frame; what isn't in every frame is left out."""
    own = [number_of(content, body) for _, body in seen]
    numbers = [place for place, _ in seen] if None in own else own
    track: dict[Key, Any] = {"frame_ids": np.array(numbers)}
    track |= {key: seen[0][1][key] for key in (*table.GENDERS, *table.MODELS) if seen[0][1].get(key) is not None}
    for name in layout.arrays:
        rows = [body.get(name) for _, body in seen]
        if any(row is None for row in rows):
            continue
        flat = [content.array(row).reshape(-1) for row in rows]
        if len({len(row) for row in flat}) > 1:
            raise ValueError(f"{name} has {len(flat[0])} numbers in one frame and others in another")
        track[name] = np.stack(flat)
    return track


def _sequences(root: Any, is_body: Callable[[Mapping[Key, Any]], bool]) -> Iterator[list[list[Mapping[Key, Any]]]]:
    """Every sequence of frames that have persons in them, from the outside inwards; shared lists are visited once.

    A dictionary counts only if no frame has more people than there are frames. Otherwise a dictionary that holds a
    single list would be one frame with everybody in the list; instead, the list is searched.
    """

    def bodies(value: Any) -> list[Mapping[Key, Any]]:
        """The persons of a frame: it is one person, or holds some, as the first mapping in it shows."""
        if type(value) not in _HOLDERS:
            return []
        if id(value) not in persons:
            persons[id(value)] = _persons(value)
        return persons[id(value)]

    def _persons(value: Any) -> list[Mapping[Key, Any]]:
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
    persons: dict[int, list[Mapping[Key, Any]]] = {}
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


def _name_of(content: Content, body: Mapping[Key, Any]) -> str:
    """The name that a tracker gives somebody; empty if there is none."""
    return next((str(name) for key in table.TRACK_IDS if (name := content.single(body.get(key))) is not None), "")


def _who_is_who(frames: Iterable[Sequence[tuple[str, NDArray[np.float64]]]]) -> Iterator[list[str]]:
    """Names of those seen in each frame, from given names and places (3,) [m]: the tracker's name, else a number.

    Somebody without a name is the person last seen nearest, if near enough. Without a place either (NaN), their number
    is their position in the frame's list.
    """
    last: dict[str, NDArray[np.float64]] = {}
    for seen in frames:
        free, found = set(last), []
        for rank, (given, place) in enumerate(seen):
            name = given
            if not name and np.isnan(place).any():
                name = str(rank)
            elif not name:
                near = {one: float(np.linalg.norm(last[one] - place)) for one in free}
                near = {one: way for one, way in near.items() if way <= _SAME}  # never NaN: last seen without a place
                new = next(number for number in map(str, count(len(last))) if number not in last)
                name = min(near, key=near.__getitem__, default=new)
            free.discard(name)
            last[name] = place
            found.append(name)
        yield found


def _mapping(value: Any) -> Mapping[Key, Any] | None:
    return None if isinstance(held_by(value), (list, tuple)) else entries(value)


def _items(value: Any) -> Sequence[Any]:
    value = held_by(value)
    if isinstance(value, (list, tuple)):
        return value
    return list((entries(value) or {}).values())
