"""Motion of a body that isn't SMPL, from the places of its points: SMPL's skeleton follows them like keypoints.

So is MHR followed, the body of SAM 3D Body: by the keypoints beside its parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core.keypoints import KeypointTracker, Proportions, Skeleton, TrackerSettings, layout_of
from refu_core.keypoints._layouts import POINTS_OF
from refu_core.recordings._recording import Recording, tell_pace
from refu_core.recordings._upright import Axes, to_smpl
from refu_core.skeleton import PARENTS

_FIT = 100  # frames that a person's shape is taken from
_QUICK = TrackerSettings(smoothing=0.5)
"""A file's joints have no noise that would have to be smoothed away."""
_UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254, "CMU's units": 0.0254 / 0.45}
_LEG = 0.82
"""Length of the mean body's leg, from hip to knee to ankle [m]."""
_LEGS = (0.45, 1.1)
"""Shortest and longest leg of a person [m]; a unit that gives any other length can't be the file's."""
SMPL_POINTS = tuple(POINTS_OF["smpl24"].split()[:22])
"""SMPL's joints that SMPL-H and SMPL-X also have, by their names in the keypoint layouts."""
_OF_SMPL = {"pelvis": "smpl_pelvis", "spine_low": "smpl_spine1", "spine_mid": "smpl_spine2"}
_OF_SMPL |= {"spine_high": "smpl_spine3", "neck": "smpl_neck", "head": "smpl_head"}
_OF_SMPL |= {"l_clavicle": "l_smpl_collar", "r_clavicle": "r_smpl_collar"}
_RAISED = 0.119
"""How high SMPL's pelvis is above the middle of its hips, as a share of the legs; the built-in bodies' is at 0.006."""
_BONES = (0.4, 2.5)
"""Least and greatest ratio of a bone's length to the mean body's, each taken as a share of the length of the legs."""
_TRUNK = [SMPL_POINTS.index(name) - 1 for name in ("spine_low", "spine_mid", "spine_high", "neck")]
_NOTHING = 1e-3  # least length of the legs, in the file's unit: bodies of zeros have none

N_KEYPOINTS = 70
_MHR = "nose l_eye r_eye l_ear r_ear l_shoulder r_shoulder l_elbow r_elbow l_hip r_hip l_knee r_knee l_ankle r_ankle "
_MHR += "l_big_toe l_small_toe l_heel r_big_toe r_small_toe r_heel"
_PLACES = dict(zip(_MHR.split(), range(21), strict=True))
_PLACES |= {"r_index": 28, "r_pinky": 40, "r_wrist": 41, "l_index": 49, "l_pinky": 61, "l_wrist": 62, "neck": 69}
"""Which of MHR's 70 keypoints each point of the keypoint layouts is; on a hand the knuckles, since fingers bend."""
MHR_POINTS = tuple(_PLACES)


def follow(
    points: Sequence[str],
    places: NDArray[np.float64],
    *,
    fps: float,
    axes: Axes,
    usual: Axes,
    worn: Proportions | None,
    notes: list[str],
    betas: NDArray[np.float64] | None = None,
) -> Recording:
    """The motion of a person whose `points`, named as in the keypoint layouts, are at `places` (T, K, 3) [m].

    A point that isn't seen is NaN. The `betas`, if they aren't known, are fitted to the body `worn`, or to the neutral
    body if that isn't given. Every assumption is added to `notes`, which go into the recording.

    Raises `ValueError` if no frame shows a person.
    """
    known_body = Proportions.builtin("neutral") if worn is None else worn
    skeleton = Skeleton(layout_of("recording", tuple(points)), known_body)
    if betas is None:
        some = np.linspace(0, len(places) - 1, min(_FIT, len(places))).astype(int)
        shapes = [KeypointTracker(skeleton).update(places[i], 0) for i in some]
        known = [frame.betas for frame in shapes if frame is not None]
        if not known:
            raise ValueError("its joints are in no order that a person's are in")
        betas = np.median(known, axis=0)
    track = KeypointTracker(skeleton, betas=betas, settings=_QUICK)
    frames = [track.update(place, round(1e9 * i / fps)) for i, place in enumerate(places)]
    poses = np.stack([np.full((24, 3), np.nan) if frame is None else frame.pose for frame in frames])
    transl = np.stack([np.full(3, np.nan) if frame is None else frame.transl for frame in frames])
    pelvis = known_body.of(betas.astype(np.float64))[0]
    roots = poses[:, 0].astype(np.float64)
    poses[:, 0], transl = to_smpl(roots, transl, axes, notes, usual=usual, pelvis=pelvis)
    tell_pace(transl, fps, notes, has_unit=True)
    is_fitted = worn is not None
    return Recording(
        poses.astype(np.float32), transl, betas.astype(np.float32), fps, "neutral", tuple(notes), is_fitted
    )


