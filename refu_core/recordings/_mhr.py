"""MHR as SAM 3D Body writes it: not SMPL's body, so the keypoints beside its parameters are followed instead."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

N_KEYPOINTS = 70
_BODY = "nose l_eye r_eye l_ear r_ear l_shoulder r_shoulder l_elbow r_elbow l_hip r_hip l_knee r_knee l_ankle r_ankle "
_BODY += "l_big_toe l_small_toe l_heel r_big_toe r_small_toe r_heel"
_PLACES = dict(zip(_BODY.split(), range(21), strict=True))
_PLACES |= {"r_index": 28, "r_pinky": 40, "r_wrist": 41, "l_index": 49, "l_pinky": 61, "l_wrist": 62, "neck": 69}
"""Which of the 70 each point of the keypoint layouts is; on a hand they are the knuckles, since fingers bend."""
POINTS = tuple(_PLACES)


def is_of_mhr(keypoints: NDArray[Any]) -> bool:
    """Whether these are frames of MHR's 70 keypoints: most estimators write other ones under that name."""
    return keypoints.dtype.kind in "iuf" and keypoints.shape[1:] in ((N_KEYPOINTS, 3), (3 * N_KEYPOINTS,))


def places_of_mhr(
    keypoints: NDArray[Any], place: NDArray[np.float64], at: NDArray[np.int64] | None
) -> NDArray[np.float64]:
    """Places of `POINTS` [m], shape (T, K, 3), NaN in frames in which the person was lost.

    Args:
        keypoints: relative to the body [m], (N, 70, 3) or (N, 210).
        place: of the body [m], (N, 3).
        at: which of the T frames they are, (N,); None for all.
    """
    seen = keypoints.reshape(-1, N_KEYPOINTS, 3).astype(np.float64)[:, list(_PLACES.values())] + place[:, None]
    if at is None:
        return seen
    places = np.full((int(at[-1]) + 1, *seen.shape[1:]), np.nan)
    places[at] = seen
    return places
