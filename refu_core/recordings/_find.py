"""Where in a file the motion of a person is."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core._pickle_machine import Record
from refu_core.recordings import _layouts as table
from refu_core.recordings._containers import Content, Key, entries
from refu_core.recordings._followed import is_of_mhr
from refu_core.recordings._rotations import BODY, are_hinges, flexion_of, is_one_frame
from refu_core.recordings._tables import told_apart
from refu_core.recordings._tracks import frames_of
from refu_core.recordings._values import word_of

_WORLD, _CAMERA = ("world", "global"), ("cam", "incam", "camera")
_SHOWN = 8
_WITH_PLACE = (69, 75)
"""Columns of an array that may be those of a pose, of 22 or 24 joints, and of a translation [1]."""
_CLEARLY = 0.5
"""Knees and elbows must bend by so much more in one reading than in any other [rad]: of real clips, walks and dances
have 0.7 and more, stiff exercises less."""
_MOST_WAYS = 1000
"""Most arrays that are looked at for names like a pose's; files have some dozens."""


@dataclass(frozen=True)
class Located:
    """A mapping with the arrays of a layout."""

    layout: table.Layout
    path: tuple[Key, ...]
    node: Mapping[Key, Any]

    @property
    def rank(self) -> tuple[int, int]:
        """Motion in the world ranks before motion in a camera; then the order of the table decides."""
        words = [str(step).lower() for step in self.path]
        is_world = any(word in step for step in words for word in _WORLD)
        is_camera = any(word in step for step in words for word in _CAMERA)
        return (0 if is_world else 2 if is_camera else 1), table.LAYOUTS.index(self.layout)


def find_motion(content: Content, person: str | None, notes: list[str]) -> tuple[Located, list[Mapping[Key, Any]]]:
    """The mapping that holds the motion, and the mappings around it, from the inside outwards.

    Raises `ValueError` if there is no motion, or not that of the `person`.
    """
    alone = _alone(content)
    if alone is not None:
        notes.append("an array without a name: taken as poses")
        bare: dict[Key, Any] = _bare(alone, notes)
        poses = next(layout for layout in table.LAYOUTS if layout.pose == ("poses",))
        return Located(poses, (), bare), [bare]
    original, content = content, told_apart(content, notes)
    tracks = frames_of(content)
    whole = entries(content.root) or {}  # a frame rate may stand here, beside the frames
    if tracks:
        notes.append("the file goes frame by frame: each person's frames are put together")
        content = Content(tracks)
    nodes = dict(content.nodes())
    every = [
        Located(layout, path, node)
        for path, node in nodes.items()
        for layout in table.LAYOUTS
        if layout.is_in(node) and (layout is not table.MHR or is_of_mhr(content.array(node[layout.pose[0]])))
    ]
    every = list(_of_people(content, every, notes))
    if not every:
        raise ValueError(_unknown(nodes))
    best = min(found.rank for found in every)
    same = _without_copies([found for found in every if found.rank == best], notes)
    others = {" with ".join(found.layout.pose) for found in every if found.rank[0] != best[0]}
    is_both = "world" in same[0].layout.writers and any("camera" in found.layout.writers for found in every)
    if is_both or (best[0] == 0 and others):
        notes.append("the file has the motion in a camera, too: the one in the world is taken")
    names = [person_of(found.path) for found in same]
    lengths = [_n_frames(content.array(one.node[one.layout.pose[0]]).shape, one.layout.joints[0]) for one in same]
    found = same[chosen(names, person, lengths, notes) if len(same) > 1 else 0]
    above = [nodes[found.path[:i]] for i in range(len(found.path), -1, -1) if found.path[:i] in nodes] + [whole]
    wanted = (table.RATES, table.GENDERS) if len(same) == 1 else (table.RATES,)
    return found, [*above, _aside(original, [names for names in wanted if first(above, names) is None], notes)]


