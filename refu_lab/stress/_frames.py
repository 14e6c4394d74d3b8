"""Frames to try: those of real people, and those that only a faulty or hostile sender makes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refu_core.body import JOINT_NAMES
from refu_core.frames import N_BETAS, N_JOINTS, N_STYLES, SmplFrame
from refu_core.history import PoseHistory
from refu_core.realtime import PROMISED_BEND, PROMISED_POSES, PROMISED_SIZE, SPINE, spine_bend
from refu_core.recordings import interpolated

Draw = Callable[[np.random.Generator], SmplFrame]
frame_of: Callable[..., SmplFrame] = SmplFrame  # typed loosely: it converts numbers of any kind

_SPREAD: dict[str, float] = {
    **dict.fromkeys(("pelvis", "spine1", "spine2", "spine3", "neck", "head"), 0.12),
    **dict.fromkeys(("hip", "knee"), 0.3),
    **dict.fromkeys(("collar", "wrist", "ankle"), 0.1),
    "shoulder": 0.35,
    "elbow": 0.4,
}
"""Standard deviation of a joint's rotation vector in everyday poses [rad]; other joints are at rest."""
_SHOULDERS = (JOINT_NAMES.index("left_shoulder"), JOINT_NAMES.index("right_shoulder"))
_HIPS = (JOINT_NAMES.index("left_hip"), JOINT_NAMES.index("right_hip"))
_LIMBS = tuple(JOINT_NAMES.index(f"{side}_{joint}") for side in ("left", "right") for joint in ("shoulder", "elbow"))
_SERIES_SWITCH = 1e-2  # [rad]; below it, Rodrigues' formula is replaced by its series


def everyday_pose(rng: np.random.Generator) -> NDArray[np.float64]:
    """Arms half lowered and all joints randomly turned a little [rad], shape (24, 3)."""
    spread = np.array([_SPREAD.get(name.split("_")[-1], 0.0) for name in JOINT_NAMES])
    pose: NDArray[np.float64] = rng.normal(0, 1, (N_JOINTS, 3)) * spread[:, None]
    pose[_SHOULDERS, 2] += (-0.6, 0.6)
    return pose


def everyday(rng: np.random.Generator) -> SmplFrame:
    """A person of any shape in an everyday pose, somewhere in a room; every other one has a style."""
    return frame_of(
        everyday_pose(rng),
        betas=rng.normal(0, 1, N_BETAS),
        transl=rng.normal(0, 3, 3),
        style=rng.normal(0, 1, N_STYLES) if rng.random() < 0.5 else None,
    )


def _turned(rng: np.random.Generator, *, by: Sequence[float], jitter: float = 0.0) -> SmplFrame:
    """Each joint turns by one of these angles, give or take `jitter` [rad], about a random axis."""
    angles = rng.choice(by, N_JOINTS) + jitter * rng.normal(size=N_JOINTS)
    axes = rng.normal(size=(N_JOINTS, 3))
    pose = axes / np.linalg.norm(axes, axis=1, keepdims=True) * angles[:, None]
    return frame_of(pose, betas=rng.normal(0, 1, N_BETAS))


def _wrapped(rng: np.random.Generator) -> SmplFrame:
    """An everyday pose by other rotation vectors: some with a full turn more or less."""
    pose = everyday_pose(rng)
    angle = np.maximum(np.linalg.norm(pose, axis=1, keepdims=True), 1e-6)
    turns = rng.choice((-1, 0, 1), (N_JOINTS, 1))
    return frame_of(pose * (1 + 2 * np.pi * turns / angle), betas=rng.normal(0, 1, N_BETAS))


def _betas(rng: np.random.Generator, *, size: float) -> SmplFrame:
    return frame_of(everyday_pose(rng), betas=rng.choice((-size, size), N_BETAS) * rng.random(N_BETAS) ** 0.1)


def _styles(rng: np.random.Generator, *, size: float) -> SmplFrame:
    return frame_of(everyday_pose(rng), style=rng.uniform(-size, size, N_STYLES))


def _far(rng: np.random.Generator) -> SmplFrame:
    transl = rng.choice((-1, 1), 3) * 10.0 ** rng.uniform(0, 7, 3)
    return frame_of(everyday_pose(rng), betas=rng.normal(0, 1, N_BETAS), transl=transl)


def _self_penetrating(rng: np.random.Generator) -> SmplFrame:
    """Arms through the trunk, thighs through each other."""
    pose = everyday_pose(rng)
    pose[_SHOULDERS, 2] += (-rng.uniform(0.3, 2.5), rng.uniform(0.3, 2.5))
    pose[_SHOULDERS, 1] += (-rng.uniform(0, 1.5), rng.uniform(0, 1.5))
    pose[_HIPS, 2] += (-rng.uniform(0, 0.6), rng.uniform(0, 0.6))
    pose[list(_LIMBS)] += rng.normal(0, 0.5, (len(_LIMBS), 3))
    return frame_of(pose, betas=rng.normal(0, 1.5, N_BETAS))


