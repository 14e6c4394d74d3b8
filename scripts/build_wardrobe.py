#!/usr/bin/env python3
"""Builds the garments that are cut from the built-in bodies' own skin: run after `build_bodies.py`.

    python scripts/build_wardrobe.py [--assets refu_core/assets] [GARMENT ...]

Needs the extra `train`; ten seconds to a minute a garment. The skin is cut where the cloth ends, draped tautly round
the mean body at a clearance that gives it its ease, meshed evenly (as in `build_garments.py`), and bound to the body as
`refu garment add` binds any mesh. A dress continues downwards from the hips.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from asset_tools.cuts import Neckline, Plane
from asset_tools.remesh import remesh
from asset_tools.surfaces import Faces, Vertices, boundary_loops, self_intersections
from build_garments import Pattern, area, cut_out, drape, edge_for, keep_clear, ramp

from refu_core.body import SmplBody, load_body
from refu_core.fitting import GarmentDetails, Placing, PosedBody, SurfaceMesh, Transfer, fit_garment
from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.garments import save_garment

_PROVENANCE = (
    "the built-in body's skin, from MakeHuman's targets and skinning weights (CC0 1.0), cut and draped by "
    "scripts/build_wardrobe.py; CC0 1.0"
)


@dataclass(frozen=True)
class Measures:
    """Where things are on a mean body in the T-pose [m]."""

    neck: float
    """Height of the neck's joint."""
    neck_depth: float
    armpit: float
    """Height of the shoulders' joints."""
    elbow: float
    wrist: float
    """Distances from the middle."""
    knee: float
    ankle: float
    """Heights."""

    @classmethod
    def of(cls, body: SmplBody) -> Measures:
        joints = body.rest_joints(torch.zeros(1, N_BETAS))[0].tolist()
        return cls(
            neck=joints[12][1],
            neck_depth=joints[12][2],
            armpit=joints[16][1],
            elbow=joints[18][0],
            wrist=joints[20][0],
            knee=joints[4][1],
            ankle=joints[7][1],
        )


@dataclass(frozen=True, kw_only=True)
class Garment(Pattern):
    """How one garment is made on one body."""

    details: GarmentDetails
    skirt: tuple[float, float] | None = None
    """Heights from and to which the cloth continues, round both legs [m]."""


def _details(layer: int, color: tuple[float, float, float], held_at: str) -> GarmentDetails:
    return GarmentDetails(layer=layer, color=color, held_at=held_at, provenance=_PROVENANCE)


def _top(m: Measures, low: float, sleeve: float, ease: Callable[..., np.ndarray], wide: float = 0.0) -> dict:
    """Cuts and ease of a garment with sleeves."""
    neckline = Neckline((0.0, m.neck - 0.037, m.neck_depth + 0.0095), 0.080 + wide, 0.0765 + wide)
    shoulder = m.elbow * 0.42

    def field(p: Vertices) -> np.ndarray:
        """Blends torso into sleeve at the shoulder, and lets the neckline lie on the neck."""
        across = np.abs(p[:, 0])
        torso, arm_ease = ease(p)
        arm = ramp(across, shoulder, shoulder + 0.08)
        neck = ramp(across, 0.15, 0.09) * ramp(p[:, 1], m.neck - 0.157, m.neck - 0.087)
        return (torso * (1 - arm) + arm_ease * arm) * (1 - neck) + 0.0065 * neck

    return {"cuts": (Plane(1, low, 1), Plane(0, -sleeve, 1), Plane(0, sleeve, -1), neckline), "ease": field}


def tshirt(m: Measures, color: tuple[float, float, float]) -> Garment:
    """Falls loosely from the chest; sleeves widen towards their end."""
    sleeve = 0.82 * m.elbow

    def ease(p: Vertices) -> tuple[np.ndarray, np.ndarray]:
        wide = ramp(np.abs(p[:, 0]), 0.5 * m.elbow, sleeve)
        return 0.011 + 0.009 * ramp(p[:, 1], m.armpit - 0.07, -0.05), 0.012 + 0.010 * wide

    return Garment(**_top(m, -0.25, sleeve, ease), vertices=5600, details=_details(1, color, "shoulders"))


def shirt(m: Measures, color: tuple[float, float, float]) -> Garment:
    """Wide, to be worn over others; sleeves narrow towards the cuff."""
    sleeve = m.wrist - 0.025

    def ease(p: Vertices) -> tuple[np.ndarray, np.ndarray]:
        narrow = ramp(np.abs(p[:, 0]), m.elbow, sleeve)
        return 0.012 + 0.012 * ramp(p[:, 1], m.armpit - 0.07, -0.05), 0.014 - 0.004 * narrow

    return Garment(**_top(m, -0.27, sleeve, ease), vertices=7000, details=_details(2, color, "shoulders"))


def longsleeve(m: Measures, color: tuple[float, float, float]) -> Garment:
    """A slim top that follows the body, with sleeves to the wrist."""

    def ease(p: Vertices) -> tuple[np.ndarray, np.ndarray]:
        return 0.0085 + 0.003 * ramp(p[:, 1], 0.0, -0.2), np.full(len(p), 0.0085)

    top = _top(m, -0.21, m.wrist - 0.01, ease, wide=0.008)
    return Garment(**top, vertices=6600, details=_details(1, color, "shoulders"))