def _of_people(content: Content, every: Sequence[Located], notes: list[str]) -> Sequence[Located]:
    """Those that aren't a robot's. Raises `ValueError` if only a robot's poses are there."""
    poses = [(found.layout.pose[-1], _shape_of_robot(content, found)) for found in every]
    robots = [f"{name} {shape}" for name, shape in poses if shape]
    if not robots:
        return every
    people = [
        found
        for found, (_, shape) in zip(every, poses, strict=True)
        if not shape and (not found.layout.holds_places or _is_shaped(content, found.layout, found.node))
    ]
    if not people:
        wanted = "wanted a person's, such as the file that it was retargeted from"
        raise ValueError(f"{robots[0]}: each joint turns about one axis, as a robot's do; {wanted}")
    notes.append(f"{robots[0]} is left out: each joint turns about one axis, as a robot's do")
    return people


def _shape_of_robot(content: Content, found: Located) -> tuple[int, ...]:
    """The shape of a robot's pose; empty for anybody else's."""
    try:
        array = content.array(found.node[found.layout.pose[-1]])
    except ValueError:
        return ()  # which is told when it is read
    return array.shape if not found.layout.holds_places and are_hinges(array) else ()


def _n_frames(shape: tuple[int, ...], counts: Collection[int]) -> int:
    """How many frames an array of this shape holds; a first axis of one may be that of the persons."""
    if not shape or is_one_frame(shape, counts):
        return len(shape[:1])
    return shape[1] if len(shape) > 2 and shape[0] == 1 else shape[0]


def _without_copies(same: Sequence[Located], notes: list[str]) -> Sequence[Located]:
    """Those that aren't copies, deeper and by a like name: GVHMR keeps what its network gave beside the result."""
    depth = min(len(found.path) for found in same)
    tops = [found.path[-1] for found in same if 0 < len(found.path) == depth]
    words = tuple(table.spelled(name) for name in tops[:_SHOWN] if isinstance(name, str))

    def is_copy(found: Located) -> bool:
        *above, last = found.path or (0,)
        return len(above) >= depth and isinstance(last, str) and table.spelled(last).endswith(words)

    copies = [found for found in same if is_copy(found)]
    if not copies:
        return same
    names = ["/".join(map(str, found.path)) for found in copies[:_SHOWN]]
    notes.append(f"left out as another version of the same motion: {', '.join(names)}")
    return [found for found in same if not is_copy(found)]


def _aside(content: Content, wanted: Sequence[Sequence[str]], notes: list[str]) -> dict[Key, Any]:
    """What isn't around the motion but stands elsewhere in the file, once or with one value, as MoSh's frame rate."""
    found: dict[Key, Any] = {}
    for names in wanted:
        given = {
            (path, name): str(value) if type(value) in (int, float) else word_of(content, value)
            for path, node in content.nodes()
            for name in names
            if (value := node.get(name)) is not None
        }
        if len(set(filter(None, given.values()))) == 1:
            (path, name), value = next(pair for pair in given.items() if pair[1])
            found[name] = value
            notes.append(f"{name} of {'/'.join(map(str, path))} counts for the motion")
    return found


def with_known_names(content: Content) -> tuple[Content, Mapping[Key, str]]:
    """The content with known names, and which were changed, where a pose's are spelled differently or have a prefix.

    Of several arrays with such names, the first that is shaped like a pose is one: `cam_pose` isn't.
    """
    nodes = [node for _, node in content.nodes()]
    if any(layout.is_whole and layout.is_in(node) for node in nodes for layout in table.LAYOUTS):
        return content, {}
    ways = (
        (node, layout, names)
        for node in nodes
        for layout, names in table.names_like(
            key for key, value in node.items() if value is not None and entries(value) is None
        )
    )
    chosen: Mapping[Key, str] = {}
    for node, layout, names in islice(ways, _MOST_WAYS):
        is_shaped = _is_shaped(content, layout, _renamed(node, names))
        if is_shaped or not chosen:
            chosen = names
        if is_shaped:
            break
    return (content.changed(lambda node: _renamed(node, chosen)), chosen) if chosen else (content, {})


def _renamed(node: Mapping[Key, Any], names: Mapping[Key, str]) -> Mapping[Key, Any]:
    return {names.get(key, key): item for key, item in node.items()}


def _is_shaped(content: Content, layout: table.Layout, node: Mapping[Key, Any]) -> bool:
    """Whether the arrays of a layout are shaped like poses, of one person or several."""
    shapes = content.shapes(node, layout.pose)
    each = zip(shapes, layout.joints, strict=True)
    return bool(shapes) and (
        layout.is_time_last
        or all(any(is_one_frame(shape[axes:], counts) for axes in range(min(3, len(shape)))) for shape, counts in each)
    )


