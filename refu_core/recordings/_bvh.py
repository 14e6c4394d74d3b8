"""BVH: any person's skeleton in motion; SMPL's skeleton is fitted to the positions of its joints.

A BVH file identifies its joints only by their names, doesn't give its units, and may have any rest pose. So its joints
are posed, recognised by their names, and followed as keypoints are.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from refu_core._files import read_file
from refu_core.errors import RefuError
from refu_core.keypoints import Proportions
from refu_core.recordings._followed import follow, metres_of
from refu_core.recordings._layouts import WANTED
from refu_core.recordings._recording import MAX_FRAMES, Recording, check_fps
from refu_core.recordings._retarget import SourceSkeleton, bearer_of, retargeted
from refu_core.recordings._upright import Array, Axes

_MAX_BYTES = 256 << 20
_MAX_JOINTS = 1000
_LARGEST = 1e9
"""A thousand kilometres in millimetres; squares of larger numbers soon overflow."""
_CHANNELS = {f"{axis}{kind}": (kind, i) for kind in ("position", "rotation") for i, axis in enumerate("xyz")}
_NAMES = {
    "knee": ("shin", "shank", "knee", "lowerleg", "lowleg", "calf", "tibia", "leg"),
    "hip": ("upleg", "thigh", "upperleg", "femur", "hip", "leg"),
    "ankle": ("ankle", "foot"),
    "foot": ("toebase", "toe", "toes", "toe2", "ball", "foot"),
    "shoulder": ("arm", "upperarm", "uparm", "uarm", "shldr", "humerus", "shoulder"),
    "elbow": ("forearm", "elbow", "lowerarm", "lowarm", "farm", "larm", "radius"),
    "wrist": ("wrist", "hand"),
    "pelvis": ("hips", "pelvis", "hip"),
    "neck": ("neck", "necklower", "lowerneck", "necktwist"),
    "head": ("head",),
}
"""Names of joints, without their side. The first name that a file has is taken, unless its joint already is another
point. So a `leg` is the thigh in files that also have a shin (SOMA), a `shoulder` is a collar in files that also have
an arm, and a `foot` the ball of the foot in files that also have an ankle (SMPL, Kinect)."""
_BARE = frozenset(name for names in _NAMES.values() for name in names) - {"larm"}  # which is the left arm of others
_SUFFIXES = "jnt|joint|bone|m|c"
"""Words after a joint's name that don't belong to it; m and c are for the middle."""
_NEAR = 0.5
"""Greatest distance from between the hips to the joint that both hang on, for that to be the pelvis [thighs]: SMPL's is
at a quarter, a root on the floor at two."""
_SIDED = ("hip", "knee", "ankle", "foot", "shoulder", "elbow", "wrist")
_POINTS = (*(f"{side}_{part}" for part in _SIDED for side in "lr"), "pelvis", "neck", "head")
_NEEDED = tuple(f"{side}_{part}" for side in "lr" for part in ("hip", "knee", "shoulder", "elbow"))


@dataclass(eq=False)
class _Joint:
    name: str
    parent: int
    offset: Array
    channels: list[str] = field(default_factory=list)


def read_bvh(
    path: Path, *, error: type[RefuError], fps: float | None, axes: Axes, worn: Proportions | None
) -> Recording:
    """The motion of a BVH file. Raises `error` for a damaged file, and for a skeleton that isn't a person's."""
    text = read_file(path, most=_MAX_BYTES, error=error, wanted=WANTED).decode("utf-8", "replace")
    try:
        joints, rows, seconds = _parsed(text)
        rate = check_fps(fps if fps is not None else 1 / seconds if seconds > 0 else 0.0)
        return _fitted(joints, *_placed(joints, rows), rate, axes, worn)
    except ValueError as cause:
        raise error(f"{path}: {cause}") from cause


def _parsed(text: str) -> tuple[list[_Joint], Array, float]:
    """The joints, one row of channels per frame, and the seconds between frames. Raises `ValueError`."""
    hierarchy, word, motion = text.partition("MOTION")
    head = re.match(r"\s*Frames:\s*(\d+)\s+Frame\s+Time:\s*([-+.\deE]+)", motion) if word else None
    if head is None:
        raise ValueError("not a BVH file: wanted HIERARCHY, then MOTION, Frames: and Frame Time:")
    joints = _joints(word for line in hierarchy.split("\n") for word in _words(line))
    n_channels, count = sum(len(joint.channels) for joint in joints), int(head[1])
    if len(joints) > n_channels:  # joints that the file says nothing of would take memory in every frame
        raise ValueError(f"wanted at least as many channels as joints, got {n_channels} and {len(joints)}")
    numbers = np.array(motion[head.end() :].split(), dtype=np.float64)
    count = count or numbers.size // n_channels  # programs that were stopped leave a zero there
    if not 0 < count <= MAX_FRAMES or numbers.size != count * n_channels or not np.isfinite(numbers).all():
        finite = int(np.isfinite(numbers).sum())
        raise ValueError(f"wanted {count} frames (1 to {MAX_FRAMES}) of {n_channels} finite numbers, got {finite}")
    given = np.concatenate((numbers, *(joint.offset for joint in joints)))
    if not (np.abs(given) < _LARGEST).all():
        raise ValueError(f"wanted offsets, places and angles below {_LARGEST:g}, got {np.abs(given).max():g}")
    return joints, numbers.reshape(count, n_channels), float(head[2])


def _words(line: str) -> list[str]:
    """The words of a line, with a joint's name as one of them."""
    words = line.split()
    end = len(words) - (words[-1:] == ["{"])
    if end < 3 or words[0].upper() not in ("ROOT", "JOINT"):
        return words
    return [words[0], "_".join(words[1:end]), *words[end:]]


