"""What is believed of one garment's numbers: a Kalman filter whose prior never goes away."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.linalg.lapack import dpotri

F64 = NDArray[np.float64]


class Estimate:
    """A mean and a covariance of D numbers that return to zero by themselves (an Ornstein–Uhlenbeck process).

    Between frames each number fades towards zero, and what is unknown of it grows towards its prior. So information is
    forgotten, yet nothing can drift: without measurements the prediction is left as it was, and with them every number
    stays within its bound.
    """

    def __init__(self, std: F64, times: F64, bound: float) -> None:
        """Of the prior's standard deviations (D,), the times in which numbers fade to a third [s], (D,), and bounds in
        standard deviations."""
        self._std, self._times, self._limit = std, times, bound * std
        self.reset()

    def reset(self) -> None:
        """Forgets all."""
        self.mean = np.zeros_like(self._std)
        self.covariance = np.diag(self._std**2)

    def wait(self, seconds: float) -> None:
        """Lets time pass."""
        keeps = np.exp(-seconds / self._times)
        self.mean = keeps * self.mean
        self.covariance = keeps[:, None] * self.covariance * keeps
        rows = np.arange(len(keeps))
        self.covariance[rows, rows] += (1 - keeps**2) * self._std**2

    def precision(self) -> F64:
        """The inverse of the covariance, shape (D, D)."""
        return _inverse(self.covariance)

    def updated(self, precision: F64, information: F64, pull: F64) -> tuple[F64, F64]:
        """Mean (D,) and precision (D, D) after measurements of `information` JᵀWJ and `pull` JᵀW(r + J c).

        `precision` is that before.
        """
        total = precision + information
        mean = cho_solve(cho_factor(total), precision @ self.mean + pull)
        return np.clip(mean, -self._limit, self._limit), total

    def take(self, mean: F64, precision: F64) -> None:
        """Believes this from now on."""
        self.mean = mean
        self.covariance = _inverse(precision)


def _inverse(matrix: F64) -> F64:
    """Of a symmetric positive definite matrix (D, D): half the work of solving for each unit vector, and symmetric."""
    factor, lower = cho_factor(matrix, lower=True)
    found, failed = dpotri(factor, lower=lower)
    if failed:
        msg = f"row {failed} of the factor is zero"
        raise LinAlgError(msg)
    half = np.tril(found)
    return np.asarray(half + np.tril(half, -1).T)
