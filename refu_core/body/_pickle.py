"""Reads official SMPL `.pkl` files without executing anything in them.

These files were written by Python 2 and hold numpy arrays, a scipy sparse matrix and `chumpy` objects. Python's own
unpickler isn't used at all. The machine below knows the opcodes that such a file needs, and makes of them text,
numbers, lists and inert records of what an object was built from. Nothing is imported or called, nothing is hashed but
text, and nothing is walked by recursion, so that nested values do no harm either. Arrays are rebuilt from the records
afterwards, within the budget of all files.
"""

from __future__ import annotations

import codecs
import operator
import pickletools
import re
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from refu_core._files import open_file
from refu_core._npz import ArrayBudget

if TYPE_CHECKING:
    from collections.abc import Callable, Collection
    from pathlib import Path

    from numpy.typing import NDArray

    from refu_core._files import InputFile
    from refu_core.errors import RefuError

_MAX_BYTES = 512 << 20
"""The largest official file has 236 MiB: it's text, and takes three times what its arrays do."""
_MAX_OPCODES = 100_000
"""An official file has some hundreds."""
_LONG_TEXT = 1 << 16
_OPCODES = {opcode.code.encode("latin1"): opcode for opcode in pickletools.opcodes}
_READERS = {opcode.name: opcode.arg.reader for opcode in pickletools.opcodes if opcode.arg}
_NUMPY = ("numpy.core", "numpy._core")
_NAMES: dict[str, str] = {
    "numpy.dtype": "dtype",
    "numpy.ndarray": "array",
    "_codecs.encode": "latin1",
    **{f"{package}.multiarray._reconstruct": "new array" for package in _NUMPY},
    **{f"{package}.numeric._frombuffer": "buffer" for package in _NUMPY},
    **{f"{module}._reconstructor": "new" for module in ("copy_reg", "copyreg")},
    **{f"{module}.{name}": name for module in ("__builtin__", "builtins") for name in ("object", "bytearray")},
    **{f"{module}.csc_matrix": "sparse" for module in ("scipy.sparse.csc", "scipy.sparse._csc", "scipy.sparse")},
    **{f"chumpy.{name}": "chumpy" for name in ("ch.Ch", "ch.MatVecMult", "reordering.Select")},
}
"""What a model may name, and what it is here."""
_READABLE = (
    *("INT", "LONG", "LONG1", "BININT", "BININT1", "BININT2", "FLOAT", "BINFLOAT", "BINSTRING", "SHORT_BINSTRING"),
    *("SHORT_BINUNICODE", "SHORT_BINBYTES", "BINBYTES", "BINBYTES8"),
)
_WITH_ARGUMENT = ("PROTO", "FRAME", "PUT", "BINPUT", "LONG_BINPUT", "GET", "BINGET", "LONG_BINGET", "GLOBAL")


@dataclass(eq=False, slots=True)
class _Name:
    """A name of `_NAMES`."""

    kind: str


@dataclass(eq=False, slots=True)
class _Record:
    """Stands for an object of a pickle: what it was built from."""

    kind: str
    args: tuple[Any, ...] = ()
    state: Any = None


