"""Loads body models: built-in names, `.npz` files, and official SMPL `.pkl` files."""

from __future__ import annotations

from dataclasses import fields
from functools import cache
from importlib import resources
from os import PathLike
from pathlib import Path

import torch

from refu_core._npz import read_npz
from refu_core._pickle import read_smpl_pickle
from refu_core.body._model import BodyArrays, SmplBody
from refu_core.errors import BodyError, require_type
from refu_core.modes import BUILTIN_BODIES

_KEYS = ("v_template", "f", "weights", "J_regressor", "kintree_table", "shapedirs", "posedirs")
_TELLING = ("faces", "skin_template_v")
"""Read only so that an error can say what the key should be called, or what the file is."""
_MESHES = (".obj", ".ply", ".stl", ".off", ".glb", ".gltf", ".fbx")
_WANTED = "a body model, an .npz or an official .pkl file"


def load_body(
    source: str | PathLike[str], *, device: str | torch.device = "cpu", dtype: torch.dtype = torch.float32
) -> SmplBody:
    """Loads a body model: `male`, `female` or `neutral` (built in), or an SMPL-layout `.npz` or an official `.pkl`.

    A pickle is read as data only: nothing in it is ever executed. `dtype` is torch.float32 or torch.float64.

    Raises:
        BodyError: no such body or file, a file that can't be read, or one that isn't an SMPL-layout model.
        RefuError: no such device.
    """
    if str(source) in BUILTIN_BODIES:
        return SmplBody(_builtin(str(source)), name=str(source), device=device, dtype=dtype)
    require_type(source, (str, PathLike), "a body's name or path", error=BodyError)
    path = Path(source)
    kind = path.suffix.lower()
    if path.is_dir():
        raise BodyError(f"{path} is a folder: wanted a body model in it, as {path / 'SMPL_FEMALE.pkl'}")
    if not kind:
        msg = f"no body {str(source)!r}: wanted one of {', '.join(BUILTIN_BODIES)}, or the path of an .npz or .pkl file"
        raise BodyError(msg)
    if kind not in (".npz", ".pkl"):
        msg = f"{path}: a body model must be an .npz or an official .pkl file, got {path.suffix!r}"
        if kind in _MESHES:
            msg += ": a mesh or a scan has no joints and no shapes; fit SMPL to it and give SMPL's own file"
        raise BodyError(msg)
    read = read_npz if kind == ".npz" else read_smpl_pickle
    data = read(path, keys=_KEYS + _TELLING, error=BodyError, wanted=_WANTED)
    return SmplBody(BodyArrays.from_mapping(data, source=str(path)), name=path.stem, device=device, dtype=dtype)


@cache
def _builtin(name: str) -> BodyArrays:
    """The arrays of a built-in body, read once: a pipeline asks for its garments' body several times."""
    with resources.as_file(resources.files("refu_core") / "assets" / f"body_{name}.npz") as path:
        data = read_npz(path, keys=_KEYS, error=BodyError, wanted=_WANTED)
    arrays = BodyArrays.from_mapping(data, source=f"body {name}")
    for entry in fields(arrays):
        array = getattr(arrays, entry.name)
        if array is not None:
            array.flags.writeable = False
    return arrays
