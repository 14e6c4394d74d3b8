"""A person's keypoints, frame by frame, to a pose of SMPL: a Kalman filter on the pose.

The state is a pose (pelvis, the turns of the joints, betas) and the rates of its parts, each with its variance. A frame
of keypoints updates it by Gauss-Newton steps towards the most likely pose, given the keypoints as far as they are seen
and believed, the predicted pose, and how joints rest. So bones keep their lengths, a joint that isn't seen moves on for
a while and then comes to rest, and how much a keypoint moves the pose depends on how certain both are.
"""

from __future__ import annotations

import math
from numbers import Integral
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from refu_core._numbers import NOT_NUMBERS, as_numbers
from refu_core.errors import FrameError, as_before_if_it_fails, require_type
from refu_core.frames import N_BETAS, N_JOINTS, SmplFrame, checked_numbers
from refu_core.keypoints._pose import Array, Pose, Skeleton, exp_so3, log_so3
from refu_core.keypoints._solver import (
    BETAS,
    MEAN,
    N_PARTS,
    TURNS,
    Solution,
    Solver,
    TrackerSettings,
    first_pose,
    turned_about_bones,
    twisted_wrongly,
)
from refu_core.skeleton import JOINT_NAMES

DEFAULTS = TrackerSettings()


class _Seen(NamedTuple):
    """A frame of keypoints, cleaned."""

    points: Array
    """[m], shape (K, 3); zeros where nothing is seen."""
    weights: Array
    """Confidence from 0 to 1, shape (K,)."""


