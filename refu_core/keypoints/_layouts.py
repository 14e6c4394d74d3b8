"""Which point of the body each keypoint of a tracker is: the table of layouts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from refu_core.errors import RefuError
from refu_core.skeleton import JOINT_NAMES as SMPL_JOINTS


class _Point(NamedTuple):
    joint: str
    """The joint that carries it."""
    offset: tuple[float, float, float] = (0, 0, 0)
    """[m] in the T-pose, in SMPL's axes."""
    along: float | None = None
    """It is that far from the joint, or else from this share of the way from between the hips to between the shoulders:
    bodies have the joints of their spines in other places, SMPL's and the built-in ones up to 8 cm."""


_POINTS: dict[str, _Point] = {
    "pelvis": _Point("pelvis"),
    "spine_low": _Point("spine1"),
    "spine_mid": _Point("spine2"),
    "spine_high": _Point("spine3"),
    "neck": _Point("neck"),
    "head": _Point("head"),
    "head_top": _Point("head", (0, 0.15, 0.01)),
    "nose": _Point("head", (0, 0.005, 0.12)),
    "l_eye": _Point("head", (0.032, 0.045, 0.095)),
    "l_ear": _Point("head", (0.080, 0.040, 0.0)),
    "l_mouth": _Point("head", (0.025, -0.035, 0.10)),
    "l_clavicle": _Point("left_collar"),
    "l_shoulder": _Point("left_shoulder"),
    "l_elbow": _Point("left_elbow"),
    "l_wrist": _Point("left_wrist"),
    "l_palm": _Point("left_hand"),
    "l_hand": _Point("left_wrist", (0.08, -0.01, 0)),
    "l_handtip": _Point("left_wrist", (0.19, -0.03, 0)),
    "l_index": _Point("left_wrist", (0.105, -0.01, 0.025)),
    "l_pinky": _Point("left_wrist", (0.095, -0.01, -0.035)),
    "l_thumb": _Point("left_wrist", (0.10, -0.03, 0.06)),
    "l_hip": _Point("left_hip"),
    "l_knee": _Point("left_knee"),
    "l_ankle": _Point("left_ankle"),
    "l_foot": _Point("left_foot"),
    "l_big_toe": _Point("left_foot", (-0.02, -0.005, 0.055)),
    "l_small_toe": _Point("left_foot", (0.055, -0.012, 0.0)),
    "l_heel": _Point("left_ankle", (-0.01, -0.036, -0.055)),
    "mid_hip": _Point("pelvis", along=0.0),
    "kinect_navel": _Point("pelvis", (0, 0, 0.005), 0.38),
    "kinect_chest": _Point("spine2", (0, 0, 0.015), 0.68),
    "kinect_neck": _Point("spine3", (0, 0, -0.02), 1.14),
    "kinect_head": _Point("neck", (0, 0.053, -0.01)),
    "l_kinect_clavicle": _Point("spine3", (0.03, 0, -0.02), 1.06),
    "h36m_spine": _Point("spine1", along=0.6),
    "h36m_thorax": _Point("spine3", (0, 0, 0.03), 1.18),
    "h36m_nose": _Point("neck", (0, 0.05, 0.11)),
    "h36m_head": _Point("head", (0, 0.10, 0.05)),
    "smpl_pelvis": _Point("pelvis", (0, 0, 0.012), 0.17),
    "smpl_spine1": _Point("pelvis", (0, 0, -0.006), 0.37),
    "smpl_spine2": _Point("spine1", (0, 0, 0.005), 0.62),
    "smpl_spine3": _Point("spine2", (0, 0, 0.034), 0.72),
    "smpl_neck": _Point("spine3", (0, 0, 0.007), 1.115),
    "smpl_head": _Point("neck", (0, 0.04, 0.056)),
    "l_smpl_collar": _Point("spine3", (0.08, 0, 0.007), 0.94),
    "-": _Point("pelvis"),
}
"""Points on the skin and limbs were measured on the built-in neutral body's mean shape; the right side mirrors the left
one. Those of Kinect's trunk are from 12 recordings of three people, in which they stay within 1.5 cm of their places;
Human3.6M's are from three, within 2 cm. SMPL's own joints are the neutral mean shape's, as published, but its head: on
a trunk that is shorter than SMPL's by 6 cm, somebody who stands would look up by 20°."""

