"""Garments as others model them: implicit cloth round a mannequin of tubes, cut open, in any unit, axes and pose.

The mannequin is no body of this project: capsules and stacked ellipses with the measures of a person of 1.70 m who
stands on a floor at 0 and looks along z. Cloth is the level of its distance where the garment hangs, cut where it ends.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import igl
import numpy as np
import trimesh
from numpy.typing import NDArray

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

_HEIGHTS = (0.72, 0.82, 0.92, 1.02, 1.12, 1.22, 1.30, 1.37, 1.42, 1.46)
_WIDTHS = (0.192, 0.188, 0.178, 0.156, 0.142, 0.172, 0.178, 0.158, 0.122, 0.075)
_DEPTHS = (0.100, 0.103, 0.116, 0.108, 0.104, 0.114, 0.114, 0.096, 0.075, 0.062)
_FORWARD = (0.035, 0.028, 0.032, 0.050, 0.055, 0.055, 0.048, 0.030, 0.025, 0.030)


@dataclass(frozen=True)
class Outside:
    """A mesh file's content."""

    vertices: F64
    faces: list[list[int]]
    uv: F64 | None = None
    uv_faces: list[list[int]] | None = None


@dataclass(frozen=True)
class Wanted:
    """What a garment is made like."""

    ease: float = 0.02
    """How far off the mannequin [m]."""
    arms: float = 0.0
    """How far they hang [rad]."""
    sleeve: float | None = None
    """Where sleeves end along the arm, from 0 at the shoulder to 1 at the wrist; None for no sleeves."""
    low: float = 0.75
    high: float = 1.48
    """Heights of hem and collar [m]."""
    legs: bool = False
    """Trouser legs, or one tube."""
    flare: float = 0.0
    """How much wider below the waist [m a m]."""
    is_open: bool = False
    """Whether the front is."""
    step: float = 0.02
    """Size of its triangles [m]."""
    turn: tuple[str, float] = field(default=("y", 1.0))
    """The axis that is up, and units a metre."""


def _capsule(p: F64, start: F64, end: F64, r0: float, r1: float) -> F64:
    along = end - start
    t = np.clip(((p - start) @ along) / (along @ along), 0, 1)
    return np.linalg.norm(p - start - t[:, None] * along, axis=1) - (r0 + t * (r1 - r0))


def _torso(p: F64, flare: float) -> F64:
    y = p[:, 1]
    wide = np.clip(1.02 - y, 0, None) * flare
    w, d, z = (np.interp(y, _HEIGHTS, row) for row in (_WIDTHS, _DEPTHS, _FORWARD))
    w, d = w + wide, d + wide
    radius = np.hypot(p[:, 0] / w, (p[:, 2] - z) / d)
    return (radius - 1) * np.minimum(w, d)


def _arm(side: float, lowered: float) -> tuple[F64, F64, F64]:
    shoulder = np.array([side * 0.172, 1.355, 0.035])
    out = np.array([side * np.cos(lowered), -np.sin(lowered), 0.0])
    return shoulder, shoulder + 0.26 * out, shoulder + 0.495 * out


def _smooth_min(a: F64, b: F64, k: float = 0.03) -> F64:
    h = np.clip(0.5 + 0.5 * (b - a) / k, 0, 1)
    return b + h * (a - b) - k * h * (1 - h)


