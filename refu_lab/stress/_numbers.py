"""Numbers: float32 against float64, for all kinds of frames and points."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from refu_core.body import UP_STEP
from refu_core.mesh import face_normals
from refu_core.sdf import ExactSdf
from refu_lab.stress._trial import Measurement, Subject, Trial, distance_to_mesh, predicted

ROUNDING = 5e-6
"""Rounding error allowed for float32 on a body of a metre or two [m]: fifty times its resolution there."""
COLLIDER_ROUNDING = 2e-5
"""The same with the collider [m], which divides short distances between two surfaces. It holds in everyday poses only:
where joints turn as in no real body, rounding may decide which of two sides is nearer."""
_DISTANCE_ROUNDING = 2e-6  # [m], relative beyond a metre
_POINTS = 24
_UNIT = 1e-3
"""How far the length of a gradient may be from one."""
_COLLAPSED = 40
"""Number of faces whose corners are put in one place or in line."""


def against_float64(subject: Subject, trial: Trial, *, on_collider: bool = False) -> Iterator[Measurement]:
    """Compares bodies and garments before collision handling in float32, the first also by the pipeline, with float64.

    Garments are on the skin, or on the collider. The limit grows with the size of the result and with the angles:
    float32 resolves 1,000 rad to 6e-5. In float32, networks are told of gravity's direction in steps (`up_in`): what
    half a step makes of the cloth isn't counted.
    """
    worn = subject if on_collider else subject.on_skin
    out = worn.pipeline(trial.frames[0])
    first = [out.body, *(mesh.raw for mesh in out.values())]
    ours, wanted = (predicted(outfit, trial.frames) for outfit in (worn.pipeline.outfit, worn.outfit64))
    aside, upright = np.sin(UP_STEP / 2), np.cos(UP_STEP / 2)
    tilts = (aside, upright, 0), (0, upright, aside)
    tilted = [predicted(worn.outfit64, trial.frames, up=up) for up in tilts]
    turn = 1 + np.array([np.linalg.norm(frame.pose, axis=1).max() for frame in trial.frames]) / np.pi
    rounding = COLLIDER_ROUNDING if on_collider else ROUNDING
    for got, whole, right, *others in zip(ours, first, wanted, *tilted, strict=True):
        deviation = np.abs(got - right).max((1, 2))
        deviation[0] = max(deviation[0], np.abs(whole - right[0]).max())
        limit = rounding * turn * np.abs(right).max((1, 2), initial=1.0)
        limit += sum(np.abs(other - right).max((1, 2)) for other in others)
        for i in range(len(trial.frames)):
            yield Measurement(deviation=float(deviation[i]), limit=float(limit[i]), culprit=i)
    yield Measurement(nan=n_not_finite(*first, *(mesh.vertices for mesh in out.values()), *ours))
    if not on_collider:
        out = subject.pipeline(trial.frames[0])
        yield Measurement(nan=n_not_finite(out.body, *(m for mesh in out.values() for m in (mesh.raw, mesh.vertices))))


def n_not_finite(*arrays: NDArray[np.floating]) -> int:
    return sum(int(np.count_nonzero(~np.isfinite(array))) for array in arrays)


F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Place = Callable[[F32, I64, np.random.Generator], F64]
"""Makes query points (N, 3) around a body's vertices (V, 3) and faces (F, 3); it may move the vertices."""


def _on_faces(vertices: F32, faces: I64, rng: np.random.Generator) -> F64:
    weights = rng.dirichlet((0.3, 0.3, 0.3), _POINTS)
    return _mixed(vertices, faces[rng.integers(len(faces), size=_POINTS)], weights)


