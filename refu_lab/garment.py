"""What `refu garment` does: makes garments from meshes, tries them on, and lists the known ones."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from refu_core import GarmentError, GarmentPipeline, PipelineOutput, SmplFrame, fitting, load_body, load_garment
from refu_core.frames import N_JOINTS
from refu_core.garments import garment_files, garments_folder, require_name, save_garment
from refu_core.metrics import CollisionChecker
from refu_core.modes import BUILTIN_GARMENTS
from refu_core.recordings import SUFFIXES, read_recording
from refu_core.weights import weights_folder
from refu_lab.commands.garment import AddOptions
from refu_lab.render import RenderMesh, Viewpoint, render, save_png
from refu_lab.tables import format_table

_MOST_CUT = 20
"""Triangles of a garment that may cut the body in one pose without a warning: a few at an armhole's rim do."""
_MOST_STRETCHED = 3.5
"""There is a warning if over a thousandth of the edges are longer than this many times their length at rest."""


def _name_of(mesh: Path) -> str:
    """A garment's name made from the file's: `T-Shirt (1).obj` gives `T-Shirt-1`."""
    plain = unicodedata.normalize("NFKD", mesh.stem).encode("ascii", "ignore").decode()
    return re.sub(r"[^A-Za-z0-9_]+", "-", plain).strip("-_") or mesh.stem


def try_on_poses() -> dict[str, NDArray[np.float32]]:
    """A few ordinary poses, by name: rotation vectors [rad], shape (24, 3)."""
    stand, walk, reach = (fitting.standing_pose(arms) for arms in (1.0, 1.1, -0.9))
    walk[1, 0], walk[2, 0], walk[4, 0], walk[5, 0] = -0.45, 0.35, 0.25, 0.55
    walk[16, 1], walk[17, 1] = 0.3, 0.3
    reach[3, 0] = -0.1
    return {name: pose.astype(np.float32) for name, pose in (("stand", stand), ("walk", walk), ("reach", reach))}


def add_garment(options: AddOptions) -> dict[str, Any]:
    """Makes a garment's file from a mesh and tries the garment on; returns what was done, as plain values.

    Raises `RefuError` for a mesh that can't be worn, a name that isn't valid or isn't the file's, and a file that
    exists already.
    """
    target = options.output or garments_folder() / f"{options.name or _name_of(options.mesh)}.npz"
    name = target.stem.removeprefix("garment_")
    if name in BUILTIN_GARMENTS:
        raise GarmentError(f"{name} is a garment that ships: call this one otherwise (--name)")
    if name in ("body", "skin"):  # exported files and the viewer would take it for the wearer
        raise GarmentError(f"{name} is what the wearer's is called: call the garment otherwise (--name)")
    require_name(name if options.name is None else options.name)
    if options.name not in (None, name):
        raise GarmentError(f"{target}: a garment is called as its file: leave --name out, or write {options.name}.npz")
    if target.exists() and not options.overwrite:
        raise GarmentError(f"{target} is there already: give it another --name, or --overwrite it")
    details = fitting.GarmentDetails(
        options.layer,
        options.color or fitting.GarmentDetails().color,
        options.held_at,
        f"{options.source} ({options.mesh.name}), by refu garment add",
    )
    body, surface, placing = load_body(options.body), fitting.read_surface(options.mesh), _placing(options)
    try:
        made = fitting.fit_garment(
            surface, body, name=name, placing=placing, details=details, longest_edge=options.longest_edge
        )
    except GarmentError as error:
        raise GarmentError(f"{options.mesh}: {error}") from error
    worn = try_on(made)
    save_garment(made.template, target)
    template = made.template
    if options.picture is not None:
        save_png(picture([str(target)]), options.picture)
    return {
        "garment": name,
        "file": str(target),
        "body": template.body,
        "layer": template.card.layer,
        "held_at": "waist" if template.card.held_at_waist else "shoulders",
        "vertices": template.n_vertices,
        "faces": len(template.faces),
        "uv": template.uv is not None,
        "joints": list(template.card.joints),
        "notes": made.notes,
        "worn": worn,
        "warnings": [*made.warnings, *warnings_of(worn)],
    }


def _number(text: str) -> float:
    """The number that a text gives; NaN if it isn't one."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def _placing(options: AddOptions) -> fitting.Placing:
    unit = None
    if options.unit is not None:
        unit = fitting.UNITS.get(options.unit) or _number(options.unit)
        if not 1e-6 < unit < 1e6:
            raise GarmentError(f"no unit {options.unit!r}: wanted {', '.join(fitting.UNITS)}, or how many metres it is")
    return fitting.Placing(unit, options.up, _pose(options.pose), options.as_placed)


def _pose(text: str | None) -> NDArray[np.float64] | None:
    """The pose that a text stands for: `t`, how far both arms hang down [degrees], or a motion file's first pose."""
    if text is None:
        return None
    if Path(text).suffix.lower() in SUFFIXES:
        pose = np.array(read_recording(text, error=GarmentError, fps=30.0).poses[0], np.float64).reshape(N_JOINTS, 3)
        if not np.isfinite(pose).all():
            raise GarmentError(f"{text}: its first frame isn't finite, and wanted is the pose of the mesh: cut it out")
        pose[0] = 0  # the mesh stands upright; --up gives its axes
        return pose
    angle = 0.0 if text == "t" else _number(text)
    if not -90 <= angle <= 90:
        msg = f"no pose {text!r}: wanted t, the angle in degrees that the arms hang down (45), or a motion .npz"
        raise GarmentError(msg)
    return fitting.standing_pose(np.radians(angle))


