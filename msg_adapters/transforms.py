"""tf2_msgs/TFMessage in CDR, and a buffer of transforms that tells where a frame was at a given time."""

from __future__ import annotations

import math
import time
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation, Slerp

from msg_adapters.cdr import Buffer, CdrReader, CdrWriter
from msg_adapters.errors import EncodeError, TransformError
from refu_core.frames import PLAUSIBLE_TRANSL, SET_BACK_NS

TF_MESSAGE = "tf2_msgs/msg/TFMessage"
HISTORY_NS = 10 * 10**9
"""How far back transforms are kept, as in tf2 [ns]."""
_MOST_FRAMES, _MOST_STAMPS = 10_000, 1_000_000
"""The most frames, and the most stamps of all frames together, 265 bytes each: both are up to the sender."""
_MOST_OWN = 10_000
"""The most stamps of one frame within the history; fewer where there are more than a hundred frames."""
_LONGEST_NAME = 255
"""Of a frame [characters], as in the node's parameter: names of a megabyte each would fill the memory."""
_LONGEST_WAY = 100
"""Longest chain of parents. Robots have a few dozen; the chain is followed anew for each input."""
_UNIT_TOLERANCE = 1e-2
"""How far a quaternion's length may be from 1, as in tf2."""
_DISCOVERY_S = 1.0
"""How long no transforms are missed: on a busy machine, the first came 0.07 to 0.18 s after they were asked for [s]."""
ALWAYS_NS = 2**63 - 1
"""Until when a way of static transforms alone is known [ns]."""
_MIN_TRANSFORM_BYTES = 72


@dataclass(frozen=True, eq=False)
class Transform:
    """Where a child frame is in its parent: geometry_msgs/TransformStamped."""

    stamp_ns: int
    parent: str
    child: str
    translation: ArrayLike
    """[m], shape (3,)."""
    quaternion: ArrayLike
    """xyzw, shape (4,)."""