def cloth(wanted: Wanted) -> tuple[F64, Ints]:
    """Vertices [m], y up, on a floor at 0, and triangles."""
    wide = wanted.flare * (1.02 - wanted.low)
    low = np.array([-0.8, wanted.low - 0.08, -0.15 - wide])
    high = np.array([0.8, 1.6 if wanted.high > 1.3 else wanted.high + 0.1, 0.25 + wide])
    counts = np.ceil((high - low) / wanted.step).astype(int)
    axes = [low[k] + wanted.step * np.arange(counts[k]) for k in range(3)]
    grid = np.stack(np.meshgrid(*axes[::-1], indexing="ij")[::-1], -1).reshape(-1, 3)
    y = grid[:, 1]
    body = _torso(grid, wanted.flare)
    if wanted.legs:
        body = np.maximum(body, 0.80 - y)
        for side in (-1.0, 1.0):
            hip, knee, ankle = (np.array(q) for q in ((0.1, 0.86, 0.04), (0.13, 0.51, 0.02), (0.153, 0.08, -0.005)))
            for start, end, r0, r1 in ((hip, knee, 0.088, 0.06), (knee, ankle, 0.06, 0.045)):
                flip = np.array([side, 1, 1])
                body = _smooth_min(body, _capsule(grid, start * flip, end * flip, r0, r1), 0.02)
    if wanted.sleeve is not None:
        for side in (-1.0, 1.0):
            shoulder, elbow, wrist = _arm(side, wanted.arms)
            body = _smooth_min(body, _capsule(grid, shoulder, elbow, 0.052, 0.043))
            body = _smooth_min(body, _capsule(grid, elbow, wrist, 0.043, 0.033))
    v, f = igl.marching_cubes(body, grid, *(int(n) for n in counts), wanted.ease)[:2]
    centre = v[f].mean(1)
    kept = (centre[:, 1] > wanted.low) & (centre[:, 1] < wanted.high)
    neck = np.hypot(centre[:, 0], centre[:, 2] - 0.03) < 0.105
    kept &= ~(neck & (centre[:, 1] > 1.36))
    for side in (-1.0, 1.0):
        shoulder, _, wrist = _arm(side, wanted.arms)
        if wanted.sleeve is None:  # armholes
            kept &= _capsule(centre, shoulder - [side * 0.04, 0, 0], wrist, 0.075, 0.075) > 0
            continue
        along = ((centre - shoulder) @ (wrist - shoulder)) / ((wrist - shoulder) @ (wrist - shoulder))
        kept &= ~((side * centre[:, 0] > 0.19) & (along > wanted.sleeve) & (centre[:, 1] > 0.9))
    if wanted.is_open:
        kept &= ~((np.abs(centre[:, 0]) < 0.02) & (centre[:, 2] > 0.05))
    mesh = trimesh.Trimesh(v, f[kept], process=True)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64)


def placed(v: F64, wanted: Wanted) -> F64:
    """In the unit and axes of its file."""
    axis, unit = wanted.turn
    return unit * (np.stack((v[:, 0], -v[:, 2], v[:, 1]), 1) if axis == "z" else v)


def unwrapped(v: F64, f: Ints) -> tuple[F64, Ints]:
    """A cylindrical unwrapping, cut at the back: coordinates (T, 2) and those of the faces' corners."""
    angle = np.arctan2(v[:, 0], v[:, 2] - 0.03)
    corners = angle[f]
    crosses = np.ptp(corners, axis=1) > np.pi
    corners = np.where(crosses[:, None] & (corners < 0), corners + 2 * np.pi, corners)
    u = corners / (2 * np.pi) + 0.5
    pairs = np.stack((u, v[f][:, :, 1] - v[:, 1].min()), -1).reshape(-1, 2)
    coordinates, local = np.unique(pairs.round(9), axis=0, return_inverse=True)
    return coordinates, local.reshape(-1, 3)