def are_places(array: NDArray[np.float64]) -> bool:
    """Whether an array (T, n, 3) holds places of SMPL's joints: in every frame, the bones between them are a person's.

    Rotation vectors have the same shape, and files of places, HumanML3D's and others', have no name that tells the two
    apart.
    """
    low, high = _BONES
    n = min(len(SMPL_POINTS), array.shape[1])
    child = np.arange(1, n)
    parent = np.array(PARENTS)[child]
    bones = np.linalg.norm(array[:, child] - array[:, parent], axis=-1)
    legs = bones[:, [3, 4, 6, 7]].sum(axis=1)
    if not np.nanmin(legs, initial=np.inf) > _NOTHING:
        return False
    known = Proportions.builtin("neutral").joints
    lengths = np.linalg.norm(known[child] - known[parent], axis=-1)
    share = _joined(bones) / legs[:, None] / (_joined(lengths) / lengths[[3, 4, 6, 7]].sum())
    return bool((~(share < low) & ~(share > high)).all())


def _joined(bones: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths of bones (..., n) with those of the trunk as one, for betas move its joints along it."""
    trunk = bones[..., _TRUNK].sum(axis=-1, keepdims=True)
    return np.concatenate((np.delete(bones, _TRUNK, axis=-1), trunk), axis=-1)


def whose_joints(places: NDArray[np.float64], worn: Proportions | None) -> tuple[str, ...]:
    """`SMPL_POINTS` as the points of the keypoint layouts that joints at `places` (T, n, 3) are.

    They are those of the body `worn`, by default the neutral one, or of SMPL, whose trunk has its joints elsewhere.
    """

    def raised(joints: NDArray[np.float64]) -> float:
        middle = joints[:, 1:3].mean(axis=1)
        bones = [joints[:, 0] - middle, *(joints[:, a] - joints[:, b] for a, b in ((1, 4), (4, 7)))]
        height, thigh, shank = np.nanmedian(np.linalg.norm(bones, axis=-1), axis=1)
        return float(height / (thigh + shank))

    own = raised((Proportions.builtin("neutral") if worn is None else worn).joints[None])
    found = raised(places)
    if abs(found - own) <= abs(found - _RAISED):
        return SMPL_POINTS
    return tuple(_OF_SMPL.get(point, point) for point in SMPL_POINTS)


def metres_of(points: Sequence[str], places: NDArray[np.float64], notes: list[str]) -> float:
    """Metres per unit of points (K, 3): with it the legs are as long as a person's. Adds the unit to `notes`.

    Raises `ValueError` if the legs have no length.
    """
    at = dict(zip(points, places, strict=True))
    ends = ("l_hip", "l_knee", "l_ankle") if "l_ankle" in at else ("l_hip", "l_knee")
    leg = sum(float(np.linalg.norm(at[a] - at[b])) for a, b in pairwise(ends))
    leg *= 1.0 if len(ends) == 3 else 2.0
    if not leg > 0:
        raise ValueError("its legs have no length")
    unit = min(_UNITS, key=lambda name: abs(np.log(leg * _UNITS[name] / _LEG)))
    scale = _UNITS[unit]
    if not _LEGS[0] <= leg * scale <= _LEGS[1]:
        notes.append(f"no unit makes its legs as long as people's: scaled so that they are {_LEG:g} m")
        return _LEG / leg
    notes.append(f"taken as {unit}: its legs are {leg * scale:.2f} m long")
    return scale


def is_of_mhr(keypoints: NDArray[Any]) -> bool:
    """Whether these are frames of MHR's 70 keypoints: most estimators write other ones under that name."""
    return keypoints.dtype.kind in "iuf" and keypoints.shape[1:] in ((N_KEYPOINTS, 3), (3 * N_KEYPOINTS,))


def places_of_mhr(
    keypoints: NDArray[Any], place: NDArray[np.float64], at: NDArray[np.int64] | None
) -> NDArray[np.float64]:
    """Places of `MHR_POINTS` [m], shape (T, K, 3), NaN in frames in which the person was lost.

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
