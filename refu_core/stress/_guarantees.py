"""Guarantees: nothing inside, nothing thrown out, nothing that jumps."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from refu_core.frames import N_BETAS
from refu_core.repulsion import DEFAULT_MARGIN, MAX_DISPLACEMENT, Blend, resolve
from refu_core.stress._frames import FRAMES, between, everyday, everyday_pose, frame_of
from refu_core.stress._numbers import n_not_finite
from refu_core.stress._trial import Check, Measurement, Trial

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from refu_core.evaluation import SelfContact
    from refu_core.realtime import GarmentMesh, PipelineOutput
    from refu_core.stress._subject import Subject

DEPTH = 1e-4
"""No vertex is deeper inside than this [m], away from where the body touches itself."""
MULTIPLE = 2.0
"""No vertex is moved farther than this multiple of what the deepest one near it lacks to the margin."""
REACH = 8
"""How near that is [edges]: as far as pushed vertices take others along, and the edges that are raised after."""
PACE = 2.0
"""No vertex moves in a frame by more than this multiple of what the fastest vertex of the body does,"""
PACE_SLACK = 1e-3
"""and this [m]."""
_BOUND_SLACK = 1e-5  # [m]; rounding of a displacement that is drawn back to its bound
_STEPS = 24
_BURIED = 0.02  # [m]


def guarantee_checks() -> list[Check]:
    """What collision handling promises."""
    return [
        Check(name="guarantees: nothing inside", draw=_any_day, measure=nothing_inside, trials=4, sdf_modes=_EXACT),
        Check(
            name="guarantees: nothing inside, garment buried in the body",
            draw=_calm_day,
            measure=buried,
            sdf_modes=_EXACT,
        ),
        Check(name="guarantees: no vertex thrown out", draw=_any_day, measure=not_thrown, trials=2),
        Check(name="guarantees: displacement bounded in any pose", draw=_any_frame, measure=bounded, trials=4),
        Check(name="guarantees: no jumps in smooth motion", draw=_motion, measure=no_jumps),
        Check(name="guarantees: bounded jumps through self-contact", draw=_folding, measure=bounded_jumps),
    ]


_EXACT = ("accurate",)


def _any_day(rng: np.random.Generator) -> Trial:
    return Trial((everyday(rng),)) if rng.random() < 0.5 else _calm_day(rng)


def _calm_day(rng: np.random.Generator) -> Trial:
    """Poses in which most bodies don't touch themselves."""
    frame = frame_of(0.6 * everyday_pose(rng), betas=rng.normal(0, 1, N_BETAS), transl=rng.normal(0, 3, 3))
    return Trial((frame,), int(rng.integers(2**31)))


def _any_frame(rng: np.random.Generator) -> Trial:
    names = [name for name in FRAMES if name != "absurd"]
    return Trial((FRAMES[names[rng.integers(len(names))]](rng),))


def _motion(rng: np.random.Generator) -> Trial:
    betas, style = rng.normal(0, 1, N_BETAS), rng.normal(0, 1, 4)
    poses: list[NDArray[np.floating]] = [0.7 * everyday_pose(rng) for _ in range(2)]
    return Trial(tuple(frame_of(pose, betas=betas, style=style) for pose in between(poses, _STEPS)))


def _folding(rng: np.random.Generator) -> Trial:
    """From an everyday pose to one with limbs through the trunk."""
    last = FRAMES["limbs through the trunk"](rng)
    poses: list[NDArray[np.floating]] = [0.7 * everyday_pose(rng), last.pose]
    return Trial(tuple(frame_of(pose, betas=last.betas) for pose in between(poses, _STEPS)))


def nothing_inside(subject: Subject, trial: Trial) -> Measurement:
    """The depth of the deepest vertex, by winding number, away from where the body touches itself."""
    (out,) = subject.pipeline(trial.frames)
    contact = subject.contacts.detect(out.body)
    subject.checker.update(out.body)
    depths = [
        subject.checker.check(mesh.local, mesh.faces).depth[~_in_contact(contact, mesh)].max(initial=0.0)
        for mesh in out.values()
    ]
    return Measurement(nan=_not_finite(out), deviation=float(max(depths)), limit=DEPTH)


def buried(subject: Subject, trial: Trial) -> Measurement:
    """The same, of garments whose every vertex starts 2 cm inside the body."""
    body, frame = subject.pipeline.body, trial.frames[0]
    pose, betas = torch.tensor(frame.pose)[None], torch.tensor(frame.betas)[None]
    deepest, nan = 0.0, 0
    with torch.no_grad():
        posed = body(pose, betas)
        sdf = subject.distances["exact"]
        sdf.update(posed.vertices[0])
        contact = subject.contacts.detect(posed.vertices[0].numpy())
        subject.checker.update(posed.vertices[0].numpy())
        for name, garment in subject.pipeline.garments.items():
            points = garment.pose(garment.rest(betas), posed.transforms)[0]
            sample = sdf.query(points)
            points = points - (sample.distance + _BURIED)[:, None] * sample.gradient
            limbs = subject.limbs[name]
            done = resolve(
                points, sdf, blend=Blend.of_faces(garment.faces, len(points)), edges=garment.edges, limbs=limbs
            )
            nan += n_not_finite(done.vertices.numpy())
            depth = subject.checker.check(done.vertices.numpy(), garment.faces.numpy()).depth
            away = ~(contact.near(points.numpy()) | contact.near(done.vertices.numpy()))
            deepest = max(deepest, float(depth[away].max(initial=0.0)))
    return Measurement(nan=nan, deviation=deepest, limit=DEPTH)


