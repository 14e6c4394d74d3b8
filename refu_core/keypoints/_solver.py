"""The most likely pose for keypoints: Gauss-Newton steps on what is seen, what was predicted, and how joints rest.

Where nothing was predicted, they begin at a guess: the trunk as a whole, then limb by limb.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs
from scipy.spatial.transform import Rotation

from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.keypoints._pose import LIMBS, Array, Pose, Skeleton, exp_so3, log_so3, skew
from refu_core.skeleton import JOINT_NAMES, PARENTS


@dataclass(frozen=True, kw_only=True)
class TrackerSettings:
    """The numbers, tuned on ten clips of CMU; docs/results/keypoints.md has what half and twice of each do."""

    smoothing: float = 1.0
    """How much smoother than the most likely motion: accelerations are taken to be this many times smaller."""
    noise: float = 0.01
    """Standard deviation of a keypoint along each axis at the start of a track [m]; it then adapts to what is seen."""
    least_noise: float = 0.004
    """[m]"""
    most_noise: float = 0.06
    """[m]"""
    offset_noise: float = 0.01
    """Noise added for keypoints beside a joint, whose places differ between people and trackers [m]."""
    unsure_noise: float = 0.05
    """Noise added for keypoints that may be elsewhere on the trunk [m]: between neck and shoulders there are 10 cm."""
    shape_pull: float = 5.0
    """How many times the betas' own spread of 1 pulls them to 0 in `rest_after`: trackers are off by centimetres, alike
    in every frame. On 40 recordings of eight layouts the largest beta is 1.5 on average instead of 2.7, and keypoints
    are missed by 2 mm more; of known betas of 2, 1.9 is found of the first and 0.4 to 1 of the next three, instead of
    2.0 and 0.8 to 1.6, and joints are off by 0.1 mm more."""
    push: float = 1.0
    """Power of the pelvis's acceleration [m²/s³]: twice that of the ten clips, as `twist`."""
    twist: float = 40.0
    """Power of the joints' angular acceleration [rad²/s³]: twice that of the ten clips. With 20 they'd be followed too
    late in fast motion: one usual error in 200 would be beyond 38 mm, where it is 32."""
    growth: float = 1e-3
    """Power of the betas' drift [1/s]: 0.03 in a second, since the first guess may be wrong."""
    rest_after: float = 0.1
    """A joint that isn't seen comes to rest in about this time [s]."""
    pelvis_coast: float = 0.6
    """The pelvis's velocity dies away in this time while nothing is seen [s]: so long that of the ten clips lasts."""
    coast: float = 0.12
    """So do the rates of the joints [s]. They last as long in the ten clips: 0.1 to 0.15 s, the pelvis's turn 0.3."""
    outlier: float = 3.0
    """A keypoint this many deviations off has half the weight; farther off it soon has none."""
    hold: float = 0.5
    """A person of whom nothing is seen for this long is taken to have left [s]."""
    doubt: float = 1.0
    """Exchanged sides, or keypoints that don't fit the pose, are believed after this long [s]."""
    jump: float = 0.75
    """Keypoints farther than this from the prediction are somebody else's [m]."""
    beta_step: float = 0.1
    """New betas are sent only if they changed by this: each change costs the pipeline a few frames' time."""
    most_beta: float = 3.0
    """Betas stay within this."""
    steps: int = 2
    """Gauss-Newton steps a frame at most; a third one changes the error by a hundredth of a millimetre."""