def _joints(words: Iterator[str]) -> list[_Joint]:
    joints: list[_Joint] = []
    open_: list[int] = []
    try:
        for word in words:
            word = word.upper()
            if word in ("ROOT", "JOINT", "END"):
                name = next(words)
                joints.append(_Joint("" if word == "END" else name, open_[-1] if open_ else -1, np.zeros(3)))
            elif word == "{":
                open_.append(len(joints) - 1)
            elif word == "}":
                open_.pop()
            elif word == "OFFSET":
                joints[open_[-1]].offset = np.array([float(next(words)) for _ in range(3)])
            elif word == "CHANNELS":
                joints[open_[-1]].channels = [next(words).lower() for _ in range(int(next(words)))]
            if len(joints) > _MAX_JOINTS:
                raise ValueError(f"more than {_MAX_JOINTS} joints")
    except (StopIteration, IndexError) as cause:
        raise ValueError("its hierarchy is cut short") from cause
    if open_:
        raise ValueError(f"its hierarchy is cut short: {len(open_)} braces are never closed")
    unknown = [name for joint in joints for name in joint.channels if name not in _CHANNELS]
    if not joints or unknown:
        raise ValueError(f"unknown channel {unknown[0]!r}" if unknown else "no joints")
    return joints


def _placed(joints: list[_Joint], rows: Array) -> tuple[Array, Array]:
    """Positions of the joints in the file's units, shape (T, J, 3), and their rotations in the world, (J, T, 3, 3)."""
    places, turns = np.zeros((len(joints), len(rows), 3)), np.zeros((len(joints), len(rows), 3, 3))
    start = 0
    for i, joint in enumerate(joints):
        own = rows[:, start : start + len(joint.channels)]
        start += len(joint.channels)
        way, order = np.tile(joint.offset, (len(rows), 1)), ""
        angles: list[Array] = []
        for name, column in zip(joint.channels, own.T, strict=True):
            kind, axis = _CHANNELS[name]
            if kind == "position":  # replaces the offset: for the root, and in some files for every joint
                way[:, axis] = column
            else:
                order, angles = order + "XYZ"[axis], [*angles, column]
        if len(set(order)) < len(order):
            raise ValueError(f"{joint.name} turns twice about one axis: {order}")
        turn = Rotation.from_euler(order, np.stack(angles, axis=1), degrees=True).as_matrix() if order else np.eye(3)
        if joint.parent < 0:
            places[i], turns[i] = way, turn
        else:
            above = turns[joint.parent]
            places[i] = places[joint.parent] + np.einsum("tij,tj->ti", above, way)
            turns[i] = above @ turn
    return places.swapaxes(0, 1), turns


