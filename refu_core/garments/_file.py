"""A garment's file, one `.npz` with its mesh and all that is known of it; and where such files live."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from refu_core._files import write_file
from refu_core._npz import MAX_TEXT_BYTES, read_npz
from refu_core.body import BUILTIN_BODIES
from refu_core.errors import GarmentError, MeshError, require_type
from refu_core.frames import N_BETAS, N_JOINTS, N_STYLES
from refu_core.garments._template import GarmentCard, GarmentTemplate, UvMap, card_to_json, json_to_card
from refu_core.mesh import check_faces
from refu_core.modes import BUILTIN_GARMENTS, GARMENT_FILE

_BUILTIN = Path(__file__).parents[1] / "assets"


def garments_folder() -> Path:
    """The user's garments: $REFU_GARMENTS, or refu/garments in $XDG_DATA_HOME (~/.local/share); it may not exist.

    Raises `GarmentError` for a user without a home, who has set neither.
    """
    own, shared = os.environ.get("REFU_GARMENTS"), os.environ.get("XDG_DATA_HOME") or "~/.local/share"
    try:
        return (Path(own) if own else Path(shared, "refu", "garments")).expanduser()
    except RuntimeError as error:
        msg = f"{own or shared}: there is no such home; set REFU_GARMENTS to a folder for your own garments"
        raise GarmentError(msg) from error


def garment_files() -> dict[str, Path]:
    """The file of each garment by name: those that ship, then the user's. For the same name, the one that ships."""
    found = {name: _BUILTIN / GARMENT_FILE.format(name) for name in BUILTIN_GARMENTS}
    try:
        own = sorted(garments_folder().glob("*.npz"))
    except (OSError, GarmentError):  # no home or no permission: no garments of the user's
        own = []
    for path in own:
        found.setdefault(_name_in(path), path)
    return found


_NEEDED = ("v_template", "f", "weights", "shapedirs", "body", "card")
_OPTIONAL = ("styledirs", "uv", "uv_f")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


def load_garment(
    garment: str | os.PathLike[str], *, device: str | torch.device = "cpu", dtype: torch.dtype = torch.float32
) -> GarmentTemplate:
    """Loads a garment that ships or is in the user's folder (`garment_files`), by its name, or from an `.npz`.

    `refu_core/assets/README.md` describes such files. `garment_kilt.npz` and `kilt.npz` are the garment `kilt`. `dtype`
    is that of all tensors but the faces. Raises `GarmentError` if there is no such garment, or the file isn't one.
    """
    require_type(garment, (str, os.PathLike), "a garment's name or the path of an .npz", error=GarmentError)
    path = Path(garment)
    if isinstance(garment, str) and not garment.endswith(".npz"):
        known = garment_files()
        if garment not in known:
            raise GarmentError(_unknown(garment, list(known)))
        path = known[garment]
    return _read(path, device, dtype)


def _unknown(garment: str, known: list[str]) -> str:
    if Path(garment).suffix.lower() in (".obj", ".ply", ".stl", ".off", ".glb", ".gltf", ".fbx", ".dae"):
        return f"{garment} is a mesh, wanted a garment: make one of it first, by refu garment add {garment}"
    like = [name for name in known if name.startswith(f"{garment.lower()}-") or name == garment.lower()]
    like = like or get_close_matches(garment, known)
    wanted = " or ".join(like) if like else f"one of {', '.join(known)}, or the path of an .npz"
    return f"no garment {garment!r}: wanted {wanted}"


def garment_name(garment: str | os.PathLike[str]) -> str:
    """The name of a garment that is given by its name or by its file's path; the file needn't exist."""
    text = os.fspath(garment)
    return _name_in(Path(text)) if text.endswith(".npz") else text


def require_name(name: str) -> None:
    """Raises `GarmentError` for a name that no garment may have: topics and files are named after it."""
    if not _NAME.fullmatch(name):
        raise GarmentError(f"no garment is called {name!r}: wanted letters, digits, - and _ (--name)")


def _read(path: Path, device: str | torch.device, dtype: torch.dtype) -> GarmentTemplate:
    name = _name_in(path)
    try:
        require_name(name)
    except GarmentError as error:
        raise GarmentError(f"{path}: a garment has its file's name; {error}") from error
    data = read_npz(path, keys=(*_NEEDED, *_OPTIONAL), error=GarmentError, wanted="a garment, as an .npz")
    try:
        card = _check(data)
    except (ValueError, RecursionError, MeshError) as error:
        raise GarmentError(f"{path}: not a garment: {error}") from error

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
        uv=UvMap(data["uv"].astype(np.float32), data["uv_f"].astype(np.int64)) if "uv" in data else None,
    )


