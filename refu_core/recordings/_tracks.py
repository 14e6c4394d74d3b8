"""PHALP's files (4DHumans): a dictionary a frame, with everybody who is in it; here a dictionary a person."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from refu_core.recordings._containers import Content, entries

_ARRAYS = ("global_orient", "body_pose", "betas")


def tracks_of(content: Content) -> Mapping[Any, Any] | None:
    """The persons of frames that have the lists `smpl` and `tid`, None where a file isn't such.

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


def _ids(content: Content, value: Any) -> list[int]:
    return [int(number) for number in content.array(value).reshape(-1)] if len(value or ()) else []
