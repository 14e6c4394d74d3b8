"""Files that go image by image, with everybody who is in it: here a dictionary a person."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from refu_core.recordings import _layouts as table
from refu_core.recordings._containers import Content, Key, entries
from refu_core.recordings._people import name_of, sequences, who_is_who
from refu_core.recordings._rate import MAX_FRAMES
from refu_core.recordings._rotations import is_one_frame

_IMAGES = (".jpg", ".jpeg", ".png", ".bmp", ".webp")
_ARRAYS = ("global_orient", "body_pose", "betas")


def tracks_of(content: Content) -> Mapping[Any, Any] | None:
    """The persons of frames that have PHALP's lists `smpl` and `tid`, None where a file isn't such.

    Raises `ValueError` for frames whose lists don't fit each other.
    """
    frames = [inside for inside in map(entries, (entries(content.root) or {}).values()) if inside is not None]
    if not frames or not all("smpl" in frame and "tid" in frame for frame in frames):
        return None
    persons: dict[int, dict[str, list[Any]]] = {}
    for number, frame in enumerate(frames):
        bodies = list((entries(frame["smpl"]) or {}).values())
        for person, body in zip(_ids(content, frame["tid"]), bodies, strict=False):
            values = entries(body) or {}
            if not all(name in values for name in _ARRAYS):
                msg = f"frame {number}: a person without {', '.join(_ARRAYS)}"
                raise ValueError(msg)
            track = persons.setdefault(person, {name: [] for name in (*_ARRAYS, "frame_ids")})
            if track["frame_ids"][-1:] == [number]:
                continue
            track["frame_ids"].append(number)
            for name in _ARRAYS:
                track[name].append(content.array(values[name]))
    return {
        person: {name: np.stack(rows) if name != "frame_ids" else np.array(rows) for name, rows in track.items()}
        for person, track in persons.items()
    }


def frames_of(content: Content) -> Mapping[Any, Any] | None:
    """The persons of frames that are each one pose, None where a file doesn't go frame by frame.

    Estimators that see single images leave a list of dictionaries, one of lists, or a dictionary by the image's name.

    Raises `ValueError` for frames that don't fit each other.
    """

    def is_body(node: Mapping[Key, Any]) -> bool:
        return _layout_of(content, node) is not None

    content = _rows_apart(content)
    found = [frames for frames in sequences(content.root, is_body) if len(frames) > 1]
    tracks: dict[str, Any] = {}
    for k, frames in enumerate(found):
        people = _people(content, frames)
        for name, track in people.items():
            tracks[name if len(found) == 1 else str(k) if len(people) == 1 else f"{k}.{name}"] = track
    return tracks or None


def _people(content: Content, frames: list[list[Mapping[Key, Any]]]) -> dict[str, Any]:
    if len(frames) > MAX_FRAMES:
        msg = f"{len(frames)} frames, at most {MAX_FRAMES} are read; cut the clip"
        raise ValueError(msg)
    layout = next(_layout_of(content, bodies[0]) for bodies in frames if bodies)
    assert layout is not None
    named = who_is_who([(name_of(body), _place_of(content, body, layout)) for body in bodies] for bodies in frames)
    persons: dict[str, list[tuple[int, Mapping[Key, Any]]]] = {}
    for number, (bodies, names) in enumerate(zip(frames, named, strict=True)):
        for name, body in zip(names, bodies, strict=True):
            if persons.get(name, [(-1, body)])[-1][0] != number:
                persons.setdefault(name, []).append((number, body))
    return {name: _stacked(content, layout, seen) for name, seen in persons.items()}


def filled(
    poses: NDArray[np.float64], transl: NDArray[np.float64], frames: NDArray[Any], notes: list[str]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The frames that a tracker has lost in between, on the shorter arc between those around them."""
    at = frames.reshape(-1)
    gaps = np.diff(at) if at.dtype.kind in "iu" and len(at) == len(poses) else np.zeros(0)
    if not len(gaps) or (gaps == 1).all() or gaps.min() < 1 or at[-1] - at[0] >= MAX_FRAMES:
        return poses, transl
    if not (np.isfinite(poses).all() and np.isfinite(transl).all()):
        return poses, transl
    wanted = np.arange(at[0], at[-1] + 1)
    joints = [Slerp(at, Rotation.from_rotvec(poses[:, j]))(wanted).as_rotvec() for j in range(poses.shape[1])]
    notes.append(f"{len(wanted) - len(at)} of {len(wanted)} frames are missing: interpolated")
    return np.stack(joints, 1), np.stack([np.interp(wanted, at, transl[:, k]) for k in range(3)], 1)


