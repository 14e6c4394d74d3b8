"""MHR as SAM 3D Body writes it: a body that isn't SMPL's is followed by the keypoints beside its parameters.

For each image there is a list of persons, each with 70 keypoints about the body and the body's place before the camera.
People save lists of those lists, dictionaries by image, or the arrays of one person stacked; all of them are read.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from refu_core.recordings._containers import Content, Key
from refu_core.recordings._layouts import KEYPOINTS, KEYPOINTS_PLACE
from refu_core.recordings._people import name_of, sequences, who_is_who
from refu_core.recordings._rate import MAX_FRAMES

Array = NDArray[np.float64]

_N_KEYPOINTS = 70
_BODY = "nose l_eye r_eye l_ear r_ear l_shoulder r_shoulder l_elbow r_elbow l_hip r_hip l_knee r_knee l_ankle r_ankle "
_BODY += "l_big_toe l_small_toe l_heel r_big_toe r_small_toe r_heel"
_PLACES = dict(zip(_BODY.split(), range(21), strict=True))
_PLACES |= {"r_index": 28, "r_pinky": 40, "r_wrist": 41, "l_index": 49, "l_pinky": 61, "l_wrist": 62, "neck": 69}
"""Which of the 70 are points of the keypoint layouts; of a hand its knuckles, as fingers bend."""
_HIPS = [_PLACES["l_hip"], _PLACES["r_hip"]]

POINTS = tuple(_PLACES)


class Track(NamedTuple):
    """One person."""

    name: str
    places: Array
    """Of `POINTS`, NaN in frames without the person [m], shape (T, K, 3)."""
    stays: bool
    """Whether the file doesn't say where the person is."""


def tracks_of_mhr(content: Content) -> list[Track]:
    """The persons of a file of MHR keypoints, none where a file isn't such.

    Raises `ValueError` for keypoints and places that don't fit each other.
    """
    for frames in sequences(content.root, _is_body):
        if len(frames) > MAX_FRAMES:
            msg = f"{len(frames)} frames, at most {MAX_FRAMES} are read; cut the clip"
            raise ValueError(msg)
        found = [[seen for body in bodies if (seen := _seen(content, body)) is not None] for bodies in frames]
        if any(found):
            return _tracks(found)
    return []


class _Seen(NamedTuple):
    name: str
    places: Array  # (T, K, 3)
    stays: bool


def _is_body(value: Mapping[Key, Any]) -> bool:
    return value.get(KEYPOINTS) is not None


def _seen(content: Content, body: Mapping[Key, Any]) -> _Seen | None:
    """None for other keypoints: most estimators have some of that name."""
    points = content.array(body[KEYPOINTS])
    if points.dtype.kind not in "iuf" or points.shape[-2:] != (_N_KEYPOINTS, 3) or points.ndim > 3:
        return None
    points = points.reshape(-1, _N_KEYPOINTS, 3).astype(np.float64)
    place = body.get(KEYPOINTS_PLACE)
    if place is not None:
        transl = content.array(place)
        if transl.dtype.kind not in "iuf" or transl.size != 3 * len(points):
            msg = f"{KEYPOINTS_PLACE} must be ({len(points)}, 3) like the keypoints, got {transl.dtype} {transl.shape}"
            raise ValueError(msg)
        points = points + transl.reshape(-1, 1, 3)
    return _Seen(name_of(body), points[:, list(_PLACES.values())], place is None)


def _tracks(frames: list[list[_Seen]]) -> list[Track]:
    """Who of each image is whom: by name, else whoever is nearest to where they were."""
    whole = [seen for bodies in frames for seen in bodies if len(seen.places) > 1]
    if whole:
        return [Track(seen.name or str(i), seen.places, seen.stays) for i, seen in enumerate(whole)]
    places: dict[str, Array] = {}
    named = who_is_who([(seen.name, seen.places[0, _HIPS].mean(axis=0)) for seen in bodies] for bodies in frames)
    for number, (bodies, names) in enumerate(zip(frames, named, strict=True)):
        for seen, name in zip(bodies, names, strict=True):
            empty = np.full((len(frames), len(_PLACES), 3), np.nan)
            places.setdefault(name, empty)[number] = seen.places[0]
    stays = any(seen.stays for bodies in frames for seen in bodies)
    return [Track(name, _cut(own), stays) for name, own in places.items()]


def _cut(places: Array) -> Array:
    """From the first frame with the person to the last."""
    there = np.flatnonzero(np.isfinite(places).any(axis=(1, 2)))
    return places[there[0] : there[-1] + 1]
