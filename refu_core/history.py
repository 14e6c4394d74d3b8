"""How people have moved until now: how a skirt swings can't be told from a pose alone."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refu_core.errors import FrameError, require_type
from refu_core.frames import LAGS, SET_BACK_NS, SmplFrame

_MOST_PEOPLE = 64
"""How many people are remembered, those seen last; each takes half a megabyte at most."""
_CLOSEST_NS = 1_000_000_000 // 240
"""Frames closer together in time than this replace one another, so that no frame rate fills the memory."""
_FASTEST = 15.0
"""Anybody who moves faster is somebody else, or was lost and found again [m/s]; sprinters reach 12."""
_FASTEST_TURN = 12.0
"""Anybody whose root turns faster was taken for somebody else, or for facing backwards [rad/s].

In ten recorded clips (jumps, swordplay, climbing) roots reach 6.2 over `_SHORTEST`; two turns a second are a dancer's.
Half a turn from one frame to the next is faster at any rate from 4 Hz on.
"""
_SHORTEST = 1 / 30
"""Speeds are taken over at least this long [s]: queued messages are stamped on arrival, one right after another."""
_LONGEST_PAUSE = 0.25
"""Between frames farther apart than this, the motion is unknown [s]."""
_LAGS = np.array(LAGS)


class _Moment(NamedTuple):
    """A person in a frame."""

    stamp_ns: int
    rotations: NDArray[np.float64]
    """Of the joints relative to their parents, shape (24, 3, 3)."""
    transl: NDArray[np.float64]
    """[m], shape (3,)."""


class PoseHistory:
    """Adds to frames the half second before them, as `SmplFrame.past`, for pipelines with the backbone `dynamic`.

    Only the frames of that half second are kept, so nothing can drift. People are taken to have stood still before
    their first frame, and after a pause of over a quarter of a second, a clock that went back, or a leap, of place or
    direction. Frames may come at any rate from 4 Hz on, and twice: of two with the same stamp the later counts. One
    that comes late, by less than a second, is no past of others. Not thread-safe.

    `past` is the state `LAGS` ago minus the state now, shape (4, 219): nine numbers of each joint's rotation relative
    to its parent, row by row, those of the root in its own axes; then where the root was [m], in its axes, relative to
    where it would have been at the mean speed of the longest lag. It is zero for a person who stands still, and for one
    who glides: the air is taken to move along, as in the simulation.

    Example:
        >>> history = PoseHistory()
        >>> history(SmplFrame(pose=np.zeros((24, 3)))).past.any()
        np.False_
    """

    def __init__(self) -> None:
        self._people: OrderedDict[str, deque[_Moment]] = OrderedDict()

    def __call__(self, frame: SmplFrame, person: str = "") -> SmplFrame:
        """A person's next frame, with its past. Raises `FrameError` for anything but a frame and a name."""
        require_type(frame, SmplFrame, "an SmplFrame", error=FrameError)
        require_type(person, str, "a person's name", error=FrameError)
        now = _Moment(frame.stamp_ns, Rotation.from_rotvec(frame.pose.astype(np.float64)).as_matrix(), frame.transl)
        known = self._people.pop(person, None)
        if known and _CLOSEST_NS < known[-1].stamp_ns - now.stamp_ns < SET_BACK_NS:  # newer ones go on from each other
            self._people[person] = known
            before = [one for one in known if one.stamp_ns < now.stamp_ns]
            return replace(frame, past=_past([*before, now] if before and _goes_on(before[-1], now) else [now]))
        if known is None or not _goes_on(known[-1], now):
            known = deque()
        while known and now.stamp_ns <= known[-1].stamp_ns:
            known.pop()
        if len(known) > 1 and now.stamp_ns - known[-2].stamp_ns < _CLOSEST_NS:
            known.pop()
        known.append(now)
        while len(known) > 2 and known[1].stamp_ns <= now.stamp_ns - 1e9 * LAGS[-1]:
            known.popleft()
        self._people[person] = known
        while len(self._people) > _MOST_PEOPLE:
            self._people.popitem(last=False)
        return replace(frame, past=_past(known))

    @classmethod
    def told(cls, frames: Iterable[SmplFrame]) -> list[SmplFrame]:
        """The frames of one person's motion, each with its past."""
        return [*map(cls(), frames)]

    def forget(self, person: str = "") -> None:
        """Forgets a person who has left."""
        self._people.pop(person, None)


def _goes_on(last: _Moment, now: _Moment) -> bool:
    """Whether `now` continues the motion of `last`."""
    passed = now.stamp_ns - last.stamp_ns
    seconds = max(1e-9 * passed, _SHORTEST)
    way = float(np.linalg.norm(now.transl - last.transl))
    turn = float(Rotation.from_matrix(last.rotations[0].T @ now.rotations[0]).magnitude())
    is_soon = -_CLOSEST_NS < passed <= 1e9 * _LONGEST_PAUSE
    return is_soon and way <= _FASTEST * seconds and turn <= _FASTEST_TURN * seconds


def _past(moments: Sequence[_Moment]) -> NDArray[np.float32]:
    """`SmplFrame.past` of the last of these moments, shape (4, 219)."""
    now = moments[-1]
    ages = [1e-9 * (moment.stamp_ns - now.stamp_ns) for moment in moments]
    place = np.interp(-_LAGS, ages, np.arange(len(ages)))  # before the first moment, that one
    before = place.astype(int)
    after = np.minimum(before + 1, len(ages) - 1)
    pairs = [(moments[a], moments[b], w) for a, b, w in zip(before, after, place - before, strict=True)]
    rotations = np.stack([(1 - w) * a.rotations + w * b.rotations for a, b, w in pairs])
    # Relative to where the root is now, so that far from the origin no motion is made of rounding.
    way = np.stack([(1 - w) * (a.transl - now.transl) + w * (b.transl - now.transl) for a, b, w in pairs])
    root = now.rotations[0]
    turned = rotations - now.rotations
    turned[:, 0] = root.T @ turned[:, 0]
    beside = (way - _LAGS[:, None] / _LAGS[-1] * way[-1]) @ root
    return np.concatenate((turned.reshape(len(_LAGS), -1), beside), 1).astype(np.float32)
