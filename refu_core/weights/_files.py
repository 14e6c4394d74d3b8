"""Reads and writes weights; files are checked before their content is used.

A tensor may be stored as whole numbers of steps, -127 to 127, a byte each. Weights may be stored as differences from
others in the same folder, their base: differences a tenth as large as the weights are as exact in bytes as the weights
are in half precision. A tensor that isn't stored at all is the base's.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from refu_core._files import InputFile, open_file, parse_json, write_file
from refu_core._npz import DAMAGE
from refu_core._versions import versions
from refu_core.errors import WeightsError, require_type

FORMAT = "refu-weights-1"
MAX_BYTES = 3 << 30
"""A larger file is refused before it is read; networks of the paper's sizes take 2.5 GB."""
MAX_CARD_BYTES = 1 << 20
LARGEST = 1e4
"""Larger weights are refused: those that ship are below 30, and what overflowed in training is far above."""
_DTYPES = {
    *(torch.float64, torch.float32, torch.float16, torch.bfloat16),
    *(torch.int64, torch.int32, torch.int8, torch.bool),
}
_PIECE = 1 << 22
_STEPS = 127
_STEP = ".step"
"""Follows the name of a tensor in bytes in the name of another one: the size of a step, or of those of its rows."""


@dataclass(frozen=True, eq=False)
class Weights:
    """The tensors of a network and what is known of them."""

    tensors: Mapping[str, Tensor]
    card: Mapping[str, Any]
    """Garment, body fingerprint, data set, training settings, measured figures, versions."""
    path: Path
    """File of the tensors."""
    files: tuple[Path, ...]
    """All files of tensors that were read: that of the base, if there is one, and then its own."""


def in_steps(values: Tensor, dim: int | None = None) -> tuple[Tensor, Tensor]:
    """The steps, int8, of float32 `values`, and a step's size: a number, or with `dim` one for each row along that.

    Sizes are rounded to bfloat16. 127 steps then have few enough digits for float32, so the largest of the values that
    are read tells what the step was: stored again, they are the same to the bit.
    """
    largest = values.abs().amax() if dim is None else values.abs().amax(dim, keepdim=True)
    step = (largest / _STEPS).bfloat16().float()
    steps = (values / step.clamp_min(torch.finfo(step.dtype).tiny)).round().clamp(-_STEPS, _STEPS)
    return steps.to(torch.int8), step


def weights_folder(garment: str, root: str | os.PathLike[str] | None = None) -> Path:
    """The folder of a garment's weights below `root`, or of those that ship; it needn't exist.

    Raises `WeightsError` for a `root` that is no path.
    """
    require_type(root, (str, os.PathLike, NoneType), "a folder of weights", error=WeightsError)
    return (Path(__file__).parent if root is None else Path(root)) / garment


def save_weights(
    stem: str | Path,
    tensors: Mapping[str, Tensor],
    card: Mapping[str, Any],
    *,
    in_bytes: Collection[str] = (),
    base: str | None = None,
) -> Path:
    """Writes `stem`.safetensors, which is returned, and its card `stem`.json; neither is ever left half written.

    Tensors named in `in_bytes` are stored as whole numbers of steps, with a step for each row along dimension 1. `base`
    is the name of weights in the same folder, stored whole, that these are stored as differences from; differences are
    in bytes anyway. Tensors that only the base has are read as the base's. Raises `WeightsError` where a tensor isn't
    finite, the base can't be read, or the disk can't be written.
    """
    stem = Path(stem)
    _require_sense(stem, tensors)
    differs: dict[str, Any] = {}
    if base is not None:
        loaded = load_weights(stem.with_name(base))
        if "base" in loaded.card:
            raise WeightsError(f"{stem}: wanted a base that is stored whole, got {base}; nothing was written")
        differs = {"base": base, "base_sha256": loaded.card["sha256"]}
        tensors = _differences(tensors, loaded.tensors)
    elif in_bytes:
        stored = {name: tensor for name, tensor in tensors.items() if name not in in_bytes}
        for name in in_bytes:
            stored[name], stored[name + _STEP] = in_steps(tensors[name].detach().cpu().float(), 1)
        tensors = stored
    data = save({name: t.detach().cpu().contiguous() for name, t in tensors.items()})
    digest = hashlib.sha256(data).hexdigest()
    full = {"format": FORMAT, **card, **differs, "sha256": digest, "versions": versions("torch")}
    path = Path(f"{stem}.safetensors")
    write_file(path, data, error=WeightsError)
    write_file(Path(f"{stem}.json"), (json.dumps(full, indent=1) + "\n").encode(), error=WeightsError)
    return path


def load_weights(stem: str | Path, *, expect: Mapping[str, Any] | None = None) -> Weights:
    """Reads `stem`.safetensors and its card, onto the CPU.

    `expect` is what the card must say, `{"garment": ..., "body_fingerprint": ...}` for instance. Raises `WeightsError`
    where a file is missing, damaged, of another format, or made for something else.
    """
    stored = _load_stored(Path(stem), expect=expect)
    if "base" not in stored.card:
        return stored
    name = stored.card["base"]
    if not isinstance(name, str) or not name or name != Path(name).name:
        raise WeightsError(f"{stored.path}: wanted a base in the same folder, got {str(name)[:80]!r}")
    base = _load_stored(Path(stem).with_name(name))
    if "base" in base.card or base.card["sha256"] != stored.card.get("base_sha256"):
        raise WeightsError(f"{stored.path}: made for another {name} than the one beside it; get both files again")
    return replace(_whole(stored, base.tensors), files=(*base.files, *stored.files))