def _rows_apart(content: Content) -> Content:
    """Of a dictionary by the image's name, the rows of whose arrays are people: a list of them an image."""
    for _, node in content.nodes():
        if not node or not all(isinstance(key, str) and key.lower().endswith(_IMAGES) for key in node):
            continue
        return Content({image: _rows(content, entries(seen) or {}) for image, seen in node.items()})
    return content


def _rows(content: Content, seen: Mapping[Key, Any]) -> Any:
    layout = next((one for one in table.LAYOUTS if all(seen.get(name) is not None for name in one.pose)), None)
    if layout is None or _layout_of(content, seen) is not None:
        return seen
    n = len(content.array(seen[layout.pose[0]]))
    names = (*layout.pose, *layout.transl, *layout.betas, *table.TRACK_IDS, "track_ids")
    arrays = {name: content.array(seen[name]) for name in names if seen.get(name) is not None}
    split = {name: array for name, array in arrays.items() if array.ndim and len(array) == n}
    return [
        {
            ("track_id" if row.ndim == 0 else name): int(row) if row.ndim == 0 else row
            for name, row in ((name, array[i]) for name, array in split.items())
        }
        for i in range(n)
    ]


def _layout_of(content: Content, node: Mapping[Key, Any]) -> table.Layout | None:
    """The layout of which a mapping has one frame."""
    for layout in table.LAYOUTS:
        if layout.is_time_last or not all(node.get(name) is not None for name in layout.pose):
            continue
        try:
            shapes = [content.array(node[name]).shape for name in layout.pose]
        except ValueError:
            continue
        if all(map(is_one_frame, shapes, layout.joints)):
            return layout
    return None


def _place_of(content: Content, body: Mapping[Key, Any], layout: table.Layout) -> np.ndarray[Any, Any]:
    """The translation, NaN where there is none, shape (3,)."""
    value = next((body[name] for name in layout.transl if body.get(name) is not None), None)
    place = np.full(3, np.nan) if value is None else content.array(value)
    return place.reshape(3).astype(np.float64) if place.size == 3 and place.dtype.kind in "iuf" else np.full(3, np.nan)


def _stacked(content: Content, layout: table.Layout, seen: list[tuple[int, Mapping[Key, Any]]]) -> dict[Key, Any]:
    """One person's arrays, a row a frame; what isn't in every frame is left out."""
    track: dict[Key, Any] = {"frame_ids": np.array([number for number, _ in seen])}
    track |= {key: seen[0][1][key] for key in (*table.GENDERS, *table.MODELS) if seen[0][1].get(key) is not None}
    for name in (*layout.pose, *layout.transl, *layout.betas):
        rows = [body.get(name) for _, body in seen]
        if any(row is None for row in rows):
            continue
        flat = [content.array(row).reshape(-1) for row in rows]
        if len({len(row) for row in flat}) > 1:
            msg = f"{name} has {len(flat[0])} numbers in one frame and others in another"
            raise ValueError(msg)
        track[name] = np.stack(flat)
    return track


def _ids(content: Content, value: Any) -> list[int]:
    return [int(number) for number in content.array(value).reshape(-1)] if len(value or ()) else []
