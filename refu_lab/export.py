"""Dressed persons as files for other programs: GLB, OBJ and USD, with the garments' texture coordinates."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, count, islice
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core import GarmentPipeline, PipelineOutput
from refu_core._files import replacing
from refu_core.errors import RefuError, require_pipeline, require_type
from refu_core.garments import UvMap
from refu_core.recordings import turn_from
from refu_lab.commands.replay import RecordingOptions
from refu_lab.render import SKIN
from refu_lab.sources import open_source

FORMATS: tuple[str, ...] = (".glb", ".obj", ".usda", ".usdc", ".usd")
_USD = (".usda", ".usdc", ".usd")
_FAR = 100.0
"""Farther than this from the origin, float32 has steps of 8 µm and more [m]."""


@dataclass(frozen=True, eq=False)
class ExportMesh:
    """A mesh that may move."""

    name: str
    vertices: NDArray[np.float64]
    """In SMPL axes (y up, z forward), which glTF shares [m], shape (T, V, 3)."""
    faces: NDArray[np.int64]
    """Counter-clockwise from outside, shape (F, 3)."""
    color: tuple[float, float, float]
    """sRGB, 0 to 1."""
    uv: UvMap | None = None


def meshes_of(
    pipeline: GarmentPipeline, outputs: PipelineOutput | Sequence[PipelineOutput], *, with_body: bool = True
) -> list[ExportMesh]:
    """The body and the garments in one or T pipeline outputs of one person, with the translation added.

    Raises `RefuError` for anything but outputs of this pipeline, or none.
    """
    require_pipeline(pipeline, "garments", "body", error=RefuError)
    outputs = [outputs] if isinstance(outputs, PipelineOutput) else outputs
    require_type(outputs, Sequence, "a pipeline's outputs")
    for output in outputs:
        require_type(output, PipelineOutput, "a pipeline's output of one person")
        if output.keys() != pipeline.garments.keys():
            raise RefuError(f"wanted outputs with {', '.join(pipeline.garments)}, got one with {', '.join(output)}")
    if not outputs:
        raise RefuError("wanted outputs of a pipeline, got none")
    found = []
    if with_body:
        bodies = np.stack([output.body + output.transl for output in outputs])
        found.append(ExportMesh("body", bodies, pipeline.body.faces.cpu().numpy(), SKIN))
    for name, template in pipeline.garments.items():
        vertices = np.stack([output[name].vertices for output in outputs])
        found.append(ExportMesh(name, vertices, template.faces.cpu().numpy(), template.card.color, template.uv))
    return found


def require_new(path: Path, count: int) -> None:
    """Raises `RefuError` if a file that `write_meshes` would make of `count` frames is there already."""
    there = next((one for one in _files(path, count) if one.exists()), None)
    if there is not None:
        raise RefuError(f"{there} is there already: name another file, or --overwrite it")


def _files(path: Path, count: int) -> list[Path]:
    """The files of `count` frames: one for each, numbered if there are several, and one for all in USD."""
    suffix, digits = path.suffix.lower(), len(str(count - 1))
    is_one = count == 1 or suffix in _USD
    return [path] if is_one else [path.with_name(f"{path.stem}_{k:0{digits}}{suffix}") for k in range(count)]


def write_meshes(meshes: Sequence[ExportMesh], path: str | PathLike[str], *, fps: float = 30.0) -> list[Path]:
    """Writes meshes of T frames: one animated USD stage, or a GLB or OBJ file a frame, numbered if there are several.

    OBJ and USD keep the vertex order and store texture coordinates separately. GLB has one texture coordinate a vertex,
    so vertices on texture seams are there twice. GLB and USD have numbers of seven digits: meshes farther than `_FAR`
    from the origin are stored relative to their first place, and their node moves them there. Returns the files. Raises
    `RefuError`: another suffix, no frame, a missing package, or a file that can't be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise RefuError(f"{path}: wanted a file of {', '.join(FORMATS)}, got {suffix or 'no suffix'}")
    count = len(meshes[0].vertices) if meshes else 0
    if not count:
        raise RefuError(f"{path}: there is no frame to write")
    origin = meshes[0].vertices[0].mean(0).round()
    origin *= np.abs(origin).max() > _FAR
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if suffix in _USD:
            _write_usd(meshes, path, fps, origin)
            return [path]
        paths = _files(path, count)
        for k, one in enumerate(paths):
            with replacing(one) as file:
                file.write(_glb(meshes, k, origin) if suffix == ".glb" else _obj(meshes, k))
    except OSError as error:
        raise RefuError(f"{path}: can't be written: {error.strerror or error}") from error
    return paths