def save_garment(template: GarmentTemplate, path: str | os.PathLike[str]) -> Path:
    """Writes a garment's file, which `load_garment` reads; it is never left half written.

    Lengths are kept to a micrometre, which halves the file.

    Returns the file's path. Raises `GarmentError` for anything that isn't a template, a card that is too long, and a
    path that doesn't end in `.npz`, gives no valid name or can't be written.
    """
    require_type(template, GarmentTemplate, "a GarmentTemplate, such as load_garment gives", error=GarmentError)
    target = Path(path)
    if target.suffix != ".npz":
        raise GarmentError(f"{target}: wanted the path of an .npz")
    require_name(_name_in(target))  # it becomes the garment's name when the file is read
    card = card_to_json(template.card).encode()
    if len(card) > MAX_TEXT_BYTES:
        raise GarmentError(f"{target}: the card has {len(card)} bytes, at most {MAX_TEXT_BYTES}: cut its provenance")
    n = template.n_vertices
    arrays: dict[str, Any] = {
        "v_template": template.v_template.cpu().double().numpy(),
        "f": template.faces.cpu().numpy().astype(np.uint32),
        "weights": template.weights.cpu().double().numpy(),
        "shapedirs": template.shapedirs.cpu().double().numpy().reshape(n, 3, N_BETAS),
        "body": np.array(template.body),
        "card": np.array(card),
    }
    if template.styledirs is not None:
        arrays["styledirs"] = template.styledirs.cpu().double().numpy().reshape(n, 3, N_STYLES)
    if template.uv is not None:
        arrays |= {"uv": template.uv.coordinates, "uv_f": template.uv.faces.astype(np.uint32)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **shortened(arrays))
    write_file(target, buffer.getbuffer(), error=GarmentError)
    return target


def _name_in(path: Path) -> str:
    """The name of the garment in a file."""
    return path.stem.removeprefix("garment_")


def shortened(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """A garment file's arrays, rounded to multiples of powers of two: zeros at the end compress to nothing.

    Lengths are kept to a micrometre and shares to a hundred-thousandth.
    """
    short = dict(arrays)
    for name in _LENGTHS & short.keys():
        short[name] = _rounded(short[name], 20).astype(np.float32)
    weights = _rounded(short["weights"], 16)
    short["weights"] = (weights / weights.sum(1, keepdims=True)).astype(np.float32)
    return short


_LENGTHS = {"v_template", "shapedirs", "styledirs"}


def _rounded(values: NDArray[Any], bits: int) -> NDArray[np.float64]:
    """Multiples of 2^-bits."""
    scale = float(1 << bits)
    return np.rint(values.astype(np.float64) * scale) / scale


def _check(data: dict[str, NDArray[Any]]) -> GarmentCard:
    """The card of a garment's file. Raises `ValueError` or `MeshError` if file and card don't make a garment."""
    missing = [key for key in _NEEDED if key not in data]
    if missing:
        raise ValueError(f"it has no {missing[0]}")
    text = data["card"].item()
    if not isinstance(text, (bytes, str)):
        raise ValueError(f"card: wanted a text, got {data['card'].dtype}")
    card = json_to_card(text)
    if str(data["body"]) not in BUILTIN_BODIES:
        raise ValueError(f"it is cut for the body {str(data['body'])[:80]!r}: wanted {', '.join(BUILTIN_BODIES)}")
    n = len(data["v_template"]) if data["v_template"].ndim else 0
    shapes = {"weights": (n, N_JOINTS), "shapedirs": (n, 3, N_BETAS), "styledirs": (n, 3, N_STYLES)}
    for key, shape in {"v_template": (n, 3), **shapes}.items():
        array = data.get(key)
        if array is None:
            continue
        if array.shape != shape or not n or array.dtype.kind not in "biuf" or not np.isfinite(array).all():
            raise ValueError(f"{key}: wanted finite numbers of the shape {shape}, got {array.dtype} {array.shape}")
    if not (data["weights"] >= 0).all() or np.abs(data["weights"].sum(1) - 1).max() > 1e-3:
        raise ValueError("weights: wanted shares of joints, rows that sum to 1")
    faces = check_faces(data["f"], n_vertices=n)
    _check_uv(data, len(faces))
    return card


def _check_uv(data: dict[str, NDArray[Any]], n_faces: int) -> None:
    if ("uv" in data) != ("uv_f" in data):
        raise ValueError("it has one of uv and uv_f, wanted both or none")
    if "uv" not in data:
        return
    uv, corners = data["uv"], data["uv_f"]
    is_right = uv.ndim == 2 and uv.shape[1] == 2 and uv.dtype.kind == "f" and np.isfinite(uv).all()
    if not is_right or corners.shape != (n_faces, 3) or corners.dtype.kind not in "iu":
        raise ValueError(f"uv, uv_f: wanted finite (T, 2), integers {(n_faces, 3)}, got {uv.shape} and {corners.shape}")
    if corners.min() < 0 or corners.max() >= len(uv):
        raise ValueError(f"uv_f: wanted indices of {len(uv)} coordinates, got {corners.min()} to {corners.max()}")