# Rotation vectors [rad] about x, y, z: mean and standard deviation, of the left side where there are two; the right
# side mirrors it (y and z change sign). Rounded up from 116 s of recorded motion (ten clips of CMU), where the spread
# of elbows about their own axis and of feet and collars, which those clips don't measure, is set from anatomy.
_RESTING: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "hip": ((-0.4, 0.05, 0.0), (0.6, 0.3, 0.25)),
    "spine1": ((0.2, 0, 0), (0.25, 0.12, 0.12)),
    "knee": ((0.6, 0, 0), (0.6, 0.08, 0.08)),
    "spine2": ((0.1, 0, 0), (0.15, 0.12, 0.1)),
    "ankle": ((-0.2, 0.1, 0.05), (0.3, 0.3, 0.1)),
    "spine3": ((0, 0, 0), (0.12, 0.12, 0.12)),
    "foot": ((0, 0, 0), (0.2, 0.05, 0.05)),
    "neck": ((-0.1, 0, 0), (0.25, 0.3, 0.25)),
    "collar": ((0, 0, 0), (0.1, 0.15, 0.15)),
    "head": ((0.1, 0, 0), (0.4, 0.4, 0.3)),
    "shoulder": ((0.15, -0.45, -1.05), (0.6, 0.7, 0.7)),
    "elbow": ((0, -0.85, 0.4), (0.25, 0.7, 0.35)),
    "wrist": ((-0.1, 0.1, 0.2), (0.35, 0.4, 0.3)),
    "hand": ((0, 0, 0), (0.1, 0.1, 0.1)),
}
_TOGETHER = {"shoulder": (0.4, -0.7, -0.5), "elbow": (0, 0, -0.7)}
"""How these turns go together: correlations of x and y, x and z, y and z, of those clips and three of other studios. An
arm that hangs is turned otherwise about itself than one that reaches up, which no keypoint shows while it is straight;
an elbow's hinge is oblique. Without them shoulders are off by 14° and elbows by 14°, with them by 10° and 9°."""
_MIRROR = np.array([1.0, -1, -1])


def resting() -> tuple[Array, Array]:
    """Mean (24, 3) [rad] and precision (24, 3, 3) of each joint's rotation vector; zeros for the root."""
    mean, precision = np.zeros((N_JOINTS, 3)), np.zeros((N_JOINTS, 3, 3))
    for i, name in enumerate(JOINT_NAMES[1:], start=1):
        side, _, part = name.rpartition("_")
        mirror = _MIRROR if side == "right" else np.ones(3)
        xy, xz, yz = _TOGETHER.get(part, (0, 0, 0))
        spread = np.diag(mirror * _RESTING[part][1])
        mean[i] = mirror * _RESTING[part][0]
        precision[i] = np.linalg.inv(spread @ np.array([[1, xy, xz], [xy, 1, yz], [xz, yz, 1]]) @ spread)
    return mean, precision


N_PARTS = 3 + 3 * N_JOINTS + N_BETAS
TURNS, BETAS = slice(3, 3 + 3 * N_JOINTS), slice(3 + 3 * N_JOINTS, N_PARTS)
"""Where turns and betas are in a step, as `Pose.moved` takes it."""
MEAN, PRECISION = resting()

_HEAD = JOINT_NAMES.index("head")
_FLAT = 1e-2
"""Precision of a number of which nothing is known."""
_LOOSE = 0.1
"""How far a first guess may be off [m]."""
_CLOSE = 2e-3
"""A step that moves every keypoint to within this of where a linear one would is the last [m]."""
_BOLDEST = 0.6
"""A step turns no joint by more than this [rad]."""


class Solution(NamedTuple):
    """The most likely pose."""

    pose: Pose
    variance: Array
    """Variance of each of its parts, shape (85,)."""
    step: Array
    """The step to it from the pose where the search began, shape (85,)."""
    cost: float
    """How unlikely it is: minus twice the logarithm of its probability, up to a constant."""