def export(
    options: RecordingOptions, path: Path, *, first: int, count: int, with_body: bool, overwrite: bool = False
) -> tuple[list[Path], list[str]]:
    """What `refu export` does: writes some frames of a bag or motion file, dressed; returns the files and the warnings.

    Frames are numbered as they were recorded; those that can't be read are left out, and a warning says so. Whatever
    the input's axes are, y is up in the files. Raises `RefuError`: as `write_meshes`; a file that is there already,
    unless `overwrite`; options that make no pipeline, an input that can't be read, or no frame.
    """
    if path.suffix.lower() not in FORMATS:  # raises before the work is done
        write_meshes((), path)
    if not overwrite:
        require_new(path, count)
    source = open_source(options)
    frames, outputs, left_out, n_records = [], [], list[str](), 0
    for number, record in enumerate(islice(source.records, first + count)):
        n_records = number + 1
        try:
            frame = source.frame_of(record)  # of earlier ones, too: what follows depends on their past
            if number >= first:
                outputs.append(source.pipeline(frame))
                frames.append(frame)
        except RefuError as error:
            if number >= first:
                left_out.append(f"frame {number} is left out: {error}")
    if n_records < first + count:
        left_out.append(f"it has {n_records} frames, wanted number {first} to {first + count - 1}")
    warnings = [*source.warnings(), *left_out]
    if not outputs:
        why = left_out[-1]
        raise RefuError(f"{options.input}: has no frame that can be dressed from number {first} on: {why}")
    step = 1e-9 * float(np.median(np.diff([frame.stamp_ns for frame in frames]))) if len(frames) > 1 else 0.0
    fps = round(1 / step, 3) if step > 0 else 30.0
    turn = turn_from(frames[0].up.astype(np.float64))
    meshes = meshes_of(source.pipeline, outputs, with_body=with_body)
    if turn[1, 1] != 1:
        meshes = [replace(mesh, vertices=mesh.vertices @ turn.T) for mesh in meshes]
    if not overwrite and len(outputs) < count:  # then the files have other names
        require_new(path, len(outputs))
    return write_meshes(meshes, path, fps=fps), warnings


def _glb(meshes: Sequence[ExportMesh], frame: int, origin: NDArray[np.float64]) -> bytes:
    import trimesh

    scene = trimesh.Scene()
    for mesh in meshes:
        vertices, faces, coordinates = mesh.vertices[frame] - origin, mesh.faces, None
        if mesh.uv is not None:
            # A vertex for each pair of position and texture coordinate.
            pairs = np.stack((mesh.faces, mesh.uv.faces), -1).reshape(-1, 2)
            unique, local = np.unique(pairs, axis=0, return_inverse=True)
            vertices, coordinates = vertices[unique[:, 0]], mesh.uv.coordinates[unique[:, 1]]
            faces = local.reshape(-1, 3)
        material = trimesh.visual.material.PBRMaterial(
            name=mesh.name,
            baseColorFactor=(*mesh.color, 1.0),
            roughnessFactor=0.9,
            metallicFactor=0.0,
            doubleSided=True,
        )
        visual = trimesh.visual.TextureVisuals(uv=coordinates, material=material)
        scene.add_geometry(
            trimesh.Trimesh(vertices, faces, visual=visual, process=False),
            geom_name=mesh.name,
            node_name=mesh.name,
            transform=trimesh.transformations.translation_matrix(origin),
        )
    data: bytes = scene.export(file_type="glb")
    return data