def dressed(pipeline: GarmentPipeline, output: PipelineOutput) -> list[RenderMesh]:
    """The body and what it wears, without the translation."""
    worn = [RenderMesh(mesh.local, mesh.faces, pipeline.garments[name].card.color) for name, mesh in output.items()]
    return [RenderMesh(output.body, pipeline.body.faces.numpy()), *worn]


def try_on(made: fitting.FittedGarment) -> dict[str, dict[str, Any]]:
    """For each of a few poses, worn by skinning: the collisions left with the body, and how far it is stretched."""
    pipeline = GarmentPipeline.load([made.template], backbone="skinned")
    checker = CollisionChecker(pipeline.body.faces.numpy())
    found = {}
    for pose_name, pose in try_on_poses().items():
        output = pipeline(SmplFrame(pose=pose))
        checker.update(output.body)
        mesh = output[made.template.name]
        left = checker.check(mesh.local, mesh.faces)
        rest = made.template.v_template.double().numpy()
        long = fitting.stretch(made.template.faces.numpy(), rest, mesh.local.astype(np.float64))
        stretched = float(np.quantile(long, 0.999))
        found[pose_name] = {"inside": left.n_inside, "pairs": left.n_pairs, "stretch": stretched}
    return found


def warnings_of(worn: dict[str, dict[str, Any]]) -> list[str]:
    found = []
    if (most := max(left["pairs"] for left in worn.values())) > _MOST_CUT:
        found.append(f"{most} of its triangles cut the body: look at it (--picture) before you use it")
    if (most := max(left["stretch"] for left in worn.values())) > _MOST_STRETCHED:
        found.append(f"it is torn to {most:.1f} times its length in places: look at it (--picture) before you use it")
    return found


def picture(garments: Sequence[str], *, size: tuple[int, int] = (260, 400), samples: int = 4) -> NDArray[np.uint8]:
    """Garments worn together, a view of `size` (width, height) for each pose: sRGB, shape (height, poses width, 3)."""
    pipeline = GarmentPipeline.load(garments)
    views = []
    for yaw, pose in zip((25.0, 40.0, -160.0), try_on_poses().values(), strict=True):
        output = pipeline(SmplFrame(pose=pose))
        camera = Viewpoint.framing(output.body, size=size, yaw=yaw)
        views.append(render(dressed(pipeline, output), camera=camera, size=size, samples=samples))
    return np.concatenate(views, axis=1)


def list_garments() -> list[dict[str, Any]]:
    """A row for each named garment; one whose file is damaged says why in `fault`."""
    rows: list[dict[str, Any]] = []
    for name, path in garment_files().items():
        row: dict[str, Any] = {"garment": name, "from": "refu" if name in BUILTIN_GARMENTS else str(path)}
        try:
            template = load_garment(name)
        except GarmentError as error:
            rows.append({**row, "fault": str(error)})
            continue
        row |= {"body": template.body, "layer": template.card.layer, "vertices": template.n_vertices}
        row |= {"styles": template.styledirs is not None, "uv": template.uv is not None}
        row["networks"] = sorted(file.stem for file in weights_folder(name).glob("*-hybrid.json"))
        rows.append(row)
    return rows


def garments_table(rows: list[dict[str, Any]]) -> str:
    cells = []
    for row in rows:
        if "fault" in row:
            cells.append((row["garment"], *["-"] * 6, row["fault"]))
            continue
        networks = ", ".join(row["networks"]) or "none: worn by skinning"
        flags = ("yes" if row[key] else "no" for key in ("styles", "uv"))
        numbers = (str(row[key]) for key in ("layer", "vertices"))
        cells.append((row["garment"], row["body"], *numbers, *flags, networks, row["from"]))
    return format_table(("garment", "body", "layer", "vertices", "styles", "UVs", "networks", "from"), cells)


def added_text(result: dict[str, Any]) -> str:
    lines = [f"{result['garment']}: {result['vertices']} vertices, for the body {result['body']}"]
    lines += [f"  - {note}" for note in result["notes"]]
    for pose, left in result["worn"].items():
        lines.append(f"  worn in the pose {pose}: {left['inside']} vertices inside, {left['pairs']} triangles cut it")
    lines.append(f"wrote {result['file']}")
    lines += [f"warning: {text}" for text in result["warnings"]]
    return "\n".join(lines)
