"""Everybody whose keypoints arrive, each with a track."""

from __future__ import annotations

from numpy.typing import ArrayLike

from refu_core.frames import SmplFrame
from refu_core.keypoints._pose import Skeleton
from refu_core.keypoints._settings import DEFAULTS, TrackerSettings
from refu_core.keypoints._tracker import KeypointTracker

_MOST = 64
"""People who are followed at once; whose keypoints haven't come for longest is forgotten."""


class People:
    """Tracks by name. Times are of two clocks: the sender's stamps, and when messages came. Not thread-safe."""

    def __init__(
        self, skeleton: Skeleton, *, betas: ArrayLike | None = None, settings: TrackerSettings = DEFAULTS
    ) -> None:
        self.skeleton = skeleton
        self._options = {"betas": betas, "settings": settings}
        self._tracks: dict[str, KeypointTracker] = {}
        self._newest: dict[str, tuple[int, int]] = {}

    def update(
        self, person: str, points: ArrayLike, *, confidence: ArrayLike | None, stamp_ns: int, now_ns: int
    ) -> SmplFrame | None:
        """A person's pose after a frame of keypoints; as `KeypointTracker.update`."""
        track = self._tracks.pop(person, None)
        if track is None:
            track = KeypointTracker(self.skeleton, **self._options)  # type: ignore[arg-type]
        self._tracks[person] = track
        self._newest[person] = stamp_ns, now_ns
        for gone in list(self._tracks)[:-_MOST]:
            del self._tracks[gone], self._newest[gone]
        return track.update(points, stamp_ns, confidence=confidence)

    def at(self, now_ns: int) -> dict[str, SmplFrame]:
        """Everybody's pose by now, as far on from their newest keypoints as these are old.

        The age is that on the receiver's clock: senders' clocks differ.
        """
        poses = {}
        for person, track in self._tracks.items():
            stamp_ns, came_ns = self._newest[person]
            frame = track.at(stamp_ns + max(0, now_ns - came_ns))
            if frame is not None:
                poses[person] = frame
        return poses
