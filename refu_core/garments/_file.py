"""A garment's file: its mesh and all that is known of it, one `.npz`."""

from __future__ import annotations

import os
import re
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from refu_core._npz import read_npz
from refu_core.body import BUILTIN_BODIES
from refu_core.errors import GarmentError, MeshError
from refu_core.frames import N_BETAS, N_JOINTS, N_STYLES
from refu_core.garments._card import GarmentCard, json_to_card
from refu_core.garments._template import GarmentTemplate
from refu_core.mesh import check_faces
from refu_core.modes import BUILTIN_GARMENTS

if TYPE_CHECKING:
    from numpy.typing import NDArray

_ARRAYS = ("v_template", "f", "weights", "shapedirs")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


def load_garment(
    garment: str | os.PathLike[str], *, device: str | torch.device = "cpu", dtype: torch.dtype = torch.float32
) -> GarmentTemplate:
    """Loads a garment.

    Args:
        garment: `shirt-male`, `tshirt-male`, `short-pant-male` or `skirt-female`, or the path of an `.npz` as
            `refu_core/assets/README.md` describes it. `garment_kilt.npz` and `kilt.npz` are the garment `kilt`.
        device: torch device.
        dtype: of all but the faces.

    Raises:
        GarmentError: there is no such garment, or the file isn't one.
    """
    if garment in BUILTIN_GARMENTS:
        with resources.as_file(resources.files("refu_core") / "assets" / f"garment_{garment}.npz") as shipped:
            return _read(shipped, device, dtype)
    try:
        path = Path(garment)
    except TypeError as error:
        msg = f"a garment is a name or the path of an .npz, got {type(garment).__name__}"
        raise GarmentError(msg) from error
    if isinstance(garment, str) and not garment.endswith(".npz"):
        msg = f"no garment {garment!r}: wanted one of {', '.join(BUILTIN_GARMENTS)}, or the path of an .npz"
        raise GarmentError(msg)
    return _read(path, device, dtype)


def _read(path: Path, device: str | torch.device, dtype: torch.dtype) -> GarmentTemplate:
    name = path.stem.removeprefix("garment_")
    if not _NAME.fullmatch(name):
        msg = f"{path}: a garment has its file's name: wanted one of letters, digits, - and _"
        raise GarmentError(msg)
    data = read_npz(
        path, keys=(*_ARRAYS, "styledirs", "body", "card"), error=GarmentError, wanted="a garment, as an .npz"
    )
    try:
        card = _check(data)
    except (ValueError, RecursionError, MeshError) as error:
        msg = f"{path}: not a garment: {error}"
        raise GarmentError(msg) from error

    def tensor(key: str) -> torch.Tensor:
        return torch.tensor(data[key], device=device, dtype=dtype)

    n_numbers = data["v_template"].size
    return GarmentTemplate(
        name=name,
        body=str(data["body"]),
        card=card,
        faces=torch.tensor(data["f"].astype(np.int64), device=device),
        weights=tensor("weights"),
        v_template=tensor("v_template"),
        shapedirs=tensor("shapedirs").view(n_numbers, -1),
        styledirs=tensor("styledirs").view(n_numbers, -1) if "styledirs" in data else None,
    )


def _check(data: dict[str, NDArray[Any]]) -> GarmentCard:
    """The card of a garment's file. Raises `ValueError` or `MeshError` where file and card make no garment."""
    missing = [key for key in (*_ARRAYS, "body", "card") if key not in data]
    if missing:
        msg = f"it has no {missing[0]}"
        raise ValueError(msg)
    text = data["card"].item()
    if not isinstance(text, (bytes, str)):
        msg = f"card: wanted a text, got {data['card'].dtype}"
        raise ValueError(msg)
    card = json_to_card(text)
    if str(data["body"]) not in BUILTIN_BODIES:
        msg = f"it is cut for the body {str(data['body'])[:80]!r}: wanted {', '.join(BUILTIN_BODIES)}"
        raise ValueError(msg)
    n = len(data["v_template"]) if data["v_template"].ndim else 0
    shapes = {
        "v_template": (n, 3),
        "weights": (n, N_JOINTS),
        "shapedirs": (n, 3, N_BETAS),
        "styledirs": (n, 3, N_STYLES),
    }
    for key, shape in shapes.items():
        if key in data and (data[key].shape != shape or not n or not np.isfinite(data[key]).all()):
            msg = f"{key}: wanted finite numbers of the shape {shape}, got {data[key].shape}"
            raise ValueError(msg)
    if not (data["weights"] >= 0).all() or np.abs(data["weights"].sum(1) - 1).max() > 1e-3:
        msg = "weights: wanted shares of joints, rows that sum to 1"
        raise ValueError(msg)
    check_faces(data["f"], n_vertices=n)
    return card
