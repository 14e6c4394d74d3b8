"""Files of arrays, opened without executing anything in them: .npz, .npy, pickles of Python, joblib and torch."""

from __future__ import annotations

import bz2
import io
import lzma
import math
import re
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from refu_core._files import open_file
from refu_core._npz import DAMAGE, METHODS, ArrayBudget, check_npy, npz_names, open_archive, read_npz, told
from refu_core._pickle import PickledArrays
from refu_core._pickle_machine import MAX_PICKLE_BYTES, STREAM_MAGIC, Record, Unpickler, bytes_of, read_stream
from refu_core.errors import RefuError
from refu_core.recordings import _layouts as table
from refu_core.recordings._layouts import WANTED

Key = str | int
_ZIP, _NPY = b"PK\x03\x04", b"\x93NUMPY"
_UNPACKERS: dict[bytes, Callable[[], Any]] = {
    b"x": zlib.decompressobj,
    b"\x1f\x8b": lambda: zlib.decompressobj(wbits=31),
    b"BZh": bz2.BZ2Decompressor,
    b"\xfd7zXZ": lambda: lzma.LZMADecompressor(memlimit=_MOST_HELD),
}
"""Decompressors, by the bytes that compressed files begin with; gzip and joblib make such files."""
_MOST_NODES = 20_000
MOST_DEPTH = 5
"""Levels of nested values that are searched; trackers write three."""
_MOST_ITEMS = 2_000_000
"""Most items in a file's lists: a quarter of an hour of poses at 30 Hz."""
_MOST_COLUMNS = 64 << 20
"""Largest size of all columns together [bytes]: names of the images of 400,000 rows, 40 letters each."""
_MOST_HELD = 256 << 20
"""Largest size of a dictionary in an array, and of unpacked data [bytes]."""


class Content:
    """What a file holds: nested mappings, lists and arrays. Arrays are made when they are asked for."""

    def __init__(self, root: Any, storage: Callable[[str], bytes] | None = None) -> None:
        """`storage` returns the bytes that torch keeps beside its pickle, by their key."""
        self.root = root
        self._arrays, self._columns = PickledArrays(storage), PickledArrays(storage)
        self._left = _MOST_ITEMS
        self._made: dict[int, tuple[Any, NDArray[Any]]] = {}

    def array(self, value: Any) -> NDArray[Any]:
        """The array that a value stands for; a list of rows counts as one. Raises `ValueError` for anything else."""
        if id(value) in self._made:
            return self._made[id(value)][1]
        return self._array(value, 0)

    def _array(self, value: Any, depth: int) -> NDArray[Any]:
        if isinstance(value, np.ndarray):
            return value
        known = self._made.get(id(value))
        if _is_list(value):  # a shared list is converted once, but counts each time it is seen
            self._left -= len(value) if known is None else known[1].size
        if depth > MOST_DEPTH or self._left < 0:
            raise ValueError(f"lists of lists, more than {MOST_DEPTH} deep or of more than {_MOST_ITEMS} items")
        if known is not None:
            return known[1]
        try:
            if isinstance(value, (list, tuple)) and value and not all(type(item) in (int, float) for item in value):
                rows = [self._array(item, depth + 1) for item in value]
                shapes = sorted({row.shape for row in rows})
                if len(shapes) > 1:
                    raise ValueError(f"a list of arrays of several shapes: {', '.join(map(str, shapes[:4]))}")
                array = np.stack(rows)
            else:
                array = self._arrays.of(value)
        except DAMAGE as cause:
            raise ValueError(told(cause)) from cause
        self._made[id(value)] = value, array  # the value is kept, so that its id is never reused
        return array

    def shapes(self, node: Mapping[Key, Any], names: Sequence[str]) -> list[tuple[int, ...]]:
        """The shapes of a mapping's arrays of these names; empty where one of them is no array."""
        try:
            return [self.array(node[name]).shape for name in names]
        except ValueError:
            return []

    def column(self, value: Any) -> NDArray[Any] | None:
        """The array of numbers or words that a value stands for, of one axis or two; None for anything else.

        Has a budget of its own: pictures under a column's name leave the other arrays as much as before.
        """
        aside = Content(None)
        aside._arrays = self._columns
        try:
            array = aside.array(value)
        except ValueError:
            return None
        return array if 0 < array.ndim <= 2 and array.dtype.kind in "biufUS" else None

    def single(self, value: Any) -> int | str | None:
        """The whole number or word that a value stands for, NumPy's and torch's too; None for anything else."""
        if value is None or isinstance(value, (int, str)):
            return value
        try:
            array = self.array(value)
        except ValueError:
            return None
        item: int | str | None = (
            array.reshape(-1).tolist()[0] if array.size == 1 and array.dtype.kind in "iuU" else None
        )
        return item

    def nodes(self) -> Iterator[tuple[tuple[Key, ...], Mapping[Key, Any]]]:
        """Every mapping in the file and the path to it, from the outside inwards; a shared one comes once."""
        todo: list[tuple[tuple[Key, ...], Any]] = [((), self.root)]
        known: set[int] = set()
        for count, (path, value) in enumerate(todo):
            inside = entries(value)
            if inside is None or count > _MOST_NODES or id(value) in known:
                continue
            known.add(id(value))
            if not _is_list(value):
                yield path, inside
            if len(path) < MOST_DEPTH and len(todo) < _MOST_NODES:
                todo += [((*path, key), item) for key, item in inside.items() if entries(item) is not None]

    def changed(self, change: Callable[[Mapping[Key, Any]], Mapping[Key, Any]]) -> Content:
        """The same content with every mapping changed, and then the mappings in it; a shared one is changed once."""
        made: dict[int, Any] = {}

        def other(value: Any, depth: int) -> Any:
            inside = entries(value)
            if inside is None or depth > MOST_DEPTH:
                return value
            if id(value) not in made:
                made[id(value)] = value  # what holds itself stays as it is in there
                after = inside if _is_list(value) else change(inside)
                found = {key: other(item, depth + 1) for key, item in after.items()}
                made[id(value)] = list(found.values()) if _is_list(value) else found
            return made[id(value)]

        content = Content(other(self.root, 0))
        content._arrays, content._columns = self._arrays, self._columns
        return content