class _Machine:
    """The stack, and what the opcodes do to it."""

    def __init__(self) -> None:
        self._stack: list[Any] = []
        self._marked: list[list[Any]] = []
        self._memo: dict[int, Any] = {}

    def run(self, file: InputFile) -> Any:
        """What a pickle holds. Raises `ValueError`, `LookupError` or `struct.error` where it is damaged."""
        for _ in range(_MAX_OPCODES):
            opcode = _OPCODES.get(file.read(1))
            if opcode is None:
                msg = f"no opcode at byte {file.tell()}"
                raise ValueError(msg)
            if opcode.name == "STOP":
                return self._stack.pop()
            if opcode.name in _VALUES:
                self._stack.append(_VALUES[opcode.name](file))
            else:
                self._do(opcode.name, _READERS[opcode.name](file) if opcode.name in _WITH_ARGUMENT else None)
        msg = f"more than {_MAX_OPCODES} opcodes"
        raise ValueError(msg)

    def _do(self, name: str, argument: Any) -> None:
        match name:
            case "PROTO" | "FRAME":
                pass
            case "MARK":
                self._marked.append(self._stack)
                self._stack = []
            case "PUT" | "BINPUT" | "LONG_BINPUT":
                self._memo[argument] = self._stack[-1]
            case "MEMOIZE":
                self._memo[len(self._memo)] = self._stack[-1]
            case "GET" | "BINGET" | "LONG_BINGET":
                self._stack.append(self._memo[argument])
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                self._stack.append(tuple(self._last(int(name[-1]))))
            case "TUPLE" | "LIST" | "DICT":
                items = self._since_mark()
                self._stack.append(_dict(items) if name == "DICT" else items if name == "LIST" else tuple(items))
            case "APPEND" | "APPENDS":
                items = self._last(1) if name == "APPEND" else self._since_mark()
                _exactly(list, self._stack[-1]).extend(items)
            case "SETITEM" | "SETITEMS":
                items = self._last(2) if name == "SETITEM" else self._since_mark()
                _exactly(dict, self._stack[-1]).update(_dict(items))
            case "GLOBAL" | "STACK_GLOBAL":
                words = self._last(2) if argument is None else argument.split(" ", 1)
                self._stack.append(_named(".".join(_exactly(str, word) for word in words)))
            case "REDUCE" | "NEWOBJ":
                called, args = self._last(2)
                self._stack.append(_made(_exactly(_Name, called).kind, _exactly(tuple, args)))
            case "BUILD":
                state = self._stack.pop()
                _exactly(_Record, self._stack[-1]).state = state
            case _:
                msg = f"it uses {name}, which no SMPL model needs: refused, nothing was executed"
                raise ValueError(msg)

    def _last(self, n: int) -> list[Any]:
        return [self._stack.pop() for _ in range(n)][::-1]

    def _since_mark(self) -> list[Any]:
        items, self._stack = self._stack, self._marked.pop()
        return items


def _named(name: str) -> _Name:
    if name not in _NAMES:
        msg = f"it refers to {name[:80]}, which no SMPL model needs: refused, nothing was executed"
        raise ValueError(msg)
    return _Name(_NAMES[name])


def _exactly(kind: type[Any], value: Any) -> Any:
    """`value`, if that is what it is."""
    if type(value) is not kind:
        msg = f"{type(value).__name__.strip('_')} where {kind.__name__.strip('_')} was expected"
        raise ValueError(msg)
    return value


def _dict(items: list[Any]) -> dict[str, Any]:
    return {_exactly(str, key): value for key, value in zip(items[::2], items[1::2], strict=True)}


def _made(kind: str, args: tuple[Any, ...]) -> Any:
    """What a call of a name gives."""
    if kind == "new":  # Python 2's way to make an object: of its class, which is the first argument
        return _Record(_exactly(_Name, args[0]).kind)
    if kind == "new array":
        return _Record("array")
    if kind == "latin1":  # how Python 3 writes bytes into protocol 2
        return _exactly(str, args[0]).encode("latin1")
    return args[0] if kind == "bytearray" and args else _Record(kind, args)


def _quoted(file: InputFile) -> str:
    """A line of Python 2's text, which pickletools knows in ASCII only."""
    line = file.readline().strip()
    if len(line) < 2 or line[:1] not in b"'\"" or line[-1:] != line[:1]:
        msg = "text without quotation marks"
        raise ValueError(msg)
    decoded: bytes = codecs.escape_decode(line[1:-1])[0]
    return decoded.decode("latin1")


def _line(file: InputFile) -> str:
    line = file.readline()
    if len(line) > _LONG_TEXT and re.search(rb"\\(?:U|u(?!00))", line):
        msg = "a long text that isn't of bytes"
        raise ValueError(msg)
    return line[:-1].decode("raw-unicode-escape")


def _utf8(length: str) -> Callable[[InputFile], str]:
    def read(file: InputFile) -> str:
        (n,) = struct.unpack(length, file.read(struct.calcsize(length)))
        text = file.read(n)
        # Long text is bytes that Python 3 wrote as text; one other character would make each four times as wide.
        if len(text) != n or (n > _LONG_TEXT and text.translate(None, bytes(range(0xC4)))):
            msg = f"a text of {n} bytes that was cut short, or isn't of bytes"
            raise ValueError(msg)
        return text.decode("utf-8", "surrogatepass")

    return read


_VALUES: dict[str, Callable[[InputFile], Any]] = {
    "NONE": lambda _: None,
    "NEWTRUE": lambda _: True,
    "NEWFALSE": lambda _: False,
    "EMPTY_LIST": lambda _: [],
    "EMPTY_DICT": lambda _: {},
    "EMPTY_TUPLE": lambda _: (),
    "STRING": _quoted,
    "UNICODE": _line,
    "BINUNICODE": _utf8("<I"),
    "BINUNICODE8": _utf8("<Q"),
    **{name: _READERS[name] for name in _READABLE},
    "BYTEARRAY8": lambda file: bytes(_READERS["BYTEARRAY8"](file)),
}
"""Opcodes that put a value on the stack, and what reads it."""


