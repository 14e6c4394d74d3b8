#!/usr/bin/env python3
"""Adds styles to the built-in garments: run after `build_garments.py`, which writes them without.

    python scripts/build_styles.py [--output DIR] [GARMENT ...]

Replaces a garment's `v_template` by the mean cut and adds `styledirs` and `tailoring_from_style`; about a
minute a garment. See docs/guide/data.md, "Styles".

A tailoring parameter moves the vertices of the *cut* (the rest shape in the T-pose) along a fixed smooth field, so a
cut is linear in the parameters. Drapes of cuts with different parameters on the mean body are analysed for their
principal axes, as TailorNet does; γ are the scores on those axes, scaled to unit variance. As γ is a rotation of the
parameters, the cut follows γ exactly: rest lengths and template come from one linear map, and the folds of a drape stay
where they belong, in the displacement that a backbone predicts.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from build_garments import ramp
from numpy.typing import NDArray

from refu_core.body import SmplBody, load_body
from refu_core.frames import N_BETAS
from refu_core.garments import N_STYLES, PAPER_GARMENTS, GarmentTemplate, load_garment
from refu_core.garments._file import shortened
from refu_core.mesh import face_normals, vertex_areas, vertex_normals
from refu_core.sdf import ExactSdf
from refu_core.simulation._cloth import F32, ClothTopology
from refu_core.simulation._drape import Draper

F64 = NDArray[np.float64]
_CLEARANCE = 0.005
"""Distance that a cut made longer or wider keeps from the mean body [m]."""
_DRAPES = 24
"""Number of drapes of drawn parameters, besides the mean cut's and two for each parameter."""


class _Cut:
    """The template's geometry that tailoring fields are made of."""

    def __init__(self, garment: GarmentTemplate, body: SmplBody) -> None:
        self.topology = ClothTopology.of(garment.mesh)
        self.x: F64 = garment.v_template.numpy().astype(np.float64)
        self.joints: F64 = body.rest_joints(torch.zeros(1, N_BETAS))[0].double().numpy()
        loops = self.topology.boundary_loops()
        height = [self.x[loop, 1].mean() for loop in loops]
        self.top = loops[int(np.argmax(height))]
        self.bottom = loops[int(np.argmin(height))]
        self.from_top = self.topology.distance_from(self.x, self.top)
        self.held = garment.card.held_at_waist
        self._laplacian = garment.mesh.uniform_laplacian()
        self._sdf = ExactSdf(body.faces)
        self._sdf.update(body.rest_vertices(torch.zeros(1, N_BETAS))[0])

    def below(self, start: float) -> F64:
        """How far below a height [m] each vertex is, from 0 there to 1 at the lowest hem, slowly at first, (N,)."""
        low = self.x[self.bottom, 1].mean()
        return np.clip((start - self.x[:, 1]) / (start - low), 0, None) ** 1.2

    def normals(self) -> F64:
        """Outward unit normals, smoothed so that a wider cut doesn't deepen the folds of the body under it."""
        normal = self.smooth(vertex_normals(self.x, self.topology.mesh.faces), 30)
        return normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def smooth(self, field: F64, rounds: int = 10) -> F64:
        """A field (N, 3) after `rounds` of moving each vertex halfway to the mean of its neighbours."""
        for _ in range(rounds):
            field = field - 0.5 * (self._laplacian @ field)
        return field

    def outside(self, vertices: F64) -> F64:
        """`vertices` (N, 3) moved out of the mean body where they are closer to it than a garment should be."""
        for _ in range(4):
            found = self._sdf.query(torch.from_numpy(vertices.astype(np.float32)))
            depth = np.clip(_CLEARANCE - found.distance.numpy(), 0, None)[:, None]
            if not depth.any():
                break
            gradient = found.gradient.numpy()
            vertices = vertices + self.smooth(depth * gradient.astype(np.float64), 3) + (0.3 * depth * gradient)
        return vertices


def _length(cut: _Cut) -> F64:
    start = cut.joints[1:3, 1].mean() + 0.02 if cut.held else cut.joints[16:18, 1].mean() - 0.12
    return np.outer(cut.below(start), (0, -1, 0))


def _sleeve_length(cut: _Cut) -> F64:
    start = 0.7 * abs(cut.joints[16, 0])
    far = np.abs(cut.x[:, 0]).max()
    share = np.clip((np.abs(cut.x[:, 0]) - start) / (far - start), 0, None) ** 1.1
    return np.outer(np.sign(cut.x[:, 0]) * share, (1, 0, 0))


def _ease(cut: _Cut) -> F64:
    if cut.held:
        return cut.normals() * ramp(cut.from_top, 0.01, 0.08)[:, None]
    # Sleeves are narrower than the trunk: the same share of their girth is less.
    weight = ramp(cut.from_top, 0.06, 0.22)
    return cut.normals() * (weight * (1 - 0.4 * ramp(np.abs(cut.x[:, 0]), 0.17, 0.26)))[:, None]


def _neckline(cut: _Cut) -> F64:
    # Along the cloth, away from the neck: the gradient of the distance from its rim.
    x, d, faces = cut.x, cut.from_top, cut.topology.mesh.faces
    a, b, c = faces.T
    normal = face_normals(x, faces)
    area2 = (normal**2).sum(1, keepdims=True) + 1e-18
    gradient = (
        np.cross(normal, x[c] - x[b]) * d[a, None]
        + np.cross(normal, x[a] - x[c]) * d[b, None]
        + np.cross(normal, x[b] - x[a]) * d[c, None]
    ) / area2
    away = np.zeros_like(x)
    for corner in (a, b, c):
        np.add.at(away, corner, gradient * np.sqrt(area2))
    away = cut.smooth(away / (np.linalg.norm(away, axis=1, keepdims=True) + 1e-12), 20)
    # A neckline is cut deeper in front than at the back and on the shoulders.
    middle = x[cut.top, 2].mean()
    front = 0.35 + 0.65 * ramp(x[:, 2], middle - 0.01, middle + 0.07)
    return away * (np.exp(-((d / 0.1) ** 2)) * front)[:, None]