def _is_list(value: Any) -> bool:
    return isinstance(value, (list, tuple))


def entries(value: Any, depth: int = MOST_DEPTH) -> Mapping[Key, Any] | None:
    """The entries of a mapping, an object's attributes, or the items of a list of these; None for anything else.

    Lists may be in lists, so many levels deep.
    """
    value = held_by(value)
    if isinstance(value, dict):
        return value
    if isinstance(value, Record):
        state = value.items or value.state
        return state if value.kind == "foreign" and isinstance(state, dict) else None
    is_list = depth > 0 and _is_list(value) and value and isinstance(value[0], (dict, Record))
    return dict(enumerate(value)) if is_list and entries(value[0], depth - 1) is not None else None


def held_by(value: Any) -> Any:
    """What an array of objects holds, which is how NumPy saves a dictionary or a list; any other value is itself."""
    for _ in range(MOST_DEPTH):  # one that holds itself would never end
        state = value.state if isinstance(value, Record) and value.kind == "array" else None
        if not (isinstance(state, tuple) and len(state) == 5 and isinstance(state[4], list)):
            break
        value = state[4][0] if len(state[4]) == 1 else state[4]
    return value


def words_of(value: Any) -> Sequence[str]:
    """The words of a list, of an array of objects, or of an array of text in a pickle; empty for anything else.

    Raises `ValueError` for a damaged array.
    """
    if isinstance(value, Record) and value.kind in ("array", "buffer"):
        inside = value.args if value.kind == "buffer" else value.state
        if value.kind == "array" and isinstance(inside, tuple) and len(inside) == 5:
            inside = (inside[4], inside[2], inside[1])
        raw, kind, *_ = inside if isinstance(inside, tuple) and len(inside) > 2 else (None, None)
        value = raw
        code = kind.args[0] if isinstance(kind, Record) and kind.kind == "dtype" and kind.args else None
        if isinstance(code, str) and re.fullmatch("[US][1-9][0-9]{0,3}", code):
            try:
                value = np.frombuffer(bytes_of(raw)[:_MOST_COLUMNS], code).tolist()
            except DAMAGE as cause:
                raise ValueError(told(cause)) from cause
    if not _is_list(value) or not all(type(one) in (str, bytes) for one in value):
        return []
    return [one.decode("utf-8", "replace") if isinstance(one, bytes) else one for one in value]


def open_content(path: Path, *, error: type[RefuError]) -> Content:
    """Opens a file of any supported kind. Raises `error` for one that can't be read."""
    with open_file(path, most=1 << 32, error=error, wanted=WANTED) as file:
        magic = file.read(6)
    if path.suffix == ".npz" or magic.startswith(_ZIP):
        names = npz_names(path, error=error, wanted=WANTED)
        if any(name.endswith("data.pkl") for name in names):
            return _torch(path, error)
        return _npz(path, names, error)
    with open_file(path, most=MAX_PICKLE_BYTES, error=error, wanted=WANTED) as file:
        try:
            if magic == _NPY:
                return _npy(file, file.size)
            unpacker = next((made for start, made in _UNPACKERS.items() if magic.startswith(start)), None)
            # All at once: the unpickler reads byte by byte, which takes three times as long from a file.
            data = io.BytesIO(file.read() if unpacker is None else _unpacked(file.read(), unpacker()))
            root = Unpickler(data).load()
            if type(root) is int and root == STREAM_MAGIC:
                root, storage = read_stream(data)
                return Content(root, storage)
            return Content(root)
        except DAMAGE as cause:
            is_other = path.suffix and path.suffix.lower() not in table.SUFFIXES
            why = f"no file of motion is a {path.suffix}" if is_other else told(cause)
            hint = table.JSON_ADVICE if path.suffix.lower() == ".json" else ""
            raise error(f"{path}: can't be read: {why}; wanted {WANTED}{hint}") from cause


