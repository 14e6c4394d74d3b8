"""Several people's keypoints, by name and on two clocks."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from refu_core.frames import SmplFrame
from refu_core.keypoints._pose import Skeleton
from refu_core.keypoints._solver import TrackerSettings
from refu_core.keypoints._tracker import DEFAULTS, KeypointTracker

MOST_PEOPLE = 64
"""Most people followed at once; beyond that, whoever's keypoints haven't come for longest is forgotten."""


@dataclass
class _Person:
    track: KeypointTracker
    newest_ns: int
    """Stamp of the newest keypoints, by the sender's clock."""
    came_ns: int
    """When they came, by the receiver's clock."""
    went_on_ns: int
    """When a stamp was last later than the one before it."""
    last_ns: int = -1
    """The last stamp, by the sender's clock."""


class People:
    """Tracks by name. Times are of two clocks: the sender's stamps, and when messages came. Not thread-safe."""

    def __init__(
        self, skeleton: Skeleton, *, betas: ArrayLike | None = None, settings: TrackerSettings = DEFAULTS
    ) -> None:
        self.skeleton = skeleton
        self._betas, self._settings = betas, settings
        self._people: dict[str, _Person] = {}

    def update(
        self, person: str, points: ArrayLike, *, confidence: ArrayLike | None, stamp_ns: int, now_ns: int
    ) -> SmplFrame | None:
        """A person's pose after a frame of keypoints; as `KeypointTracker.update`.

        Stamps that haven't advanced for `hold` say nothing; the time at which messages come is then used instead.
        """
        one = self._people.get(person)
        if one is None:
            track = KeypointTracker(self.skeleton, betas=self._betas, settings=self._settings)
            one = _Person(track, stamp_ns, now_ns, now_ns)
        one.went_on_ns = now_ns if stamp_ns > one.last_ns else min(one.went_on_ns, now_ns)
        one.last_ns = stamp_ns
        if 1e-9 * (now_ns - one.went_on_ns) > self._settings.hold:
            stamp_ns = now_ns
        before = one.track.stamp_ns
        frame = one.track.update(points, stamp_ns, confidence=confidence)
        if one.track.stamp_ns != before:  # otherwise they were older than those that are known
            one.newest_ns, one.came_ns = stamp_ns, now_ns
        self._people.pop(person, None)
        self._people[person] = one  # the newest is the last
        for gone in list(self._people)[:-MOST_PEOPLE]:
            del self._people[gone]
        return frame

    def at(self, now_ns: int) -> dict[str, SmplFrame]:
        """Everybody's pose by now, moved on from their newest keypoints by the age of these.

        The age is measured on the receiver's clock, since senders' clocks differ. If that clock was set back by more
        than `hold`, people are forgotten until their keypoints come again.
        """
        poses = {}
        for person, one in self._people.items():
            age_ns = now_ns - one.came_ns
            if 1e-9 * age_ns < -self._settings.hold:
                one.track.reset()
            frame = one.track.at(one.newest_ns + max(0, age_ns))
            if frame is not None:
                poses[person] = frame
        return poses
