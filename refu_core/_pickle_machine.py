"""Reads pickles without executing anything in them: official SMPL `.pkl` files, and what pose estimators write.

The first were written by Python 2 and hold numpy arrays, a scipy sparse matrix and `chumpy` objects; the others hold
dictionaries of arrays, as pickle, joblib or torch write them. Python's own unpickler isn't used at all. The machine
below knows the opcodes that such a file needs, and makes of them text, numbers, lists and inert records of what an
object was built from. Nothing is imported or called, nothing is hashed but text and whole numbers, and nothing is
walked by recursion, so that nested values do no harm either. Arrays are rebuilt from the records afterwards
(`_pickle`), within the budget of all files.
"""

from __future__ import annotations

import codecs
import math
import pickletools
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, BinaryIO

MAX_PICKLE_BYTES = 512 << 20
"""The largest official file has 236 MiB: it's text, and takes three times what its arrays do."""
_MODEL_OPCODES, _DATA_OPCODES = 100_000, 1_000_000
"""An official file has some hundreds; a tracker's has a thousand a frame."""
_MAX_MARKS = 10_000
"""Values in values; Python itself writes no more than a thousand."""
_MAX_NAMES = 10_000
"""Python writes each name once in a file, and then refers to it."""
_MAX_NESTED = 4
"""Pickles in a pickle: joblib writes arrays of objects so."""
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
DATA_NAMES: dict[str, str] = _NAMES | {
    **{f"{package}.multiarray.scalar": "scalar" for package in _NUMPY},
    **{f"collections.{name}": "mapping" for name in ("OrderedDict", "defaultdict")},
    "joblib.numpy_pickle.NumpyArrayWrapper": "joblib",
    "torch._utils._rebuild_tensor_v2": "tensor",
    "torch._utils._rebuild_parameter": "parameter",
    "torch.storage._load_from_bytes": "stream",
    **{
        f"torch.{name}Storage": kind
        for name, kind in (
            *(("Float", "f4"), ("Double", "f8"), ("Half", "f2"), ("Long", "i8"), ("Int", "i4"), ("Short", "i2")),
            *(("Byte", "u1"), ("Char", "i1"), ("Bool", "b1")),
        )
    },
}
"""What a file of data may name, besides; everything else that it names stands there inert (`foreign`)."""
_READABLE = (
    *("INT", "LONG", "LONG1", "BININT", "BININT1", "BININT2", "FLOAT", "BINFLOAT", "BINSTRING", "SHORT_BINSTRING"),
    *("SHORT_BINUNICODE", "SHORT_BINBYTES", "BINBYTES", "BINBYTES8"),
)
_ARGUMENTS: dict[str, Callable[[BinaryIO], Any]] = {
    **{name: _READERS[name] for name in ("PROTO", "FRAME", "PUT", "BINPUT", "LONG_BINPUT")},
    **{name: _READERS[name] for name in ("GET", "BINGET", "LONG_BINGET")},
    "GLOBAL": lambda file: [file.readline().rstrip().decode("ascii") for _ in range(2)],
}
"""Of opcodes that change what is there, and what reads it."""


@dataclass(eq=False, slots=True)
class _Name:
    """A name of the table, or `foreign`."""

    kind: str


@dataclass(eq=False, slots=True)
class Record:
    """Stands for an object of a pickle: what it was built from."""

    kind: str
    args: tuple[Any, ...] = ()
    state: Any = None
    items: dict[str | int, Any] | None = None
    """What was put into it, where it is some class's kind of dictionary."""