def _fitted(
    joints: list[_Joint], places: Array, turns: Array, fps: float, axes: Axes, worn: Proportions | None
) -> Recording:
    points = _points(joints, places[0])
    missing = [name for name in _NEEDED if name not in points]
    if missing:
        names = ", ".join(joint.name for joint in joints[:12] if joint.name)
        raise ValueError(f"not a person's skeleton, or its names aren't known: no {', '.join(missing)} among {names} …")
    notes: list[str] = []
    places = places * metres_of(list(points), places[0, list(points.values())], notes)
    rest = np.zeros((len(joints), 3))
    for i, joint in enumerate(joints):
        rest[i] = joint.offset if joint.parent < 0 else rest[joint.parent] + joint.offset
    source = SourceSkeleton(points, [joint.parent for joint in joints], rest, places, turns)
    lost = [name for name in _POINTS if name not in points]
    without = f"; not found by their names: {', '.join(lost)}" if lost else ""
    body = Proportions.builtin("neutral") if worn is None else worn
    on_body = retargeted(source, body)
    betas, seen = on_body or (None, {name: source.at(name) for name in points})
    turned = "; its trunk and head turn as these joints do" if on_body else ""
    notes.append(f"the skeleton of {len(joints)} joints is fitted by the positions of {len(points)}{without}{turned}")
    found = np.stack(list(seen.values()), axis=1)
    return follow(tuple(seen), found, fps=fps, axes=axes, usual="smpl", worn=worn, betas=betas, notes=notes)


def _points(joints: list[_Joint], places: Array) -> dict[str, int]:
    """The number of the joint at each point of the body, for the `places` (J, 3) of one frame."""
    sides: dict[tuple[str, str], int] = {}
    for i, joint in enumerate(joints):
        if joint.name:
            key = _sided(joint.name)
            if len(joint.name) < len(joints[sides.setdefault(key, i)].name):  # beside L_Hip, Pelvis_L_Hip is a helper
                sides[key] = i
    points: dict[str, int] = {}
    for part, names in _NAMES.items():
        for side in ("l", "r") if part in _SIDED else ("",):
            taken = points.values()
            named = (sides.get((side, name)) for name in names)
            if (found := next((at for at in named if at is not None and at not in taken), None)) is not None:
                points[f"{side}_{part}" if side else part] = found
    if "pelvis" not in points and (pelvis := _between(joints, places, points)) is not None:
        points["pelvis"] = pelvis
    ends = {joint.parent: i for i, joint in reversed(list(enumerate(joints))) if not joint.name}
    bones = [(f"{side}_{a}", f"{side}_{b}") for side in "lr" for a, b in (("knee", "ankle"), ("elbow", "wrist"))]
    for bearer, point in (*bones, ("head", "head_top")):
        if point not in points and points.get(bearer) in ends:
            points[point] = ends[points[bearer]]
    return points


def _between(joints: list[_Joint], places: Array, points: dict[str, int]) -> int | None:
    """The joint that both legs hang on, if it is near the hips, whatever its name is."""
    if any(name not in points for name in ("l_hip", "r_hip", "l_knee")):
        return None
    both = bearer_of([joint.parent for joint in joints], points["l_hip"], points["r_hip"])
    if both < 0 or both in points.values():
        return None
    left, right, knee = (places[points[name]] for name in ("l_hip", "r_hip", "l_knee"))
    off, thigh = np.linalg.norm(places[both] - (left + right) / 2), np.linalg.norm(left - knee)
    return both if off < _NEAR * thigh else None


def _sided(name: str) -> tuple[str, str]:
    """The side (`l`, `r` or empty) and the rest of a joint's name, in any of the ways that tools write them."""
    bare = re.sub(rf"(?i)(?<=.)[_. -](?:{_SUFFIXES})$", "", re.split(r"[:|]", name)[-1])
    match = re.fullmatch(r"(?i)(?:.*[_. -])?(left|right)[_. -]?(.+)", bare)
    at_end = None if match else re.fullmatch(r"(?i)(.+?)[_. -](left|right)", bare)
    if not at_end:
        match = match or re.fullmatch(r"(?:.*[_. -])?([lLrR])(?:[_. -]|(?=[A-Z]))(.+)", bare)
    if match:
        side, rest = match[1], match[2]
    else:
        match = at_end or re.fullmatch(r"(?i)(.+?)[_. -](l|r)", bare) or re.fullmatch(r"(.+[a-z])(Left|Right)", bare)
        rest, side = (match[1], match[2]) if match else (bare, "")
        rest = re.sub(r"^(?:[A-Za-z0-9]+[_-])+(?=[A-Za-z])", "", rest)
    rest = re.sub(r"[^a-z0-9]", "", rest.lower())
    rest = re.sub(r"(?:bend|0*[01])$", "", rest)  # the first of several bones of a limb
    if not side and rest[:1] in ("l", "r") and rest not in _BARE and rest[1:] in _BARE:  # lfemur
        side, rest = rest[0], rest[1:]
    return side[:1].lower(), rest