def _anything(rng: np.random.Generator) -> SmplFrame:
    return frame_of(Rotation.random(N_JOINTS, random_state=rng).as_rotvec(), betas=rng.normal(0, 2, N_BETAS))


def _denormal(rng: np.random.Generator) -> SmplFrame:
    tiny = np.float64(np.finfo(np.float32).smallest_subnormal)

    def draw(*shape: int) -> NDArray[np.float64]:
        numbers: NDArray[np.float64] = tiny * rng.integers(-1000, 1000, shape)
        return numbers

    return frame_of(draw(N_JOINTS, 3), betas=draw(N_BETAS), transl=draw(3), style=draw(N_STYLES))


def _absurd(rng: np.random.Generator) -> SmplFrame:
    """A finite float32 number of any size somewhere in the frame: it has to be refused, or survived."""
    frame = everyday(rng)
    pose, betas, transl = np.array(frame.pose, np.float64), np.array(frame.betas, np.float64), np.array(frame.transl)
    target = (pose.reshape(-1), betas, transl)[rng.integers(3)]
    target[rng.integers(len(target))] = rng.choice((-1, 1)) * 10.0 ** rng.uniform(3, 38)
    return frame_of(pose, betas=betas, transl=transl, style=frame.style)


def promised(rng: np.random.Generator) -> SmplFrame:
    """A frame of the range that "nothing inside" is promised for; half of them have β at the corners of its range."""
    low, high = PROMISED_POSES
    pose = np.where(np.isfinite(low), rng.uniform(np.maximum(low, -np.pi), np.minimum(high, np.pi)), 0.0)
    angle = np.linalg.norm(pose, axis=1, keepdims=True)
    pose *= np.minimum(1.0, 3.0 / np.maximum(angle, 1e-9))  # beyond half a turn, a shorter vector is the same rotation
    pose *= rng.uniform(0.2, 1.0)
    while spine_bend(pose) > PROMISED_BEND:
        pose[SPINE] *= 0.9
    betas = PROMISED_SIZE * (rng.uniform(-1, 1, N_BETAS) if rng.random() < 0.5 else rng.choice((-1, 0, 1), N_BETAS))
    return frame_of(pose, betas=betas)


FRAMES: Mapping[str, Draw] = {
    "everyday": everyday,
    "any rotation of any joint": _anything,
    "half a turn, give or take 1e-6": partial(_turned, by=(np.pi, 2 * np.pi, 3 * np.pi), jitter=1e-6),
    "angles beyond a turn": _wrapped,
    "angles of 0, 1e-12, 1e-4 and where the series begins": partial(
        _turned, by=(0.0, 1e-30, 1e-12, 1e-4, _SERIES_SWITCH), jitter=1e-6
    ),
    "angles of 1e3": partial(_turned, by=(1e3, 300.0, 30.0)),
    "denormals": _denormal,
    "betas of 5": partial(_betas, size=5.0),
    "betas of 50": partial(_betas, size=50.0),
    "styles of 5": partial(_styles, size=5.0),
    "styles of 50": partial(_styles, size=50.0),
    "translations up to 1e7 m": _far,
    "limbs through the trunk": _self_penetrating,
    "absurd": _absurd,
}


def on_the_move(frame: SmplFrame, rng: np.random.Generator) -> SmplFrame:
    """The frame of a person whose joints all turned, and who changed course, in the fifths of a second before it."""
    moments = []
    for ago in (400_000_000, 200_000_000):
        pose, place = everyday_pose(rng).astype(np.float32), frame.transl + rng.normal(0, 0.3, 3)
        pose[0] = frame.pose[0]  # whose root turns too fast is somebody else
        moments.append(replace(frame, pose=pose, transl=place, stamp_ns=frame.stamp_ns - ago))
    return PoseHistory.told([*moments, frame])[-1]


MOTION_FPS = 60
"""Frames of a motion in a second."""


def motion(
    poses: Sequence[NDArray[np.floating]], betas: NDArray[np.floating], style: NDArray[np.floating] | None = None
) -> list[SmplFrame]:
    """The frames of one person in such poses (24, 3) [rad], each with its past."""
    stamps = (round(1e9 * i / MOTION_FPS) for i in range(len(poses)))
    return PoseHistory.told(frame_of(one, betas, style=style, stamp_ns=t) for one, t in zip(poses, stamps, strict=True))


def between(poses: Sequence[NDArray[np.floating]], steps: int) -> list[NDArray[np.float64]]:
    """Goes from each pose (24, 3) [rad] to the next in `steps` on the shorter arc, without the last pose itself."""
    eased = 0.5 - 0.5 * np.cos(np.pi * np.arange(steps) / steps)  # in and out, so that the speed has no jumps
    moments = np.add.outer(np.arange(len(poses) - 1), eased).ravel()
    motion, _ = interpolated(np.stack(poses), np.zeros((len(poses), 3)), np.arange(len(poses)), moments)
    return [*motion]
