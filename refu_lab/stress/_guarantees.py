"""Guarantees: nothing inside, nothing thrown out, nothing that jumps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refu_core.backbones import Skinned
from refu_core.body import Surface
from refu_core.contact import ASKED_FROM, DEFAULT_CONTACT
from refu_core.frames import SmplFrame, pasts_of
from refu_core.garments import inner_first
from refu_core.mesh import face_normals
from refu_core.modes import DEFAULT_MARGIN
from refu_core.realtime import GarmentMesh, GarmentPipeline, PipelineOutput, Wearer, dress
from refu_core.refu import MAX_DISPLACEMENT
from refu_lab.stress._numbers import n_not_finite
from refu_lab.stress._trial import Measurement, Subject, Trial

DEPTH = 1e-4
"""No vertex may be deeper inside the collider than this [m]."""
MULTIPLE = 2.0
"""No vertex may move farther than this times the sum of the margin and the largest shortfall from it nearby."""
REACH = 8
"""What counts as nearby [edges]: as far as pushed vertices, and after them raised edges, take others along."""
PACE = 2.0
"""From frame to frame, no vertex may move farther than this multiple of the body's fastest vertex plus `PACE_SLACK`."""
PACE_SLACK = 1e-3
"""[m]."""
_BOUND_SLACK = 1e-5  # [m]; rounding of a displacement that is clamped to its bound
_ON_SKIN = 1e-5  # [m]
_BURIED = 0.02  # [m]


