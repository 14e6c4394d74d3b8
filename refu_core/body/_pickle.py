"""Reads official SMPL `.pkl` files without executing anything in them.

These files were written by Python 2 and hold numpy arrays, a scipy sparse matrix and `chumpy` objects. The unpickler
below never imports what a pickle names: the few names such a file needs are mapped to inert records that remember their
arguments, everything else is refused, and arrays are rebuilt from the records afterwards.
"""

from __future__ import annotations

import mmap
import pickle
import pickletools
from typing import TYPE_CHECKING, Any

import numpy as np

from refu_core.errors import BodyError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

_MAX_BYTES = 1 << 30
_MAX_MEMO = 1 << 20
_MAX_OPCODES = 5_000_000
_NUMERIC_KINDS = "biuf"
_OPCODES = {ord(opcode.code): opcode for opcode in pickletools.opcodes}
_LENGTH_BYTES = {
    pickletools.TAKEN_FROM_ARGUMENT1: 1,
    pickletools.TAKEN_FROM_ARGUMENT4: 4,
    pickletools.TAKEN_FROM_ARGUMENT4U: 4,
    pickletools.TAKEN_FROM_ARGUMENT8U: 8,
}


class _Record:
    """Stands for an object of a pickle: keeps what it was built from, does nothing."""

    args: tuple[Any, ...] = ()
    state: Any = None

    def __init__(self, *args: Any, **_kwargs: Any) -> None:
        self.args = args

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Dtype(_Record):
    def resolve(self) -> np.dtype[Any]:
        code = self.args[0] if self.args else None
        code = code.decode("ascii") if isinstance(code, bytes) else code
        order = self.state[1] if isinstance(self.state, tuple) and len(self.state) > 1 else "|"
        order = order.decode("ascii") if isinstance(order, bytes) else order
        if not isinstance(code, str) or not isinstance(order, str):
            msg = "an array's type isn't given as text"
            raise ValueError(msg)
        dtype = np.dtype(code)
        if dtype.kind not in _NUMERIC_KINDS:
            msg = f"arrays of the type {code!r} are not read"
            raise ValueError(msg)
        return np.dtype(order + dtype.str[1:]) if order in ("<", ">") else dtype


class _Array(_Record):
    def resolve(self) -> NDArray[Any]:
        if not isinstance(self.state, tuple) or len(self.state) != 5:
            msg = "an array without content"
            raise ValueError(msg)
        _, shape, dtype, fortran, raw = self.state
        raw = raw.encode("latin1") if isinstance(raw, str) else raw
        if not isinstance(dtype, _Dtype) or not isinstance(raw, bytes):
            msg = "an array of objects"
            raise ValueError(msg)
        flat: NDArray[Any] = np.frombuffer(raw, dtype.resolve())
        return np.reshape(flat, shape, order="F" if fortran else "C")


class _Sparse(_Record):
    """A `scipy.sparse` matrix in compressed columns."""

    def resolve(self) -> NDArray[Any]:
        state = self.state if isinstance(self.state, dict) else {}
        rows, columns = (int(n) for n in state["_shape" if "_shape" in state else "shape"])
        data, indices, pointers = (_resolve(state[key]) for key in ("data", "indices", "indptr"))
        if rows * columns > _MAX_BYTES // 8 or len(pointers) != columns + 1 or len(indices) != len(data):
            msg = f"a sparse matrix of {rows} x {columns} with {len(data)} entries"
            raise ValueError(msg)
        counts = np.diff(pointers)
        if counts.min(initial=0) < 0 or counts.sum() != len(indices):
            msg = f"a sparse matrix whose columns have {counts.sum()} entries, and {len(indices)} are given"
            raise ValueError(msg)
        dense = np.zeros((rows, columns))
        column = np.repeat(np.arange(columns), counts)
        np.add.at(dense, (indices, column), data)
        return dense


class _Chumpy(_Record):
    """A `chumpy` variable: its value is the array `x`; expressions of several variables aren't evaluated."""

    def resolve(self) -> NDArray[Any]:
        if not isinstance(self.state, dict) or "x" not in self.state:
            msg = "a chumpy expression; save the model again with its values as plain arrays"
            raise ValueError(msg)
        return _resolve(self.state["x"])


class _Object(_Record):
    """The name `object`, which Python 2's reconstructor is called with."""


# What a pickle may call are classes, too: it could set attributes of a function, and they would stay.


class _Reconstructor(_Record):
    """Python 2's way to make an object of a class."""

    def __new__(cls, made: Any = None, *_args: Any) -> Any:
        """An empty record of the class `made`."""
        if not (isinstance(made, type) and issubclass(made, _Record)):
            msg = "a reconstructor of something that isn't a class"
            raise pickle.UnpicklingError(msg)
        return object.__new__(made)


class _ArrayReconstructor(_Record):
    """Numpy's way to make an array."""

    def __new__(cls, *_args: Any) -> Any:
        """An array without content."""
        return _Array()


class _Latin1(_Record):
    """How Python 3 writes bytes into protocol 2."""

    def __new__(cls, text: Any = None, *_encoding: Any) -> Any:
        """The bytes."""
        if not isinstance(text, str):
            msg = "bytes that aren't given as text"
            raise pickle.UnpicklingError(msg)
        return text.encode("latin1")