class KeypointTracker:
    """Tracks one person by keypoints of a skeleton, that of the body that is dressed. Not thread-safe.

    The person's `betas` (10,) are estimated from the lengths of bones if they aren't given.
    """

    def __init__(
        self, skeleton: Skeleton, *, betas: ArrayLike | None = None, settings: TrackerSettings = DEFAULTS
    ) -> None:
        require_type(skeleton, Skeleton, "a Skeleton", error=FrameError)
        self.skeleton = skeleton
        self._settings = settings
        self._known = None if betas is None else checked_numbers("betas", betas, (N_BETAS,), np.float64)
        self._solver = Solver(skeleton, fits_betas=betas is None, settings=settings)
        layout = skeleton.layout
        joints, other = layout.joints, layout.mirrored
        has_side = other != np.arange(len(other))
        self._with_a_side = np.flatnonzero(has_side)
        self._parts = [[np.flatnonzero(np.isin(joints, part) & has_side) for part in limb] for limb in _OUTWARDS]
        power = [np.full(3, settings.push), np.full(3 * N_JOINTS, settings.twist), np.zeros(N_BETAS)]
        self._power = np.concatenate(power) / settings.smoothing**2
        self._coast = np.concatenate([np.full(3, settings.pelvis_coast), np.full(N_PARTS - 3, settings.coast)])
        self._offset = np.where(layout.is_joint, 0.0, settings.offset_noise)
        self._offset[~layout.is_sure] = settings.unsure_noise
        self.reset()

    def reset(self) -> None:
        """Forgets the person."""
        self._is_here = False
        self._sent_betas: Array | None = None
        self._stamp = self._seen_at = 0
        self._noise = self._settings.noise
        self._swapped_for = self._unfit_for = 0.0

    # A frame --------------------------------------------------------------------------------------

    @property
    def stamp_ns(self) -> int:
        """Time stamp of the newest keypoints, 0 without a person [ns]."""
        return self._stamp

    def update(self, points: ArrayLike, stamp_ns: int, *, confidence: ArrayLike | None = None) -> SmplFrame | None:
        """The pose after a frame of keypoints, None while no person is seen.

        Args:
            points: [m], shape (K, 3); a keypoint that isn't seen is NaN, or has no confidence.
            stamp_ns: when they were seen [ns]. Keypoints older than the newest change nothing; after a second without
                any, or if the clock was set back by more than that, the track begins anew.
            confidence: from 0 to 1, shape (K,); NaN and negative numbers count as 0. In a frame that has one above 2,
                all are out of 100.

        Raises `FrameError`: another number of keypoints, values that aren't numbers, or that can't be metres. Whatever
        it raises, an interrupt too, the track is as it was.
        """
        require_type(stamp_ns, Integral, "a whole number of nanoseconds", error=FrameError)
        seen = self._cleaned(points, confidence)
        with as_before_if_it_fails(self):
            return self._updated(seen, int(stamp_ns))

    def _updated(self, seen: _Seen, stamp_ns: int) -> SmplFrame | None:
        dt = 1e-9 * (stamp_ns - self._stamp)
        if self._is_here and not -1.0 < dt <= 1.0:
            self.reset()
        if not self._is_here:
            return self._begin(seen, stamp_ns)
        if dt <= 0:
            return self.at(self._stamp)
        self._predict(dt)
        self._stamp = stamp_ns
        if (seen.weights > 0).any():
            sided = self._sided(seen)
            if sided is None:
                self.reset()
                return self._begin(seen, stamp_ns)
            self._correct(sided, dt)
            if max(self._unfit_for, self._swapped_for) > self._settings.doubt:
                self._begin_again(seen)
            self._unwind(seen)
        if 1e-9 * (stamp_ns - self._seen_at) > self._settings.hold:
            self.reset()
        return self.at(stamp_ns)

    def at(self, stamp_ns: int) -> SmplFrame | None:
        """The pose at another time, before the next keypoints: rates continue, and die away.

        None if nobody was seen for `hold`. Raises `FrameError` for a time that isn't one.
        """
        require_type(stamp_ns, Integral, "a whole number of nanoseconds", error=FrameError)
        stamp_ns = int(stamp_ns)
        if not self._is_here or 1e-9 * (stamp_ns - self._seen_at) > self._settings.hold:
            return None
        dt = 1e-9 * (stamp_ns - self._stamp)
        pose = self._pose.moved(self._coast * (1 - np.exp(-dt / self._coast)) * self._rate) if dt > 0 else self._pose
        if self._sent_betas is None or np.abs(pose.betas - self._sent_betas).max() > self._settings.beta_step:
            self._sent_betas = pose.betas.copy()
        betas = self._sent_betas
        transl = pose.pelvis - self.skeleton.proportions.of(betas)[0]
        return SmplFrame(log_so3(pose.turns), betas, transl, stamp_ns=stamp_ns)

    def _cleaned(self, points: ArrayLike, confidence: ArrayLike | None) -> _Seen:
        n = len(self.skeleton.layout)
        try:
            given = as_numbers(points).astype(np.float64)
            weights = np.ones(n) if confidence is None else as_numbers(confidence, also="b").astype(np.float64)
        except NOT_NUMBERS as error:
            raise FrameError(f"wanted {n} keypoints of {self.skeleton.layout.name} as numbers: {error}") from error
        if given.shape != (n, 3) or weights.shape != (n,):
            msg = f"wanted {n} keypoints of {self.skeleton.layout.name}, got {given.shape} and {weights.shape}"
            raise FrameError(msg)
        weights[~(weights > 0)] = 0.0
        is_percent = weights.max(initial=0.0) > _MOST_SCORE
        weights = np.minimum(weights / 100 if is_percent else weights, 1.0)
        here = np.isfinite(given).all(axis=1) & (np.abs(given) < 1e6).all(axis=1)
        weights[~here | (weights < _LEAST) | ~self.skeleton.layout.is_told] = 0.0
        seen = given[weights > 0]
        if len(seen) and np.median(np.linalg.norm(seen - np.median(seen, axis=0), axis=1)) > _FARTHEST:
            msg = f"most of a person's keypoints are over {_FARTHEST:g} m from their middle, wanted metres"
            raise FrameError(f"{msg}: does the tracker send millimetres or centimetres?")  # alike for every frame
        return _Seen(np.where(weights[:, None] > 0, given, 0.0), weights)

    # Beginnings -----------------------------------------------------------------------------------

    def _begin(self, seen: _Seen, stamp_ns: int) -> SmplFrame | None:
        guess = self._guessed(seen)
        if guess is None:
            return None
        self._take(guess)
        self._stamp = self._seen_at = stamp_ns
        return self.at(stamp_ns)

    def _guessed(self, seen: _Seen) -> tuple[Pose, Array, float] | None:
        """The pose, its variances, and how badly it fits [m], from one frame alone, left and right as they fit best."""
        found, other = [], self.skeleton.layout.mirrored
        betas = np.zeros(N_BETAS) if self._known is None else self._known
        neutral = Pose(np.zeros(3), exp_so3(MEAN), betas)
        for sides in (seen, _Seen(seen.points[other], seen.weights[other])):
            pose = first_pose(self.skeleton, sides.points, sides.weights > 0, neutral)
            if pose is not None:
                solved = self._solved(pose, sides, prior=None, rest=1.0, steps=8)
                found.append((solved.pose, solved.variance, self._misfit(solved.pose, sides)))
                if found[0][2] < _FITS:
                    break
        if not found:
            return None
        # What the tracker says is believed unless the mirror image fits much better: most people are symmetric.
        return found[1] if len(found) == 2 and found[1][2] < 0.5 * found[0][2] else found[0]

    def _take(self, guess: tuple[Pose, Array, float]) -> None:
        self._is_here = True
        self._pose, self._variance, _ = guess
        self._rate = np.zeros(N_PARTS)
        self._mixed = np.zeros(N_PARTS)
        self._rate_variance = np.concatenate([np.full(3, 1.0), np.full(3 * N_JOINTS, 4.0), np.zeros(N_BETAS)])
        self._swapped_for = self._unfit_for = 0.0

    def _begin_again(self, seen: _Seen) -> None:
        """Starts again from this frame alone if that fits better, once pose or sides haven't fitted for long."""
        self._swapped_for = self._unfit_for = 0.0
        guess = self._guessed(seen)
        if guess is not None and guess[2] < 0.7 * self._misfit(self._pose, seen):
            self._take(guess)

    def _unwind(self, seen: _Seen) -> None:
        """Starts again from this frame alone if a spine is wound up, as after a cut at which somebody turned."""
        wound = _wound(self._pose)
        guess = self._guessed(seen) if wound > _WOUND else None
        if guess is not None and _wound(guess[0]) < wound:
            self._take(guess)

    def _misfit(self, pose: Pose, seen: _Seen) -> float:
        """Root mean square distance of keypoints from where the pose has them, each at most 0.5 [m]."""
        off = np.linalg.norm(self.skeleton.posed(pose).points - seen.points, axis=1)[seen.weights > 0]
        return float(np.sqrt(np.mean(np.minimum(off, 0.5) ** 2))) if len(off) else 0.0

    def _sided(self, seen: _Seen) -> list[_Seen] | None:
        """The frame as told, and with sides exchanged in each way that may be; None if it is somebody else's.

        If all keypoints are near where they were expected, there is no other way.
        """
        expected = self.skeleton.posed(self._pose).points
        off = np.square(seen.points - expected).sum(axis=1)
        visible = seen.weights > 0
        if off[visible].max() < _NEAR**2:
            return [seen]
        if visible.sum() >= 4 and float(np.median(off[visible])) > self._settings.jump**2:
            return None
        other = self.skeleton.layout.mirrored
        exchanged = np.square(seen.points - expected[other]).sum(axis=1)
        told, exchanged = (np.where(visible, np.minimum(squared, _FAR**2), 0.0) for squared in (off, exchanged))
        gained = told - exchanged
        # All of them, or of each limb the part that explains most.
        of_limbs = [max(limb, key=lambda part: float(gained[part].sum())) for limb in self._parts]
        ways = [self._with_a_side], [part for part in of_limbs if gained[part].sum() > 0]
        found = [seen]
        for way in ways:
            if sum(float(gained[part].sum()) for part in way) > 0:
                taken = np.arange(len(other))
                for part in way:
                    taken[part] = other[part]
                found.append(_Seen(seen.points[taken], seen.weights[taken]))
        return found

    # The filter -----------------------------------------------------------------------------------

    def _predict(self, dt: float) -> None:
        """Moves the pose on by rates that die away, and the variances with it."""
        own = self._settings
        keep = np.exp(-dt / self._coast)
        ahead = self._coast * (1 - keep)
        self._pose = self._pose.moved(ahead * self._rate)
        power, p, m, r = self._power, self._variance, self._mixed, self._rate_variance
        self._variance = p + 2 * ahead * m + ahead**2 * r + power * dt**3 / 3
        self._variance[BETAS] += own.growth * dt
        self._mixed = keep * (m + ahead * r) + power * dt**2 / 2
        self._rate_variance = keep**2 * r + power * dt
        self._rate = keep * self._rate

    def _correct(self, sided: list[_Seen], dt: float) -> None:
        """Brings the pose to the frame, by the likeliest of the ways in which sides may have been `sided`."""
        rest = min(1.0, dt / self._settings.rest_after)
        prior, steps = 1 / self._variance, self._settings.steps
        solved = [self._solved(self._pose, one, prior=prior, rest=rest, steps=steps) for one in sided]
        best = min(range(len(solved)), key=lambda i: solved[i].cost)
        self._swapped_for = self._swapped_for + dt if best else 0.0
        if self._swapped_for > self._settings.doubt:  # it was the prediction that had the sides wrong
            best = 0
        seen, (after, variance, step, _) = sided[best], solved[best]
        gain = self._mixed / self._variance
        shrunk = 1 - variance / self._variance
        self._rate = np.minimum(np.maximum(self._rate + gain * step, -_FASTEST), _FASTEST)
        self._rate_variance = np.maximum(self._rate_variance - gain * self._mixed * shrunk, 0.0)
        self._mixed = gain * variance
        self._variance, self._pose = variance, after
        self._untwist()
        self._seen_at = self._stamp
        self._learn_noise(seen, dt)

    def _untwist(self) -> None:
        """Turns limbs about their bones where they bend the wrong way, rates with them."""
        for joints, about in twisted_wrongly(self._pose, self.skeleton):
            turns, rates = self._pose.turns.copy(), self._rate[TURNS].reshape(N_JOINTS, 3)
            turns[joints] = turned_about_bones(turns[joints], about)
            rates[joints] = np.einsum("jki,jk->ji", about, rates[joints])
            self._pose = Pose(self._pose.pelvis, turns, self._pose.betas)

    def _learn_noise(self, seen: _Seen, dt: float) -> None:
        """Adapts to the tracker's noise, by the median distance that is left after the fit."""
        off = self.skeleton.posed(self._pose).points - seen.points
        squared = np.sort(np.einsum("ki,ki->k", off, off)[seen.weights > 0])
        if len(squared) < 4:
            return
        own, median = self._settings, math.sqrt(squared[len(squared) // 2])
        # Of three normal components the median length is 1.54 deviations; the fit takes up about a quarter of it.
        target = min(max(median / 1.54 * 1.25, own.least_noise), own.most_noise)
        self._noise += min(1.0, dt) * (target - self._noise)
        self._unfit_for = self._unfit_for + dt if median > max(4 * self._noise, 0.08) else 0.0

    def _solved(self, pose: Pose, seen: _Seen, *, prior: Array | None, rest: float, steps: int) -> Solution:
        deviation = np.sqrt(self._noise**2 + self._offset**2)
        return self._solver.solve(
            pose, seen.points, seen.weights, deviation=deviation, prior=prior, rest=rest, steps=steps
        )


def _wound(pose: Pose) -> float:
    """How far the joints of the spine turn together [rad]."""
    return float(np.linalg.norm(log_so3(pose.turns[_SPINE]), axis=1).sum())


_OUTWARDS = (
    ((16, 18, 20, 22, 17, 19, 21, 23), (18, 20, 22, 19, 21, 23), (20, 22, 21, 23)),
    ((1, 4, 7, 10, 2, 5, 8, 11), (4, 7, 10, 5, 8, 11), (7, 10, 8, 11)),
    ((15,),),
)
"""Joints of arms, legs and head, whose keypoints trackers exchange together, from some joint on outwards."""
_WOUND = 2.2
"""The joints of a spine rarely turn by more than this together [rad]: deep bends have 1.8."""
_SPINE = [JOINT_NAMES.index(f"spine{i}") for i in (1, 2, 3)]
_FASTEST = np.concatenate([np.full(3, 12.0), np.full(3 * N_JOINTS, 40.0), np.zeros(N_BETAS)])
"""No pelvis [m/s] and no joint [rad/s] is faster than this."""
_LEAST = 0.05
"""A confidence below this counts as none."""
_MOST_SCORE = 2.0
"""Detectors that score by the height of a heat map go a little beyond 1; scores above this are per cent."""
_FARTHEST = 3.0
"""No person's keypoints are farther than this from their middle, in the median [m]: they are in another unit."""
_FITS = 0.04
"""A first pose that misses its keypoints by less than this [m] has its sides right."""
_NEAR, _FAR = 0.1, 0.5
"""A keypoint within `_NEAR` of its expected place is on its side; a distance beyond `_FAR` counts as `_FAR` [m]."""
