"""The most likely pose for keypoints: Gauss-Newton steps on what is seen, what was predicted, and how joints rest."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.keypoints._pose import Pose, Skeleton, log_so3, skew
from refu_core.keypoints._settings import TrackerSettings
from refu_core.skeleton import JOINT_NAMES

Array = NDArray[np.float64]

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
    "shoulder": ((0.1, -0.4, -1.1), (0.6, 0.7, 0.7)),
    "elbow": ((0, -0.8, 0.3), (0.25, 0.7, 0.35)),
    "wrist": ((-0.1, 0.1, 0.2), (0.35, 0.4, 0.3)),
    "hand": ((0, 0, 0), (0.1, 0.1, 0.1)),
}
_MIRROR = np.array([1.0, -1, -1])


def resting() -> tuple[Array, Array]:
    """Mean and standard deviation of each joint's rotation vector [rad], shapes (24, 3); the root's spread is 100."""
    mean, spread = np.zeros((len(JOINT_NAMES), 3)), np.full((len(JOINT_NAMES), 3), 100.0)
    for i, name in enumerate(JOINT_NAMES[1:], start=1):
        side, _, part = name.rpartition("_")
        mean[i], spread[i] = _RESTING[part]
        if side == "right":
            mean[i] *= _MIRROR
    return mean, spread


N_PARTS = 3 + 3 * N_JOINTS + N_BETAS
TURNS, BETAS = slice(3, 3 + 3 * N_JOINTS), slice(3 + 3 * N_JOINTS, N_PARTS)
"""Where turns and betas are in a step, as `Pose.moved` takes it."""
MEAN, SPREAD = resting()

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
        pulled[BETAS] = rest
        for k in range(steps):
            off = points - posed.points
            far = np.einsum("ki,ki->k", off, off) / tolerated
            weighted = np.repeat(weights / (np.square(1 + far) * noise), 3)[:, None] * jacobian
            matrix = jacobian.T @ weighted
            matrix.reshape(-1)[:: len(matrix) + 1] += (precision + pulled)[free]
            matrix[self._blocks] += resting.stiffness[self._skeleton.turning]
            found, info = dpotrf(matrix, lower=1)
            if info:  # not positive definite: the keypoints say nothing
                break
            factor = found
            pull = resting.pull - precision * step
            pull[BETAS] -= rest * pose.betas
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
        return Solution(pose, variance, step)


class _Resting:
    """What pulls joints to where they rest, and how stiffly."""

    def __init__(self, pose: Pose, rest: float) -> None:
        vectors = log_so3(pose.turns)
        inverse = _inverse_right_jacobian(vectors)
        strength = rest / SPREAD**2
        transposed = inverse.swapaxes(1, 2)
        self.stiffness = transposed @ (inverse * strength[:, :, None])
        """Shape (24, 3, 3)."""
        self.pull = np.zeros(N_PARTS)
        """Shape (85,)."""
        self.pull[TURNS] = (transposed @ ((MEAN - vectors) * strength)[:, :, None]).ravel()

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
