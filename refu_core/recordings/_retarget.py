"""Another skeleton's motion on SMPL's: bones point where its bones point, trunk and head turn as its joints do.

Tools put a pelvis between the hips or a hand's breadth above them, a neck between the shoulders or under the skull, and
make trunks longer or shorter than SMPL's. Fitted by the places of such joints, SMPL's spine bends by up to 80° in
somebody who stands. What turns with a joint is sure, and so is which way is up in the rest pose: along the spine, if
hips and spine turn together there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from refu_core.frames import N_BETAS
from refu_core.keypoints import Proportions, layout_of
from refu_core.recordings._rotations import unit
from refu_core.recordings._upright import Array
from refu_core.skeleton import JOINT_NAMES

_STRAIGHT = np.cos(np.radians(35.0))
"""A spine that bends by more in the rest pose doesn't say which way is up."""
_ALIGNED = np.cos(np.radians(15.0))
"""A spine this near to an axis of the rest pose stands along it, as SMPL's does."""
_ALIKE = np.cos(np.radians(30.0))
"""Hips and shoulders that are turned farther apart in the rest pose don't say where the face is."""
_TURNED = np.cos(np.radians(60.0))
"""Trunks are bent and twisted by less than that on average; else these aren't the turns of a person's joints."""
_BONE, _WIDTH = 0.01, 0.02
"""How well betas give the lengths of bones, and of trunk, hips and shoulders, which tools measure between other places
[m]. Of 20 files, 4 get a beta of 3, the most; with 10 mm for all 11 do, with 3 mm for bones 13. On a skeleton of the
male body's proportions, joints of limbs are off by 5 mm at most."""
_SAME = 0.01
"""A shoulder may be this far from where the betas would have it [m]: collars turn by 4° for that."""
_MOST_BETA = 3.0
_SIDES = {"l": "left", "r": "right"}
_LIMBS = (("hip", "knee", "ankle", "foot"), ("shoulder", "elbow", "wrist"))
_BONES = tuple(bone for limb in _LIMBS for bone in pairwise(limb[:3]))
_FACE = ("head_top", "nose")


@dataclass(frozen=True, eq=False)
class SourceSkeleton:
    """A skeleton in motion, and which of its joints are known."""

    points: Mapping[str, int]
    """The number of the joint at each point of the body; hips, knees, shoulders and elbows are among them."""
    parents: Sequence[int]
    """-1 for a root."""
    rest: Array
    """Places of the joints where none is turned, in any unit, shape (J, 3)."""
    places: Array
    """[m], shape (T, J, 3)."""
    turns: Array
    """Rotation of each joint in the world, shape (J, T, 3, 3)."""

    def at(self, name: str) -> Array:
        """The places of a point (T, 3)."""
        return self.places[:, self.points[name]]

    def middle(self, name: str) -> Array:
        """The places between both sides of a point (T, 3)."""
        return (self.at(f"l_{name}") + self.at(f"r_{name}")) / 2

    def across(self, name: str) -> Array:
        """From the right side of a point to the left one (T, 3)."""
        return self.at(f"l_{name}") - self.at(f"r_{name}")

    def bearer(self, name: str) -> int:
        """The joint that both sides of a point hang on, -1 if there is none."""
        return bearer_of(self.parents, self.points[f"l_{name}"], self.points[f"r_{name}"])

    def at_rest(self, name: str) -> Array:
        """The place between both sides of a point where no joint is turned (3,)."""
        middle: Array = (self.rest[self.points[f"l_{name}"]] + self.rest[self.points[f"r_{name}"]]) / 2
        return middle

    def hangs_on(self, joint: int, above: int) -> bool:
        """Whether a joint is another one, or turns with it."""
        while joint not in (above, -1):
            joint = self.parents[joint]
        return joint == above


def bearer_of(parents: Sequence[int], a: int, b: int) -> int:
    """The nearest joint that two joints hang on, -1 if there is none."""
    above = set()
    while a >= 0:
        a = parents[a]
        above.add(a)
    b = parents[b]
    while b not in above:
        b = parents[b]
    return b


