"""Reads a garment's mesh from the files that modelling programs write, with its UVs."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core._files import parse_json, read_file
from refu_core._numbers import NOT_NUMBERS, as_numbers
from refu_core.errors import GarmentError
from refu_core.garments import UvMap

F64 = NDArray[np.float64]
Ints = NDArray[np.int64]

MESH_SUFFIXES: tuple[str, ...] = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf")
"""Files that are read."""
_PACKED = {"KHR_draco_mesh_compression", "EXT_meshopt_compression"}
"""Extensions of glTF whose meshes aren't read."""
_MAX_FILE_BYTES = 256 << 20
_MAX_FACES = 400_000
"""A larger mesh is refused before anything is computed: no garment that is worn in real time is as fine."""
_MAX_CORNERS = 1000
"""Of one polygon: the lid of a fine tube has hundreds."""
_MAX_SQUARES = 10_000_000
"""Of polygons' numbers of corners, which is what cutting their ears takes: ten lids of 1,000 corners."""
_MAX_PARTS, _MAX_NODES = 600, 6000
"""Of a file; trimesh takes up to 3 ms for each piece. A coat with its buttons has a hundred."""
_MAX_VERTICES = 4_000_000
"""Places and texture coordinates of a glTF's pieces, which often share them and are read with all of them."""
_SIZES = (1e-6, 1e9)
"""Limits of a mesh's extent in its own unit: a garment may have 1e-4 in kilometres, 1e6 in micrometres."""


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """Triangles as a file has them: in any unit and axes, perhaps cut open along the seams of its UVs.

    Raises `GarmentError` for arrays of another kind, for no faces, and for faces with vertices that don't exist.
    """

    vertices: F64
    """Shape (V, 3)."""
    faces: Ints
    """Shape (F, 3)."""
    uv: UvMap | None = None

    def __post_init__(self) -> None:
        try:
            v = np.asarray(as_numbers(self.vertices, also="U"), np.float64).reshape(-1, 3)  # NumPy judges text
            f = as_numbers(self.faces).astype(np.int64, casting="same_kind").reshape(-1, 3)
        except NOT_NUMBERS as error:
            raise GarmentError(str(error)) from error
        vars(self).update(vertices=v, faces=f)
        if not len(f):
            raise GarmentError("it has no faces")
        if f.min() < 0 or f.max() >= len(v):
            raise GarmentError(f"a face names vertex {f.max() + 1} of {len(v)}")
        if not np.isfinite(v[f]).all():
            raise GarmentError("it has vertices that are NaN or infinite")
        largest, extent = float(np.abs(v[f]).max()), float(np.ptp(v[f].reshape(-1, 3), axis=0).max())
        if largest > _SIZES[1] or extent < _SIZES[0]:
            wanted = f"wanted sizes from {_SIZES[0]:g} to {_SIZES[1]:g}"
            raise GarmentError(f"it is {extent:.3g} large and reaches to {largest:.3g}: {wanted}")
        if self.uv is None:
            return
        if np.shape(self.uv.faces) != f.shape:
            raise GarmentError(f"texture coordinates of the corners must be {f.shape}, got {np.shape(self.uv.faces)}")
        if self.uv.faces.min() < 0 or self.uv.faces.max() >= len(self.uv.coordinates):
            raise GarmentError("a face names texture coordinates that there aren't")

    def only(self, kept: NDArray[np.bool_]) -> SurfaceMesh:
        """The mesh of some of its faces, a mask (F,)."""
        uv = None if self.uv is None else replace(self.uv, faces=self.uv.faces[kept])
        return SurfaceMesh(self.vertices, self.faces[kept], uv)

    def compact(self, faces: Ints | None = None) -> SurfaceMesh:
        """The mesh without vertices that no face uses; if given, `faces` (F, 3) take the place of its own."""
        used, local = np.unique(self.faces if faces is None else faces, return_inverse=True)
        return replace(self, vertices=self.vertices[used], faces=local.reshape(-1, 3).astype(np.int64))


