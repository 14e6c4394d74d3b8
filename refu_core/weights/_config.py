"""Builds the network that a card describes: nothing is built that the tensors beside the card don't fit."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, Field, fields
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor, nn

from refu_core.errors import RefuError, WeightsError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_LARGEST = 1 << 20
_LONGEST = 64
_WRONG = (TypeError, ValueError, AttributeError, LookupError, ArithmeticError, RuntimeError, RefuError)
"""What constructors raise for sizes that no network can have."""

Config = TypeVar("Config", bound="DataclassInstance")
Module = TypeVar("Module", bound=nn.Module)


@contextmanager
def naming(what: object) -> Iterator[None]:
    """Has a `WeightsError` begin with what it is about, such as a file's path."""
    try:
        yield
    except WeightsError as error:
        raise WeightsError(f"{what}: {error}") from error


def config_of_card(kind: type[Config], values: Any) -> Config:
    """The configuration `kind` that a card describes.

    Raises `WeightsError` for other fields, fields of other types, and sizes that no network has.
    """
    if not isinstance(values, Mapping):
        raise WeightsError(f"wanted the fields of {kind.__name__}, got {str(values)[:80]}: train it again")
    given = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
    for field in fields(kind):
        if field.name in given and not _fits(field, given[field.name]):
            raise WeightsError(f"{field.name} of {kind.__name__} can't be {given[field.name]!s:.80}: train it again")
    try:
        return kind(**given)
    except TypeError as error:
        raise WeightsError(f"a card that this version doesn't know: {error}; train it again") from error


def build_for(tensors: Mapping[str, Tensor], build: Callable[[], Module], *, shared: str = " ") -> Module:
    """What `build` makes, in float32, loaded with `tensors`; it keeps those whose names begin with `shared`.

    It is first built without memory: a card may claim sizes that no machine can hold, and its tensors reveal that.
    Raises `WeightsError` where the module can't be built, or has other tensors.
    """
    try:
        with torch.device("meta"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about layers of no width, which don't fit any tensor
            wanted = {k: v.shape for k, v in build().state_dict().items() if not k.startswith(shared)}
        got = {k: v.shape for k, v in tensors.items()}
        if wanted != got:
            other = sorted(k for k in {**wanted, **got} if wanted.get(k) != got.get(k))
            msg = f"wanted {len(wanted)} tensors, got {len(got)}; {len(other)} are missing, surplus or of another "
            msg += f"shape, {other[0][:80]} for one"
            raise WeightsError(msg)
        module = build().float()  # torch builds it in the caller's default type, which may be coarser than `tensors`
        module.load_state_dict(dict(tensors), strict=False)
    except _WRONG as error:
        raise WeightsError(f"not the network that its card describes: {error}; train it again") from error
    return module


def _fits(field: Field[Any], value: Any) -> bool:
    """Whether a value has the type of a field's default (a row of whole numbers, if it has none) and a valid size."""
    default = (0,) if field.default is MISSING else field.default
    if isinstance(default, bool) or isinstance(value, bool):
        return isinstance(default, bool) and isinstance(value, bool)
    if isinstance(default, float):
        return isinstance(value, (int, float)) and 0 <= value < math.inf
    if isinstance(default, int):
        return isinstance(value, int) and 0 < value < _LARGEST
    if isinstance(default, tuple):
        is_row = isinstance(value, tuple) and len(value) <= _LONGEST
        return is_row and all(type(item) is int and 0 <= item < _LARGEST for item in value)
    return isinstance(value, type(default))