def button(at: F64, radius: float = 0.008) -> tuple[F64, Ints]:
    """A closed ball."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=radius)
    return np.asarray(ball.vertices) + at, np.asarray(ball.faces, dtype=np.int64)


def together(parts: list[tuple[F64, Ints]]) -> tuple[F64, Ints]:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(v) for v, _ in parts[:-1])])
    return np.concatenate([v for v, _ in parts]), np.concatenate(
        [f + start for start, (_, f) in zip(starts, parts, strict=True)]
    )


def quads_of_a_skirt(rows: int = 40, columns: int = 120) -> tuple[F64, list[list[int]]]:
    """A flared tube of quads, on a floor at 0."""
    height = np.linspace(0.95, 0.42, rows)
    angle = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    w = np.interp(height, _HEIGHTS, _WIDTHS) + 0.02 + 0.28 * np.clip(0.9 - height, 0, None)
    d = np.interp(height, _HEIGHTS, _DEPTHS) + 0.02 + 0.28 * np.clip(0.9 - height, 0, None)
    z = np.interp(height, _HEIGHTS, _FORWARD)
    v = np.stack(
        (
            w[:, None] * np.sin(angle),
            np.broadcast_to(height[:, None], (rows, columns)),
            z[:, None] + d[:, None] * np.cos(angle),
        ),
        -1,
    ).reshape(-1, 3)
    index = np.arange(rows * columns).reshape(rows, columns)
    right = np.roll(index, -1, 1)
    quads = np.stack((index[:-1], index[1:], right[1:], right[:-1]), -1).reshape(-1, 4)
    return v, quads.tolist()


def write_obj(path: Path, mesh: Outside) -> Path:
    """As modelling programs write it."""
    lines = ["# made elsewhere", "mtllib none.mtl", "o garment"]
    lines += ["v {:.7g} {:.7g} {:.7g}".format(*p) for p in mesh.vertices.tolist()]
    if mesh.uv is not None and mesh.uv_faces is not None:
        lines += ["vt {:.6g} {:.6g}".format(*p) for p in mesh.uv.tolist()]
        for face, texture in zip(mesh.faces, mesh.uv_faces, strict=True):
            lines.append("f " + " ".join(f"{a + 1}/{b + 1}" for a, b in zip(face, texture, strict=True)))
    else:
        lines += ["f " + " ".join(str(a + 1) for a in face) for face in mesh.faces]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _dress(folder: Path, coarser: float) -> Path:
    wanted = Wanted(low=0.50, sleeve=0.3, flare=0.25, step=0.034, turn=("y", 100))
    v, f = cloth(replace(wanted, step=coarser * wanted.step))
    return write_obj(folder / "dress.obj", Outside(placed(v, wanted), f.tolist()))


def _coat(folder: Path, coarser: float) -> Path:
    wanted = Wanted(low=0.55, sleeve=0.97, arms=0.7, ease=0.028, is_open=True, flare=0.1, step=0.014, turn=("z", 1000))
    v, f = cloth(replace(wanted, step=coarser * wanted.step))
    front = [np.array([0.03, y, float(v[np.abs(v[:, 1] - y) < 0.03, 2].max()) + 0.004]) for y in (1.2, 1.1, 1.0, 0.9)]
    v, f = together([(v, f), *(button(at) for at in front)])
    return write_obj(folder / "coat.obj", Outside(placed(v, wanted), f.tolist()))


def _trousers(folder: Path, coarser: float) -> Path:
    wanted = Wanted(low=0.13, high=0.99, legs=True, ease=0.014, step=0.016)
    v, f = cloth(replace(wanted, step=coarser * wanted.step))
    uv, uv_f = unwrapped(v, f)
    # Cut open along the seam of its texture, as exporters do: a vertex for each pair of place and coordinates.
    pairs, local = np.unique(np.stack((f, uv_f), -1).reshape(-1, 2), axis=0, return_inverse=True)
    faces = local.reshape(-1, 3).tolist()
    split = Outside(placed(v[pairs[:, 0]], wanted), faces, uv[pairs[:, 1]], faces)
    return write_obj(folder / "trousers.obj", split)


def _skirt(folder: Path, coarser: float) -> Path:
    v, quads = quads_of_a_skirt(round(40 / coarser), round(120 / coarser))
    return write_obj(folder / "skirt.obj", Outside(placed(v, Wanted(turn=("y", 39.37))), quads))


def _tunic(folder: Path, coarser: float) -> Path:
    wanted = Wanted(low=0.66, sleeve=0.6, step=0.0085, turn=("z", 1))
    v, f = cloth(replace(wanted, step=coarser * wanted.step))
    trimesh.Trimesh(placed(v, wanted), f, process=False).export(folder / "tunic.ply")
    return folder / "tunic.ply"


def _jacket(folder: Path, coarser: float) -> Path:
    wanted = Wanted(low=0.80, sleeve=0.95, arms=0.95, ease=0.022, is_open=True, turn=("y", 100))
    v, f = cloth(replace(wanted, step=coarser * wanted.step))
    trimesh.Trimesh(placed(v, wanted), f, process=False).export(folder / "jacket.stl")  # a soup of triangles
    return folder / "jacket.stl"


def _top(folder: Path, coarser: float) -> Path:
    wanted = Wanted(low=0.88, ease=0.012, step=0.018)
    v, f = cloth(replace(wanted, step=coarser * wanted.step))
    uv, uv_f = unwrapped(v, f)
    pairs, local = np.unique(np.stack((f, uv_f), -1).reshape(-1, 2), axis=0, return_inverse=True)
    visual = trimesh.visual.TextureVisuals(uv=uv[pairs[:, 1]])
    turned = placed(v, wanted)[pairs[:, 0]] * [-1, 1, -1]  # it looks along -z
    trimesh.Trimesh(turned, local.reshape(-1, 3), visual=visual, process=False).export(folder / "top.glb")
    return folder / "top.glb"


def _vest(folder: Path, coarser: float) -> Path:
    """Cloth with a thickness: an outer and an inner side, closed along its hems."""
    wanted = Wanted(low=0.86, ease=0.022, step=0.02, turn=("y", 10))
    v, f = cloth(replace(wanted, step=coarser * wanted.step))
    mesh = trimesh.Trimesh(v, f, process=False)
    inner = v - 0.006 * mesh.vertex_normals
    edges = mesh.edges[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]
    a, b = edges.T
    n = len(v)
    walls = np.concatenate((np.stack((b, a, a + n), 1), np.stack((b, a + n, b + n), 1)))
    faces = np.concatenate((f, f[:, ::-1] + n, walls))
    return write_obj(folder / "vest.obj", Outside(placed(np.concatenate((v, inner)), wanted), faces.tolist()))


def _damaged(folder: Path, coarser: float) -> Path:
    """Faces that are turned over, there twice, or without area, and vertices that nothing uses."""
    wanted = Wanted(low=0.40, high=0.99, legs=True, ease=0.016, step=0.019, turn=("y", 1000))
    v, f = cloth(replace(wanted, step=coarser * wanted.step))
    rng = np.random.default_rng(0)
    turned = rng.random(len(f)) < 0.2
    f = np.where(turned[:, None], f[:, ::-1], f)
    double = f[rng.choice(len(f), 50, replace=False)][:, ::-1]
    flat = np.stack((f[:20, 0], f[:20, 1], f[:20, 1]), 1)
    faces = np.concatenate((f, double, flat)) + 7
    v = np.concatenate((rng.normal(size=(7, 3)), v))
    return write_obj(folder / "shorts.obj", Outside(placed(v, wanted), faces.tolist()))


def _gown(folder: Path, coarser: float) -> Path:
    """No unit, no floor: scaled to a size of 1 and centred, as data sets of shapes are."""
    wanted = Wanted(low=0.16, sleeve=0.2, flare=0.3, step=0.024)
    v, f = cloth(replace(wanted, step=coarser * wanted.step))
    v = (v - (v.min(0) + v.max(0)) / 2) / np.ptp(v, axis=0).max()
    return write_obj(folder / "gown.obj", Outside(v, f.tolist()))


MESHES: dict[str, Callable[[Path, float], Path]] = {
    "dress, cm, long edges": _dress,
    "coat, mm, z up, arms down, open, buttons": _coat,
    "trousers, m, cut open along texture seams": _trousers,
    "skirt of quads, inches": _skirt,
    "tunic, fine, z up": _tunic,
    "jacket, cm, arms down, soup of triangles": _jacket,
    "top, faces backwards, textured": _top,
    "vest with a thickness, dm": _vest,
    "shorts, mm, damaged": _damaged,
    "gown of size one": _gown,
}
"""Ten meshes: each is written into a folder, some times coarser than it should be; the path of its file."""
