"""What is simulated: which shape, style and pose each slot of a data set has.

Every draw comes from a generator seeded with the plan's seed and the number of the item drawn, so a slot is the same on
every machine, in any order and after any interruption.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from numbers import Real

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from refu_core.errors import SimulationError
from refu_core.frames import N_BETAS
from refu_core.garments import N_STYLES, garment_name
from refu_core.simulation._poses import FIRST_POSTURES, POSTURES, Clip, drawn_pose

TRAIN, TEST = 0, 1
_MOST = 10**9


def garments_of(garment: str | Sequence[str]) -> list[str]:
    """The garments of a plan, as they were given."""
    return [garment] if isinstance(garment, str) else list(garment)


def names_of(garment: str | Sequence[str]) -> str:
    """The garments' names, sorted and joined by `+`, whatever their files are called; takes a card's joined name."""
    return "+".join(sorted(name for one in garments_of(garment) for name in garment_name(one).split("+")))


def truncated_normal(u: NDArray[np.float64], spread: float) -> NDArray[np.float32]:
    """Maps uniform `u` in [0, 1) to normal numbers of this standard deviation, cut off at ±2."""
    edge = ndtr(2 / spread)
    return np.clip(spread * ndtri((1 - edge) + u * (2 * edge - 1)), -2, 2).astype(np.float32)


@dataclass(frozen=True)
class SamplePlan:
    """The slots of one data set.

    Half of the training samples belong to `pivots` style-shape pairs with many poses each (TailorNet has one
    high-frequency network per pivot), the other half to pairs with `poses_per_pair` poses (its low-frequency and
    style-shape networks learn from these). Test samples have their own pairs, and poses from clips kept for the test.
    """

    garment: str | Sequence[str]
    """One garment, or several that are simulated together."""
    count: int
    """Samples in the set, training and test together."""
    seed: int = 0
    test_share: float = 1 / 6
    pivots: int = 20
    poses_per_pair: int = 6
    recorded_share: float = 0.6
    """Share of poses that are frames of motions."""
    posture_share: float = 0.0
    """Share of poses that are varied everyday postures (`POSTURES`)."""
    acrobatic_share: float = 0.0
    """Share of poses of acrobats (`acrobatic_pose`); the rest are drawn within the limits of human joints."""
    spread: float = 1.2
    """Standard deviation of β and γ before they are cut off at ±2."""
    block: int = 12
    """Most slots that are simulated one after the other from one canonical drape."""
    postures: Sequence[str] = FIRST_POSTURES
    """Names of the postures that are drawn, each as often."""

    def __post_init__(self) -> None:
        """Raises `SimulationError` for values that make no plan; plans are also read from cards."""
        whole = self.count, self.seed, self.pivots, self.poses_per_pair, self.block
        shares = self.test_share, self.recorded_share, self.posture_share, self.acrobatic_share, self.spread
        is_named = isinstance(self.garment, (str, list, tuple)) and all(isinstance(name, str) for name in self.garment)
        is_whole = all(isinstance(number, int) and 0 <= number <= _MOST for number in whole)
        if not (is_named and is_whole and all(isinstance(share, Real) for share in shares)):
            wanted = f"names of garments, whole numbers from 0 to {_MOST}, and shares"
            raise SimulationError(f"a plan is made of {wanted}, got {str(asdict(self))[:400]}")
        if min(self.count, self.pivots, self.poses_per_pair, self.block) < 1:
            raise SimulationError(f"count, pivots, poses_per_pair and block must be at least 1, got {asdict(self)}")
        is_listed = isinstance(self.postures, (list, tuple)) and len(self.postures) > 0
        if not is_listed or not all(isinstance(name, str) and name in POSTURES for name in self.postures):
            known = f"{', '.join(POSTURES)[:160]}…"
            raise SimulationError(f"wanted names of postures, from {known}, got {str(self.postures)[:80]}")
        object.__setattr__(self, "postures", list(self.postures))  # as a card has it
        of_poses = self.recorded_share, self.posture_share, self.acrobatic_share
        if not (0 <= self.test_share < 1 and min(of_poses) >= 0 and sum(of_poses) <= 1 and self.spread > 0):
            wanted = "shares must lie in [0, 1), those of poses sum up to 1 at most, and the spread be above 0"
            raise SimulationError(f"{wanted}, got {asdict(self)}")

    @property
    def n_test(self) -> int:
        """Test samples."""
        return round(self.count * self.test_share)

    @property
    def n_pivot(self) -> int:
        """Training samples of the pivots: the first ones of the set."""
        return (self.count - self.n_test) // 2

    def pair_of(self, slot: int) -> int:
        """Number of the style-shape pair of a slot; the pivots are 0 to `pivots` - 1."""
        if slot < self.n_pivot:
            return slot * self.pivots // self.n_pivot
        n_train = self.count - self.n_test
        if slot < n_train:
            return self.pivots + (slot - self.n_pivot) // self.poses_per_pair
        first = self.pivots + -(-(n_train - self.n_pivot) // self.poses_per_pair)
        return first + (slot - n_train) // self.poses_per_pair

    def split_of(self, slot: int) -> int:
        """`TRAIN` or `TEST`."""
        return TEST if slot >= self.count - self.n_test else TRAIN

    def blocks(self) -> list[range]:
        """The slots in runs of one style-shape pair and at most `block` slots, in an order that mixes all kinds.

        This makes a set representative from its first hour on.
        """
        runs: list[range] = []
        start = 0
        for slot in range(1, self.count + 1):
            if slot == self.count or slot - start == self.block or self.pair_of(slot) != self.pair_of(start):
                runs.append(range(start, slot))
                start = slot
        order = np.random.default_rng(self._key(0)).permutation(len(runs))
        return [runs[k] for k in order]

    def _key(self, *numbers: int) -> list[int]:
        return [self.seed, zlib.crc32(names_of(self.garment).encode()), *numbers]

    def style_shape(self, pair: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """β (10,) and γ (4,) of a pair, normal, cut off at ±2; the pivots are spread evenly over each coordinate."""
        if pair < self.pivots:
            rng = np.random.default_rng(self._key(1))
            cells = np.stack([rng.permutation(self.pivots) for _ in range(N_BETAS + N_STYLES)], 1)
            u = (cells[pair] + rng.random((self.pivots, N_BETAS + N_STYLES))[pair]) / self.pivots
        else:
            u = np.random.default_rng(self._key(2, pair)).random(N_BETAS + N_STYLES)
        value = truncated_normal(u, self.spread)
        return value[:N_BETAS], value[N_BETAS:]

    def pose(self, slot: int, attempt: int, clips: Sequence[Clip]) -> tuple[NDArray[np.float32], int, int]:
        """The pose that a slot tries at its `attempt`, and its clip and frame, as `drawn_pose` tells them."""
        rng = np.random.default_rng(self._key(3, slot, attempt))
        return drawn_pose(
            clips,
            rng,
            recorded_share=self.recorded_share,
            posture_share=self.posture_share,
            acrobatic_share=self.acrobatic_share,
            postures=self.postures,
        )
