"""Motion of a body that isn't SMPL, from where points of it are: SMPL's skeleton follows them as it does a tracker."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from refu_core.keypoints import KeypointTracker, Proportions, Skeleton, TrackerSettings, layout_of
from refu_core.recordings._recording import Recording
from refu_core.recordings._upright import Axes, to_smpl

_SETTINGS = TrackerSettings(noise=0.01, rest_after=1.0)
_FIT = 100  # frames that a person's shape is taken from


def follow(
    points: Sequence[str], places: NDArray[np.float64], *, fps: float, axes: Axes, usual: Axes, notes: list[str]
) -> Recording:
    """The motion of a person whose `points`, by the names of keypoint layouts, are in places (T, K, 3) [m].

    A point that isn't seen is NaN. What is taken for granted is added to `notes`, which the recording gets.

    Raises `ValueError` where no frame shows a person.
    """
    skeleton = Skeleton(layout_of("recording", tuple(points)), Proportions.builtin("neutral"))
    some = np.linspace(0, len(places) - 1, min(_FIT, len(places))).astype(int)
    shapes = [KeypointTracker(skeleton, settings=_SETTINGS).update(places[i], 0) for i in some]
    known = [frame.betas for frame in shapes if frame is not None]
    if not known:
        msg = "its joints are in no order that a person's are in"
        raise ValueError(msg)
    betas = np.median(known, axis=0)
    track = KeypointTracker(skeleton, betas=betas, settings=_SETTINGS)
    frames = [track.update(place, round(1e9 * i / fps)) for i, place in enumerate(places)]
    poses = np.stack([np.full((24, 3), np.nan) if frame is None else frame.pose for frame in frames])
    transl = np.stack([np.full(3, np.nan) if frame is None else frame.transl for frame in frames])
    roots, transl = to_smpl(poses[:, 0].astype(np.float64), transl, axes, notes, usual=usual)
    poses[:, 0] = roots
    return Recording(poses.astype(np.float32), transl, betas.astype(np.float32), fps, "neutral", tuple(notes))
