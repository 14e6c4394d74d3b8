"""Reads pickles as data: official SMPL `.pkl` files, and what pose estimators write with pickle, joblib or torch.

The standard library's unpickler (its version in Python) manages the stack. Here every name becomes an inert record of
what an object was built from, so nothing is imported or called. Opcodes that would hash arbitrary values, allocate what
they only announce, or use Python's registries are replaced or refused. Arrays are made from the records afterwards
(`_pickle`), within the budget that applies to all files.
"""

from __future__ import annotations

import math
import pickle
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, BinaryIO, ClassVar

import numpy as np
from numpy.typing import NDArray

MAX_PICKLE_BYTES = 512 << 20
"""The largest official file has 236 MiB: it's text, and takes three times what its arrays do."""
STREAM_MAGIC = 0x1950A86A20F9469CFC6C
"""A stream of torch begins with a pickle of this number alone."""
_MAX_READS = 1_500_000
"""An opcode takes one to three reads; an official file has some hundred opcodes, a tracker's has a thousand a frame."""
_MAX_MARKS = 10_000
"""The most values nested in each other; Python itself writes no more than a thousand."""
_MAX_NAMES = 10_000
"""Python writes each name once in a file, and then refers to it."""
_LONGEST_NAME = 80
"""Of a longer name only this much is kept, for messages."""
_MAX_NESTED = 4
"""The most pickles nested in each other: joblib writes arrays of objects that way."""
_LONG_TEXT = 1 << 16
_NUMPY = ("numpy.core", "numpy._core")
SPARSE = ("csc", "csr", "coo")
"""The kinds of `scipy.sparse` matrices that are read."""
NAMES: dict[str, str] = {
    "numpy.dtype": "dtype",
    "numpy.ndarray": "array",
    "_codecs.encode": "bytes",
    **{f"{package}.multiarray._reconstruct": "new array" for package in _NUMPY},
    **{f"{package}.numeric._frombuffer": "buffer" for package in _NUMPY},
    **{f"{module}._reconstructor": "new" for module in ("copy_reg", "copyreg")},
    **{f"{module}.object": "object" for module in ("__builtin__", "builtins")},
    **{f"{module}.bytearray": "bytes" for module in ("__builtin__", "builtins")},
    **{
        f"scipy.sparse{module}.{kind}_{name}": kind
        for kind in SPARSE
        for module in (f".{kind}", f"._{kind}", "")
        for name in ("matrix", "array")
    },
    **{f"chumpy.{name}": "chumpy" for name in ("ch.Ch", "ch.MatVecMult", "reordering.Select")},
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
"""The names that are known, and the kind of record that each becomes; all others are kept, but inert (`foreign`)."""


@dataclass(eq=False, slots=True)
class Name:
    """A name, and its kind in the table above, or `foreign`."""

    kind: str
    full: str
    """With its module."""


@dataclass(eq=False, slots=True)
class Record:
    """Stands for an object of a pickle: what it was built from."""

    kind: str
    args: tuple[Any, ...] = ()
    """Of a `foreign` one, the name alone."""
    state: Any = None
    items: dict[str | int, Any] = field(default_factory=dict)
    """What was put into it, if it stands for a subclass of dictionary."""

    def extend(self, _: Any) -> None:
        """Drops what is put into it, if it stands for a subclass of list."""

    append = extend


_REFUSED = (pickle.EXT1, pickle.EXT2, pickle.EXT4, pickle.LONG4)
_KNOWN: dict[int, Any] = {
    code: how for code, how in pickle._Unpickler.dispatch.items() if bytes([code]) not in _REFUSED
}


class _Opcodes(dict[int, Any]):
    def __missing__(self, code: int) -> None:
        raise ValueError(f"it uses the opcode {chr(code)!r}, which no plain data need: refused, nothing was executed")


class Unpickler(pickle._Unpickler):
    """Keeps objects of unknown names, but inert. `load` raises one of `DAMAGE` where the file is damaged."""

    stack: list[Any]
    metastack: list[list[Any]]
    append: Callable[[Any], None]
    pop_mark: Callable[[], list[Any]]
    read: Callable[[int], bytes]
    readline: Callable[[], bytes]

    def __init__(self, file: BinaryIO | Unpickler, *, nested: int = 0) -> None:
        super().__init__(file, encoding="latin1")
        self._nested, self._left, self._n_names = nested, _MAX_READS, 0
        self._read_uncounted, self._file_read = file.read, self._read_counted
        self.storages: dict[str, np.dtype[Any]] = {}
        """The types of torch's storages beside the pickle, by their keys."""

    def _read_counted(self, n: int) -> bytes:
        self._left -= 1
        if self._left < 0:
            raise ValueError("too many values: save one array for all frames, as in an .npz, or fewer frames")
        return self._read_uncounted(n)

    def find_class(self, module: str, name: str) -> Name:
        """A stand-in for what a pickle names."""
        self._n_names += 1
        if self._n_names > _MAX_NAMES:
            raise ValueError(f"it names objects more than {_MAX_NAMES} times")
        full = f"{module}.{name}"
        return Name(NAMES.get(full, "foreign"), full[:_LONGEST_NAME])

    def persistent_load(self, pid: Any) -> Record:
        """A stand-in for a storage of torch, which is beside the pickle."""
        storage = Record("storage", exactly(tuple, pid))
        if len(pid) > 2 and type(pid[1]) is Name and type(pid[2]) is str and is_plain(pid[1].kind):
            self.storages[pid[2]] = np.dtype(f"<{pid[1].kind}")
        return storage

    def _mark(self) -> None:
        if len(self.metastack) == _MAX_MARKS:
            raise ValueError(f"values in each other, {_MAX_MARKS} deep")
        _KNOWN[pickle.MARK[0]](self)

    def _call(self) -> None:
        args = exactly(tuple, self.stack.pop())
        self.stack[-1] = _made(self.stack[-1], args)

    def _call_with_names(self) -> None:
        self.stack.pop()
        self._call()

    def _build(self) -> None:
        state, built = self.stack.pop(), self.stack[-1]
        if type(built) is dict:  # further attributes of a subclass of dictionary
            return
        exactly(Record, built).state = state
        if built.kind == "joblib":
            self.stack[-1] = self._array_behind(exactly(dict, state))

    def _set_item(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        _put(self.stack[-1], [key, value])

    def _set_items(self) -> None:
        items = self.pop_mark()
        _put(self.stack[-1], items)

    def _dict(self) -> None:
        items = self.pop_mark()
        self.append({})
        _put(self.stack[-1], items)

    def _text(self, length: str) -> None:
        (n,) = struct.unpack(length, self.read(struct.calcsize(length)))
        text = self.read(n)
        # Long text is bytes that Python 3 wrote as text; one wider character makes all up to four times as wide.
        if len(text) > _LONG_TEXT and text.translate(None, bytes(range(0xC4))):
            raise ValueError("a long text that isn't of bytes")
        self.append(text.decode("utf-8", "surrogatepass"))

    def _line(self) -> None:
        line = self.readline()
        if len(line) > _LONG_TEXT and re.search(rb"\\(?:U|u(?!00))", line):
            raise ValueError("a long text that isn't of bytes")
        self.append(line[:-1].decode("raw-unicode-escape"))

    def _array_behind(self, state: dict[str, Any]) -> Any:
        """The array whose bytes joblib has put between two opcodes."""
        kind, shape = exactly(Record, state["dtype"]), exactly(tuple, state["shape"])
        if str(kind.args[0] if kind.args else "").startswith("O"):
            if self._nested == _MAX_NESTED:
                raise ValueError(f"arrays of objects, {_MAX_NESTED} deep")
            return Unpickler(self, nested=self._nested + 1).load()
        if state.get("numpy_array_alignment_bytes") is not None:
            self.read(self.read(1)[0])
        n_bytes = math.prod(exactly(int, n) for n in shape) * dtype_of(kind).itemsize
        if not 0 <= n_bytes <= MAX_PICKLE_BYTES:
            raise ValueError(f"an array of {n_bytes >> 20} MiB")
        return Record("buffer", (self.read(n_bytes), kind, shape, state.get("order")))

    _own: ClassVar[dict[int, Any]] = {
        pickle.FRAME[0]: lambda self: self.read(8),
        pickle.MARK[0]: _mark,
        pickle.REDUCE[0]: _call,
        pickle.NEWOBJ[0]: _call,
        pickle.NEWOBJ_EX[0]: _call_with_names,
        pickle.BUILD[0]: _build,
        pickle.SETITEM[0]: _set_item,
        pickle.SETITEMS[0]: _set_items,
        pickle.DICT[0]: _dict,
        pickle.BINUNICODE[0]: lambda self: self._text("<I"),
        pickle.BINUNICODE8[0]: lambda self: self._text("<Q"),
        pickle.UNICODE[0]: _line,
        pickle.BYTEARRAY8[0]: _KNOWN[pickle.BINBYTES8[0]],
        pickle.EMPTY_SET[0]: _KNOWN[pickle.EMPTY_LIST[0]],
        pickle.ADDITEMS[0]: _KNOWN[pickle.APPENDS[0]],
        pickle.FROZENSET[0]: _KNOWN[pickle.LIST[0]],
    }
    dispatch: ClassVar[dict[int, Any]] = _Opcodes(_KNOWN | _own)


def read_stream(file: BinaryIO) -> tuple[Any, Callable[[str], bytes]]:
    """The content of a torch file from before those were archives, and a function that gives a storage's bytes by key.

    Such a file holds `STREAM_MAGIC`, which has been read already, then more pickles, then numbers.
    """
    for _ in ("version", "machine"):
        Unpickler(file).load()
    unpickler = Unpickler(file)
    root = unpickler.load()
    parts: dict[str, bytes] = {}
    for key in exactly(list, Unpickler(file).load()):
        if key not in unpickler.storages:
            raise ValueError("a tensor of a type that isn't read, as bfloat16: save it as float32")
        (count,) = struct.unpack("<q", file.read(8))
        size = count * unpickler.storages[key].itemsize
        part = file.read(size) if size >= 0 else b""
        if len(part) != size:
            raise ValueError(f"a tensor of {size} bytes that was cut short")
        parts[key] = part
    return root, parts.__getitem__


def exactly(kind: type[Any], value: Any) -> Any:
    """`value`, if it is exactly of this kind; raises `ValueError` if not."""
    if type(value) is not kind:
        raise ValueError(f"{type(value).__name__} where {kind.__name__} was expected")
    return value


def bytes_of(value: Any) -> bytes:
    """Bytes, which Python 3 writes as text in protocol 2; converted only on request, as many may share one text."""
    return value.encode("latin1") if type(value) is str else exactly(bytes, value)


def dtype_of(record: Record) -> np.dtype[Any]:
    """The NumPy type that a record of one stands for."""
    code = record.args[0] if record.args else None
    order = record.state[1] if type(record.state) is tuple and len(record.state) > 1 else "|"
    code, order = (text.decode("latin1") if type(text) is bytes else text for text in (code, order))
    if not is_plain(code):
        raise ValueError(f"arrays of the type {code[:20] if type(code) is str else type(code).__name__!r} are not read")
    return np.dtype(f"{order}{code}" if order in ("<", ">") else code)


def scalar_of(record: Record) -> NDArray[Any]:
    """The NumPy scalar that a record of one stands for; trackers count persons with them."""
    dtype, raw = record.args
    return np.frombuffer(bytes_of(raw), dtype_of(exactly(Record, dtype)), count=1).reshape(())


def is_plain(code: Any) -> bool:
    """Whether this is NumPy's short name of a plain type of numbers, such as `f4`."""
    return type(code) is str and re.fullmatch("[biuf][1248]", code) is not None


def _made(called: Any, args: tuple[Any, ...]) -> Any:
    """The result of calling a name."""
    if type(called) is Record:  # the result of a foreign call
        return Record("foreign", called.args if called.kind == "foreign" else ())
    kind = exactly(Name, called).kind
    if kind == "foreign":
        return Record(kind, (called.full,))
    if kind == "new":  # Python 2's way to make an object; its class is the first argument
        kind, args = exactly(Name, args[0]).kind, ()
    if kind == "mapping":
        return {}
    if kind == "new array":
        return Record("array")
    return args[0] if kind == "bytes" and args else Record(kind, args)


def _put(holder: Any, items: list[Any]) -> None:
    """Puts keys and values into a dictionary, or into a record that stands for one.

    Keys that are neither text nor whole numbers are left out: hashing one may never end.
    """
    target = holder.items if type(holder) is Record else exactly(dict, holder)
    for key, value in zip(items[::2], items[1::2], strict=True):
        name = scalar_of(key).item() if type(key) is Record and key.kind == "scalar" else key
        if isinstance(name, (str, int)):
            target[name] = value
