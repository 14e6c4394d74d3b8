"""Arrays from pickles: rebuilt from what the unpickler has read, within the budget that applies to all files."""

from __future__ import annotations

import io
import operator
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array

from refu_core._files import open_file
from refu_core._npz import DAMAGE, ArrayBudget, told
from refu_core._pickle_machine import (
    MAX_PICKLE_BYTES,
    SPARSE,
    STREAM_MAGIC,
    Name,
    Record,
    Unpickler,
    bytes_of,
    dtype_of,
    exactly,
    is_plain,
    read_stream,
    scalar_of,
)
from refu_core.errors import RefuError


class PickledArrays:
    """Makes arrays from records; `storage` returns the bytes that torch keeps beside its pickle, by their key."""

    def __init__(self, storage: Callable[[str], bytes] | None = None) -> None:
        self._budget = ArrayBudget()
        self._storage = storage

    def of(self, value: Any) -> NDArray[Any]:
        """The array that a value of a pickle stands for. Raises `ValueError`, `KeyError`, `TypeError`."""
        for _ in range(8):  # variables may hold variables; one that holds itself would never end
            if not isinstance(value, Record) or value.kind != "chumpy":
                break
            if type(value.state) is not dict or "x" not in value.state:
                raise ValueError("a chumpy expression; save the model again with its values as plain arrays")
            value = value.state["x"]
        if isinstance(value, Record) and value.kind == "parameter" and value.args:
            value = value.args[0]
        kind = value.kind if isinstance(value, Record) else ""
        if kind in ("array", "buffer"):
            return self._plain(value)
        if kind in SPARSE:
            return self._sparse(kind, exactly(dict, value.state))
        if kind == "tensor":
            return self._tensor(value)
        if kind == "scalar":
            return scalar_of(value)
        if isinstance(value, (list, tuple)) and all(type(item) in (int, float) for item in value):
            self._budget.take((len(value),), np.dtype(np.float64))
            return np.asarray(value)
        raise ValueError(_unread(value))

    def _plain(self, record: Record) -> NDArray[Any]:
        if record.kind == "buffer":  # protocol 5
            raw, kind, shape, order = record.args
        else:
            if type(record.state) is not tuple or len(record.state) != 5:
                raise ValueError("an array without content")
            _, shape, kind, is_fortran, raw = record.state
            order = "F" if is_fortran else "C"
        if not isinstance(kind, Record) or kind.kind != "dtype" or not isinstance(raw, (str, bytes)):
            raise ValueError("an array of objects")
        dtype = dtype_of(kind)
        shape = tuple(operator.index(n) for n in exactly(tuple, shape))
        self._budget.take(shape, dtype)
        flat: NDArray[Any] = np.frombuffer(bytes_of(raw), dtype)
        return flat.reshape(shape, order="F" if order == "F" else "C")

    def _tensor(self, record: Record) -> NDArray[Any]:
        """A tensor of torch: a view of a storage."""
        storage, offset, shape, strides = record.args[:4]
        given = self._storage
        if exactly(Record, storage).kind == "stream":  # tensors in a pickle that torch didn't write
            storage, given = _streamed(storage)
        _, name, key = exactly(Record, storage).args[:3]
        kind = exactly(Name, name).kind
        if given is None or not is_plain(kind) or type(key) is not str:
            raise ValueError("a tensor without its numbers, or of a type that isn't read: save it as float32")
        shape, strides = (tuple(operator.index(n) for n in exactly(tuple, pair)) for pair in (shape, strides))
        if len(shape) != len(strides) or min((*shape, *strides, operator.index(offset)), default=0) < 0:
            raise ValueError(f"a tensor of the shape {str(shape)[:80]} and the strides {str(strides)[:80]}")
        self._budget.take(shape, np.dtype(kind))
        flat = np.frombuffer(given(key), np.dtype("<" + kind))
        if 0 in shape:
            return np.zeros(shape, kind)
        last = offset + sum((n - 1) * stride for n, stride in zip(shape, strides, strict=True))
        if last >= len(flat):
            raise ValueError(f"a tensor that reaches to number {last} of {len(flat)}")
        steps = tuple(stride * flat.itemsize for stride in strides)
        return np.array(np.lib.stride_tricks.as_strided(flat[offset:], shape, steps, writeable=False), order="C")

    def _sparse(self, kind: str, state: dict[str, Any]) -> NDArray[Any]:
        """A `scipy.sparse` matrix: compressed columns, compressed rows, or coordinates."""
        rows, columns = (operator.index(n) for n in exactly(tuple, state["_shape" if "_shape" in state else "shape"]))
        if kind != "coo":
            places = [state["indices"], state["indptr"]]
        else:  # SciPy names them otherwise since its version 1.13
            places = [state["row"], state["col"]] if "row" in state else exactly(tuple, state["coords"])
        data, first, second = (self.of(part).reshape(-1) for part in (state["data"], *places))
        self._budget.take((rows, columns), np.dtype(np.float64))
        if not first.dtype.kind == second.dtype.kind == "i":
            raise ValueError(f"a sparse matrix with places of {first.dtype} and {second.dtype}")
        numbers = data.astype(np.float64)
        if kind == "coo":
            return coo_array((numbers, (first, second)), shape=(rows, columns)).toarray()
        matrix = (csc_array if kind == "csc" else csr_array)((numbers, first, second), shape=(rows, columns))
        matrix.check_format(full_check=True)
        return matrix.toarray()


def _unread(value: Any) -> str:
    """What a value is that stands for no array, and what to do."""
    kind = getattr(value, "kind", type(value).__name__)
    if kind != "foreign":
        return f"{kind} where an array was expected"
    (name,) = (value.full,) if isinstance(value, Name) else value.args or ("an object",)
    saved = "what its toarray() gives" if name.startswith("scipy.sparse") else "a plain NumPy array"
    return f"it refers to {name}, which is not read (nothing was executed): save {saved}"


def _streamed(record: Record) -> tuple[Record, Callable[[str], bytes]]:
    """A storage that torch has written as a stream of its own, and the function that returns its bytes."""
    file = io.BytesIO(bytes_of(record.args[0] if record.args else None))
    if Unpickler(file).load() != STREAM_MAGIC:
        raise ValueError("a tensor whose numbers are no stream of torch")
    storage, given = read_stream(file)
    return exactly(Record, storage), given


def read_smpl_pickle(
    path: Path, *, keys: Collection[str], error: type[RefuError], wanted: str
) -> dict[str, NDArray[Any]]:
    """The arrays of an official SMPL `.pkl` that are named in `keys`.

    Raises `error`: it is too large, isn't a pickle, isn't a model, or holds anything but arrays under one of the keys.
    """
    with open_file(path, most=MAX_PICKLE_BYTES, error=error, wanted=wanted) as file:
        if file.peek(2).startswith(b"PK"):
            raise error(f"{path}: an archive, as torch.save writes it, and no pickle: save its arrays by numpy.savez")
        try:
            content = Unpickler(file).load()
        except DAMAGE as cause:
            raise error(f"{path}: can't be read as an SMPL pickle: {told(cause)}; wanted {wanted}") from cause
    if type(content) is not dict:
        raise error(f"{path}: an SMPL pickle holds a dictionary, this one a {type(content).__name__}")
    arrays, made = PickledArrays(), {}
    for key in keys:
        if key in content:
            try:
                made[key] = arrays.of(content[key])
            except DAMAGE as cause:
                raise error(f"{path}: {key} can't be read: {cause}") from cause
    return made