_ALLOWED: dict[tuple[str, str], Any] = {
    ("numpy", "dtype"): _Dtype,
    ("numpy", "ndarray"): _Array,
    ("_codecs", "encode"): _Latin1,
    **{(module, "_reconstruct"): _ArrayReconstructor for module in ("numpy.core.multiarray", "numpy._core.multiarray")},
    **{(module, "_reconstructor"): _Reconstructor for module in ("copy_reg", "copyreg")},
    **{(module, "object"): _Object for module in ("__builtin__", "builtins")},
    **{(module, "csc_matrix"): _Sparse for module in ("scipy.sparse.csc", "scipy.sparse._csc", "scipy.sparse")},
    ("chumpy.ch", "Ch"): _Chumpy,
    ("chumpy.ch", "MatVecMult"): _Chumpy,
    ("chumpy.reordering", "Select"): _Chumpy,
}


class _InertUnpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        try:
            return _ALLOWED[module, name]
        except KeyError:
            msg = f"it refers to {module}.{name}, which no SMPL model needs: refused, nothing was executed"
            raise pickle.UnpicklingError(msg) from None

    def persistent_load(self, _pid: Any) -> Any:
        msg = "it refers to objects outside the file: refused"
        raise pickle.UnpicklingError(msg)


def _check_opcodes(data: mmap.mmap) -> None:
    """Checks that a pickle holds what its lengths announce: an unpickler makes room for it before it looks.

    Raises `UnpicklingError` where it doesn't, and for more entries of the memo, or more opcodes, than any model has.
    """
    at = 0
    for _ in range(_MAX_OPCODES):
        opcode = _OPCODES.get(data[at]) if at < len(data) else None
        if opcode is None:
            msg = f"no opcode at byte {at}"
            raise pickle.UnpicklingError(msg)
        if opcode.name == "STOP":
            return
        at += 1
        size = _argument_size(opcode.arg, data, at)
        if size > len(data) - at:
            msg = f"{opcode.name} at byte {at - 1} wants {size} bytes, the file has {len(data) - at} left"
            raise pickle.UnpicklingError(msg)
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT"):
            raw = data[at : at + size]
            index = int(raw) if opcode.name == "PUT" else int.from_bytes(raw, "little")
            if not 0 <= index < _MAX_MEMO:
                msg = f"an entry {index} of the memo, at most {_MAX_MEMO} are made"
                raise pickle.UnpicklingError(msg)
        at += size
    msg = f"more than {_MAX_OPCODES} opcodes"
    raise pickle.UnpicklingError(msg)


def _argument_size(argument: Any, data: mmap.mmap, at: int) -> int:
    """Bytes that an opcode's argument takes, from `at` on."""
    if argument is None or argument.n >= 0:
        return 0 if argument is None else int(argument.n)
    if argument.n == pickletools.UP_TO_NEWLINE:
        end = at - 1
        for _ in range(2 if argument.name == "stringnl_noescape_pair" else 1):
            end = data.find(b"\n", end + 1)
            if end < 0:
                return len(data) + 1
        return end + 1 - at
    size = _LENGTH_BYTES[argument.n]
    # The lengths that have a sign: as a number without one, a negative one is longer than any file.
    return size + int.from_bytes(data[at : at + size], "little")


def _resolve(value: Any) -> NDArray[Any]:
    if isinstance(value, (_Array, _Sparse, _Chumpy)):
        return value.resolve()
    if isinstance(value, (list, tuple)) and all(isinstance(item, (int, float)) for item in value):
        return np.asarray(value)
    msg = f"{type(value).__name__} where an array was expected"
    raise ValueError(msg)


def read_smpl_pickle(path: Path, *, keys: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """The arrays of an official SMPL `.pkl` whose names are in `keys`.

    Raises:
        BodyError: the file is too large, isn't a pickle, isn't a model, or refers to anything but arrays.
    """
    try:
        size = path.stat().st_size
        if size > _MAX_BYTES:
            msg = f"{path}: {size >> 20} MiB, at most {_MAX_BYTES >> 20} MiB are read"
            raise BodyError(msg)
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            _check_opcodes(data)
            content = _InertUnpickler(data, encoding="latin1").load()
    except BodyError:
        raise
    except RecursionError as error:
        msg = f"{path}: can't be read as an SMPL pickle: nested too deeply"
        raise BodyError(msg) from error
    except Exception as error:  # damaged pickles raise nearly anything: IndexError, KeyError, UnicodeError, …
        msg = f"{path}: can't be read as an SMPL pickle: {error}"
        raise BodyError(msg) from error
    if not isinstance(content, dict):
        msg = f"{path}: an SMPL pickle holds a dictionary, this one a {type(content).__name__}"
        raise BodyError(msg)
    arrays: dict[str, NDArray[Any]] = {}
    for key in keys:
        if key in content:
            try:
                arrays[key] = _resolve(content[key])
            except (ValueError, TypeError, LookupError, OverflowError, RecursionError, MemoryError) as error:
                msg = f"{path}: {key} can't be read: {error}"
                raise BodyError(msg) from error
    return arrays
