"""A second kind of set: continuous motions with dynamics, the cloth carried from frame to frame."""

from __future__ import annotations

import math
import time
import zlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core._engine import Engine
from refu_core.errors import SimulationError
from refu_core.frames import LAGS, N_BETAS
from refu_core.garments import N_STYLES
from refu_core.simulation._cloth import F32
from refu_core.simulation._drape import GRAVITY
from refu_core.simulation._motions import STEPS, DrawnMotion, recorded_motion, synthetic_motion
from refu_core.simulation._plan import TEST, TRAIN, names_of, truncated_normal
from refu_core.simulation._poses import Clip, split_clips
from refu_core.simulation._produce import Progress, produce
from refu_core.simulation._store import CAUSES, DONE, FPS, GOT_THROUGH, SEQUENCES
from refu_core.simulation._worker import SimulationSettings, Simulator, is_lost


@dataclass(frozen=True)
class SequencePlan:
    """Sequence k has the shape k % `shapes`, the mean style, and a stretch of motion of its own.

    Shapes are drawn one by one: the 5 shapes of one set are the first 5 of a set with 17.
    """

    garment: str | Sequence[str]
    """One garment, or several that are simulated together."""
    count: int
    """Sequences in the set, training and test together."""
    shapes: int = 5
    seconds: float = 10.0
    """Length of each sequence."""
    seed: int = 0
    test_share: float = 1 / 4
    """Share of each shape's sequences, rounded up but never all, whose motions are from clips kept for the test."""
    spread: float = 1.2
    """Standard deviation of β before it is cut off at ±2."""
    synthetic_share: float = 0.0
    """Share of the training sequences whose motions are synthetic."""

    def __post_init__(self) -> None:
        """Raises `SimulationError` for numbers that make no plan."""
        if self.count < 1 or self.shapes < 1 or not 0 < self.seconds <= 600 or self.n_frames < 2:
            raise SimulationError(f"wanted a sequence and a shape at least, two frames to 600 s, got {asdict(self)}")
        if not (0 <= self.test_share < 1 and 0 <= self.synthetic_share <= 1 and self.spread > 0):
            wanted = "the test's share in [0, 1), the synthetic one in [0, 1], and the spread above 0"
            raise SimulationError(f"wanted {wanted}, got {asdict(self)}")

    @property
    def n_frames(self) -> int:
        """Frames of a sequence."""
        return round(self.seconds * FPS)

    def split_of(self, slot: int) -> int:
        """`TRAIN` or `TEST`: the last sequences of each shape are the test's."""
        rounds = math.ceil(self.count / self.shapes)
        n_test = min(math.ceil(rounds * self.test_share), rounds - 1)
        return TEST if slot // self.shapes >= rounds - n_test else TRAIN

    def blocks(self) -> list[list[int]]:
        """Each sequence by itself, in an order that mixes shapes and motions."""
        return [[int(slot)] for slot in np.random.default_rng(self._key(0)).permutation(self.count)]

    def _key(self, *numbers: int) -> list[int]:
        return [self.seed, zlib.crc32(f"{names_of(self.garment)} sequences".encode()), *numbers]

    def style_shape(self, slot: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """β (10,), normal, cut off at ±2, and γ (4,), zero."""
        u = np.random.default_rng(self._key(1, slot % self.shapes)).random(N_BETAS)
        return truncated_normal(u, self.spread), np.zeros(N_STYLES, np.float32)

    def motion(self, slot: int, clips: list[Clip], attempt: int = 0) -> DrawnMotion:
        """The motion that a sequence tries to show. Raises `SimulationError` when no clip is long enough."""
        rng = np.random.default_rng(self._key(2, slot, *([attempt] if attempt else [])))
        return (synthetic_motion if self.is_synthetic(slot) else recorded_motion)(clips, self.n_frames, rng)

    def is_synthetic(self, slot: int) -> bool:
        """Whether a sequence shows a synthetic motion."""
        is_drawn = np.random.default_rng(self._key(3, slot)).random() < self.synthetic_share
        return bool(is_drawn) and self.split_of(slot) == TRAIN


@dataclass(frozen=True)
class SequenceSettings(SimulationSettings):
    """All settings of a set of sequences except its plan."""

    drag: float = 6.0
    """Rate at which the cloth's velocity fades in the air, which moves with the body [1/s]."""
    rebuild_every: int = 10
    """Simulated frames after which the body's tree of triangles is built anew."""
    pauses: int = 3
    """Most simulated frames for which the body waits until cloth that is in it or in itself is out again. Of 90 frames
    of a T-shirt with a hand at its hem, 4 could be taken with none, 72 of 88 with these."""
    most_smoothing: float = 0.02
    """A frame whose cloth would have to be smoothed by more than this isn't taken [m]; the sequence goes on. Where
    sleeves drew together, it was 30 to 140 mm."""
    most_caught: int = 8
    """After so many frames in a row with cloth in the body or in itself it is draped anew: a hand that has got under a
    hem stays there. Of a sequence with a hand in the T-shirt 9 % of the frames could be taken, and 77 % with this, in a
    quarter of the time."""


_LOOKED_BACK = math.ceil(max(LAGS) * FPS)
"""Frames that networks are told of."""


class SequenceSimulator(Simulator):
    """Simulates whole sequences."""

    kind = SEQUENCES
    plan: SequencePlan
    settings: SequenceSettings

    def __init__(
        self, plan: SequencePlan, clips: tuple[list[Clip], list[Clip]], settings: SequenceSettings, body: Any
    ) -> None:
        """As `Simulator`; also raises `SimulationError` when the clips of a split are too short."""
        super().__init__(plan, clips, settings, body)
        recorded = [slot for slot in range(plan.count) if not plan.is_synthetic(slot)]
        for slot in (*recorded[:1], *recorded[-1:]):
            plan.motion(slot, clips[plan.split_of(slot) == TEST])

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a row's garments."""
        return (self.plan.n_frames, *super().shape)

    def simulate(self, slot: int) -> dict[str, Any]:
        """The columns of a sequence's row (see `_store`)."""
        started = time.perf_counter()
        plan = self.plan
        split = plan.split_of(slot)
        betas, style = plan.style_shape(slot)
        row: dict[str, Any] = {"slot": slot, "shape": slot % plan.shapes, "split": split, "betas": betas}
        for attempt in range(self.settings.attempts):
            motion = plan.motion(slot, self.clips[split == TEST], attempt)
            drape = self.draper.drape(motion.poses[0], betas, style)
            body = self.draper.bodies(motion.poses[:1], betas)[0]
            if self._examine(drape.vertices, body, drape.cut)[0] is None:
                break  # an arm that begins within the cloth would stay there
        played = self._play(motion, drape.vertices, betas, style)
        row |= {"style": style, **played, "pose": motion.poses[::STEPS], "transl": motion.transl[::STEPS]}
        row |= {"clip": motion.clip, "start": motion.start, "mirrored": motion.mirrored}
        row |= {"dropped": np.bincount(played["cause"], minlength=len(CAUSES) + 1)[1:], "state": DONE}
        return row | {"seconds": time.perf_counter() - started}

    def _play(self, motion: DrawnMotion, start: F32, betas: F32, style: F32) -> dict[str, NDArray[Any]]:
        """Garments (T, N, 3), causes, stretch and speed (T,) of a motion, by the names of their columns.

        The cloth is simulated in a frame of reference that moves with the root and doesn't turn. There, the body's
        acceleration acts as gravity with the opposite sign, and the air is still. The cloth starts at rest in
        `start` (N, 3) [m]. Cloth that stays caught is draped anew, and its frames aren't taken until it moves as if it
        had been there all along.
        """
        s, cloth, poses = self.settings, self.draper.cloth, motion.poses
        bodies = np.concatenate([self.draper.bodies(poses[k : k + 50], betas) for k in range(0, len(poses), 50)])
        cut = self.draper.cut(betas, style)
        self.draper.begin(cut, start, bodies[0])
        gravity = (np.array([0, -GRAVITY, 0]) - motion.acceleration()).astype(np.float32)
        n = len(poses[::STEPS])
        vertices = np.zeros((n, *start.shape), np.int16)
        cause = np.full(n, 1 + CAUSES.index("unsettled"), np.uint8)
        stretch, speed = np.full((2, n), np.nan, np.float32)
        caught, moves_from = 0, 0
        for k, body in enumerate(bodies):
            now = 0.0
            if k:
                if k % s.rebuild_every == 0:
                    self.draper.rebuild(bodies[k - 1])
                careful = k % STEPS == 0  # where a frame is stored; elsewhere it would only take time
                now = cloth.frame(bodies[k - 1], body, gravity=gravity[k], drag=s.drag, careful=careful)
            if is_lost(cloth.positions):
                break  # and with it the rest of the sequence
            if k % STEPS == 0:
                t = k // STEPS
                found, stored = self._freed(body, gravity[k])
                if stored is None:
                    break
                caught = caught + 1 if found in GOT_THROUGH else 0
                found = "unsettled" if found is None and t < moves_from else found
                vertices[t], cause[t] = stored, 0 if found is None else 1 + CAUSES.index(found)
                stretch[t] = cut.stretch(self.draper.topology, cloth.positions)
                speed[t] = now  # a moving cloth may be fast: no limit on its speed
                if caught == s.most_caught:
                    drape = self.draper.drape(poses[k], betas, style)
                    self.draper.begin(cut, drape.vertices, body)
                    caught, moves_from = 0, t + 1 + _LOOKED_BACK
        return {"vertices": vertices, "cause": cause, "stretch": stretch, "speed": speed}

    def _freed(self, body: F32, gravity: F32) -> tuple[str | None, Any]:
        """Frees the cloth where it is in itself or in the body (V, 3) [m]; what `_examine` says of it then.

        Cloth that has got through would stay there for the rest of the sequence, as contacts keep each vertex on the
        side that it is on. So it is smoothed where it intersects itself. While that doesn't free it, the body waits and
        the cloth is strongly damped. `gravity` is (3,) [m/s²].
        """
        cloth, s = self.draper.cloth, self.settings
        for pause in range(s.pauses + 1):
            if pause:
                cloth.frame(body, body, gravity=gravity, drag=s.drape.drag[0], careful=True)
                if is_lost(cloth.positions):
                    return "unsettled", None
            level = self.draper.untangled(cloth.positions, body)
            found, stored = self._examine(level, body, cloth.cut)
            if found not in GOT_THROUGH:
                if np.linalg.norm(level - cloth.positions, axis=1).max() > s.most_smoothing:
                    found, stored = self._examine(cloth.positions, body, cloth.cut)
                cloth.positions[:] = level
                break
        return found, stored


def simulate_sequences(
    garment: str | Sequence[str],
    count: int,
    output: str | Path,
    *,
    motions: str | Path | Sequence[Clip] | None,
    body: str | Path | None = None,
    engine: Engine | None = None,
    settings: SequenceSettings | None = None,
    progress: Callable[[Progress], None] | None = None,
    **plan: Any,
) -> dict[str, Any]:
    """Simulates a set of `count` sequences of a built-in garment, or goes on with one that was interrupted.

    It works as `simulate_dataset`, but `plan` are fields of `SequencePlan`, `motions` are required, and whole
    sequences are finished or not. It is best to make `count` a multiple of `shapes`. Only motions that last at least
    `seconds` are used.

    Raises as `simulate_dataset`, and `SimulationError` for motions that are too short.
    """
    slots = SequencePlan(garment, count, **plan)
    if motions is None:
        raise SimulationError(f"sequences need recorded motion: give a folder of files of {slots.seconds:g} s or more")
    given = slots, split_clips(motions), settings or SequenceSettings(), body
    return produce(SequenceSimulator, *given, output=output, engine=engine, progress=progress, fps=FPS)