def nothing_inside(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """The depth of the deepest vertex, by winding number, where that is promised (`FrameStats.within_promise`).

    Where it isn't, as when the body overlaps itself deeper than skin gives way, the vertices inside have to be counted.
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
    """Compares each garment's certificate (`n_unresolved`) with the winding numbers of all its output vertices."""
    (out,) = subject.pipeline(trial.frames)
    subject.checker.update(out.body)
    for name, mesh in out.items():
        found = subject.checker.check(mesh.local, mesh.faces)
        # The certificate is computed before the person is turned, so vertices on the skin may round to its other side.
        n_sure, n_said = int((found.depth > _ON_SKIN).sum()), out.stats.garments[name].n_unresolved
        fault = f"{name}: {n_sure} vertices are inside, {n_said} are said to be"
        yield Measurement(nan=n_not_finite(mesh.vertices), faults=(fault,) if n_said < n_sure else ())


def buried(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """The depth of the deepest vertex of garments whose every vertex starts 2 cm inside the body."""
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
                laid=points,
                on_mean=drape.on_mean[0],
                rest=skinned[name].template.rest(betas)[0],
                margin=skinned[name].margin,
                scale=1.0,
                n_layered=torch.zeros(1, dtype=torch.int32),
            ).vertices.numpy()
            depth = subject.checker.check(done, skinned[name].template.faces.numpy()).max_depth
            yield Measurement(nan=n_not_finite(done), deviation=depth, limit=DEPTH)


def not_thrown(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """Compares how far vertices are moved off the body with how far short of the margin those near them are."""
    for name, pipeline in subject.one_by_one.items():
        (out,) = pipeline(trial.frames)
        mesh = out[name]
        _, lack = _closest_skin(subject, out, torch.tensor(mesh.raw))
        moved = np.linalg.norm(mesh.local - mesh.raw, axis=1)
        near = _largest_near(lack, pipeline.garments[name].edges.numpy())
        limit = np.minimum(MAX_DISPLACEMENT, MULTIPLE * (near + DEFAULT_MARGIN)) + _BOUND_SLACK
        yield _finite(out)
        yield _farthest(moved, limit + _pressed(subject, trial.frames[0])[name])


def bounded(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """Compares displacements from where limbs press the cloth with `MAX_DISPLACEMENT`, whatever the frame."""
    for name, pipeline in subject.one_by_one.items():
        (out,) = pipeline(trial.frames)
        moved = np.linalg.norm(out[name].local - out[name].raw, axis=1)
        yield _finite(out)
        yield _farthest(moved, _pressed(subject, trial.frames[0])[name] + MAX_DISPLACEMENT + _BOUND_SLACK)


def no_jumps(subject: Subject, trial: Trial, *, together: bool = False) -> Iterator[Measurement]:
    """Compares how far vertices go from frame to frame, each garment worn alone, with the body's fastest vertex.

    Pushed vertices go to the closest skin. That leaps from one side of a limb's medial axis to the other where another
    way out becomes the shortest, and no projection without memory can follow it smoothly. So vertices may go farther by
    as much as the closest skin of pushed vertices near them moves; of garments worn `together`, the closest point of
    the garment below may leap, too.
    """
    for pipeline in [subject.pipeline] if together else subject.one_by_one.values():
        told = [(out := pipeline(frame), _aims(subject, pipeline, out)) for frame in trial.frames]
        yield from (_finite(out) for out, _ in told)
        for (last, before), (out, aims) in pairwise(told):
            pace = PACE * float(np.linalg.norm(out.body - last.body, axis=1).max()) + PACE_SLACK
            for name, mesh in out.items():
                leap = _leap(before[name], aims[name], pipeline.garments[name].edges.numpy())
                yield _farthest(np.linalg.norm(mesh.local - last[name].local, axis=1), pace + leap)


def bounded_jumps(subject: Subject, trial: Trial) -> Iterator[Measurement]:
    """As limbs go through each other, vertices may go from one bound of the displacement to the other, no farther."""
    told = [(subject.pipeline(frame), _pressed(subject, frame, together=True)) for frame in trial.frames]
    yield from (_finite(out) for out, _ in told)
    for (last, before), (out, pressed) in pairwise(told):
        pace = PACE * float(np.linalg.norm(out.body - last.body, axis=1).max())
        for name, mesh in out.items():
            way = np.linalg.norm(mesh.local - last[name].local, axis=1)
            yield _farthest(way, pace + 2 * MAX_DISPLACEMENT + before[name] + pressed[name])


def _pressed(subject: Subject, frame: SmplFrame, *, together: bool = False) -> dict[str, NDArray[np.floating]]:
    """How far vertices of each garment go to the skin that they lie on, pressed by limbs or deep in the body [m], (N,).

    For garments worn `together`, this includes how far they are unfolded beforehand, and tucked under each other.
    """
    stage, outfit = subject.contact_stage, subject.pipeline.outfit
    pose, betas = torch.tensor(frame.pose)[None], torch.tensor(frame.betas)[None]
    style = None if frame.style is None else torch.tensor(frame.style)[None]
    with torch.no_grad():
        dressed = dress(pose, Wearer.of(outfit, betas, style), past=torch.from_numpy(pasts_of([frame])))
        stage.update(dressed.body[0])
        raw = {name: one.vertices[0] for name, one in dressed.drapes.items()}
        laid = stage.laid(raw, dressed.transforms.rotation[0]) if together else {n: stage.press(n, raw[n]) for n in raw}
        ways = {
            name: stage.own_side(name, laid[name], one.on_mean[0], DEFAULT_MARGIN + ASKED_FROM)[0] - raw[name]
            for name, one in dressed.drapes.items()
        }
    return {name: np.linalg.norm(way.numpy(), axis=1) for name, way in ways.items()}


def _farthest(way: NDArray[np.floating], limit: NDArray[np.floating]) -> Measurement:
    """Measures the vertex that moves farthest relative to its limit; `way` and `limit` are (N,) [m]."""
    i = int(np.argmax(way / limit))
    return Measurement(deviation=float(way[i]), limit=float(limit[i]))


def _finite(out: PipelineOutput) -> Measurement:
    return Measurement(nan=n_not_finite(*(mesh.vertices for mesh in out.values())))


@dataclass(frozen=True, eq=False)
class _Aims:
    """Where collision handling takes the N vertices of a garment: to the skin, and to the garments worn below."""

    places: list[NDArray[np.floating]]
    """The closest point of each surface to each vertex before collision handling [m], (N, 3); of the body, once cloth
    is on its own side (`OwnSide`)."""
    is_pushed: list[NDArray[np.bool_]]
    """Whether each vertex is nearer to that surface than allowed, (N,)."""


def _closest_skin(
    subject: Subject, out: PipelineOutput, raw: Tensor
) -> tuple[NDArray[np.float32], NDArray[np.floating]]:
    """The skin closest to each of the vertices `raw`, (N, 3), and its shortfall from the margin, (N,) [m].

    Where limbs overlap, the closest skin may be inside the body; then the closest skin outside is taken.
    """
    body = torch.tensor(out.body)
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
        raw = torch.tensor(mesh.raw)
        place, lack = _closest_skin(subject, out, raw)
        own_side = subject.contact_stage.own_sides[name]
        share = own_side.share(subject.distances["exact"].query(raw).distance)
        if bool(share.any()):
            skin = pipeline.outfit.below[name](torch.tensor(out.body)[None])[0]
            place, _ = _closest_skin(subject, out, own_side(raw, share, skin))
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
    """The points of a garment closest to `points` [m], both (N, 3), and the height of `points` above it [m], (N,)."""
    surface = Surface(sheet.local.astype(np.float64), sheet.faces.astype(np.int32))
    found = surface.closest(points.astype(np.float64))
    closest = surface.at(found)
    up = face_normals(surface.vertices, surface.faces[found.face])
    return closest, ((points - closest) * up).sum(axis=1) / np.linalg.norm(up, axis=1)


def _leap(before: _Aims, now: _Aims, edges: NDArray[np.int64]) -> NDArray[np.floating]:
    """Bounds, for each vertex, how far the targets of pushed vertices near it have moved [m], (N,)."""
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
