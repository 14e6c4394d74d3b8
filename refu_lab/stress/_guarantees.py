"""Guarantees: nothing inside, nothing thrown out, nothing that jumps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from refu_core.backbones import Skinned
from refu_core.body import Surface
from refu_core.contact import DEFAULT_CONTACT
from refu_core.frames import SmplFrame
from refu_core.garments import inner_first
from refu_core.modes import DEFAULT_MARGIN
from refu_core.realtime import GarmentMesh, GarmentPipeline, PipelineOutput, Wearer, dress
from refu_core.refu import MAX_DISPLACEMENT
from refu_lab.stress._numbers import n_not_finite
from refu_lab.stress._subject import Subject
from refu_lab.stress._trial import Measurement, Trial

DEPTH = 1e-4
"""No vertex is deeper inside the collider than this [m]."""
MULTIPLE = 2.0
"""No vertex is moved farther than this multiple of what the deepest one near it lacks to the margin."""
REACH = 8
"""How near [edges]: as far as pushed vertices and, after them, raised edges take others along."""
PACE = 2.0
"""From frame to frame, no vertex moves by more than this multiple of the body's fastest vertex, plus `PACE_SLACK`."""
PACE_SLACK = 1e-3
"""[m]."""
_BOUND_SLACK = 1e-5  # [m]; rounding of a displacement that is drawn back to its bound
_ON_SKIN = 1e-5  # [m]
_BURIED = 0.02  # [m]