def _obj(meshes: Sequence[ExportMesh], frame: int) -> bytes:
    lines = ["# metres, y up, z forward"]
    n_vertices = n_coordinates = 1
    for mesh in meshes:
        lines.append(f"o {mesh.name}")
        lines += ["v {:.6f} {:.6f} {:.6f}".format(*point) for point in mesh.vertices[frame].tolist()]
        corners = (mesh.faces + n_vertices).tolist()
        if mesh.uv is None:
            lines += ["f {} {} {}".format(*face) for face in corners]
        else:
            lines += ["vt {:.6f} {:.6f}".format(*point) for point in mesh.uv.coordinates.tolist()]
            textured = (mesh.uv.faces + n_coordinates).tolist()
            lines += [
                "f " + " ".join(f"{v}/{t}" for v, t in zip(face, texture, strict=True))
                for face, texture in zip(corners, textured, strict=True)
            ]
            n_coordinates += len(mesh.uv.coordinates)
        n_vertices += mesh.vertices.shape[1]
    return ("\n".join(lines) + "\n").encode()


def usd_names(names: Sequence[str]) -> list[str]:
    """Names as USD requires them, of ASCII letters, digits and underscores; those that become alike are numbered."""
    plain = ("".join(c if c.isascii() and c.isalnum() else "_" for c in given) for given in names)
    return numbered(("_" * (not one or one[0].isdigit()) + one for one in plain), mark="_")


def numbered(names: Iterable[str], *, mark: str) -> list[str]:
    """The names, each once: those that occur again end in `mark` and a number."""
    found: list[str] = []
    for name in names:
        others = (f"{name}{mark}{k}" for k in count(2))
        found.append(next(one for one in chain([name], others) if one not in found))
    return found


def _write_usd(meshes: Sequence[ExportMesh], path: Path, fps: float, origin: NDArray[np.float64]) -> None:
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, Vt
    except ImportError as error:
        raise RefuError(f'{path}: to write USD, install its library: pip install "refu-ros[usd]" (usd-core)') from error
    stage: Any = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/person")
    stage.SetDefaultPrim(root.GetPrim())
    root.AddTranslateOp().Set(Gf.Vec3d(*origin.tolist()))
    frames = len(meshes[0].vertices)
    if frames > 1:
        stage.SetTimeCodesPerSecond(fps)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(frames - 1)
    for mesh, name in zip(meshes, usd_names([mesh.name for mesh in meshes]), strict=True):
        prim = UsdGeom.Mesh.Define(stage, f"/person/{name}")
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        prim.CreateDoubleSidedAttr(True)
        prim.CreateFaceVertexCountsAttr(Vt.IntArray([3] * len(mesh.faces)))
        prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.faces.ravel().astype(np.int32)))
        linear = tuple(channel**2.2 for channel in mesh.color)  # display colours are linear
        prim.CreateDisplayColorAttr(Vt.Vec3fArray([Gf.Vec3f(*linear)]))
        points, extent = prim.CreatePointsAttr(), prim.CreateExtentAttr()
        for k, vertices in enumerate((mesh.vertices - origin).astype(np.float32)):
            time = Usd.TimeCode(k) if frames > 1 else Usd.TimeCode.Default()
            points.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(vertices)), time)
            bounds = np.stack((vertices.min(0), vertices.max(0)))
            extent.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(bounds)), time)
        if mesh.uv is not None:
            texture = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(
                "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
            )
            texture.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(mesh.uv.coordinates)))
            texture.SetIndices(Vt.IntArray.FromNumpy(mesh.uv.faces.ravel().astype(np.int32)))
    if not stage.GetRootLayer().Export(str(path)):
        raise RefuError(f"{path}: can't be written")
