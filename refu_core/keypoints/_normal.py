"""The normal equations of keypoints, from sums over limbs instead of a Jacobian.

Whatever hangs from a joint turns with it as one rigid body. So what a turn does to all of its keypoints follows from a
few sums over them: their moments, as with the inertia of a composite body. Turns are about the world's axes here, and
unknowns are in the order (pelvis 3, turns of `Skeleton.turning` 3 m, betas).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.keypoints._pose import CARRIES, Posed, Skeleton, axes_of, skew

Array = NDArray[np.float64]

_I = np.eye(3).ravel()
_TRACE_LESS = np.outer(_I, _I) - np.eye(9)
"""Makes its trace, times the identity, less itself of a matrix (9,)."""


class NormalEquations:
    """Those of one skeleton's keypoints: JᵀWJ x = JᵀW off.

    Args:
        skeleton: whose they are.
        fits_betas: whether betas are among the unknowns.
    """

    def __init__(self, skeleton: Skeleton, *, fits_betas: bool) -> None:
        self.turning = skeleton.turning
        self._n_turns = m = len(skeleton.turning)
        self._n_betas = N_BETAS if fits_betas else 0
        self.size = 3 + 3 * m + self._n_betas
        """Number of unknowns."""
        self._carried = skeleton.carried
        self._carries = np.ascontiguousarray(skeleton.carried.T)
        self._chains = CARRIES[:, skeleton.turning].T.astype(np.float64)
        self._of_joint = (np.arange(N_JOINTS)[:, None] == skeleton.layout.joints).astype(np.float64)
        self._joints = skeleton.layout.joints
        below, above = np.nonzero(np.tril(CARRIES[np.ix_(skeleton.turning, skeleton.turning)], -1))
        own = np.arange(m)  # the blocks on the diagonal come first
        self._below, self._above = np.concatenate([own, below]), np.concatenate([own, above])
        rows, columns = (3 + 3 * which[:, None, None] for which in (self._below, self._above))
        xyz = np.arange(3)
        self._blocks = ((columns + xyz) * self.size + rows + xyz[:, None]).reshape(-1, 9)

    def matrix(self, posed: Posed, weights: Array, diagonal: Array, held: Array) -> Array:
        """JᵀWJ and what is added to it, shape (size, size); its upper triangle holds nothing.

        Args:
            posed: where the skeleton is.
            weights: how far each keypoint counts [1/m²], shape (K,).
            diagonal: added to the unknowns' diagonal, shape (size,).
            held: added to the turns' blocks, shape (m, 3, 3).
        """
        m, size = self._n_turns, self.size
        columns: Array = np.zeros((size, size))  # each row is a column of the matrix
        turns, betas = slice(3, 3 + 3 * m), slice(3 + 3 * m, size)
        joints = posed.joints[self.turning]
        places = np.ones((len(weights), 4))
        places[:, :3] = posed.points
        weighted = weights[:, None] * places
        squares = weighted[:, :, None] * places[:, None, :]
        moments = (self._carries @ squares.reshape(-1, 16)).reshape(m, 4, 4)
        sums = moments[:, :3, 3]
        arms = sums - moments[:, 3, 3, None] * joints
        # Of two joints the arms from them to what both carry: Σ w a bᵀ, with a from the one above.
        about = moments[:, :3, :3] - sums[:, :, None] * joints[:, None, :]
        pairs = about[self._below] - joints[self._above][:, :, None] * arms[self._below][:, None, :]
        blocks = pairs.reshape(-1, 9) @ _TRACE_LESS
        blocks[:m] += held.reshape(m, 9)
        columns.reshape(-1)[self._blocks] = blocks
        columns[:3, turns] = skew(arms).transpose(2, 0, 1).reshape(3, -1)
        if self._n_betas:
            of_joints = self._of_joint @ weighted
            pulled = of_joints[:, 3, None, None] * posed.moves
            both = np.concatenate([skew(of_joints[:, :3]) @ posed.moves, pulled], axis=1).reshape(N_JOINTS, -1)
            of_arms = (self._chains @ both).reshape(m, 6, -1)
            moves = posed.moves.reshape(3 * N_JOINTS, -1)
            columns[:3, betas] = of_arms[0, 3:]
            columns[turns, betas] = (of_arms[:, :3] - skew(joints) @ of_arms[:, 3:]).reshape(3 * m, -1)
            columns[betas, betas] = moves.T @ pulled.reshape(moves.shape)
        own = columns.reshape(-1)[:: size + 1]
        own += diagonal
        own[:3] += weighted[:, 3].sum()
        matrix: Array = columns.T
        return matrix

    def right(self, posed: Posed, weights: Array, off: Array) -> Array:
        """JᵀW off, shape (size,), of what is from keypoints to where they are seen [m], shape (K, 3)."""
        m = self._n_turns
        ways = weights[:, None] * off
        torques = axes_of(ways[:, :, None] * posed.points[:, None, :])
        both = self._carries @ np.concatenate([torques, ways], axis=1)
        right = np.empty(self.size)
        right[:3] = ways.sum(axis=0)
        turns = both[:, :3] - axes_of(both[:, 3:, None] * posed.joints[self.turning][:, None, :])
        right[3 : 3 + 3 * m] = turns.ravel()
        if self._n_betas:
            right[3 + 3 * m :] = (self._of_joint @ ways).ravel() @ posed.moves.reshape(3 * N_JOINTS, -1)
        return right

    def moved(self, posed: Posed, step: Array) -> Array:
        """Keypoints [m], shape (K, 3), after a step (size,), to first order."""
        m, points = self._n_turns, posed.points
        turns = skew(step[3 : 3 + 3 * m].reshape(m, 3))
        shifts = -(turns @ posed.joints[self.turning][:, :, None])
        whole = (self._carried @ np.concatenate([turns, shifts], axis=2).reshape(m, 12)).reshape(-1, 3, 4)
        moved: Array = points + step[:3] + np.einsum("kij,kj->ki", whole[:, :, :3], points) + whole[:, :, 3]
        return moved + (posed.moves @ step[3 + 3 * m :])[self._joints] if self._n_betas else moved

    def doubt(self, posed: Posed, pelvis: Array, turns: Array, betas: Array) -> Array:
        """Variance of the keypoints along an axis, on average [m²], shape (K,).

        Args:
            posed: where the skeleton is.
            pelvis: variances [m²], shape (3,).
            turns: of each joint that turns about its own axes [rad²], shape (m, 3).
            betas: shape (10,).
        """
        m, back = self._n_turns, posed.turns[self.turning].swapaxes(1, 2)
        arms = np.concatenate([back, -(back @ posed.joints[self.turning][:, :, None])], axis=2)
        # |t × r|² over the axes t of a joint is a square form of r, and those of all joints above are one.
        forms = arms.swapaxes(1, 2) @ ((turns.sum(axis=1, keepdims=True) - turns)[:, :, None] * arms)
        whole = (self._carried @ forms.reshape(m, 16)).reshape(-1, 4, 4)
        points = np.ones((len(posed.points), 4))
        points[:, :3] = posed.points
        doubt: Array = pelvis.sum() + np.einsum("ki,kij,kj->k", points, whole, points)
        if self._n_betas:
            doubt = doubt + (np.square(posed.moves).sum(axis=1) @ betas)[self._joints]
        return doubt / 3
