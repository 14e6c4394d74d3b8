"""Guarantees: nothing inside, nothing thrown out, nothing that jumps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from refu_core.frames import N_BETAS
from refu_core.garments import inner_first
from refu_core.repulsion import DEFAULT_MARGIN, LAYER_GAP, LAYER_REACH, MAX_DISPLACEMENT, Blend, resolve
from refu_core.stress._frames import FRAMES, between, everyday, everyday_pose, frame_of
from refu_core.stress._numbers import n_not_finite
from refu_core.stress._sheets import closest_on_sheet
from refu_core.stress._trial import Check, Measurement, Trial

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from refu_core.evaluation import SelfContact
    from refu_core.realtime import GarmentMesh, GarmentPipeline, PipelineOutput
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
        Check(name="guarantees: no jumps in smooth motion, worn together", draw=_motion, measure=no_jumps_together),
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
    """How far vertices go from frame to frame, each garment worn alone, against the body's fastest vertex.

    What is pushed goes to the closest skin. That leaps where another way out becomes the shortest, from one side of a
    limb's medial axis to the other, and no projection that remembers nothing can follow it smoothly: so vertices may go
    as far, in addition, as the closest skin does of what is pushed near them. Where the body touches itself, the way
    out may change sides at any depth; cloth around is taken along, and left out here.
    """
    found = [_jumps(subject, pipeline, trial) for pipeline in subject.one_by_one.values()]
    return replace(_worst(found), runs=len(trial.frames))


def no_jumps_together(subject: Subject, trial: Trial) -> Measurement:
    """The same of garments worn over each other, where the closest place of the sheet below may leap, too."""
    return replace(_jumps(subject, subject.pipeline, trial), runs=len(trial.frames))


def _jumps(subject: Subject, pipeline: GarmentPipeline, trial: Trial) -> Measurement:
    found = []
    last: PipelineOutput | None = None
    before: dict[str, _Aims] = {}
    for frame in trial.frames:
        out = pipeline(frame)
        found.append(Measurement(nan=_not_finite(out)))
        aims = _aims(subject, pipeline, out)
        if last is not None:
            pace = PACE * float(np.linalg.norm(out.body - last.body, axis=1).max()) + PACE_SLACK
            for name, mesh in out.items():
                limit = pace + _leap(before[name], aims[name], pipeline.garments[name].edges.numpy())
                way = np.linalg.norm(mesh.local - last[name].local, axis=1)
                way[before[name].is_left_out | aims[name].is_left_out] = 0
                i = int(np.argmax(way / limit))
                found.append(Measurement(deviation=float(way[i]), limit=float(limit[i])))
        last, before = out, aims
    return _worst(found)


@dataclass(frozen=True, eq=False)
class _Aims:
    """Where collision handling takes the N vertices of a garment: to the skin, and to the sheets worn below."""

    places: list[NDArray[np.float32]]
    """The closest point of each surface to each vertex before collision handling [m], (N, 3)."""
    is_pushed: list[NDArray[np.bool_]]
    """Whether a vertex is nearer to that surface than it may be, (N,)."""
    is_left_out: NDArray[np.bool_]
    """The vertices with a self-contact of the body near, (N,)."""


def _aims(subject: Subject, pipeline: GarmentPipeline, out: PipelineOutput) -> dict[str, _Aims]:
    contact, skin = subject.contacts.detect(out.body), subject.distances["exact"]
    skin.update(torch.from_numpy(out.body))
    aims: dict[str, _Aims] = {}
    worn: list[GarmentMesh] = []
    for name in inner_first(out):
        mesh = out[name]
        sample = skin.query(torch.from_numpy(mesh.raw))
        places = [mesh.raw - (sample.distance[:, None] * sample.gradient).numpy()]
        is_pushed = [(sample.distance < DEFAULT_MARGIN).numpy()]
        for below in worn:
            closest, height = closest_on_sheet(mesh.raw, below.local, below.faces)
            places.append(closest)
            is_pushed.append((height < LAYER_GAP) & (np.linalg.norm(mesh.raw - closest, axis=1) < LAYER_REACH))
        is_near = np.zeros(len(mesh.raw), np.bool_)
        if not contact.is_free:
            is_near = _largest_near(_in_contact(contact, mesh), pipeline.garments[name].edges.numpy())
        aims[name] = _Aims(places, is_pushed, is_near)
        worn.append(mesh)
    return aims


def _leap(before: _Aims, now: _Aims, edges: NDArray[np.int64]) -> NDArray[np.floating]:
    """How far, at most, the places go that vertices near each vertex are pushed to [m], (N,)."""
    leap = np.zeros(len(now.is_left_out), np.float32)
    for i, place in enumerate(now.places):
        way = np.linalg.norm(place - before.places[i], axis=1)
        leap += _largest_near(np.where(before.is_pushed[i] | now.is_pushed[i], way, 0), edges)
    return leap


def bounded_jumps(subject: Subject, trial: Trial) -> Measurement:
    """All vertices, through self-contact: from one bound of the displacement to the other, and no farther."""
    found = []
    last: PipelineOutput | None = None
    for frame in trial.frames:
        out = subject.pipeline(frame)
        found.append(Measurement(nan=_not_finite(out)))
        if last is not None:
            limit = PACE * float(np.linalg.norm(out.body - last.body, axis=1).max()) + 2 * MAX_DISPLACEMENT
            for name, mesh in out.items():
                way = float(np.linalg.norm(mesh.local - last[name].local, axis=1).max())
                found.append(Measurement(deviation=way, limit=limit))
        last = out
    return replace(_worst(found), runs=len(trial.frames))


def _worst(found: Sequence[Measurement]) -> Measurement:
    """The worst of these, with all numbers together that aren't finite."""
    worst = max(found, key=lambda measured: replace(measured, nan=0).badness)
    return replace(worst, nan=sum(measured.nan for measured in found))


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
