"""Invariance to where a person stands and faces, to left and right, to who else is dressed, and to what came before."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refu_core.body import MIRRORED_JOINTS
from refu_core.frames import N_JOINTS, SmplFrame, pasts_of
from refu_core.realtime import GarmentMesh
from refu_lab.stress._numbers import ROUNDING
from refu_lab.stress._trial import Measurement, Subject, Trial, distance_to_mesh

RIGID = 1e-4
"""Largest deviation of a garment that has to follow its person [m]."""
_FAR = 1e5  # [m]
ALONE = 16
"""Number of persons in a batch that are also dressed alone."""
_UNDECIDED = 0.01
"""Share of a garment's vertices whose way out may depend on rounding."""
_MIRROR_POINTS = 32
ASYMMETRY = 4e-3
"""What collision handling may add to the asymmetry of body, garment and backbone [m]; equal to the margin."""


def turned(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """Compares the garment of a turned person with the turned garment.

    Networks know which way is down, so with them the person turns about the vertical only; with skinning, in any way.
    """
    rng, frame = np.random.default_rng(trial.seed), trial.frames[0]
    is_skinned = subject.wardrobe.backbone == "skinned"
    turn = Rotation.random(random_state=rng) if is_skinned else Rotation.from_euler("y", rng.uniform(-np.pi, np.pi))
    pose = np.array(frame.pose, np.float64)
    pose[0] = (turn * Rotation.from_rotvec(pose[0])).as_rotvec()
    here, there = subject.pipeline(frame), subject.pipeline(replace(frame, pose=pose.astype(np.float32)))
    root = subject.pipeline.body.rest_joints(torch.tensor(frame.betas)[None])[0, 0].double().numpy()
    for name, mesh in here.items():
        yield _apart(turn.apply(mesh.local - root) + root, there[name].local, RIGID)


def moved(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """Compares the garment of a person up to 100 km away along each axis with that of one at the origin."""
    rng, frame = np.random.default_rng(trial.seed), trial.frames[0]
    transl = _FAR * rng.uniform(-1, 1, 3)
    here, there = subject.pipeline(frame), subject.pipeline(replace(frame, transl=transl))
    for name, mesh in here.items():
        yield _apart(mesh.vertices, there[name].vertices - transl, RIGID)


def mirrored(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """Compares the garment of the mirror image with the garment's mirror image, surface to surface.

    Meshes and networks aren't quite symmetric, so the limit is the deviation before collision handling plus what that
    may add.
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
    """The frame mirrored at x = 0: left and right joints exchanged, rotations mirrored."""
    mirror = np.array((-1, 1, 1), np.float32)
    rotations, way = np.split(pasts_of([frame])[0], (9 * N_JOINTS,), axis=1)
    rotations = rotations.reshape(-1, N_JOINTS, 3, 3)[:, MIRRORED_JOINTS] * np.outer(mirror, mirror)
    return replace(
        frame,
        pose=frame.pose[MIRRORED_JOINTS,] * np.array((1, -1, -1), np.float32),
        transl=frame.transl * mirror,
        past=np.concatenate((rotations.reshape(len(way), -1), way * mirror), 1),
    )


def history(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """Compares a frame after others, far from it, with the same frame after itself and in a new pipeline."""
    for frame in trial.frames[:-1]:
        subject.pipeline(frame)
    last = trial.frames[-1]
    after, again = subject.pipeline(last), subject.pipeline(last)
    alone = subject.load()(last)  # as the first frame of a new pipeline
    for other in (again, alone):
        for name, mesh in after.items():
            yield _apart(mesh.local, other[name].local, 1e-6)


def batch(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """Compares persons dressed together with the same persons one by one, before collision handling."""
    for alone, together in _alone_and_together(subject, trial):
        yield _apart(alone.raw, together.raw, ROUNDING)


def batch_resolved(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """The same after collision handling, for all but one vertex in a hundred: some have two ways out.

    A matrix product of 64 rows is rounded differently from one of a single row, which may decide the shorter way. Every
    single vertex is still subject to the bound of displacements, which has a check of its own.
    """
    for alone, together in _alone_and_together(subject, trial):
        way = np.linalg.norm(alone.local - together.local, axis=1)
        yield Measurement(deviation=float(np.quantile(way, 1 - _UNDECIDED)), limit=RIGID)


def _alone_and_together(subject: Subject, trial: Trial) -> Iterator[tuple[GarmentMesh, GarmentMesh]]:
    outs = subject.pipeline(trial.frames)
    for i in np.random.default_rng(0).choice(len(trial.frames), ALONE, replace=False):
        yield from ((mesh, outs[i][name]) for name, mesh in subject.pipeline(trial.frames[i]).items())


def _apart(a: NDArray[np.floating], b: NDArray[np.floating], limit: float) -> Measurement:
    """The largest distance between N points (N, 3) and where they should be, with its limit [m]."""
    return Measurement(deviation=float(np.linalg.norm(a - b, axis=1).max()), limit=limit)