class _Arrays:
    """Makes arrays of records."""

    def __init__(self) -> None:
        self._budget = ArrayBudget()

    def of(self, value: Any) -> NDArray[Any]:
        """The array that a value of a pickle stands for. Raises `ValueError`, `KeyError`, `TypeError`."""
        for _ in range(8):  # variables of variables; one that is its own value never ends
            if not isinstance(value, _Record) or value.kind != "chumpy":
                break
            if type(value.state) is not dict or "x" not in value.state:
                msg = "a chumpy expression; save the model again with its values as plain arrays"
                raise ValueError(msg)
            value = value.state["x"]
        if isinstance(value, _Record) and value.kind in ("array", "buffer"):
            return self._plain(value)
        if isinstance(value, _Record) and value.kind == "sparse":
            return self._sparse(_exactly(dict, value.state))
        if isinstance(value, (list, tuple)) and all(type(item) in (int, float) for item in value):
            self._budget.take((len(value),), np.dtype(np.float64))
            return np.asarray(value)
        msg = f"{getattr(value, 'kind', type(value).__name__)} where an array was expected"
        raise ValueError(msg)

    def _plain(self, record: _Record) -> NDArray[Any]:
        if record.kind == "buffer":  # protocol 5
            raw, kind, shape, order = record.args
        else:
            if type(record.state) is not tuple or len(record.state) != 5:
                msg = "an array without content"
                raise ValueError(msg)
            _, shape, kind, is_fortran, raw = record.state
            order = "F" if is_fortran else "C"
        raw = raw.encode("latin1") if isinstance(raw, str) else raw
        if not isinstance(kind, _Record) or kind.kind != "dtype" or not isinstance(raw, bytes):
            msg = "an array of objects"
            raise ValueError(msg)
        dtype = _dtype(kind)
        shape = tuple(operator.index(n) for n in _exactly(tuple, shape))
        self._budget.take(shape, dtype)
        flat: NDArray[Any] = np.frombuffer(raw, dtype)
        return flat.reshape(shape, order="F" if order == "F" else "C")

    def _sparse(self, state: dict[str, Any]) -> NDArray[Any]:
        """A `scipy.sparse` matrix in compressed columns."""
        rows, columns = (operator.index(n) for n in _exactly(tuple, state["_shape" if "_shape" in state else "shape"]))
        data, indices, pointers = (self.of(state[key]).reshape(-1) for key in ("data", "indices", "indptr"))
        self._budget.take((rows, columns), np.dtype(np.float64))
        if len(pointers) != columns + 1 or len(indices) != len(data) or indices.dtype.kind not in "iu":
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


def _dtype(record: _Record) -> np.dtype[Any]:
    code = record.args[0] if record.args else None
    order = record.state[1] if type(record.state) is tuple and len(record.state) > 1 else "|"
    code, order = (text.decode("latin1") if type(text) is bytes else text for text in (code, order))
    if type(code) is not str or not re.fullmatch("[biuf][1248]", code):
        msg = f"arrays of the type {code[:20] if type(code) is str else type(code).__name__!r} are not read"
        raise ValueError(msg)
    return np.dtype(order + code) if order in ("<", ">") else np.dtype(code)


def read_smpl_pickle(
    path: Path, *, keys: Collection[str], error: type[RefuError], wanted: str
) -> dict[str, NDArray[Any]]:
    """The arrays of an official SMPL `.pkl` whose names are in `keys`.

    Raises:
        error: the file is too large, isn't a pickle, isn't a model, or refers to anything but arrays.
    """
    with open_file(path, most=_MAX_BYTES, error=error, wanted=wanted) as file:
        try:
            content = _Machine().run(file)
        except (ValueError, LookupError, struct.error, OverflowError, MemoryError, OSError) as cause:
            msg = f"{path}: can't be read as an SMPL pickle: {str(cause) or type(cause).__name__}"
            raise error(msg) from cause
    if type(content) is not dict:
        msg = f"{path}: an SMPL pickle holds a dictionary, this one a {type(content).__name__}"
        raise error(msg)
    arrays, made = _Arrays(), {}
    for key in keys:
        if key in content:
            try:
                made[key] = arrays.of(content[key])
            except (ValueError, TypeError, LookupError, OverflowError, MemoryError) as cause:
                msg = f"{path}: {key} can't be read: {cause}"
                raise error(msg) from cause
    return made