def read_surface(path: str | os.PathLike[str]) -> SurfaceMesh:
    """The mesh of a Wavefront OBJ (polygons become triangles), or of what trimesh reads: PLY, STL, OFF, GLB, glTF.

    Raises `GarmentError`: the file can't be read, or holds no mesh.
    """
    source = Path(path)
    suffix = source.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        msg = f"{source}: wanted a mesh ({', '.join(MESH_SUFFIXES)}), got {suffix or 'a name without suffix'}"
        raise GarmentError(msg)
    content = read_file(source, most=_MAX_FILE_BYTES, error=GarmentError, wanted="a garment's mesh")
    try:
        with np.errstate(all="ignore"):  # numbers that aren't finite are refused below
            mesh = _parse_obj(content) if suffix == ".obj" else _by_trimesh(content, suffix)
        _require_few(len(mesh.faces), *_TRIANGLES)
    except ImportError:
        raise
    except Exception as error:  # trimesh may raise anything for a damaged file
        msg = f"{source}: not a mesh that can be read ({error or type(error).__name__}): export it again"
        raise GarmentError(msg) from error
    return mesh


_TRIANGLES = "triangles or more", _MAX_FACES, "decimate it"
_PIECES = "pieces", _MAX_PARTS, "join them to one"


def _require_few(n: int, what: str, most: int, advice: str) -> None:
    if n > most:
        raise ValueError(f"it has {n} {what}, at most {most} are read: {advice}")


def _parse_obj(content: bytes) -> SurfaceMesh:
    vertices: list[list[float]] = []
    coordinates: list[list[float]] = []
    corners: list[list[tuple[int, int]]] = []
    count = 0
    _require_few(content.count(b"\nf "), *_TRIANGLES)  # before its vertices are read
    text = content.decode("utf-8-sig", errors="replace").replace("\\\r\n", " ").replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), 1):
        kind, *words = line.partition("#")[0].split() or [""]
        try:
            if kind == "v":
                x, y, z = words[:3]
                vertices.append([float(x), float(y), float(z)])
            elif kind == "vt":
                coordinates.append([float(x) for x in (*words[:2], "0")[:2]])
            elif kind == "f":
                corners.append([_corner(word, len(vertices), len(coordinates)) for word in words])
                count += max(0, len(words) - 2)
        except (ValueError, IndexError) as error:
            raise ValueError(f"line {number}: {line[:60]!r}") from error
        _require_few(count, *_TRIANGLES)
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    triangles = _triangles(corners, points)
    uv = None
    if coordinates and len(triangles) and (triangles[..., 1] >= 0).all():
        uv = UvMap(np.array(coordinates, dtype=np.float32), triangles[..., 1].copy())
    return SurfaceMesh(points, triangles[..., 0].copy(), uv)


def _corner(word: str, n_vertices: int, n_coordinates: int) -> tuple[int, int]:
    """Vertex and texture coordinates of `v`, `v/vt`, `v/vt/vn` or `v//vn`, from 0; negative ones count backwards."""
    numbers = word.split("/")
    found = []
    for text, count in zip((*numbers, "")[:2], (n_vertices, n_coordinates), strict=True):
        index = int(text) if text else 0
        found.append(index - 1 if index >= 0 else count + index)
        if index and found[-1] < 0:
            raise IndexError(word)
    if found[0] < 0:
        raise IndexError(word)
    return found[0], found[1]