def _load_stored(stem: Path, *, expect: Mapping[str, Any] | None = None) -> Weights:
    path = Path(f"{stem}.safetensors")
    card = load_card(stem)
    for key, wanted in (expect or {}).items():
        if card.get(key) != wanted:
            msg = f"{path}: wanted weights whose {key} is {wanted}, got {card.get(key)}; train some with `refu train`, "
            msg += "into a folder of their own (--output)"
            raise WeightsError(msg)
    stored = Weights(_read_tensors(path, card.get("sha256")), card, path, (path,))
    return stored if "base" in card else _whole(stored, {})


def _require_sense(path: Path, tensors: Mapping[str, Tensor]) -> None:
    # One pass and no copy; NaN is the least and the largest of whatever has one.
    ends = {k: t.detach().aminmax() for k, t in tensors.items() if t.is_floating_point() and t.numel()}
    most = {name: max(-float(low), float(high)) for name, (low, high) in ends.items()}
    bad = [name for name, size in most.items() if not math.isfinite(size)]
    if bad:
        raise WeightsError(f"{path}: wanted finite weights, got NaN or infinity in {', '.join(bad)}")
    large = [name for name, size in most.items() if size > LARGEST]
    if large:
        msg = f"{path}: wanted weights of at most {LARGEST:g}, got larger ones in {', '.join(large)}; train it again"
        raise WeightsError(msg)


def _differences(tensors: Mapping[str, Tensor], base: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What is stored of `tensors`; those that the base lacks, or has in another shape, are stored whole."""
    stored = {}
    for name, tensor in tensors.items():
        if name not in base or base[name].shape != tensor.shape:
            stored[name] = tensor
            continue
        difference = tensor.detach().cpu().float() - base[name].float()
        if bool(difference.any()):
            stored[name], stored[name + _STEP] = in_steps(difference)
    return stored


def _whole(stored: Weights, base: Mapping[str, Tensor]) -> Weights:
    """What is `stored` with numbers in place of bytes, and with the tensors of its base."""
    is_difference = "base" in stored.card
    tensors = {**base, **{k: v for k, v in stored.tensors.items() if not k.endswith(_STEP)}}
    for name, step in stored.tensors.items():
        if not name.endswith(_STEP):
            continue
        name = name.removesuffix(_STEP)
        steps, start = stored.tensors.get(name, step), base.get(name)
        is_known = is_difference == (start is not None) and (start is None or start.shape == steps.shape)
        rows = (*steps.shape[:1], 1, *steps.shape[2:]) if steps.dim() > 1 else ()
        fits = steps.dtype == torch.int8 and step.shape in ((), rows)
        if not (is_known and fits):
            what = "a number of steps"
            wanted = f"a difference from a tensor of {stored.card['base']}.safetensors" if is_difference else what
            raise WeightsError(f"{stored.path}: {name[:80]} isn't {wanted}; get them again")
        tensors[name] = step * steps if start is None else start.float() + step * steps
    _require_sense(stored.path, tensors)
    return replace(stored, tensors=tensors)


def _read_tensors(path: Path, sha256: Any) -> dict[str, Tensor]:
    """The tensors of a file; none is made before the hash has been verified."""
    damaged = f"{path}: damaged, or not the file that its card describes"
    try:
        with _open(path, MAX_BYTES) as file:
            (n,) = struct.unpack("<Q", file.read(8))
            if not 2 <= n <= MAX_CARD_BYTES:  # {} at least
                raise ValueError(f"a header of {n} bytes")
            file.seek(0)
            digest = hashlib.sha256()
            while step := file.read(_PIECE):
                digest.update(step)
            if digest.hexdigest() != sha256:
                raise WeightsError(f"{damaged}; get both files again")
            file.seek(0)
            tensors: dict[str, Tensor] = load(file.read())
            if not {tensor.dtype for tensor in tensors.values()} <= _DTYPES:
                raise ValueError("it has numbers of another type")
            return tensors
    except (SafetensorError, *DAMAGE) as error:
        if isinstance(error, WeightsError):
            raise
        what = "larger than this machine's memory" if isinstance(error, MemoryError) else "not a safetensors file"
        raise WeightsError(f"{damaged}: {what} ({error}); get both files again") from error


def load_card(stem: str | Path) -> dict[str, Any]:
    """Reads only the card of weights. Raises `WeightsError` where there is none, or it isn't a card of weights."""
    path = Path(f"{stem}.json")
    try:
        with _open(path, MAX_CARD_BYTES) as file:
            card = parse_json(file.read())
    except (ValueError, RecursionError, OSError) as error:
        if isinstance(error, WeightsError):
            raise
        raise WeightsError(f"{path}: not a card of weights: {error}") from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        got = card.get("format") if isinstance(card, dict) else type(card).__name__
        raise WeightsError(f"{path}: wanted a card of the format {FORMAT}, got {got}")
    return card


def _open(path: Path, most: int) -> InputFile:
    if not os.path.lexists(path):
        raise WeightsError(f"{path}: no such weights; train some with `refu train`")
    return open_file(path, most=most, error=WeightsError, wanted="weights or their card, as `refu train` writes them")