def not_thrown(subject: Subject, trial: Trial) -> Measurement:
    """How far vertices are moved off the body, against how far the deepest one near each is from the margin.

    Where the body touches itself the way out of it may be longer: there it is bounded by `MAX_DISPLACEMENT` alone.
    """
    worst = Measurement()
    for name, pipeline in subject.one_by_one.items():
        (out,) = pipeline(trial.frames)
        mesh = out[name]
        sdf = subject.distances["exact"]
        sdf.update(torch.from_numpy(out.body))
        moved = np.linalg.norm(mesh.local - mesh.raw, axis=1)
        limit = np.full_like(moved, MAX_DISPLACEMENT)
        if subject.contacts.detect(out.body).is_free:
            lack = np.maximum(DEFAULT_MARGIN - sdf.query(torch.from_numpy(mesh.raw)).distance.numpy(), 0)
            near = _largest_near(lack, pipeline.garments[name].edges.numpy())
            limit = np.minimum(limit, MULTIPLE * (near + DEFAULT_MARGIN))
        limit = limit + _BOUND_SLACK
        i = int(np.argmax(moved / limit))
        found = Measurement(nan=worst.nan + _not_finite(out), deviation=float(moved[i]), limit=float(limit[i]))
        worst = max(replace(worst, nan=found.nan), found, key=lambda measured: measured.badness)
    return worst


def bounded(subject: Subject, trial: Trial) -> Measurement:
    """The largest displacement against `MAX_DISPLACEMENT`, whatever the frame."""
    moved, nan = 0.0, 0
    for name, pipeline in subject.one_by_one.items():
        (out,) = pipeline(trial.frames)
        moved = max(moved, float(np.linalg.norm(out[name].local - out[name].raw, axis=1).max()))
        nan += _not_finite(out)
    return Measurement(nan=nan, deviation=moved, limit=MAX_DISPLACEMENT + _BOUND_SLACK)


def no_jumps(subject: Subject, trial: Trial) -> Measurement:
    """How far vertices go from frame to frame, against the body's fastest one.

    Where the body touches itself the way out of it may change sides; cloth around is taken along, and left out here.
    """
    return _jumps(subject, trial, allowed=PACE_SLACK, everywhere=False)


def bounded_jumps(subject: Subject, trial: Trial) -> Measurement:
    """The same with all vertices: from one bound of the displacement to the other, and no farther."""
    return _jumps(subject, trial, allowed=2 * MAX_DISPLACEMENT, everywhere=True)


def _jumps(subject: Subject, trial: Trial, *, allowed: float, everywhere: bool) -> Measurement:
    worst = Measurement(runs=len(trial.frames))
    last: tuple[PipelineOutput, dict[str, NDArray[np.bool_]]] | None = None
    nan = 0
    for frame in trial.frames:
        out = subject.pipeline(frame)
        nan += _not_finite(out)
        contact = None if everywhere else subject.contacts.detect(out.body)
        near = {}
        for name, mesh in out.items():
            near[name] = np.zeros(len(mesh.local), np.bool_)
            if contact is not None and not contact.is_free:
                edges = subject.pipeline.garments[name].edges.numpy()
                near[name] = _largest_near(_in_contact(contact, mesh), edges)
        if last is not None:
            limit = PACE * float(np.linalg.norm(out.body - last[0].body, axis=1).max()) + allowed
            for name, mesh in out.items():
                way = np.linalg.norm(mesh.local - last[0][name].local, axis=1)[~(near[name] | last[1][name])]
                found = Measurement(runs=worst.runs, deviation=float(way.max(initial=0.0)), limit=limit)
                worst = max(worst, found, key=lambda measured: measured.badness)
        last = out, near
    return replace(worst, nan=nan)


def _in_contact(contact: SelfContact, mesh: GarmentMesh) -> NDArray[np.bool_]:
    """The vertices (N,) that were, or have come, where the body touches itself."""
    return contact.near(mesh.raw) | contact.near(mesh.local)


def _largest_near(values: NDArray[Any], edges: NDArray[np.int64]) -> NDArray[Any]:
    """The largest value within `REACH` edges of each vertex, (N,)."""
    for _ in range(REACH):
        larger = values.copy()
        np.maximum.at(larger, edges[:, 0], values[edges[:, 1]])
        np.maximum.at(larger, edges[:, 1], values[edges[:, 0]])
        values = larger
    return values


def _not_finite(out: PipelineOutput) -> int:
    return n_not_finite(*(mesh.vertices for mesh in out.values()))