_MADE, _UNSURE = "-", "?"
_HIPS, _SHOULDERS = [1, 2], [16, 17]

_COCO = "nose l_eye r_eye l_ear r_ear l_shoulder r_shoulder l_elbow r_elbow l_wrist r_wrist l_hip r_hip l_knee r_knee "
_COCO += "l_ankle r_ankle"
_KINECT = "mid_hip kinect_navel kinect_chest kinect_neck l_kinect_clavicle l_shoulder l_elbow l_wrist l_hand l_handtip "
_KINECT += "l_thumb r_kinect_clavicle r_shoulder r_elbow r_wrist r_hand r_handtip r_thumb l_hip l_knee l_ankle l_foot "
_KINECT += "r_hip r_knee r_ankle r_foot kinect_head nose l_eye l_ear r_eye r_ear"
POINTS_OF: dict[str, str] = {
    "coco17": _COCO,
    "halpe26": _COCO + " head_top - mid_hip l_big_toe r_big_toe l_small_toe r_small_toe l_heel r_heel",
    "body25": "nose - r_shoulder r_elbow r_wrist l_shoulder l_elbow l_wrist mid_hip r_hip r_knee r_ankle "
    "l_hip l_knee l_ankle r_eye l_eye r_ear l_ear l_big_toe l_small_toe l_heel r_big_toe r_small_toe r_heel",
    "h36m17": "mid_hip r_hip r_knee r_ankle l_hip l_knee l_ankle h36m_spine h36m_thorax h36m_nose h36m_head l_shoulder "
    "l_elbow l_wrist r_shoulder r_elbow r_wrist",
    "mediapipe33": "nose l_eye l_eye l_eye r_eye r_eye r_eye l_ear r_ear l_mouth r_mouth l_shoulder r_shoulder l_elbow "
    "r_elbow l_wrist r_wrist l_pinky r_pinky l_index r_index l_thumb r_thumb l_hip r_hip l_knee r_knee l_ankle r_ankle "
    "l_heel r_heel l_big_toe r_big_toe",
    "zed18": "nose - r_shoulder r_elbow r_wrist l_shoulder l_elbow l_wrist r_hip r_knee r_ankle l_hip "
    "l_knee l_ankle r_eye l_eye r_ear l_ear",
    "zed34": "mid_hip - - - - l_shoulder l_elbow l_wrist l_hand l_handtip l_thumb - r_shoulder r_elbow "
    "r_wrist r_hand r_handtip r_thumb l_hip l_knee l_ankle l_foot r_hip r_knee r_ankle r_foot - nose l_eye l_ear "
    "r_eye r_ear l_heel r_heel",
    "zed38": "mid_hip spine_low? spine_mid? spine_high? neck? nose l_eye r_eye l_ear r_ear l_clavicle r_clavicle "
    "l_shoulder r_shoulder l_elbow r_elbow l_wrist r_wrist l_hip r_hip l_knee r_knee l_ankle r_ankle l_big_toe "
    "r_big_toe l_small_toe r_small_toe l_heel r_heel l_thumb r_thumb l_index r_index l_handtip r_handtip l_pinky "
    "r_pinky",
    "kinect32": _KINECT,
    "smpl24": "pelvis l_hip r_hip spine_low l_knee r_knee spine_mid l_ankle r_ankle spine_high l_foot r_foot neck "
    "l_clavicle r_clavicle head l_shoulder r_shoulder l_elbow r_elbow l_wrist r_wrist l_palm r_palm",
}
"""Points of each layout, in the order in which trackers send them.

"-" is a point that the tracker makes from others: necks between shoulders, and those of ZED's 34 that are on straight
lines between hips, shoulders and nose. "?" is a point of which nobody says where it is: those of the trunk among ZED's
38. The places of clavicles, fingers and MediaPipe's eye corners are only right within 2 cm.
"""
_HEADS_OFF = {"zed18": 0.15, "zed34": 0.15}
"""How far all points of a head may be off together [m]. ZED measures the skin that it sees: above the shoulders, faces
are 12 cm farther back than SMPL's in ten recordings of its 34 keypoints, but within 5 cm with Kinect and MediaPipe."""
LAYOUTS: tuple[str, ...] = tuple(POINTS_OF)