class Machine:
    """The stack, and what the opcodes do to it.

    Of a model it takes nothing but what a model needs; of data it takes what there is and lets foreign objects lie.
    """

    def __init__(self, *, is_model: bool, nested: int = 0) -> None:
        self._stack: list[Any] = []
        self._marked: list[list[Any]] = []
        self._memo: dict[int, Any] = {}
        self._n_names = 0
        self._is_model = is_model
        self._nested = nested
        self.storages: dict[str, str] = {}
        """The types of the storages beside the pickle, as `f4`, by their keys: torch's."""

    def run(self, file: BinaryIO) -> Any:
        """What a pickle holds. Raises `ValueError`, `LookupError` or `struct.error` where it is damaged."""
        most = _MODEL_OPCODES if self._is_model else _DATA_OPCODES
        for _ in range(most):
            opcode = _OPCODES.get(file.read(1))
            if opcode is None:
                msg = f"no opcode at byte {file.tell()}"
                raise ValueError(msg)
            if opcode.name == "STOP":
                return self._stack.pop()
            if opcode.name in _VALUES:
                self._stack.append(_VALUES[opcode.name](file))
            else:
                self._do(opcode.name, _ARGUMENTS[opcode.name](file) if opcode.name in _ARGUMENTS else None)
                top = self._stack[-1] if opcode.name == "BUILD" else None
                if type(top) is Record and top.kind == "joblib":
                    self._stack[-1] = self._array_behind(top, file)
        msg = f"more than {most} opcodes"
        raise ValueError(msg)

    def _do(self, name: str, argument: Any) -> None:
        match name:
            case "PROTO" | "FRAME":
                pass
            case "MARK":
                if len(self._marked) == _MAX_MARKS:
                    msg = f"values in each other, {_MAX_MARKS} deep"
                    raise ValueError(msg)
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
                self._stack.append(self._dict(items) if name == "DICT" else items if name == "LIST" else tuple(items))
            case "APPEND" | "APPENDS":
                items = self._last(1) if name == "APPEND" else self._since_mark()
                if not self._is_foreign(self._stack[-1]):
                    exactly(list, self._stack[-1]).extend(items)
            case "SETITEM" | "SETITEMS":
                items = self._last(2) if name == "SETITEM" else self._since_mark()
                top = self._stack[-1]
                if self._is_foreign(top):
                    top.items = top.items or {}
                    top = top.items
                exactly(dict, top).update(self._dict(items))
            case "GLOBAL" | "STACK_GLOBAL":
                module, name = self._last(2) if argument is None else argument
                self._stack.append(self._named(f"{exactly(str, module)}.{exactly(str, name)}"))
            case "REDUCE" | "NEWOBJ":
                called, args = self._last(2)
                kind = "foreign" if self._is_foreign(called) else exactly(_Name, called).kind
                self._stack.append(_made(kind, exactly(tuple, args)))
            case "BUILD":
                state = self._stack.pop()
                if not (type(self._stack[-1]) is dict and not self._is_model):  # what else a kind of dictionary knows
                    exactly(Record, self._stack[-1]).state = state
            case _ if self._is_model:
                msg = f"it uses {name}, which no SMPL model needs: refused, nothing was executed"
                raise ValueError(msg)
            case "BINPERSID":
                self._stack.append(self._storage(exactly(tuple, self._stack.pop())))
            case "EMPTY_SET":
                self._stack.append([])
            case "ADDITEMS":
                items = self._since_mark()
                exactly(list, self._stack[-1]).extend(items)
            case "FROZENSET":
                self._stack.append(self._since_mark())
            case "NEWOBJ_EX":
                called, args, _ = self._last(3)
                self._stack.append(Record("foreign"))
            case _:
                msg = f"it uses {name}, which no file of plain data needs: refused, nothing was executed"
                raise ValueError(msg)

    def _storage(self, args: tuple[Any, ...]) -> Record:
        kind, key = (kind_of_name(args[1]), args[2]) if len(args) > 2 else ("", "")
        if re.fullmatch("[biuf][1248]", kind) and type(key) is str:
            self.storages[key] = kind
        return Record("storage", args)

    def _last(self, n: int) -> list[Any]:
        if len(self._stack) < n:
            msg = f"{n} values wanted, and {len(self._stack)} there"
            raise LookupError(msg)
        items = self._stack[-n:]
        del self._stack[-n:]
        return items

    def _since_mark(self) -> list[Any]:
        items, self._stack = self._stack, self._marked.pop()
        return items

    def _is_foreign(self, value: Any) -> bool:
        """An object of a class that isn't known here, or that class: it may be built in any way, and stays inert."""
        return not self._is_model and type(value) in (Record, _Name) and value.kind == "foreign"

    def _named(self, name: str) -> _Name:
        self._n_names += 1
        if self._n_names > _MAX_NAMES:
            msg = f"it names objects more than {_MAX_NAMES} times"
            raise ValueError(msg)
        if not self._is_model:
            return _Name(DATA_NAMES.get(name, "foreign"))
        if name not in _NAMES:
            msg = f"it refers to {name[:80]}, which no SMPL model needs: refused, nothing was executed"
            raise ValueError(msg)
        return _Name(_NAMES[name])

    def _dict(self, items: list[Any]) -> dict[str | int, Any]:
        pairs = zip(items[::2], items[1::2], strict=True)
        if self._is_model:
            return {exactly(str, key): value for key, value in pairs}
        named = ((_number_of(key) if type(key) is Record else key, value) for key, value in pairs)
        return {key: value for key, value in named if isinstance(key, (str, int))}

    def _array_behind(self, wrapper: Record, file: BinaryIO) -> Any:
        """The array whose bytes joblib has put between two opcodes."""
        state = exactly(dict, wrapper.state)
        kind, shape = exactly(Record, state["dtype"]), exactly(tuple, state["shape"])
        if str(kind.args[0] if kind.args else "").startswith("O"):
            if self._nested == _MAX_NESTED:
                msg = f"arrays of objects, {_MAX_NESTED} deep"
                raise ValueError(msg)
            return Machine(is_model=False, nested=self._nested + 1).run(file)
        if state.get("numpy_array_alignment_bytes") is not None:
            file.read(file.read(1)[0])
        n_bytes = math.prod(exactly(int, n) for n in shape) * _item_size(kind)
        if not 0 <= n_bytes <= MAX_PICKLE_BYTES:
            msg = f"an array of {n_bytes >> 20} MiB"
            raise ValueError(msg)
        return Record("buffer", (file.read(n_bytes), kind, shape, state.get("order")))