def _on_edges(vertices: F32, faces: I64, rng: np.random.Generator) -> F64:
    share = rng.random(_POINTS)
    weights = np.stack([share, 1 - share, np.zeros(_POINTS)], 1)
    weights[: _POINTS // 2] = (1, 0, 0)  # half of them on vertices, to the bit
    return _mixed(vertices, faces[rng.integers(len(faces), size=_POINTS)], weights)


def _mixed(vertices: F32, faces: I64, weights: F64) -> F64:
    mixed: F64 = (vertices[faces].astype(np.float64) * weights[..., None]).sum(1)
    return mixed


def _medial(vertices: F32, faces: I64, rng: np.random.Generator) -> F64:
    """Points half-way between the skin and the skin opposite, where the gradient flips."""
    chosen = faces[rng.integers(len(faces), size=_POINTS)]
    exact = vertices.astype(np.float64)
    inward = -face_normals(exact, chosen)
    inward /= np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-300)
    start = exact[chosen].mean(1)
    sdf = ExactSdf(faces)
    sdf.update(torch.from_numpy(vertices))
    # Bisect for the depth at which another part of the skin becomes as near as the part above.
    low, high = np.zeros(_POINTS), np.full(_POINTS, 0.3)
    for _ in range(20):
        middle = (low + high) / 2
        points = torch.from_numpy((start + middle[:, None] * inward).astype(np.float32))
        is_under = sdf.query(points).distance.abs().numpy() >= middle - 1e-6
        low, high = np.where(is_under, middle, low), np.where(is_under, high, middle)
    halfway: F64 = start + ((low + high) / 2)[:, None] * inward
    return halfway


def _off(vertices: F32, faces: I64, rng: np.random.Generator, *, least: float, most: float) -> F64:
    """Points off the skin on either side, by something between these powers of ten [m]."""
    on, off = _on_faces(vertices, faces, rng), rng.normal(size=(_POINTS, 3))
    return on + off * 10.0 ** rng.uniform(least, most, (_POINTS, 1))


def _without_area(vertices: F32, faces: I64, rng: np.random.Generator) -> F64:
    """Points around faces whose corners are in one place, or in line."""
    chosen = faces[rng.integers(len(faces), size=_COLLAPSED)]
    vertices[chosen[::2, 1]] = vertices[chosen[::2, 0]]
    vertices[chosen[::2, 2]] = vertices[chosen[::2, 0]]
    vertices[chosen[1::2, 2]] = (vertices[chosen[1::2, 0]] + vertices[chosen[1::2, 1]]) / 2
    return _mixed(vertices, chosen[:_POINTS], rng.dirichlet((1, 1, 1), _POINTS)) + rng.normal(0, 3e-3, (_POINTS, 3))


POINTS: dict[str, Place] = {
    "on faces": _on_faces,
    "on edges and vertices": _on_edges,
    "on the medial axis": _medial,
    "a hair's breadth off": partial(_off, least=-40, most=-4),  # down to less than float32 resolves
    "far away": partial(_off, least=-1, most=5),
    "faces without area": _without_area,
}


def distances(subject: Subject, trial: Trial, *, place: Place) -> Iterator[Measurement]:
    """Compares distances with those to all triangles in float64; the approximate one must not be smaller."""
    rng = np.random.default_rng(trial.seed)
    body, frame = subject.pipeline.body, trial.frames[0]
    with torch.no_grad():
        vertices = body(frame.pose[None], frame.betas[None]).vertices[0].numpy()
    faces = body.faces.numpy()
    points = place(vertices, faces, rng).astype(np.float32)
    wanted = distance_to_mesh(points, vertices, faces)
    for name, sdf in subject.distances.items():
        sdf.update(torch.from_numpy(vertices))
        sample = sdf.query(torch.from_numpy(points))
        distance, gradient = sample.distance.double().abs().numpy(), sample.gradient.double().numpy()
        error = wanted - distance
        error = np.maximum(error, 0) if name == "approx" else np.abs(error)
        is_unit = np.abs(np.linalg.norm(gradient, axis=1) - 1) <= _UNIT
        yield Measurement(
            nan=n_not_finite(distance, gradient),
            deviation=float((error / np.maximum(1, wanted)).max()),
            limit=_DISTANCE_ROUNDING,
            faults=() if is_unit.all() else (f"{name}: a gradient isn't of unit length",),
        )