def trousers(m: Measures, color: tuple[float, float, float]) -> Garment:
    """Close at the waist, under a shirt; straight legs to the ankle."""

    def ease(p: Vertices) -> np.ndarray:
        below = ramp(p[:, 1], m.knee, m.ankle)
        return 0.0075 + 0.009 * ramp(p[:, 1], -0.28, -0.45) + 0.010 * below

    cuts = (Plane(1, -0.085, -1), Plane(1, m.ankle + 0.035, 1))
    return Garment(cuts=cuts, ease=ease, vertices=5600, details=_details(0, color, "waist"))


def dress(m: Measures, color: tuple[float, float, float]) -> Garment:
    """Short sleeves, close to the waist, wide from the hips down, to the knee."""
    sleeve = 0.55 * m.elbow

    def ease(p: Vertices) -> tuple[np.ndarray, np.ndarray]:
        return 0.0095 + 0.006 * ramp(p[:, 1], -0.1, -0.25), np.full(len(p), 0.014)

    def flare(p: Vertices) -> np.ndarray:
        return 0.33 * np.clip(-0.1 - p[:, 1], 0, None)

    hem = m.knee + 0.05
    top = _top(m, hem, sleeve, ease, wide=0.016)
    return Garment(**top, vertices=7400, details=_details(1, color, "shoulders"), flare=flare, skirt=(-0.19, hem))


WARDROBE: dict[str, tuple[Callable[[Measures, tuple[float, float, float]], Garment], tuple[float, float, float]]] = {
    "tshirt-female": (tshirt, (0.86, 0.62, 0.36)),
    "tshirt-neutral": (tshirt, (0.42, 0.58, 0.50)),
    "shirt-female": (shirt, (0.62, 0.68, 0.80)),
    "shirt-neutral": (shirt, (0.50, 0.58, 0.66)),
    "longsleeve-male": (longsleeve, (0.30, 0.33, 0.38)),
    "longsleeve-female": (longsleeve, (0.52, 0.24, 0.30)),
    "longsleeve-neutral": (longsleeve, (0.40, 0.36, 0.50)),
    "trousers-male": (trousers, (0.24, 0.28, 0.38)),
    "trousers-female": (trousers, (0.28, 0.36, 0.52)),
    "trousers-neutral": (trousers, (0.32, 0.34, 0.36)),
    "dress-female": (dress, (0.33, 0.45, 0.58)),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("garments", nargs="*", default=tuple(WARDROBE), help="all of them if none is named")
    parser.add_argument("--assets", type=Path, default=Path(__file__).parents[1] / "refu_core" / "assets")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for name in arguments.garments:
        start = time.perf_counter()
        body = load_body(name.rpartition("-")[2])
        garment_of, color = WARDROBE[name]
        garment = garment_of(Measures.of(body), color)
        v, f = build(garment, body)
        placing = Placing(unit=1.0, up="y", pose=np.zeros((N_JOINTS, 3)), is_placed=True)
        made = fit_garment(
            SurfaceMesh(v, f), body, name=name, placing=placing, details=garment.details, longest_edge=0.05
        )
        path = save_garment(made.template, arguments.assets / f"garment_{name}.npz")
        print(
            f"{name}: {len(v)} vertices, {len(f)} faces, {len(self_intersections(v, f))} self-intersections, "
            f"{path.stat().st_size / 1e6:.2f} MB, {time.perf_counter() - start:.0f} s; {'; '.join(made.notes)}",
            flush=True,
        )


def build(garment: Garment, body: SmplBody) -> tuple[Vertices, Faces]:
    v, f = body.v_template.double().numpy(), body.faces.numpy()
    cuts = garment.cuts
    if garment.skirt is not None:  # the cloth leaves the skin above the legs, and goes on from there
        cuts = (Plane(1, garment.skirt[0], 1), *cuts[1:])
    v, f = cut_out(v, f, cuts)
    if garment.skirt is not None:
        v, f = continued(v, f, *garment.skirt)
    length = edge_for(v, f, garment.vertices)
    v, f = remesh(v, f, sizing=lambda p: np.full(len(p), length))
    draped = drape(v, f, garment, body)
    # Draping has stretched the mesh: remesh it, for even edges and the right count.
    length *= np.sqrt(area(draped, f) / area(v, f))
    final, faces = remesh(draped, f, sizing=lambda p: np.full(len(p), length))
    transfer = Transfer.of(final, faces, PosedBody(body, np.zeros((N_JOINTS, 3))))
    shaped = (body.rest_vertices(torch.eye(N_BETAS)) - body.v_template).permute(1, 2, 0)
    shapedirs = transfer(shaped.reshape(body.n_vertices, -1).double().numpy(), length=0.03).reshape(-1, 3, N_BETAS)
    return keep_clear(final, faces, shapedirs, garment, body), faces


def continued(v: Vertices, f: Faces, top: float, bottom: float, step: float = 0.012) -> tuple[Vertices, Faces]:
    """The mesh with a tube from its lowest rim straight down to a height."""
    loop = min(boundary_loops(f), key=lambda one: v[one, 1].mean())
    rings, faces = [v], [f]
    last = loop
    count = max(1, round((top - bottom) / step))
    for k in range(1, count + 1):
        ring = v[loop].copy()
        ring[:, 1] = top + (bottom - top) * k / count
        own = len(v) + (k - 1) * len(loop) + np.arange(len(loop))
        rings.append(ring)
        # The rim runs in the direction of its own faces: the new ones beyond it run against it.
        a, b, c, d = last, np.roll(last, -1), own, np.roll(own, -1)
        faces += [np.stack((b, a, c), 1), np.stack((b, c, d), 1)]
        last = own
    return np.concatenate(rings), np.concatenate(faces)


if __name__ == "__main__":
    main()