class Solver:
    """Finds the most likely pose of one skeleton's keypoints, and its betas too if it `fits_betas`."""

    def __init__(self, skeleton: Skeleton, *, fits_betas: bool, settings: TrackerSettings) -> None:
        self._skeleton = skeleton
        self._settings = settings
        self._fits_betas = fits_betas
        turns = 3 + 3 * skeleton.turning[:, None] + np.arange(3)
        betas = np.arange(N_PARTS)[BETAS if fits_betas else slice(0)]
        self._free = np.concatenate((np.arange(3), turns.ravel(), betas))
        """The unknowns among the parts of a step."""
        layout = skeleton.layout
        self._head = np.flatnonzero((layout.joints == _HEAD) & layout.is_told) if layout.head_off else np.zeros(0, int)
        of_turns = 3 + np.arange(turns.size).reshape(-1, 3)
        self._blocks = of_turns[:, :, None], of_turns[:, None]
        """Where the turns of each joint stand in the normal equations' matrix."""

    def solve(
        self,
        pose: Pose,
        points: Array,
        weights: Array,
        *,
        deviation: Array,
        prior: Array | None,
        rest: float,
        steps: int,
    ) -> Solution:
        """The most likely pose near `pose`.

        Args:
            pose: where the search begins: the prediction, or a guess.
            points: keypoints [m], shape (K, 3).
            weights: how far each is believed, 0 to 1, shape (K,).
            deviation: of each keypoint along an axis [m], shape (K,).
            prior: precision of the prediction's parts, shape (85,); None for a guess, which has no pull.
            rest: how much the pull of joints to their rest counts, from 0 to 1 for a full observation.
            steps: Gauss-Newton steps at most.
        """
        precision = np.full(N_PARTS, _FLAT) if prior is None else prior
        noise, free = np.square(deviation), self._free
        posed = self._skeleton.posed(pose)
        jacobian = self._skeleton.jacobian(posed, of_betas=self._fits_betas)
        # How far off a sound keypoint may be: by its own noise and by that of the prediction.
        doubt = _LOOSE**2 if prior is None else (np.square(jacobian) @ (1 / prior[free])).reshape(-1, 3).mean(axis=1)
        tolerated = self._settings.outlier**2 * 3 * (noise + doubt)
        step, factor, resting = np.zeros(N_PARTS), None, _Resting(pose, rest)
        pulled = np.zeros(N_PARTS)
        pulled[BETAS] = rest * self._settings.shape_pull
        for k in range(steps):
            off = points - posed.points
            far = np.einsum("ki,ki->k", off, off) / tolerated
            believed = weights / (np.square(1 + far) * noise)
            weighted = np.repeat(believed, 3)[:, None] * jacobian
            if len(self._head):
                self._set_adrift(weighted, believed)
            matrix = jacobian.T @ weighted
            matrix.reshape(-1)[:: len(matrix) + 1] += (precision + pulled)[free]
            matrix[self._blocks] += resting.stiffness[self._skeleton.turning]
            found, info = dpotrf(matrix, lower=1)
            if info:  # not positive definite: the keypoints say nothing
                break
            factor = found
            pull = resting.pull - precision * step
            pull[BETAS] -= pulled[BETAS] * pose.betas
            solved = dpotrs(factor, off.ravel() @ weighted + pull[free], lower=1)[0]
            change = np.zeros(N_PARTS)
            change[free] = solved
            short = min(1.0, _BOLDEST / max(float(np.abs(change[TURNS]).max()), 1e-9))
            change *= short
            pose = pose.moved(change, most_beta=self._settings.most_beta)
            step += change  # successive turns add up, as long as the second one is small
            if k + 1 == steps:
                break
            linear = posed.points + short * (jacobian @ solved).reshape(-1, 3)
            posed = self._skeleton.posed(pose)
            bent = posed.points - linear
            if (np.einsum("ki,ki->k", bent, bent) < _CLOSE**2).all():
                break
            jacobian = self._skeleton.jacobian(posed, of_betas=self._fits_betas)
            resting = _Resting(pose, rest) if prior is None else resting.after(change)
        variance = 1 / np.maximum(precision, _FLAT)
        if factor is not None:
            variance[free] = dpotri(factor, lower=1)[0].diagonal()
            variance[:3] = variance[:3].mean()  # alike along all axes, or the pose would depend on the world's
        off = np.square(points - self._skeleton.posed(pose).points).sum(axis=1)
        unseemly = _squared_deviations(self._skeleton.turning, pose.turns[self._skeleton.turning]).sum()
        cost = (weights * off / ((1 + off / tolerated) * noise)).sum() + precision[free] @ np.square(step[free])
        cost += rest * (unseemly + self._settings.shape_pull * np.square(pose.betas).sum())
        return Solution(pose, variance, step, float(cost))

    def _set_adrift(self, weighted: Array, believed: Array) -> None:
        """Takes from the weighted Jacobian (3 K, n) what the head's keypoints say of their common place."""
        rows, share = weighted.reshape(len(believed), 3, -1), believed[self._head]
        common = rows[self._head].sum(axis=0) / (self._skeleton.layout.head_off**-2 + share.sum())
        rows[self._head] -= share[:, None, None] * common