def _fitted_betas(source: SourceSkeleton, body: Proportions) -> Array:
    """The betas, shape (10,), with which a body's bones are about as long as the skeleton's."""
    ends = [(f"{side}_{a}", f"{side}_{b}") for a, b in _BONES for side in _SIDES if f"{side}_{b}" in source.points]
    ways = [source.at(b) - source.at(a) for a, b in ends]
    ways += [source.middle("shoulder") - source.middle("hip"), source.across("hip"), source.across("shoulder")]
    wanted = np.median(np.linalg.norm(ways, axis=-1), axis=1)
    each = np.array([_BONE] * len(ends) + [_WIDTH] * 3)
    mean, slopes = (_bones(joints, ends) for joints in (body.joints, body.shapedirs))
    betas = np.zeros(N_BETAS)
    for _ in range(4):  # each length is nearly linear in the betas
        now = mean + slopes @ betas
        lengths = np.linalg.norm(now, axis=1)
        by_beta = np.einsum("bc,bck->bk", now, slopes) / (lengths * each)[:, None]
        off = (wanted - lengths) / each + by_beta @ betas
        betas = np.linalg.solve(by_beta.T @ by_beta + np.eye(N_BETAS), by_beta.T @ off)
        betas = np.clip(betas, -_MOST_BETA, _MOST_BETA)
    return betas


def _bones(joints: Array, ends: Sequence[tuple[str, str]]) -> Array:
    """From end to end of some bones of a body with `joints` (24, 3, ...); then up the trunk, and across both ends."""
    at = {f"{side}_{name}": joints[JOINT_NAMES.index(f"{_SIDES[side]}_{name}")]
          for limb in _LIMBS for name in limb for side in _SIDES}  # fmt: skip
    trunk = (at["l_shoulder"] + at["r_shoulder"] - at["l_hip"] - at["r_hip"]) / 2
    widths = [at[f"l_{name}"] - at[f"r_{name}"] for name in ("hip", "shoulder")]
    return np.stack([*(at[b] - at[a] for a, b in ends), trunk, *widths])


@dataclass(frozen=True, eq=False)
class _Turned:
    """How a body with SMPL's axes is turned with a skeleton: rotations of parts in the world, shape (T, 3, 3)."""

    pelvis: Array
    chest: Array
    neck: Array
    head: Array
    bearer: int
    """The joint that turns with the chest."""

    @classmethod
    def of(cls, source: SourceSkeleton, upright: Array) -> _Turned | None:
        """For a body whose spine at rest points `upright` (3,); None where the joints' turns don't say it."""
        pelvis, chest = source.bearer("hip"), source.bearer("shoulder")
        if pelvis < 0 or chest < 0:
            return None
        turns = source.turns[pelvis], source.turns[chest]
        across = source.across("hip"), source.across("shoulder")
        along = source.middle("shoulder") - source.middle("hip")
        lefts = [_mean_in(turn, way) for turn, way in zip(turns, across, strict=True)]
        top = source.points.get("neck", source.points.get("head", chest))
        low = source.at_rest("hip")
        lower, upper = source.rest[chest] - low, source.rest[top] - source.rest[chest]
        up, is_straight = unit(lower + upper), top == chest or unit(lower) @ unit(upper) > _STRAIGHT
        means = [(_mean_in(turn, along), upright) for turn in turns]
        if is_straight and np.abs(up).max() > _ALIGNED:
            up, upright = np.sign(up) * (np.abs(up) == np.abs(up).max()), np.array([0.0, 1.0, 0.0])
        # A spine that isn't borne by the hips' joint has to rest as people stand: with legs that hang.
        of_hips = is_straight and (source.hangs_on(chest, pelvis) or (source.at_rest("knee") - low) @ up < 0)
        ways = [(up, upright) if is_told else mean for is_told, mean in zip((of_hips, is_straight), means, strict=True)]
        ahead = np.array([1.0, 0.0, 0.0])
        own = _axes(ahead, upright)
        trunk = [turn @ _axes(x, way) @ _axes(ahead, smpls).T
                 for turn, x, (way, smpls) in zip(turns, lefts, ways, strict=True)]  # fmt: skip
        alike = [(axes[:, :, 0] * unit(way)).sum(1).mean() for axes, way in zip(trunk, across, strict=True)]
        alike += [(axes @ smpls * unit(along)).sum(1).mean() for axes, (_, smpls) in zip(trunk, ways, strict=True)]
        if not min(alike) > _TURNED:
            return None
        faces_ahead = is_straight and lefts[0] @ lefts[1] > _ALIKE
        neck, head = (
            turn @ (_axes(lefts[0], up) @ own.T if faces_ahead else _mean_turn(turn, trunk[1]))
            for turn in (source.turns[source.points.get(name, chest)] for name in ("neck", "head"))
        )
        return cls(trunk[0], trunk[1], neck, head, chest)