def nothing_inside(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """The depth of the deepest vertex, by winding number, where the frame promises it (`FrameStats.within_promise`).

    Where it doesn't, since the body is deeper in itself than skin gives way, the frame has to say who is inside.
    """
    (out,) = subject.pipeline(trial.frames)
    if not out.stats.within_promise:
        yield from counted(subject, trial)
        return
    subject.checker.update(out.body)
    for mesh in out.values():
        depth = subject.checker.check(mesh.local, mesh.faces).max_depth
        yield Measurement(nan=n_not_finite(mesh.vertices), deviation=depth, limit=DEPTH)


def counted(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """The certificate (`n_unresolved`) against the winding numbers of every vertex that came out, by garment."""
    (out,) = subject.pipeline(trial.frames)
    subject.checker.update(out.body)
    for name, mesh in out.items():
        found = subject.checker.check(mesh.local, mesh.faces)
        # As the certificate is of the person unturned, what is on the skin itself may round to the other side.
        n_sure, n_said = int((found.depth > _ON_SKIN).sum()), out.stats.garments[name].n_unresolved
        fault = f"{name}: {n_sure} vertices are inside, {n_said} are said to be"
        yield Measurement(nan=n_not_finite(mesh.vertices), faults=(fault,) if n_said < n_sure else ())


def buried(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """The same, of garments whose every vertex starts 2 cm inside the body."""
    frame, stage = trial.frames[0], subject.contact_stage
    skinned = {name: replace(one, backbone=Skinned()) for name, one in subject.pipeline.outfit.wearables.items()}
    pose, betas = torch.tensor(frame.pose)[None], torch.tensor(frame.betas)[None]
    with torch.no_grad():
        dressed = dress(pose, Wearer.of(replace(subject.pipeline.outfit, wearables=skinned), betas))
        body, sdf = dressed.body[0], subject.distances["exact"]
        sdf.update(body)
        stage.update(body)
        subject.checker.update(body.numpy())
        for name, drape in dressed.drapes.items():
            points = drape.vertices[0]
            sample = sdf.query(points)
            points = points - (sample.distance + _BURIED)[:, None] * sample.gradient
            done = stage.resolve(
                name,
                points,
                {},
                raw=points,
                pressed=points,
                on_mean=drape.on_mean[0],
                rest=skinned[name].template.rest(betas)[0],
                margin=skinned[name].margin,
                scale=1.0,
                n_layered=torch.zeros(1, dtype=torch.int32),
            ).vertices.numpy()
            depth = subject.checker.check(done, skinned[name].template.faces.numpy()).max_depth
            yield Measurement(nan=n_not_finite(done), deviation=depth, limit=DEPTH)


def not_thrown(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """How far vertices are moved off the body, against how far the deepest one near each is from the margin."""
    for name, pipeline in subject.one_by_one.items():
        (out,) = pipeline(trial.frames)
        mesh = out[name]
        _, lack = _closest_skin(subject, out, mesh)
        moved = np.linalg.norm(mesh.local - mesh.raw, axis=1)
        near = _largest_near(lack, pipeline.garments[name].edges.numpy())
        limit = (
            np.minimum(MAX_DISPLACEMENT, MULTIPLE * (near + DEFAULT_MARGIN)) + _pressed(subject, trial.frames[0])[name]
        )
        yield _finite(out)
        yield _farthest(moved, limit + _BOUND_SLACK)


def bounded(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """The largest displacement, from where limbs press the cloth, against `MAX_DISPLACEMENT`, whatever the frame."""
    for name, pipeline in subject.one_by_one.items():
        (out,) = pipeline(trial.frames)
        moved = np.linalg.norm(out[name].local - out[name].raw, axis=1)
        yield _finite(out)
        yield _farthest(
            moved, _pressed(subject, trial.frames[0], together=True)[name] + MAX_DISPLACEMENT + _BOUND_SLACK
        )


def no_jumps(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """How far vertices go from frame to frame, each garment worn alone, against the body's fastest vertex.

    What is pushed goes to the closest skin. That leaps where another way out becomes the shortest, from one side of a
    limb's medial axis to the other, and no projection that remembers nothing can follow it smoothly: so vertices may go
    as far, in addition, as the closest skin does of what is pushed near them.
    """
    for pipeline in subject.one_by_one.values():
        yield from _jumps(subject, pipeline, trial)


def no_jumps_together(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """The same of garments worn over each other, where the closest place of the sheet below may leap, too."""
    return _jumps(subject, subject.pipeline, trial)


def _jumps(subject: Subject, pipeline: GarmentPipeline, trial: Trial) -> Iterator[Measurement]:
    before: dict[str, _Aims] = {}
    for last, out in _pairs(pipeline, trial):
        yield _finite(out)
        aims = _aims(subject, pipeline, out)
        for name, mesh in out.items() if last is not None else ():
            pace = PACE * float(np.linalg.norm(out.body - last.body, axis=1).max()) + PACE_SLACK
            limit = pace + _leap(before[name], aims[name], pipeline.garments[name].edges.numpy())
            way = np.linalg.norm(mesh.local - last[name].local, axis=1)
            yield _farthest(way, limit)
        before = aims


def bounded_jumps(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """As limbs go through each other: from one bound of the displacement to the other, and no farther."""
    before: dict[str, NDArray[np.floating]] = {}
    for frame, (last, out) in zip(trial.frames, _pairs(subject.pipeline, trial), strict=True):
        yield _finite(out)
        pressed = _pressed(subject, frame, together=True)
        for name, mesh in out.items() if last is not None else ():
            pace = PACE * float(np.linalg.norm(out.body - last.body, axis=1).max())
            way = np.linalg.norm(mesh.local - last[name].local, axis=1)
            yield _farthest(way, pace + 2 * MAX_DISPLACEMENT + before[name] + pressed[name])
        before = pressed


def _pressed(subject: Subject, frame: SmplFrame, *, together: bool = False) -> dict[str, NDArray[np.floating]]:
    """How far limbs press the vertices of each garment towards the skin that it lies on [m], (N,).

    Of garments worn `together`, how far unfolding them beforehand takes them as well.
    """
    stage, outfit = subject.contact_stage, subject.pipeline.outfit
    pose, betas = torch.tensor(frame.pose)[None], torch.tensor(frame.betas)[None]
    style = None if frame.style is None else torch.tensor(frame.style)[None]
    with torch.no_grad():
        dressed = dress(pose, Wearer.of(outfit, betas, style))
        stage.update(dressed.body[0])
        ways = {}
        for name, one in dressed.drapes.items():
            raw = flat = one.vertices[0]
            if together:
                flat = stage.unfold(name, raw, dressed.transforms.rotation[0])
            ways[name] = stage.press(name, flat) - raw
    return {name: np.linalg.norm(way.numpy(), axis=1) for name, way in ways.items()}


def _pairs(pipeline: GarmentPipeline, trial: Trial) -> Iterator[tuple[Any, PipelineOutput]]:
    """Each frame's output after that of the frame before it, which is None for the first."""
    last = None
    for frame in trial.frames:
        out = pipeline(frame)
        yield last, out
        last = out


def _farthest(way: NDArray[np.floating], limit: NDArray[np.floating]) -> Measurement:
    """Of the vertex that goes farthest on its way (N,) for its limit (N,) [m]."""
    i = int(np.argmax(way / limit))
    return Measurement(deviation=float(way[i]), limit=float(limit[i]))


def _finite(out: PipelineOutput) -> Measurement:
    return Measurement(nan=n_not_finite(*(mesh.vertices for mesh in out.values())))


@dataclass(frozen=True, eq=False)
class _Aims:
    """Where collision handling takes the N vertices of a garment: to the skin, and to the sheets worn below."""

    places: list[NDArray[np.floating]]
    """The closest point of each surface to each vertex before collision handling [m], (N, 3)."""
    is_pushed: list[NDArray[np.bool_]]
    """Whether a vertex is nearer to that surface than it may be, (N,)."""


def _closest_skin(
    subject: Subject, out: PipelineOutput, mesh: GarmentMesh
) -> tuple[NDArray[np.float32], NDArray[np.floating]]:
    """The skin closest to each vertex before collision handling [m], (N, 3), and what it lacks to the margin [m], (N,).

    Where limbs overlap the closest skin may be inside: it is the closest that isn't.
    """
    raw, body = torch.tensor(mesh.raw), torch.tensor(out.body)
    sdf, stage = subject.distances["exact"], subject.contact_stage
    sdf.update(body)
    stage.update(body)
    sample = sdf.query(raw)
    assert stage.way_out is not None  # it certifies
    foot, is_inside = stage.way_out.open_skin(raw)
    place = torch.where(is_inside[:, None], foot, raw - sample.distance[:, None] * sample.gradient)
    depth = torch.where(is_inside, -(foot - raw).norm(dim=1), sample.distance)
    return place.numpy(), (DEFAULT_MARGIN - depth).clamp_min(0).numpy()


def _aims(subject: Subject, pipeline: GarmentPipeline, out: PipelineOutput) -> dict[str, _Aims]:
    aims: dict[str, _Aims] = {}
    worn: list[GarmentMesh] = []
    for name in inner_first(pipeline.garments):
        mesh = out[name]
        place, lack = _closest_skin(subject, out, mesh)
        places: list[NDArray[np.floating]] = [place]
        is_pushed = [lack > 0]
        for below in worn:
            closest, height = _above(mesh.raw, below)
            places.append(closest)
            is_felt = np.linalg.norm(mesh.raw - closest, axis=1) < DEFAULT_CONTACT.layer_reach
            is_pushed.append((height < DEFAULT_CONTACT.gap) & is_felt)
        aims[name] = _Aims(places, is_pushed)
        worn.append(mesh)
    return aims


def _above(points: NDArray[np.float32], sheet: GarmentMesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A garment's closest points to `points` [m], both (N, 3), and how high the latter are above it [m], (N,)."""
    surface = Surface(sheet.local.astype(np.float64), sheet.faces.astype(np.int32))
    found = surface.closest(points.astype(np.float64))
    closest = surface.at(found)
    a, b, c = surface.vertices[surface.faces[found.face]].transpose(1, 0, 2)
    up = np.cross(b - a, c - a)
    return closest, ((points - closest) * up).sum(axis=1) / np.linalg.norm(up, axis=1)


def _leap(before: _Aims, now: _Aims, edges: NDArray[np.int64]) -> NDArray[np.floating]:
    """How far, at most, the places go that vertices near each vertex are pushed to [m], (N,)."""
    leap = np.zeros(len(now.is_pushed[0]), np.float32)
    for i, place in enumerate(now.places):
        way = np.linalg.norm(place - before.places[i], axis=1)
        leap += _largest_near(np.where(before.is_pushed[i] | now.is_pushed[i], way, 0), edges)
    return leap


def _largest_near(values: NDArray[Any], edges: NDArray[np.int64]) -> NDArray[Any]:
    """The largest value within `REACH` edges of each vertex, (N,)."""
    for _ in range(REACH):
        larger = values.copy()
        np.maximum.at(larger, edges[:, 0], values[edges[:, 1]])
        np.maximum.at(larger, edges[:, 1], values[edges[:, 0]])
        values = larger
    return values
