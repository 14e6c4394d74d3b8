"""What is believed about one garment's numbers: a Kalman filter whose prior never goes away."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.linalg.lapack import dpotri

F64 = NDArray[np.float64]
_AT_ONCE = 1e-9
"""Time counts only once at least this share of the prior's variance comes back in it."""


class Estimate:
    """A mean and a precision of D numbers that return to zero by themselves (an Ornstein–Uhlenbeck process).

    Numbers are in standard deviations of the prior, whose precision is therefore the identity. Between frames each
    number fades towards zero, and its variance grows towards the prior's. So information is forgotten, yet nothing can
    drift: without measurements the prediction is left as it was, and with them every number stays within its bound.
    """

    def __init__(self, times: F64, bound: float) -> None:
        """For the times in which numbers fade to a third [s], (D,), and the bound of all numbers."""
        self._times, self._limit = times, bound
        self.reset()

    def reset(self) -> None:
        """Forgets everything."""
        self.mean = np.zeros_like(self._times)
        self.precision = np.eye(len(self._times))
        """The inverse of the covariance, shape (D, D)."""
        self.is_informed = False
        """Whether anything was measured since the last reset."""

    def wait(self, seconds: float) -> None:
        """Lets time pass."""
        keeps = np.exp(-seconds / self._times)
        comes = 1 - keeps**2
        if not self.is_informed or comes.min() < _AT_ONCE:
            return
        self.mean = keeps * self.mean
        # The covariance becomes K C K + Q. Its inverse is Q⁻¹ - Q⁻¹ K (C⁻¹ + K Q⁻¹ K)⁻¹ K Q⁻¹ (Woodbury).
        rows = np.arange(len(keeps))
        between = self.precision
        between[rows, rows] += keeps**2 / comes
        ratio = keeps / comes
        self.precision = _inverse(between) * -ratio[:, None] * ratio
        self.precision[rows, rows] += 1 / comes

    def updated(self, information: F64, pull: F64) -> tuple[F64, F64]:
        """Mean (D,) and precision (D, D) after measurements of `information` JᵀWJ and `pull` JᵀW(r + J c)."""
        total = self.precision + information
        mean = cho_solve(cho_factor(total, check_finite=False), self.precision @ self.mean + pull, check_finite=False)
        return np.clip(mean, -self._limit, self._limit), total

    def take(self, mean: F64, precision: F64) -> None:
        """Takes over a mean (D,) and a precision (D, D)."""
        self.mean, self.precision, self.is_informed = mean, precision, True


def _inverse(matrix: F64) -> F64:
    """Symmetric inverse of a symmetric positive definite matrix (D, D), by half the work of `inv`; overwrites it."""
    factor, _ = cho_factor(matrix.T, lower=True, overwrite_a=True, check_finite=False)
    found, failed = dpotri(factor, lower=True, overwrite_c=True)
    if failed:
        msg = f"row {failed} of the factor is zero"
        raise LinAlgError(msg)
    half = np.tril(found)
    half += np.tril(half, -1).T
    return np.asarray(half)