def retargeted(source: SourceSkeleton, body: Proportions) -> tuple[Array, dict[str, Array]] | None:
    """Betas (10,) for a body like the skeleton, and where its points are in the skeleton's motion [m], each (T, 3).

    None where the turns of its joints don't say how hips and trunk are turned.
    """
    betas = _fitted_betas(source, body)
    joint = dict(zip(JOINT_NAMES, body.of(betas), strict=True))
    hips = (joint["left_hip"] + joint["right_hip"]) / 2
    turned = _Turned.of(source, joint["neck"] - hips)
    if turned is None:
        return None
    place = source.middle("hip") + turned.pelvis @ (joint["pelvis"] - hips)
    found, above = {"pelvis": place}, "pelvis"
    bend = Rotation.from_matrix(turned.pelvis.swapaxes(1, 2) @ turned.chest).as_rotvec()
    for share, name, point in ((0, "spine1", "low"), (1 / 3, "spine2", "mid"), (2 / 3, "spine3", "high")):
        place = place + turned.pelvis @ Rotation.from_rotvec(share * bend).as_matrix() @ (joint[name] - joint[above])
        found[f"spine_{point}"], above = place, name
    found["neck"] = place + turned.chest @ (joint["neck"] - joint["spine3"])
    for side, name in _SIDES.items():
        found[f"{side}_hip"] = found["pelvis"] + turned.pelvis @ (joint[f"{name}_hip"] - joint["pelvis"])
        start = place + turned.chest @ (joint[f"{name}_collar"] - joint["spine3"])
        collar = joint[f"{name}_shoulder"] - joint[f"{name}_collar"]
        found[f"{side}_shoulder"] = _shoulder(source, turned, side, start, collar)
        for a, b in (bone for limb in _LIMBS for bone in pairwise(limb)):
            if f"{side}_{a}" in found and f"{side}_{b}" in source.points:
                length = np.linalg.norm(joint[f"{name}_{b}"] - joint[f"{name}_{a}"])
                way = source.at(f"{side}_{b}") - source.at(f"{side}_{a}")
                found[f"{side}_{b}"] = found[f"{side}_{a}"] + length * unit(way)
    if "head" in source.points:
        found["head"] = found["neck"] + turned.neck @ (joint["head"] - joint["neck"])
        for name, offset in zip(_FACE, layout_of("", _FACE).offsets, strict=True):
            found[name] = found["head"] + turned.head @ offset
    return betas, found


def _shoulder(source: SourceSkeleton, turned: _Turned, side: str, start: Array, collar: Array) -> Array:
    """A shoulder (T, 3), at the end of a `collar` (3,) that starts at `start` (T, 3).

    Tools put shoulders higher or lower: one is shrugged where it isn't where it is on average.
    """
    turns, shoulder = source.turns[turned.bearer], source.at(f"{side}_shoulder")
    seen = _inside(turns, shoulder - source.places[:, turned.bearer])
    shrug = np.einsum("tij,tj->ti", turns, seen - np.median(seen, axis=0))
    off = np.median(_inside(turned.chest, shoulder - start), axis=0) - collar
    own = collar + off * min(1.0, _SAME / max(float(np.linalg.norm(off)), _SAME))
    end: Array = start + np.linalg.norm(collar) * unit(turned.chest @ own + shrug)
    return end


def _axes(left: Array, up: Array) -> Array:
    """Axes (3, 3), one a column: to the left, up as far as that allows, and forward."""
    x = unit(left)
    y = unit(up - (up @ x) * x)
    return np.stack((x, y, np.cross(x, y)), axis=1)


def _inside(turns: Array, ways: Array) -> Array:
    """Ways in the world (T, 3), as a joint that turns sees them."""
    seen: Array = np.einsum("tji,tj->ti", turns, ways)
    return seen


def _mean_in(turns: Array, ways: Array) -> Array:
    return unit(_inside(turns, unit(ways)).mean(axis=0))


def _mean_turn(turns: Array, axes: Array) -> Array:
    """The rotation (3, 3) that brings `turns` nearest to `axes`, both (T, 3, 3), on average."""
    return Rotation.from_matrix(turns.swapaxes(1, 2) @ axes).mean().as_matrix()