def _alone(content: Content) -> NDArray[Any] | None:
    """The array, or tensor, that is all that a file holds."""
    if isinstance(content.root, Record) and entries(content.root) is None:
        with contextlib.suppress(ValueError):
            return content.array(content.root)
    return content.root if isinstance(content.root, np.ndarray) else None


def _bare(array: NDArray[Any], notes: list[str]) -> dict[Key, Any]:
    """An array without a name: a pose, or the columns of Motion-X."""
    if array.ndim == 2 and array.shape[1] == 322:
        notes.append("322 columns: taken as Motion-X's")
        arrays: dict[Key, Any] = {"poses": array[:, :66], "trans": array[:, 309:312], "betas": array[:, 312:322]}
        return arrays | {table.MODELS[0]: "smplx"}
    if array.ndim == 2 and array.shape[1] == 263:
        raise ValueError(f"263 columns are HumanML3D features; {table.HUMANML_ADVICE}")
    return _apart(array, notes) if array.ndim == 2 and array.shape[1] in _WITH_PLACE else {"poses": array}


def _apart(array: NDArray[Any], notes: list[str]) -> dict[Key, Any]:
    """A pose and a translation in one array (T, n), in the order in which knees and elbows bend as they can.

    Raises `ValueError` if that doesn't show.
    """
    n = array.shape[1] - 3
    ways: dict[str, dict[Key, Any]] = {
        f"3 columns of a translation and {n} of a pose": {"poses": array[:, 3:], "trans": array[:, :3]},
        f"{n} columns of a pose and 3 of a translation": {"poses": array[:, :n], "trans": array[:, n:]},
    }
    if n + 3 in (3 * joints for joints in BODY):
        ways["a body without its root"] = {"poses": array}
    bent = {way: flexion_of(arrays["poses"], first=int(len(arrays) == 1)) for way, arrays in ways.items()}
    *_, second, best = sorted(bent, key=lambda way: bent[way])
    if not bent[best] - bent[second] > _CLEARLY:
        raise ValueError(f"{array.shape} may be {' or '.join(ways)}: save them apart, as poses and trans")
    notes.append(f"taken as {best}: knees and elbows bend so")
    return ways[best]


def person_of(path: tuple[Key, ...]) -> str:
    """The name of the person whose motion is at a path: its last number, or else all of it."""
    return next((str(step) for step in reversed(path) if isinstance(step, int)), "/".join(map(str, path)) or "0")


def chosen(names: Sequence[str], person: str | None, lengths: Sequence[int], notes: list[str]) -> int:
    """Which of the people is meant, by default the one with most frames. Raises `ValueError` for a stranger."""
    listing = ", ".join(f"{name} ({n} frames)" if n else name for name, n in zip(names[:_SHOWN], lengths, strict=False))
    listing += " …" if len(names) > _SHOWN else ""
    if person is not None:
        if person not in names:
            msg = f"no person {person!r}; the file has " + (listing if len(names) > 1 else "one: leave the person out")
            raise ValueError(msg)
        return names.index(person)
    best = max(range(len(names)), key=lambda i: lengths[i])
    notes.append(f"{len(names)} persons: {listing}; {names[best]} is taken (--person chooses another)")
    return best


def _unknown(nodes: Mapping[tuple[Key, ...], Mapping[Key, Any]]) -> str:
    keys = list(dict.fromkeys(str(key) for node in list(nodes.values())[:_SHOWN] for key in node))
    for names, what in table.UNREAD.items():
        if any(name in keys for name in names):
            return what
    has = ", ".join(keys[:_SHOWN]) + (" …" if len(keys) > _SHOWN else "") or "nothing that has a name"
    return f"no poses; wanted {table.accepted()} (docs/guide/inputs.md); the file has {has}"


def first(above: Sequence[Mapping[Key, Any]], names: Sequence[str]) -> Any:
    """The first entry with one of these names, from the mapping nearest to the motion."""
    return next((node[name] for node in above for name in names if node.get(name) is not None), None)