def _triangles(polygons: list[list[tuple[int, int]]], points: F64) -> Ints:
    """Polygons as triangles, in order, (T, 3, 2): quads are cut along the shorter diagonal, others by ears."""
    sizes = np.array([len(polygon) for polygon in polygons], dtype=np.int64)
    if len(sizes) and sizes.max() > _MAX_CORNERS:
        raise ValueError(f"a polygon of {sizes.max()} corners, at most {_MAX_CORNERS} are read: triangulate it")
    if np.square(sizes[sizes > 4]).sum() > _MAX_SQUARES:
        raise ValueError("it has too many polygons of many corners: triangulate it")
    known = np.array([max((corner[0] for corner in polygon), default=0) < len(points) for polygon in polygons], bool)
    # For each triangle, the number of its polygon, and its corners.
    found = [(np.flatnonzero(sizes == 3), np.array([p for p in polygons if len(p) == 3], np.int64).reshape(-1, 3, 2))]
    rows = np.flatnonzero((sizes == 4) & known)
    quads = np.array([polygons[row] for row in rows], dtype=np.int64).reshape(-1, 4, 2)
    is_convex, cuts = _cut_quads(points[quads[..., 0]] if len(quads) else np.empty((0, 4, 3)))
    which = np.arange(len(quads))[:, None]
    found += [(rows[is_convex], quads[which, cuts[:, k]][is_convex]) for k in range(2)]
    for row in (*rows[~is_convex], *np.flatnonzero((sizes > 4) | ((sizes == 4) & ~known))):
        polygon = np.array(polygons[row], dtype=np.int64)
        # A polygon whose vertices don't exist is refused later.
        ears = _ears(points[polygon[:, 0]]) if known[row] else [(0, k, k + 1) for k in range(1, len(polygon) - 1)]
        found += [(np.array([row]), polygon[list(ear)][None]) for ear in ears]
    order = np.argsort(np.concatenate([row for row, _ in found]), kind="stable")
    return np.concatenate([corners for _, corners in found])[order]


def _cut_quads(places: F64) -> tuple[NDArray[np.bool_], Ints]:
    """Which of quads (Q, 4, 3) are convex, and the corners of their halves, (Q, 2, 3), along the shorter diagonal."""
    before, after = np.roll(places, 1, axis=1), np.roll(places, -1, axis=1)
    normal = np.cross(places, after).sum(axis=1)
    turns = (np.cross(places - before, after - places) * normal[:, None]).sum(2)
    diagonal = np.square(after - before).sum(2)
    first = (diagonal[:, 0] <= diagonal[:, 1])[:, None, None]
    cuts: Ints = np.where(first, [[3, 0, 1], [1, 2, 3]], [[0, 1, 2], [0, 2, 3]])
    return (turns > 0).all(axis=1), cuts


def _ears(places: F64) -> Iterator[tuple[int, int, int]]:
    """Triangles of a polygon (N, 3), convex or not: cuts off corners that hold no other one, shortest cut first."""
    normal = np.cross(places, np.roll(places, -1, axis=0)).sum(axis=0)
    left = list(range(len(places)))
    while len(left) > 3:
        corners = np.stack([places[np.roll(left, shift)] for shift in (1, 0, -1)], axis=1)
        before, here, after = corners.swapaxes(0, 1)
        turns = np.cross(here - before, after - here) @ normal
        length = np.square(after - before).sum(axis=1) + np.where(turns > 0, 0.0, np.inf)
        order = [k for k in np.argsort(length, kind="stable").tolist() if np.isfinite(length[k])]
        ears = (k for k in order if not _holds(corners[k], places[left], normal))
        chosen = next(ears, int(length.argmin()))
        yield left[chosen - 1], left[chosen], left[(chosen + 1) % len(left)]
        del left[chosen]
    yield left[0], left[1], left[2]


def _holds(triangle: F64, points: F64, normal: F64) -> bool:
    """Whether a triangle (3, 3), seen along a normal, has any of the points (N, 3) inside."""
    ends = zip(triangle, np.roll(triangle, -1, axis=0), strict=True)
    sides = np.stack([np.cross(q - p, points - p) @ normal for p, q in ends])
    return bool((sides > 1e-9 * np.abs(sides).max(initial=0.0)).all(axis=0).any())