class _Resting:
    """What pulls joints to where they rest, and how stiffly."""

    def __init__(self, pose: Pose, rest: float) -> None:
        vectors = log_so3(pose.turns)
        inverse = _inverse_right_jacobian(vectors)
        pulling = inverse.swapaxes(1, 2) @ (rest * PRECISION)
        self.stiffness = pulling @ inverse
        """Shape (24, 3, 3)."""
        self.pull = np.zeros(N_PARTS)
        """Shape (85,)."""
        self.pull[TURNS] = (pulling @ (MEAN - vectors)[:, :, None]).ravel()

    def after(self, change: Array) -> _Resting:
        """The same after a small step (85,), to first order."""
        turns = change[TURNS].reshape(N_JOINTS, 3, 1)
        self.pull[TURNS] -= (self.stiffness @ turns).ravel()
        return self


def _inverse_right_jacobian(vectors: Array) -> Array:
    """How rotation vectors (n, 3) change with a turn in the joint's own axes, shape (n, 3, 3)."""
    squared = np.einsum("ij,ij->i", vectors, vectors)
    half = 0.5 * np.sqrt(np.maximum(squared, 1e-6))
    # Written with the half angle's cotangent, which keeps it finite and smooth up to 2π.
    factor = np.where(squared < 1e-6, 1 / 12, (1 - half / np.tan(half)) / (4 * half * half))[:, None, None]
    result: Array = (1 - factor * squared[:, None, None]) * np.eye(3) + 0.5 * skew(vectors)
    result += (factor * vectors[:, :, None]) * vectors[:, None, :]
    return result


_TRUNK = (0, 1, 2, 3, 6, 9, 12, 13, 14, 15, 16, 17)
"""Joints that turn with the pelvis, more or less."""
_BENDS = (1.0, 1.0, -1.0, -1.0)
"""Which way along z the bending hinge of each of the `LIMBS` moves its end in the T-pose: forearms forward, shins
back."""
_HINGED = np.array(LIMBS)[:, :2]
_LEAST = 0.05
"""Least length [m] of a vector that gives a direction; least half width of a trunk that shows which way it faces."""
_BENT = 0.15
"""Least sine of a bend that shows which way a limb is turned."""
_TURNS_ABOUT = np.radians(np.arange(0, 360, 30))
_FAR_LIKELIER = 9.0
"""Difference of squared deviations: as much as of three standard deviations from none."""


def first_pose(skeleton: Skeleton, points: Array, seen: NDArray[np.bool_], start: Pose) -> Pose | None:
    """A pose near that of keypoints [m], shape (K, 3), of which those `seen`, shape (K,), count; None for too few."""
    joints = skeleton.layout.joints
    upright = Pose(start.pelvis, np.broadcast_to(np.eye(3), start.turns.shape).copy(), start.betas)
    rest = skeleton.posed(upright).points
    trunk = seen & np.isin(joints, _TRUNK)
    if trunk.sum() < 3:
        return None
    here, there = rest[trunk], points[trunk]
    centre = here.mean(axis=0), there.mean(axis=0)
    u, spread, vt = np.linalg.svd((there - centre[1]).T @ (here - centre[0]))
    if spread[1] < _LEAST**2:  # all in a line
        return None
    root = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    turns = start.turns.copy()
    turns[0] = root
    bones = skeleton.bones(start.betas)
    pelvis = centre[1] + root @ (upright.pelvis - centre[0])
    world = skeleton.posed(Pose(pelvis, turns, start.betas)).turns
    for (ball, hinge, end, _), bends in zip(LIMBS, _BENDS, strict=True):
        at = [skeleton.layout.at_joint(joint) for joint in (ball, hinge, end)]
        if at[0] < 0 or at[1] < 0 or not (seen[at[0]] and seen[at[1]]):
            continue
        above = world[PARENTS[ball]]
        upper = above.T @ (points[at[1]] - points[at[0]])
        lower = above.T @ (points[at[2]] - points[at[1]]) if at[2] >= 0 and seen[at[2]] else np.zeros(3)
        lengths = np.linalg.norm(upper), np.linalg.norm(lower)
        if lengths[0] < _LEAST:
            continue
        has_end = lengths[1] >= _LEAST
        is_bent = has_end and np.linalg.norm(np.cross(upper, lower)) >= _BENT * lengths[0] * lengths[1]
        n = 2 if is_bent else 1
        turns[ball] = _aligned([bones[hinge], np.array([0, 0, bends])][:n], [upper, lower][:n])
        if has_end:
            turns[hinge] = _aligned([bones[end]], [turns[ball].T @ lower])
    return Pose(pelvis, turns, start.betas)