def quaternion_from_matrix(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """The unit quaternion xyzw with w >= 0, shape (4,), of a rotation (3, 3). Raises `EncodeError` for others."""
    try:
        return Rotation.from_matrix(matrix).as_quat(canonical=True)
    except (ValueError, np.linalg.LinAlgError) as error:
        raise EncodeError(f"wanted a rotation, got {matrix.tolist()}") from error


def encode_transforms(transforms: Sequence[Transform]) -> bytes:
    """A `tf2_msgs/TFMessage`. Raises `EncodeError` for a stamp that doesn't fit a ROS time."""
    writer = CdrWriter()
    writer.fields("I", len(transforms))
    for one in transforms:
        writer.fields("Tss", one.stamp_ns, one.parent, one.child)
        writer.array("f8", one.translation)
        writer.array("f8", one.quaternion)
    return writer.to_bytes()


def decode_transforms(data: Buffer) -> tuple[list[tuple[Any, ...]], NDArray[np.float64]]:
    """Stamp [ns], parent and child of each transform, and translations [m] with quaternions, shape (N, 7).

    Raises `DecodeError` for anything that isn't a `tf2_msgs/TFMessage`.
    """
    reader = CdrReader(data)
    headers, values = [], []
    for _ in reader.items(item_bytes=_MIN_TRANSFORM_BYTES):
        headers.append(reader.fields("Tss"))
        values.append(reader.array("f8", 7))
    reader.finish()
    return headers, np.array(values, np.float64).reshape(-1, 7)


@dataclass(frozen=True, eq=False)
class Placement:
    """Takes points of one frame to another: p ↦ `rotation` p + `translation`."""

    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    """Shape (3, 3)."""
    translation: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    """[m], shape (3,)."""
    is_late: bool = False
    """Whether the newest transform was older than the time asked for."""

    def after(self, inner: Placement) -> Placement:
        """The placement that applies first `inner`, then this."""
        translation = self.rotation @ inner.translation + self.translation
        return Placement(self.rotation @ inner.rotation, translation, self.is_late or inner.is_late)

    def inverse(self) -> Placement:
        return Placement(self.rotation.T, -(self.rotation.T @ self.translation), self.is_late)


@dataclass(eq=False)
class _Track:
    """Transforms of one child frame, oldest first: the one that came last, and those with older stamps before it."""

    parent: str
    is_static: bool
    stamps: list[int] = field(default_factory=list)
    values: list[NDArray[np.float64]] = field(default_factory=list)
    """Translation and quaternion, shape (7,) each."""
    came: float = 0.0
    """When the newest came, by the buffer's clock [s]."""
    set_back: float = -math.inf
    """When time was set back, as these tell [s]: what came of other frames before is of another time."""

    def put(self, stamp_ns: int, value: NDArray[np.float64], *, most: int) -> None:
        # A transform with an older stamp replaces all later ones: a simulation was reset, or a bag begins again.
        at = 0 if self.is_static else bisect_left(self.stamps, stamp_ns)
        del self.stamps[at:], self.values[at:]
        self.stamps.append(stamp_ns)
        self.values.append(value)
        old = max(bisect_left(self.stamps, stamp_ns - HISTORY_NS), len(self.stamps) - most)
        del self.stamps[:old], self.values[:old]

    def at(self, stamp_ns: int, tolerance_ns: int, child: str) -> Placement:
        """The placement at that time, between the two transforms around it. Raises `TransformError`."""
        after, is_late = bisect_right(self.stamps, stamp_ns), False
        if self.is_static or self.stamps[after - 1 if after else 0] == stamp_ns:
            value = self.values[max(after - 1, 0)]
        elif after == len(self.stamps):
            lag = stamp_ns - self.stamps[-1]
            if lag > tolerance_ns:
                raise TransformError(f"the newest transform of {child} is {1e-9 * lag:.3f} s older than the input")
            value, is_late = self.values[-1], True
        elif after == 0:
            lag = self.stamps[0] - stamp_ns
            raise TransformError(f"the oldest transform of {child} is {1e-9 * lag:.3f} s newer than the input")
        else:
            value = _between(self.values[after - 1 : after + 1], self.stamps[after - 1 : after + 1], stamp_ns)
        return Placement(Rotation.from_quat(value[3:]).as_matrix(), value[:3], is_late)


def _between(values: Sequence[NDArray[np.float64]], stamps: Sequence[int], stamp_ns: int) -> NDArray[np.float64]:
    (start, end), fraction = values, (stamp_ns - stamps[0]) / (stamps[1] - stamps[0])
    turn = Slerp([0.0, 1.0], Rotation.from_quat([start[3:], end[3:]]))(fraction).as_quat()
    return np.concatenate([start[:3] + fraction * (end[:3] - start[:3]), turn])


class TransformBuffer:
    """The transforms of `/tf` and `/tf_static` of the last ten seconds. Not thread-safe.

    A frame of `/tf` is forgotten when no transform of it has come for `HISTORY_NS` by the `clock` [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._tracks: dict[str, _Track] = {}
        self._clock, self._forget_at, self._since = clock, 0.0, clock()
        self._heard: set[str] = set()
        """Frames that were heard of since others were last forgotten."""

    def __len__(self) -> int:
        return len(self._tracks)

    @property
    def is_new(self) -> bool:
        """Whether transforms can't be missed yet: publishers are only being discovered."""
        return self._clock() < self._since + _DISCOVERY_S

    @property
    def is_full(self) -> bool:
        """Whether no further frame is accepted."""
        return len(self) >= _MOST_FRAMES

    def put(self, data: Buffer, *, is_static: bool) -> list[str]:
        """Takes a `tf2_msgs/TFMessage`; returns which of its transforms are left out, and why.

        Raises `DecodeError` for anything that isn't such a message.
        """
        (headers, values), now = decode_transforms(data), self._clock()
        if now >= self._forget_at:
            self._tracks = {name: one for name, one in self._tracks.items() if one.is_static or name in self._heard}
            self._heard, self._forget_at = set(), now + 1e-9 * HISTORY_NS
        values[~(np.abs(values) <= PLAUSIBLE_TRANSL).all(1)] = np.nan
        lengths = np.linalg.norm(values[:, 3:], axis=1)
        values[:, 3:] /= np.where(lengths == 0, 1, lengths)[:, None]
        refused = []
        for (stamp_ns, parent, child), value, length in zip(headers, values, lengths.tolist(), strict=True):
            if why := self._take(stamp_ns, parent.lstrip("/"), child.lstrip("/"), value, length, is_static):
                refused.append(f"{child!r} in {parent!r}, {why}")
        return refused

    def _take(
        self, stamp_ns: int, parent: str, child: str, value: NDArray[np.float64], length: float, is_static: bool
    ) -> str:
        """Takes a transform whose quaternion had a `length`, NaN where a number isn't plausible, or returns why not."""
        if not parent or not child or parent == child:
            return "which aren't two frames"
        if max(len(parent), len(child)) > _LONGEST_NAME:
            return f"whose names are longer than {_LONGEST_NAME} characters"
        if math.isnan(length):
            return f"which has numbers that aren't finite or beyond {PLAUSIBLE_TRANSL:g}"
        if abs(length - 1.0) > _UNIT_TOLERANCE:
            return f"which is no rotation: wanted a quaternion of length 1, got {length:.3g}"
        if child not in self._tracks and self.is_full:
            return f"which would be more than {len(self)} frames"
        track, now = self._tracks.get(child), self._clock()
        if track is None or track.parent != parent or track.is_static != is_static:
            track = self._tracks[child] = _Track(parent, is_static)
        elif not is_static and stamp_ns < track.stamps[-1] - SET_BACK_NS:
            track.set_back = now
        track.came = now
        track.put(stamp_ns, value.copy(), most=min(_MOST_OWN, _MOST_STAMPS // len(self)))
        self._heard.add(child)
        return ""

    def rewind(self) -> None:
        """Forgets all that moves, as tf2 does: the clock was set back, and the same stamps are of another time now."""
        self._tracks = {name: one for name, one in self._tracks.items() if one.is_static}
        self._since = self._clock()

    def lookup(self, target: str, source: str, stamp_ns: int, *, tolerance_ns: int = 0) -> Placement:
        """Where points of `source` were in `target` at that time.

        If that time's transform hasn't come yet, the newest is used, unless it is older by more than the tolerance.

        Raises `TransformError`: no way leads from one to the other, or not at that time, or they hang in a ring.
        """
        up, down = self._ways(target, source)
        ends = []
        for way in (up, down):
            placement = Placement()
            for child in way:
                placement = self._tracks[child].at(stamp_ns, tolerance_ns, child).after(placement)
            ends.append(placement)
        return ends[1].inverse().after(ends[0])

    def known_until(self, target: str, source: str) -> int:
        """The latest time at which `lookup` needs no tolerance [ns]. Raises `TransformError` where no way leads."""
        tracks = [self._tracks[child] for way in self._ways(target, source) for child in way]
        return min((track.stamps[-1] for track in tracks if not track.is_static), default=ALWAYS_NS)

    def _ways(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """The frames below the nearest common ancestor: from the source up, and from the target up.

        Raises `TransformError` where there is none, or the way goes along a ring: which of two ways is meant?
        """
        ways = self._way(source.lstrip("/")), self._way(target.lstrip("/"))
        above = {*ways[1]}
        common = next((frame for frame in ways[0] if frame in above), None)
        up, down = (way if common is None else way[: way.index(common)] for way in ways)
        for way in ways:
            ring = self._ring(way)
            if not {*ring}.isdisjoint((*up, *down)):
                raise TransformError(f"frames form a ring, end who sends one of these: {' in '.join((*ring, ring[0]))}")
        if common is None:
            hint = f", none has come: start what sends /tf, or set frame_id to {source} if they are the same place"
            what = f"no transform leads from {source or 'a frame without a name'} to {target}"
            raise TransformError(what + hint * (not self._tracks))
        moving = {child: track for child in (*up, *down) if not (track := self._tracks[child]).is_static}
        set_back = max((track.set_back for track in moving.values()), default=0.0)
        since = set_back - _DISCOVERY_S  # one after the other they tell of the same
        if late := [child for child, one in moving.items() if one.came < set_back and one.set_back < since]:
            raise TransformError(f"time was set back, and no transform of {late[0]} has come since")
        return up, down

    def _way(self, frame: str) -> list[str]:
        """The frame and its ancestors, up to a root or, if they form a ring, once around it."""
        way = {frame: None}  # in order, and sought in no time: it is followed for each frame that waits
        while len(way) <= _LONGEST_WAY and (track := self._tracks.get(frame)) is not None and track.parent not in way:
            frame = track.parent
            way[frame] = None
        return [*way]

    def _ring(self, way: list[str]) -> list[str]:
        """The ring that a way ends in, or nothing."""
        last = self._tracks.get(way[-1])
        return [] if last is None or last.parent not in way else way[way.index(last.parent) :]
