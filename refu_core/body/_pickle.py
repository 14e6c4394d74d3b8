"""Reads official SMPL `.pkl` files without executing anything in them.

These files were written by Python 2 and hold numpy arrays, a scipy sparse matrix and `chumpy` objects. The unpickler
below never imports what a pickle names: the few names such a file needs are mapped to inert records that remember their
arguments, everything else is refused, and arrays are rebuilt from the records afterwards.
"""

from __future__ import annotations

import pickle
from typing import TYPE_CHECKING, Any

import numpy as np

from refu_core.errors import BodyError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

_MAX_BYTES = 1 << 30
_NUMERIC_KINDS = "biuf"


class _Record:
    """Stands for an object of a pickle: keeps what it was built from, does nothing."""

    def __init__(self, *args: Any, **_kwargs: Any) -> None:
        self.args = args
        self.state: Any = None

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
        dense = np.zeros((rows, columns))
        column = np.repeat(np.arange(columns), np.diff(pointers))
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


def _reconstructor(cls: Any, *_args: Any) -> _Record:
    if not (isinstance(cls, type) and issubclass(cls, _Record)):
        msg = "a reconstructor of something that isn't a class"
        raise pickle.UnpicklingError(msg)
    return cls()


def _reconstruct_array(*_args: Any) -> _Array:
    return _Array()


def _encode_latin1(text: Any, *_encoding: Any) -> bytes:
    """How Python 3 writes bytes into protocol 2."""
    if not isinstance(text, str):
        msg = "bytes that aren't given as text"
        raise pickle.UnpicklingError(msg)
    return text.encode("latin1")


_ALLOWED: dict[tuple[str, str], Any] = {
    ("numpy", "dtype"): _Dtype,
    ("numpy", "ndarray"): _Array,
    ("_codecs", "encode"): _encode_latin1,
    **{(module, "_reconstruct"): _reconstruct_array for module in ("numpy.core.multiarray", "numpy._core.multiarray")},
    **{(module, "_reconstructor"): _reconstructor for module in ("copy_reg", "copyreg")},
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
        with path.open("rb") as file:
            content = _InertUnpickler(file, encoding="latin1").load()
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
            except (ValueError, TypeError, KeyError, IndexError, OverflowError, UnicodeError) as error:
                msg = f"{path}: {key} can't be read: {error}"
                raise BodyError(msg) from error
    return arrays