def _by_trimesh(content: bytes, suffix: str) -> SurfaceMesh:
    import trimesh

    if suffix.startswith(".gl"):
        content = _lean(content)
    elif suffix == ".stl":
        _require_few(content.count(b"endsolid"), *_PIECES)
    scene = trimesh.load_scene(io.BytesIO(content), file_type=suffix[1:], process=False)
    parts = [mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    if not parts:
        raise ValueError("it has no faces")
    counts = [len(part.vertices) for part in parts]
    starts = np.cumsum(counts) - counts
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)])
    found = [getattr(part.visual, "uv", None) for part in parts]
    uv = None
    if all(one is not None and len(one) == count for one, count in zip(found, counts, strict=True)):
        uv = UvMap(np.concatenate([np.asarray(one, np.float64)[:, :2] for one in found]).astype(np.float32), faces)
    return SurfaceMesh(np.concatenate([part.vertices for part in parts]), faces, uv)


def _lean(content: bytes) -> bytes:
    """A glTF file with what a garment is made of, and nothing else.

    trimesh would decode pictures, some by other programs, and repeat meshes and fill arrays as often and as far as a
    file says. Raises `ValueError` for too much of that, and other errors for damaged files.
    """
    is_binary = content.startswith(b"glTF")
    end = 20 + int.from_bytes(content[12:16], "little") if is_binary else len(content)
    tree = parse_json(content[20 if is_binary else 0 : end])
    if any(not one.get("uri", "data:").startswith("data:") for one in tree.get("buffers", ())):
        raise ValueError("its numbers are in a file beside it; save it as one file, .glb")
    if not _PACKED.isdisjoint(tree.get("extensionsRequired", ())):
        raise ValueError("it is compressed (Draco or meshopt), which isn't read: export it without compression")
    kept = "attributes", "indices", "mode", "material"
    meshes = [[_of(part, *kept) for part in one["primitives"]] for one in tree.get("meshes", ())]
    parts = [part for mesh in meshes for part in mesh]
    for part in parts:
        part["attributes"] = _of(part["attributes"], "POSITION", "TEXCOORD_0")
    placed = "children", "mesh", "matrix", "rotation", "scale", "translation"
    nodes = [_of(node, *placed) for node in tree.get("nodes", ())]
    _require_few(len(nodes), "nodes", _MAX_NODES, "leave out what isn't cloth")
    accessors = tree.get("accessors", ())
    for some in (parts, [part for node in nodes if "mesh" in node for part in meshes[node["mesh"]]]):
        _require_few(len(some), *_PIECES)
        n_corners = sum(abs(accessors[part["indices"]]["count"]) for part in some if "indices" in part)
        _require_few(n_corners // 3, *_TRIANGLES)
        n_vertices = sum(abs(accessors[i]["count"]) for part in some for i in part["attributes"].values())
        _require_few(n_vertices, "vertices in its pieces", _MAX_VERTICES, "join them to one")
    used = {i for part in parts for i in (part.get("indices"), *part["attributes"].values())}
    nothing = {"componentType": 5126, "count": 0, "type": "SCALAR"}
    lean = _of(tree, "asset", "scene", "scenes", "buffers", "bufferViews") | {
        "nodes": nodes,
        "meshes": [{"primitives": mesh} for mesh in meshes],
        "materials": [{}] * len(tree.get("materials", ())),
        "accessors": [one if i in used else nothing for i, one in enumerate(accessors)],
    }
    text = json.dumps(lean).encode()
    if not is_binary:
        return text
    text += b" " * (-len(text) % 4)
    sizes = (len(text) + 20 + len(content) - end, len(text))
    total, length = (size.to_bytes(4, "little") for size in sizes)
    return content[:8] + total + length + content[16:20] + text + content[end:]


def _of(values: dict[str, Any], *names: str) -> dict[str, Any]:
    return {name: values[name] for name in names if name in values}