def _flare(cut: _Cut) -> F64:
    if len(cut.topology.boundary_loops()) > 2:  # trouser legs: away from the axis of each leg
        side = np.where(cut.x[:, 0] >= 0, 1, 2)
        hip, knee = cut.joints[side], cut.joints[np.where(side == 1, 4, 5)]
        along = ((cut.x[:, 1] - hip[:, 1]) / (knee[:, 1] - hip[:, 1]))[:, None]
        away = cut.x - (hip + along * (knee - hip))
        start = cut.x[cut.bottom, 1].mean() + 0.75 * (cut.joints[1, 1] - cut.x[cut.bottom, 1].mean())
    else:
        away = cut.x - cut.x[cut.bottom].mean(0)
        start = cut.x[cut.top, 1].mean()
    away[:, 1] = 0
    away /= np.linalg.norm(away, axis=1, keepdims=True) + 1e-9
    return cut.smooth(away * cut.below(start)[:, None])


def _rise(cut: _Cut) -> F64:
    return np.outer(np.exp(-((cut.from_top / 0.08) ** 2)), (0, 1, 0))


_FIELDS: dict[str, Callable[[_Cut], F64]] = {
    "length": _length,
    "sleeve_length": _sleeve_length,
    "ease": _ease,
    "neckline": _neckline,
    "flare": _flare,
    "rise": _rise,
}
_ALONG_THE_BODY = ("length", "sleeve_length", "neckline", "rise")
"""Fields that carry cloth to where the body may be wider; what they move is kept outside of it."""


def tailored(garment: GarmentTemplate, body: SmplBody) -> tuple[F64, F64]:
    """The mean cut [m], shape (N, 3), and its displacement per standard deviation of each parameter, (N, 3, 4)."""
    cut, parameters = _Cut(garment, body), garment.card.tailoring
    mean = cut.x.copy()
    fields = []
    for parameter in parameters:
        field = _FIELDS[parameter.name](cut)
        mean = mean + parameter.mean * field
        fields.append(parameter.std * field)
    mean = cut.outside(mean)
    out = []
    for parameter, field in zip(parameters, fields, strict=True):
        if parameter.name in _ALONG_THE_BODY:
            field = (cut.outside(mean + 2 * field) - cut.outside(mean - 2 * field)) / 4
        out.append(cut.smooth(field, 2))
    return mean, np.stack(out, -1)


def build_styles(garment: GarmentTemplate, body: SmplBody) -> dict[str, F32]:
    """Cuts the garment's styles and finds the principal axes of their drapes on the mean body.

    Returns the arrays for its file:
        v_template: the mean cut in the T-pose [m], shape (N, 3): each parameter in the middle of its range.
        styledirs: displacement of the cut per unit of each γ [m], shape (N, 3, 4).
        tailoring_from_style: parameters in standard deviations from γ, (4, 4): p = A γ; orthogonal, so γ = Aᵀ p.
    """
    mean, fields = tailored(garment, body)
    corners = np.concatenate((1.5 * np.eye(N_STYLES), -1.5 * np.eye(N_STYLES)))
    drawn = np.clip(np.random.default_rng(0).normal(size=(_DRAPES, N_STYLES)), -2, 2)
    scores = np.concatenate((np.zeros((1, N_STYLES)), corners, drawn))
    directions = np.ascontiguousarray(fields, dtype=np.float32)
    cut = replace(
        garment,
        v_template=torch.from_numpy(mean.astype(np.float32)),
        styledirs=torch.from_numpy(directions.reshape(-1, N_STYLES)),
    )
    draper = Draper(cut, body)
    drapes = np.stack([draper.canonical(np.zeros(N_BETAS), score)[0] for score in scores]).astype(np.float64)
    weight = np.sqrt(vertex_areas(mean, draper.topology.mesh.faces))[None, :, None]
    centred = ((drapes - drapes.mean(0)) * weight).reshape(len(scores), -1)
    slope, *_ = np.linalg.lstsq(scores - scores.mean(0), centred, rcond=None)  # (4, 3N): drape per unit parameter
    rotation = np.linalg.svd(slope.T, full_matrices=False)[2].T  # p = A γ
    rotation *= np.sign(rotation[np.abs(rotation).argmax(0), np.arange(N_STYLES)])  # larger is longer, wider, deeper
    found = {"v_template": mean, "styledirs": fields @ rotation, "tailoring_from_style": rotation}
    return {name: values.astype(np.float32) for name, values in found.items()}


def main() -> int:
    assets = Path(__file__).parents[1] / "refu_core" / "assets"
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("garments", nargs="*", default=PAPER_GARMENTS, help="all that have styles if none is named")
    parser.add_argument("--output", type=Path, default=assets, help="folder for the files (default: where they are)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    for name in args.garments:
        garment = load_garment(name)
        if garment.styledirs is not None:
            print(f"{name}: has styles already; run build_garments.py first", file=sys.stderr)
            return 2
        with np.load(assets / f"garment_{name}.npz", allow_pickle=False) as data:
            arrays = {key: data[key] for key in data.files}
        arrays |= build_styles(garment, load_body(garment.body))
        args.output.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(args.output / f"garment_{name}.npz", **shortened(arrays))
        print(name, np.round(arrays["tailoring_from_style"].T, 2), [one.name for one in garment.card.tailoring])
    return 0


if __name__ == "__main__":
    sys.exit(main())
