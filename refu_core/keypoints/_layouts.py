"""Which point of the body each keypoint of a tracker is: the table of layouts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from refu_core.errors import RefuError
from refu_core.skeleton import JOINT_NAMES as SMPL_JOINTS

_POINTS: dict[str, tuple[str, tuple[float, float, float]]] = {
    "pelvis": ("pelvis", (0, 0, 0)),
    "spine_low": ("spine1", (0, 0, 0)),
    "spine_mid": ("spine2", (0, 0, 0)),
    "spine_high": ("spine3", (0, 0, 0)),
    "thorax": ("spine3", (0, 0.09, 0.03)),
    "neck": ("neck", (0, 0, 0)),
    "head": ("head", (0, 0, 0)),
    "head_top": ("head", (0, 0.15, 0.01)),
    "nose": ("head", (0, 0.005, 0.12)),
    "l_eye": ("head", (0.032, 0.045, 0.095)),
    "l_ear": ("head", (0.080, 0.040, 0.0)),
    "l_mouth": ("head", (0.025, -0.035, 0.10)),
    "l_clavicle": ("left_collar", (0, 0, 0)),
    "l_shoulder": ("left_shoulder", (0, 0, 0)),
    "l_elbow": ("left_elbow", (0, 0, 0)),
    "l_wrist": ("left_wrist", (0, 0, 0)),
    "l_palm": ("left_hand", (0, 0, 0)),
    "l_hand": ("left_wrist", (0.08, -0.01, 0)),
    "l_handtip": ("left_wrist", (0.19, -0.03, 0)),
    "l_index": ("left_wrist", (0.105, -0.01, 0.025)),
    "l_pinky": ("left_wrist", (0.095, -0.01, -0.035)),
    "l_thumb": ("left_wrist", (0.10, -0.03, 0.06)),
    "l_hip": ("left_hip", (0, 0, 0)),
    "l_knee": ("left_knee", (0, 0, 0)),
    "l_ankle": ("left_ankle", (0, 0, 0)),
    "l_foot": ("left_foot", (0, 0, 0)),
    "l_big_toe": ("left_foot", (-0.02, -0.005, 0.055)),
    "l_small_toe": ("left_foot", (0.055, -0.012, 0.0)),
    "l_heel": ("left_ankle", (-0.01, -0.036, -0.055)),
}
"""Joint and offset from it [m] in the T-pose, in SMPL's axes, measured on the built-in neutral body's mean shape; the
right side mirrors the left one."""

_COCO = "nose l_eye r_eye l_ear r_ear l_shoulder r_shoulder l_elbow r_elbow l_wrist r_wrist l_hip r_hip l_knee r_knee "
_COCO += "l_ankle r_ankle"
_KINECT = "pelvis spine_low spine_high neck l_clavicle l_shoulder l_elbow l_wrist l_hand l_handtip l_thumb r_clavicle "
_KINECT += "r_shoulder r_elbow r_wrist r_hand r_handtip r_thumb l_hip l_knee l_ankle l_foot r_hip r_knee r_ankle "
_KINECT += "r_foot head nose l_eye l_ear r_eye r_ear"
_NAMES: dict[str, str] = {
    "coco17": _COCO,
    "halpe26": _COCO + " head_top neck pelvis l_big_toe r_big_toe l_small_toe r_small_toe l_heel r_heel",
    "body25": "nose neck r_shoulder r_elbow r_wrist l_shoulder l_elbow l_wrist pelvis r_hip r_knee r_ankle l_hip "
    "l_knee l_ankle r_eye l_eye r_ear l_ear l_big_toe l_small_toe l_heel r_big_toe r_small_toe r_heel",
    "h36m17": "pelvis r_hip r_knee r_ankle l_hip l_knee l_ankle spine_mid thorax nose head_top l_shoulder l_elbow "
    "l_wrist r_shoulder r_elbow r_wrist",
    "mediapipe33": "nose l_eye l_eye l_eye r_eye r_eye r_eye l_ear r_ear l_mouth r_mouth l_shoulder r_shoulder l_elbow "
    "r_elbow l_wrist r_wrist l_pinky r_pinky l_index r_index l_thumb r_thumb l_hip r_hip l_knee r_knee l_ankle r_ankle "
    "l_heel r_heel l_big_toe r_big_toe",
    "zed18": "nose neck r_shoulder r_elbow r_wrist l_shoulder l_elbow l_wrist r_hip r_knee r_ankle l_hip l_knee "
    "l_ankle r_eye l_eye r_ear l_ear",
    "zed34": _KINECT + " l_heel r_heel",
    "zed38": "pelvis spine_low spine_mid spine_high neck nose l_eye r_eye l_ear r_ear l_clavicle r_clavicle l_shoulder "
    "r_shoulder l_elbow r_elbow l_wrist r_wrist l_hip r_hip l_knee r_knee l_ankle r_ankle l_big_toe r_big_toe "
    "l_small_toe r_small_toe l_heel r_heel l_thumb r_thumb l_index r_index l_handtip r_handtip l_pinky r_pinky",
    "kinect32": _KINECT,
    "smpl24": "pelvis l_hip r_hip spine_low l_knee r_knee spine_mid l_ankle r_ankle spine_high l_foot r_foot neck "
    "l_clavicle r_clavicle head l_shoulder r_shoulder l_elbow r_elbow l_wrist r_wrist l_palm r_palm",
}
"""Points of each layout, in the order in which trackers send them. The places of thorax, clavicles, fingers and
MediaPipe's eye corners are only right within 2 cm."""
LAYOUTS: tuple[str, ...] = tuple(_NAMES)


@dataclass(frozen=True, eq=False)
class KeypointLayout:
    """Where the K keypoints of a tracker are on SMPL's skeleton."""

    name: str
    joints: NDArray[np.intp]
    """The joint that carries each keypoint, shape (K,)."""
    offsets: NDArray[np.float64]
    """Offset from that joint in the T-pose [m], shape (K, 3)."""
    mirrored: NDArray[np.intp]
    """Each keypoint's counterpart on the body's other side, shape (K,); itself if it is in the middle or alone."""

    def __len__(self) -> int:
        """Number of keypoints."""
        return len(self.joints)

    def at_joint(self, joint: int) -> int:
        """The keypoint in a joint's centre, -1 where there is none."""
        here = np.flatnonzero((self.joints == joint) & ~self.offsets.any(axis=1))
        return int(here[0]) if len(here) else -1


@cache
def keypoint_layout(name: str) -> KeypointLayout:
    """A layout of `LAYOUTS`. Raises `RefuError` for another name."""
    if name not in _NAMES:
        raise RefuError(f"no layout of keypoints {name!r}: wanted {', '.join(LAYOUTS)}")
    return layout_of(name, tuple(_NAMES[name].split()))


def layout_of(name: str, words: tuple[str, ...]) -> KeypointLayout:
    """A layout of points of the table, in any order. Raises `KeyError` for a point that isn't in the table."""
    places = [_place(word) for word in words]
    joints = np.array([SMPL_JOINTS.index(joint) for joint, _ in places])
    offsets = np.array([offset for _, offset in places], np.float64)
    return KeypointLayout(name, joints, offsets, np.array([_twin(words, i) for i in range(len(words))]))


def _place(word: str) -> tuple[str, tuple[float, float, float]]:
    if not word.startswith("r_"):
        return _POINTS[word]
    joint, (x, y, z) = _POINTS["l_" + word[2:]]
    return joint.replace("left_", "right_"), (-x, y, z)


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
