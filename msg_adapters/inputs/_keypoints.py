"""3D keypoints of people: geometry_msgs/PoseArray and visualization_msgs/MarkerArray to points and confidences.

A PoseArray is one person; a pose's position is a keypoint, its orientation isn't read. In a MarkerArray a person is a
SPHERE_LIST, CUBE_LIST or POINTS with all keypoints, or spheres (or cubes) with the ids 100 * person + keypoint, as the
driver of Azure Kinect sends them; lines and texts are ignored. Alpha is the confidence. A keypoint that isn't seen
is NaN, or exactly zero in all of x, y, z.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from msg_adapters.cdr import Buffer
from msg_adapters.errors import DecodeError, decoding
from msg_adapters.inputs._pose_array import MESSAGE_TYPE, read_poses
from msg_adapters.markers import MARKER_ARRAY, Marker, decode_marker_array

KEYPOINT_TYPES: dict[str, str] = {"keypoint_poses": MESSAGE_TYPE, "keypoint_markers": MARKER_ARRAY}

_CUBE, _SPHERE, _ADD = 1, 2, 0
_LISTS = (6, 7, 8)  # CUBE_LIST, SPHERE_LIST, POINTS
_PERSON = 100
"""How many marker ids each person has."""
_LONGEST_NAME = 60
_Key = tuple[str, int]
"""Namespace and number of a person among markers."""


@dataclass(frozen=True, eq=False)
class Keypoints:
    """One person's keypoints."""

    points: NDArray[np.float64]
    """[m] in the axes of `frame_id`, shape (K, 3); NaN where not seen."""
    confidence: NDArray[np.float64]
    """As the message has it, shape (K,); ones where it has none."""
    stamp_ns: int
    """0 where the message has none."""
    frame_id: str


def decode_keypoints(input_type: str, data: Buffer, n: int) -> dict[str, Keypoints]:
    """Everybody's keypoints, `n` each, by name, in a CDR message of one of `KEYPOINT_TYPES`; an empty one has nobody.

    A person's name comes from the namespace: a letter, then letters, digits and underscores; a number tells persons of
    one namespace apart. It is empty for a PoseArray and for a single person without a namespace.

    Raises `DecodeError`: damaged bytes, another number of keypoints, no keypoints among the markers.
    """
    with decoding(KEYPOINT_TYPES[input_type]):
        return _of_poses(data, n) if input_type == "keypoint_poses" else _of_markers(decode_marker_array(data), n)


def _of_poses(data: Buffer, n: int) -> dict[str, Keypoints]:
    stamp_ns, frame_id, poses = read_poses(data)
    if not len(poses):
        return {}
    _check_count(len(poses), n, "poses")
    return {"": _keypoints(poses[:, :3], np.ones(n), stamp_ns, frame_id)}


def _of_markers(markers: Sequence[Marker], n: int) -> dict[str, Keypoints]:
    people: dict[_Key, Keypoints] = {}
    loose: dict[_Key, list[Marker]] = {}
    shown = [marker for marker in markers if marker.action == _ADD]
    lists = [marker for marker in shown if marker.type in _LISTS]
    several = len({marker.ns for marker in lists}) < len(lists)
    for marker in lists:
        _check_count(len(marker.points), n, "points")
        alpha = marker.colors[:, 3] if len(marker.colors) == n else np.full(n, 1.0)
        seen = _keypoints(marker.points, alpha, marker.stamp_ns, marker.frame_id)
        people[marker.ns, marker.id if several else 0] = replace(seen, points=marker.placed(seen.points))
    for marker in shown:
        if marker.type in (_CUBE, _SPHERE):
            loose.setdefault((marker.ns, marker.id // _PERSON), []).append(marker)
    for key, found in loose.items():
        points, alpha = np.full((n, 3), np.nan), np.zeros(n)
        for marker in found:
            which = marker.id % _PERSON
            if which >= n:
                msg = f"the marker {marker.ns}/{marker.id} is keypoint {which}, wanted 0 to {n - 1}; set keypoints"
                raise DecodeError(msg)
            points[which], alpha[which] = marker.pose[:3], marker.color[3]
        people.setdefault(key, _keypoints(points, alpha, found[0].stamp_ns, found[0].frame_id))
    if shown and not people:
        msg = f"{len(shown)} markers, none of them keypoints; wanted a SPHERE_LIST or POINTS a person, or spheres"
        raise DecodeError(msg)
    return _named(people)


def _check_count(count: int, n: int, what: str) -> None:
    if count != n:
        msg = f"wanted {n} {what}, one for each keypoint, got {count}; set keypoints to the tracker's layout"
        raise DecodeError(msg)


def _keypoints(points: NDArray[np.float64], confidence: NDArray[np.floating], stamp: int, frame_id: str) -> Keypoints:
    seen = np.array(points, np.float64)
    seen[~seen.any(axis=1)] = np.nan
    return Keypoints(seen, np.asarray(confidence, np.float64), stamp, frame_id)


def _named(people: dict[_Key, Keypoints]) -> dict[str, Keypoints]:
    """Everybody by name: whoever has another's (as `1a` has that of `person_1a`) is told apart by a checksum."""
    found: dict[str, Keypoints] = {}
    for key in sorted(people, key=lambda key: (_name(*key) != key[0], key)):  # who is called so keeps the name
        name = _name(*key)
        found[f"{name}_{zlib.crc32(repr(key).encode()):08x}" if name in found else name] = people[key]
    return found


def _name(namespace: str, number: int) -> str:
    """A person's name in a form that garments' namespaces and topics allow."""
    word = re.sub(r"\W", "_", namespace, flags=re.ASCII)[:_LONGEST_NAME]
    if word != namespace:  # so that names that differ only in replaced characters stay different
        word = f"{word}_{zlib.crc32(namespace.encode()):08x}"
    if word and not word[0].isalpha():
        word = f"person_{word}"
    return f"{word or 'person'}_{number % (1 << 32)}" if number else word  # a topic's name has no minus
