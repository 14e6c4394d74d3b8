"""Invariance: where the person stands, which way they face, who else is dressed and what came before."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refu_core.body import MIRRORED_JOINTS
from refu_core.frames import SmplFrame
from refu_core.realtime import PipelineOutput
from refu_lab.stress._frames import frame_of
from refu_lab.stress._numbers import ROUNDING
from refu_lab.stress._subject import Subject, distance_to_mesh
from refu_lab.stress._trial import Measurement, Trial

RIGID = 1e-4
"""How closely a garment follows the person [m]."""
_FAR = 1e5  # [m]
ALONE = 16
"""Persons of a batch that are dressed alone, too."""
_UNDECIDED = 0.01
"""Share of a garment's vertices whose way out may hang on a rounding."""
_MIRROR_POINTS = 32
ASYMMETRY = 4e-3
"""What collision handling may add to the asymmetry of body, garment and backbone [m]: as much as the margin."""


def turned(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """The garment of a turned person against the turned garment.

    Networks feel gravity, so that with them the person turns about the vertical; a skinned garment turns any way.
    """
    rng, frame = np.random.default_rng(trial.seed), trial.frames[0]
    is_skinned = subject.wardrobe.backbone == "skinned"
    turn = Rotation.random(random_state=rng) if is_skinned else Rotation.from_euler("y", rng.uniform(-np.pi, np.pi))
    pose = np.array(frame.pose, np.float64)
    pose[0] = (turn * Rotation.from_rotvec(pose[0])).as_rotvec()
    here, there = subject.pipeline(frame), subject.pipeline(frame_of(pose, betas=frame.betas))
    root = subject.pipeline.body.rest_joints(torch.tensor(frame.betas)[None])[0, 0].double().numpy()
    for name, mesh in here.items():
        yield _apart(turn.apply(mesh.local - root) + root, there[name].local, RIGID)


def moved(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """The garment of a person 100 km away against that of one at the origin."""
    rng, frame = np.random.default_rng(trial.seed), trial.frames[0]
    transl = _FAR * rng.uniform(-1, 1, 3)
    here, there = subject.pipeline(frame), subject.pipeline(frame_of(frame.pose, betas=frame.betas, transl=transl))
    for name, mesh in here.items():
        yield _apart(mesh.vertices, there[name].vertices - transl, RIGID)


def mirrored(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """The garment of the mirror image against the garment's mirror image, surface to surface.

    Meshes and networks aren't quite symmetric; so the limit is what the garment is off before collisions are handled,
    and what handling them may add.
    """
    rng, frame = np.random.default_rng(trial.seed), trial.frames[0]
    here, there = subject.pipeline(frame), subject.pipeline(mirror_image(frame))
    deviation, own = 0.0, 0.0
    for name, mesh in here.items():
        rows = rng.integers(len(mesh.local), size=_MIRROR_POINTS)
        other = there[name]
        after, before = (
            distance_to_mesh(mine[rows] * (-1, 1, 1), theirs, mesh.faces).max()
            for mine, theirs in ((mesh.local, other.local), (mesh.raw, other.raw))
        )
        deviation, own = max(deviation, float(after)), max(own, float(before))
    yield Measurement(deviation=deviation, limit=own + ASYMMETRY)


def mirror_image(frame: SmplFrame) -> SmplFrame:
    """The frame in a mirror at x = 0: left and right joints exchanged, rotations turned the other way."""
    return frame_of(
        frame.pose[MIRRORED_JOINTS,] * np.array((1, -1, -1), np.float32),
        frame.betas,
        frame.transl * (-1, 1, 1),
        frame.style,
    )


def history(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """A frame after others, each far from the last, against the same frame after itself: not a bit may differ."""
    for frame in trial.frames[:-1]:
        subject.pipeline(frame)
    last = trial.frames[-1]
    after, again = subject.pipeline(last), subject.pipeline(last)
    alone = subject.load()(last)  # a pipeline's first frame
    for other in (again, alone):
        for name, mesh in after.items():
            yield _apart(mesh.local, other[name].local, 1e-6)


def batch(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """Persons dressed together against the same persons one by one, before collision handling."""
    for alone, together in _alone_and_together(subject, trial):
        for name, mesh in alone.items():
            yield _apart(mesh.raw, together[name].raw, ROUNDING)


def batch_resolved(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """The same after collision handling, which has two ways out for some vertices: all but one in a hundred.

    A product of matrices of 64 rows is rounded otherwise than one of a single row, and which way is shorter may hang on
    that; a bound for every single vertex is that of displacements, which is a check of its own.
    """
    for alone, together in _alone_and_together(subject, trial):
        for name, mesh in alone.items():
            way = np.linalg.norm(mesh.local - together[name].local, axis=1)
            yield Measurement(deviation=float(np.quantile(way, 1 - _UNDECIDED)), limit=RIGID)


def _alone_and_together(subject: Subject, trial: Trial) -> Iterator[tuple[PipelineOutput, PipelineOutput]]:
    outs = subject.pipeline(trial.frames)
    for i in np.random.default_rng(0).choice(len(trial.frames), ALONE, replace=False):
        yield subject.pipeline(trial.frames[i]), outs[i]


def _apart(a: NDArray[np.floating], b: NDArray[np.floating], limit: float) -> Measurement:
    """How far the farthest of N points (N, 3) is from where it should be."""
    return Measurement(deviation=float(np.linalg.norm(a - b, axis=1).max()), limit=limit)