def _item_size(dtype: Record) -> int:
    code = str(dtype.args[0] if dtype.args else "")
    if not re.fullmatch("[biuf][1248]", code):
        msg = f"arrays of the type {code[:20]!r} are not read"
        raise ValueError(msg)
    return int(code[1])


def _number_of(scalar: Record) -> int | None:
    """The whole number that NumPy's scalar of it stands for, which trackers count persons with."""
    if scalar.kind != "scalar" or len(scalar.args) != 2 or type(scalar.args[1]) is not bytes:
        return None
    kind = str(scalar.args[0].args[0]) if type(scalar.args[0]) is Record and scalar.args[0].args else ""
    return int.from_bytes(scalar.args[1], "little", signed=True) if re.fullmatch("[iu][1248]", kind) else None


def exactly(kind: type[Any], value: Any) -> Any:
    """`value`, if that is what it is."""
    if type(value) is not kind:
        msg = f"{type(value).__name__.strip('_')} where {kind.__name__.strip('_')} was expected"
        raise ValueError(msg)
    return value


def _made(kind: str, args: tuple[Any, ...]) -> Any:
    """What a call of a name gives."""
    if kind == "mapping":
        return {}
    if kind == "new" and exactly(_Name, args[0]).kind == "mapping":
        return {}
    if kind == "new":  # Python 2's way to make an object: of its class, which is the first argument
        return Record(exactly(_Name, args[0]).kind)
    if kind == "new array":
        return Record("array")
    if kind == "latin1":  # how Python 3 writes bytes into protocol 2
        return exactly(str, args[0]).encode("latin1")
    return args[0] if kind == "bytearray" and args else Record(kind, args)


def _quoted(file: BinaryIO) -> str:
    """A line of Python 2's text, which pickletools knows in ASCII only."""
    line = file.readline().strip()
    if len(line) < 2 or line[:1] not in b"'\"" or line[-1:] != line[:1]:
        msg = "text without quotation marks"
        raise ValueError(msg)
    decoded: bytes = codecs.escape_decode(line[1:-1])[0]
    return decoded.decode("latin1")


def _line(file: BinaryIO) -> str:
    line = file.readline()
    if len(line) > _LONG_TEXT and re.search(rb"\\(?:U|u(?!00))", line):
        msg = "a long text that isn't of bytes"
        raise ValueError(msg)
    return line[:-1].decode("raw-unicode-escape")


def _utf8(length: str) -> Callable[[BinaryIO], str]:
    def read(file: BinaryIO) -> str:
        (n,) = struct.unpack(length, file.read(struct.calcsize(length)))
        text = file.read(n)
        # Long text is bytes that Python 3 wrote as text; one other character would make each four times as wide.
        if len(text) != n or (n > _LONG_TEXT and text.translate(None, bytes(range(0xC4)))):
            msg = f"a text of {n} bytes that was cut short, or isn't of bytes"
            raise ValueError(msg)
        return text.decode("utf-8", "surrogatepass")

    return read


_VALUES: dict[str, Callable[[BinaryIO], Any]] = {
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


def kind_of_name(value: Any) -> str:
    """What a class that a pickle names is here; empty for anything else."""
    return value.kind if type(value) is _Name else ""
