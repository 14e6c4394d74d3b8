"""The parts of a body, by SMPL joint: one table, and groups of its entries."""

from __future__ import annotations

from collections.abc import Collection

from torch import Tensor

from refu_core.skeleton import JOINT_NAMES

Joints = tuple[int, ...]

SEGMENTS: dict[str, Joints] = {
    "trunk": (0, 3, 6, 9, 13, 14),
    "head": (12, 15),
    "left_upper_arm": (16,),
    "right_upper_arm": (17,),
    "left_forearm": (18, 20, 22),
    "right_forearm": (19, 21, 23),
    "left_thigh": (1,),
    "right_thigh": (2,),
    "left_shin": (4, 7, 10),
    "right_shin": (5, 8, 11),
}
"""Joints of the segments that a body is cut into where it folds; the neck belongs to the head, a hand to the forearm, a
foot to the shin."""


def joints_of(*segments: str) -> Joints:
    """The joints of several segments."""
    return tuple(joint for segment in segments for joint in SEGMENTS[segment])


ARMS: tuple[Joints, Joints] = (
    joints_of("left_upper_arm", "left_forearm"),
    joints_of("right_upper_arm", "right_forearm"),
)
"""Left and right, without the collars."""
LEGS: tuple[Joints, Joints] = (joints_of("left_thigh", "left_shin"), joints_of("right_thigh", "right_shin"))
"""Left and right."""

_SIDES = {"left": "right", "right": "left"}
MIRRORED_JOINTS: Joints = tuple(
    JOINT_NAMES.index("_".join(_SIDES.get(word, word) for word in name.split("_"))) for name in JOINT_NAMES
)
"""The joint on the other side of each one."""


def weight_of_parts(weights: Tensor, parts: Collection[Joints]) -> Tensor:
    """The share of each vertex that moves with each of P parts, shape (V, P), from skinning weights (V, 24)."""
    groups = weights.new_zeros(weights.shape[1], len(parts))
    for part, joints in enumerate(parts):
        groups[list(joints), part] = 1
    return weights @ groups


def part_of_faces(weights: Tensor, faces: Tensor, parts: Collection[Joints]) -> Tensor:
    """The part that each face (F, 3) moves with most, int64, shape (F,), from skinning weights (V, 24)."""
    return weight_of_parts(weights.double(), parts)[faces].sum(1).argmax(1)