@dataclass(frozen=True, eq=False)
class KeypointLayout:
    """Where the K keypoints of a tracker are on SMPL's skeleton."""

    name: str
    joints: NDArray[np.intp]
    """The joint that carries each keypoint, shape (K,)."""
    places: NDArray[np.float64]
    """Each keypoint's place in the T-pose is this mean of all joints, and its offset; shape (K, 24)."""
    offsets: NDArray[np.float64]
    """Offset from there in the T-pose [m], shape (K, 3)."""
    is_told: NDArray[np.bool_]
    """Whether a keypoint says anything that others don't, shape (K,)."""
    is_sure: NDArray[np.bool_]
    """Whether it is known where it is, shape (K,)."""
    head_off: float
    """How far all keypoints of the head may be off together [m]."""
    mirrored: NDArray[np.intp]
    """Each keypoint's counterpart on the body's other side, shape (K,); itself if it is in the middle or alone."""

    def __len__(self) -> int:
        """Number of keypoints."""
        return len(self.joints)

    @property
    def is_joint(self) -> NDArray[np.bool_]:
        """Whether a keypoint is in its joint's centre, shape (K,)."""
        is_at: NDArray[np.bool_] = self.places[np.arange(len(self)), self.joints] == 1
        return is_at & ~self.offsets.any(axis=1) & self.is_told & self.is_sure

    def at_joint(self, joint: int) -> int:
        """The keypoint in a joint's centre, -1 where there is none."""
        here = np.flatnonzero((self.joints == joint) & self.is_joint)
        return int(here[0]) if len(here) else -1


@cache
def keypoint_layout(name: str) -> KeypointLayout:
    """A layout of `LAYOUTS`. Raises `RefuError` for another name."""
    if name not in POINTS_OF:
        raise RefuError(f"no layout of keypoints {name!r}: wanted {', '.join(LAYOUTS)}")
    return layout_of(name, tuple(POINTS_OF[name].split()))


def layout_of(name: str, words: tuple[str, ...]) -> KeypointLayout:
    """A layout of points of the table, in any order. Raises `KeyError` for a point that isn't in the table."""
    is_sure = np.array([not word.endswith(_UNSURE) for word in words])
    points = [_point(word.removesuffix(_UNSURE)) for word in words]
    joints = np.array([SMPL_JOINTS.index(point.joint) for point in points])
    places = np.eye(len(SMPL_JOINTS))[joints]
    for place, point in zip(places, points, strict=True):
        if point.along is not None:
            place[:] = 0.0
            place[_HIPS], place[_SHOULDERS] = (1 - point.along) / 2, point.along / 2
    offsets = np.array([point.offset for point in points], np.float64)
    is_told = np.array([word != _MADE for word in words])
    twins = np.array([_twin(words, i) for i in range(len(words))])
    return KeypointLayout(name, joints, places, offsets, is_told, is_sure, _HEADS_OFF.get(name, 0.0), twins)


def _point(word: str) -> _Point:
    if not word.startswith("r_"):
        return _POINTS[word]
    joint, (x, y, z), along = _POINTS["l_" + word[2:]]
    return _Point(joint.replace("left_", "right_"), (-x, y, z), along)


def _twin(words: tuple[str, ...], i: int) -> int:
    """The number of the same point on the other side; of several with one name, the one of the same rank.

    Its own where there is none: somebody's skeleton may lack a hand.
    """
    word = words[i]
    if word[:2] not in ("l_", "r_"):
        return i
    other = ("r_" if word[0] == "l" else "l_") + word[2:]
    same, rank = [j for j, found in enumerate(words) if found == other], words[:i].count(word)
    return same[rank] if rank < len(same) else i