def twisted_wrongly(pose: Pose, skeleton: Skeleton) -> list[tuple[NDArray[np.intp], Array]]:
    """Limbs that would be far likelier if they were turned about their own bones, which moves no keypoint.

    A straight arm doesn't show how it is turned; where that was guessed wrongly, its elbow bends the wrong way, and no
    small step mends it. No more does one where a thigh is turned by half a turn, and knee and foot against it.

    Returns the joints of each (n,), and the turns about the bones that they carry (n, 3, 3), each in the joint's own
    axes. The next joint undoes it.
    """
    wrong = []
    odds = _squared_deviations(_HINGED.ravel(), pose.turns[_HINGED.ravel()]).reshape(_HINGED.shape).sum(axis=1)
    for i in np.flatnonzero(odds > _FAR_LIKELIER):
        joints, ends = skeleton.chains[i]
        bones = skeleton.bones(pose.betas)[ends]
        axes = bones / np.maximum(np.linalg.norm(bones, axis=1), _LEAST)[:, None]
        tried = [np.eye(3)[None], *(exp_so3(_TURNS_ABOUT[:, None] * axis) for axis in axes)]
        tried += tried[:1] * (len(joints) - len(ends))
        least, choices = np.zeros(1), []
        for joint, above, own in zip(joints, tried, tried[1:], strict=False):
            turned = above.swapaxes(1, 2)[:, None] @ pose.turns[joint] @ own
            odds_of = _squared_deviations(np.full(turned[..., 0, 0].size, joint), turned.reshape(-1, 3, 3))
            both = least[:, None] + odds_of.reshape(turned.shape[:2])
            choices.append(both.argmin(axis=0))
            least = both.min(axis=0)
        if least.min() < _squared_deviations(joints, pose.turns[joints]).sum() - _FAR_LIKELIER:
            best, about = int(least.argmin()), []
            for own, choice in zip(reversed(tried[1:]), reversed(choices), strict=True):
                about.append(own[best])
                best = choice[best]
            wrong.append((joints, np.stack(about[::-1])))
    return wrong


def turned_about_bones(turns: Array, about: Array) -> Array:
    """Turns of a limb's joints (n, 3, 3) after those `about` the bones that they carry (n, 3, 3)."""
    above = np.concatenate([np.eye(3)[None], about[:-1]])
    result: Array = above.swapaxes(1, 2) @ turns @ about
    return result


def _squared_deviations(joints: NDArray[np.intp], turns: Array) -> Array:
    """How far `joints` (n,) with these turns (n, 3, 3) are from their rest, in squared standard deviations, (n,)."""
    off = log_so3(turns) - MEAN[joints]
    squared: Array = np.einsum("ni,nij,nj->n", off, PRECISION[joints], off)
    return squared


def _aligned(before: list[Array], after: list[Array]) -> Array:
    """The smallest rotation of one direction onto another (3,); with two of each, the second is only turned towards."""
    return Rotation.align_vectors(after, before, weights=[np.inf, 1.0][: len(before)])[0].as_matrix()