def _npz(path: Path, names: list[str], error: type[RefuError]) -> Content:
    wanted = {name for name in names if _steps(name)[-1] in table.ALL_KEYS}
    if not any(_steps(name)[-1] in table.POSE_KEYS for name in names):
        for name in names:  # a dictionary that NumPy has pickled into an array
            held = _object(path, name)
            if held is not None:
                return Content({**_arrays(path, wanted, error), name: held})
        wanted |= {name for name in names if table.spelled(_steps(name)[-1]).endswith(table.KNOWN_WORDS)}
    arrays = _arrays(path, wanted, error)
    root: dict[Key, Any] = dict.fromkeys(name for name in names if name not in arrays)
    for name, array in arrays.items():
        node = root
        *above, last = _steps(name)
        for step in above:
            inner = node.setdefault(step, {})
            node = inner if isinstance(inner, dict) else {}
        node[last] = array
    return Content(root)


def _arrays(path: Path, names: set[str], error: type[RefuError]) -> dict[str, NDArray[Any]]:
    """The arrays of these names; of those named like columns, only what is one. Raises `error` for damaged ones."""
    like = {name for name in names if table.spelled(_steps(name)[-1]).endswith(table.COLUMN_WORDS)}
    columns = _columns(path, like, error)
    # A gender that isn't one mustn't be overlooked.
    apart = {name for name in like if name in columns or _steps(name)[-1] not in table.GENDERS}
    return read_npz(path, keys=names - apart, error=error, wanted=WANTED) | columns


def _columns(path: Path, names: Collection[str], error: type[RefuError]) -> dict[str, NDArray[Any]]:
    columns: dict[str, NDArray[Any]] = {}
    left = _MOST_COLUMNS
    with open_archive(path, error, WANTED) as archive:
        for entry in archive.infolist():
            name = entry.filename.removesuffix(".npy")
            if name not in names or entry.compress_type not in METHODS or entry.file_size > left:
                continue
            left -= entry.file_size
            data = archive.read(entry)
            if b"'|O'" in data[:128]:
                continue
            shape, dtype = check_npy(io.BytesIO(data), len(data))
            if shape and max(shape) == math.prod(shape) and dtype.kind in "biufUS":
                columns[name] = npy.read_array(io.BytesIO(data), allow_pickle=False)
    return columns


def _steps(name: str) -> list[str]:
    """The parts of an array's name that contains groups, such as `smpl_params_global/body_pose`."""
    return [step for step in name.replace(".", "/").split("/") if step] or [name]


def _object(path: Path, name: str) -> Any:
    """The dictionary in an array of objects; None if the array holds anything else."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open(f"{name}.npy") as member:
            head = member.read(128)
            if b"'|O'" not in head:
                return None
            data = head + member.read(_MOST_HELD)
        return _npy(io.BytesIO(data), len(data)).root
    except DAMAGE:
        return None


def _npy(file: BinaryIO, size: int) -> Content:
    file.seek(0)
    version = npy.read_magic(file)
    _, _, dtype = (npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0)(file)
    if dtype.hasobject:
        return Content(Unpickler(file).load())
    file.seek(0)
    shape, dtype = check_npy(file, size)
    ArrayBudget().take(shape, dtype)
    file.seek(0)
    return Content(npy.read_array(file, allow_pickle=False))


def _unpacked(packed: bytes, unpacker: Any) -> bytes:
    """The unpacked data. Raises `ValueError` if it is cut short, or larger than `_MOST_HELD`."""
    unpacked: bytes = unpacker.decompress(packed, _MOST_HELD + 1)
    if not unpacker.eof or len(unpacked) > _MOST_HELD:
        raise ValueError(f"unpacks to more than {_MOST_HELD >> 20} MiB, or was cut short")
    return unpacked


def _torch(path: Path, error: type[RefuError]) -> Content:
    """A file of `torch.save`: an archive of a pickle and the numbers of each tensor."""

    def storage(key: str) -> bytes:
        with zipfile.ZipFile(path) as archive:
            return _member(archive, f"{folder}/data/{key}")

    try:
        with zipfile.ZipFile(path) as archive:
            name = next(name for name in archive.namelist() if name.endswith("data.pkl"))
            folder = name.rpartition("/")[0]
            tree = Unpickler(io.BytesIO(_member(archive, name))).load()
        return Content(tree, storage)
    except DAMAGE as cause:
        raise error(f"{path}: can't be read as a file of torch: {told(cause)}; wanted {WANTED}") from cause


def _member(archive: zipfile.ZipFile, name: str) -> bytes:
    entry = archive.getinfo(name)
    if entry.compress_type != zipfile.ZIP_STORED or entry.file_size > MAX_PICKLE_BYTES:
        raise ValueError(f"{name} is compressed, or has {entry.file_size >> 20} MiB")
    return archive.read(entry)
