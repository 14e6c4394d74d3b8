"""Reading and writing of weights: what they are is checked before what they say is used."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from refu_core.errors import WeightsError

FORMAT = "refu-weights-1"
MAX_BYTES = 8 << 30
"""A larger file is refused before it is read; the paper's own networks take 2.5 GB."""
MAX_CARD_BYTES = 1 << 20


@dataclass(frozen=True, eq=False)
class Weights:
    """The tensors of a network and what is known of them."""

    tensors: Mapping[str, Tensor]
    card: Mapping[str, Any]
    """Garment, body fingerprint, data set, training settings, measured figures, versions."""
    path: Path
    """File of the tensors."""


def shipped_weights(garment: str) -> Path:
    """The folder of a built-in garment's weights; it needs not exist."""
    return Path(__file__).parent / garment


def save_weights(stem: str | Path, tensors: Mapping[str, Tensor], card: Mapping[str, Any]) -> Path:
    """Writes `stem`.safetensors and its card `stem`.json; neither is ever left half written.

    Returns the file of the tensors.

    Raises:
        WeightsError: a tensor isn't finite, or the disk can't be written.
    """
    stem = Path(stem)
    bad = [name for name, t in tensors.items() if t.is_floating_point() and not bool(torch.isfinite(t).all())]
    if bad:
        msg = f"{stem}: wanted finite weights, got NaN or infinity in {', '.join(bad)}; nothing was written"
        raise WeightsError(msg)
    data = save({name: t.detach().cpu().contiguous() for name, t in tensors.items()})
    full = {
        "format": FORMAT,
        **card,
        "sha256": hashlib.sha256(data).hexdigest(),
        "versions": {name: version(name) for name in ("refu-ros", "torch")},
    }
    path = _with_suffix(stem, ".safetensors")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _replace(path, data)
        _replace(_with_suffix(stem, ".json"), (json.dumps(full, indent=1) + "\n").encode())
    except OSError as error:
        msg = f"{stem}: weights can't be written: {error}"
        raise WeightsError(msg) from error
    return path


def load_weights(stem: str | Path, *, expect: Mapping[str, Any] | None = None) -> Weights:
    """Reads `stem`.safetensors and its card, onto the CPU.

    Args:
        stem: path without suffix.
        expect: what the card must say, `{"garment": ..., "body_fingerprint": ...}` for instance.

    Raises:
        WeightsError: a file is missing, damaged, of another format, or made for something other than `expect`.
    """
    stem = Path(stem)
    path = _with_suffix(stem, ".safetensors")
    card = _read_card(_with_suffix(stem, ".json"))
    for key, wanted in (expect or {}).items():
        if card.get(key) != wanted:
            msg = f"{path}: wanted weights whose {key} is {wanted}, got {card.get(key)}; train some with `refu train`"
            raise WeightsError(msg)
    data = _read(path, MAX_BYTES)
    if hashlib.sha256(data).hexdigest() != card.get("sha256"):
        msg = f"{path}: damaged, or not the file that its card describes; get both files again"
        raise WeightsError(msg)
    try:
        tensors = load(data)
    except (SafetensorError, ValueError, KeyError, RuntimeError) as error:
        msg = f"{path}: not a safetensors file: {error}"
        raise WeightsError(msg) from error
    bad = [name for name, t in tensors.items() if t.is_floating_point() and not bool(torch.isfinite(t).all())]
    if bad:
        msg = f"{path}: wanted finite weights, got NaN or infinity in {', '.join(bad)}"
        raise WeightsError(msg)
    return Weights(tensors, card, path)


def _read_card(path: Path) -> dict[str, Any]:
    try:
        card = json.loads(_read(path, MAX_CARD_BYTES))
    except (ValueError, RecursionError) as error:
        if isinstance(error, WeightsError):
            raise
        msg = f"{path}: not a card of weights: {error}"
        raise WeightsError(msg) from error
    if not isinstance(card, dict) or card.get("format") != FORMAT:
        got = card.get("format") if isinstance(card, dict) else type(card).__name__
        msg = f"{path}: wanted a card of the format {FORMAT}, got {got}"
        raise WeightsError(msg)
    return card


def _read(path: Path, most: int) -> bytes:
    try:
        size = path.stat().st_size
        if size > most:
            msg = f"{path}: {size >> 20} MiB, at most {most >> 20} MiB are read"
            raise WeightsError(msg)
        return path.read_bytes()
    except FileNotFoundError as error:
        msg = f"{path}: no such weights; train some with `refu train`"
        raise WeightsError(msg) from error
    except OSError as error:
        msg = f"{path}: can't be read: {error}"
        raise WeightsError(msg) from error


def _with_suffix(stem: Path, suffix: str) -> Path:
    return stem.with_name(stem.name + suffix)


def _replace(path: Path, data: bytes) -> None:
    part = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
