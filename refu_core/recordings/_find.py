"""Where in a file the motion of a person is."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.recordings import _layouts as table
from refu_core.recordings._containers import Content, Key, entries
from refu_core.recordings._followed import is_of_mhr
from refu_core.recordings._rotations import is_one_frame
from refu_core.recordings._tables import told_apart
from refu_core.recordings._tracks import frames_of
from refu_core.recordings._values import word_of

_WORLD, _CAMERA = ("world", "global"), ("cam", "incam", "camera")
_SHOWN = 8


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
    if isinstance(content.root, np.ndarray):
        notes.append("an array without a name: taken as poses")
        bare: dict[Key, Any] = _bare(content.root, notes)
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
    if not every:
        raise ValueError(_unknown(nodes))
    best = min(found.rank for found in every)
    same = _without_copies([found for found in every if found.rank == best], notes)
    others = {" with ".join(found.layout.pose) for found in every if found.rank[0] != best[0]}
    is_both = best[1] == 0 and any("camera" in found.layout.writers for found in every)
    if is_both or (best[0] == 0 and others):
        notes.append("the file has the motion in a camera, too: the one in the world is taken")
    names = [person_of(found.path) for found in same]
    lengths = [_n_frames(content.array(one.node[one.layout.pose[0]]).shape, one.layout.joints[0]) for one in same]
    found = same[chosen(names, person, lengths, notes) if len(same) > 1 else 0]
    above = [nodes[found.path[:i]] for i in range(len(found.path), -1, -1) if found.path[:i] in nodes] + [whole]
    wanted = (table.RATES, table.GENDERS) if len(same) == 1 else (table.RATES,)
    return found, [*above, _aside(original, [names for names in wanted if first(above, names) is None], notes)]


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
    """The content with known names, and which were changed, where a pose's are spelled differently or have a prefix."""
    names = None
    for _, node in content.nodes():
        if any(one.is_whole and one.is_in(node) for one in table.LAYOUTS):
            return content, {}
        known = table.names_like([key for key, value in node.items() if value is not None])
        names = names or known
    if not names:
        return content, {}
    return content.changed(lambda node: {names.get(key, key): item for key, item in node.items()}), names


def _bare(array: NDArray[Any], notes: list[str]) -> dict[Key, Any]:
    """An array without a name: a pose, or the columns of Motion-X."""
    if array.ndim == 2 and array.shape[1] == 322:
        notes.append("322 columns: taken as Motion-X's")
        arrays: dict[Key, Any] = {"poses": array[:, :66], "trans": array[:, 309:312], "betas": array[:, 312:322]}
        return arrays | {table.MODELS[0]: "smplx"}
    if array.ndim == 2 and array.shape[1] == 263:
        raise ValueError(f"263 columns are HumanML3D features; {table.HUMANML_ADVICE}")
    return {"poses": array}


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
