"""The one place where input files are opened: only regular files, and no more of each than was asked for.

A FIFO would keep its reader waiting for ever; a device has no end, and opening one may already have an effect. Files
are also replaced here, whole or not at all.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import stat
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from refu_core.errors import RefuError

MAX_JSON_BYTES = 4 << 20
"""The most that a card or a table may take; parsed, it may take a hundred times as much."""
_KINDS = {
    stat.S_IFDIR: "a directory",
    stat.S_IFIFO: "a FIFO",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def keep_streams() -> None:
    """Has standard output and error lead nowhere if they are closed, at the start of a program.

    Else the next file that is opened, a bag perhaps, would get their number, and whatever is written to them.
    """
    for number, name in ((1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:
            os.dup2(os.open(os.devnull, os.O_RDWR), number)
            setattr(sys, name, os.fdopen(number, "w"))


def expanded(path: str) -> str:
    """The path with a home in place of `~` or `~user`; as it is where there is no such user."""
    try:
        return os.path.expanduser(path)  # noqa: PTH111 - Path's raises, and takes the `./` off a file called ~x
    except ValueError:  # a user whose name no system takes
        return path


class _Sized(io.FileIO):
    """A file that ends at its size when it was opened, even if it grows."""

    size = 0

    def readinto(self, buffer: Any, /) -> int | None:
        """Fills the buffer, up to the file's end."""
        return super().readinto(memoryview(buffer)[: max(0, self.size - self.tell())])


class InputFile(io.BufferedReader):
    """A file of `size` bytes: no more than that is read even if it grows, and no memory is reserved for more."""

    def __init__(self, raw: _Sized, size: int) -> None:
        super().__init__(raw)
        self.size = raw.size = size
        self.step = size
        """The most that one `read` returns [bytes]; to a caller that asks for more, the file seems to be cut short."""

    def read(self, size: int | None = -1, /) -> bytes:
        """At most `size` bytes."""
        if size is not None and 0 <= size <= _SHORT:  # a pickle has a million reads of one byte
            return super().read(size)
        most = max(0, min(self.size - self.tell(), self.step))
        return super().read(most if size is None or size < 0 else min(size, most))


_SHORT = 256
"""A read of so few bytes reserves next to no memory [bytes]."""


def open_file(path: str | os.PathLike[str], *, most: int, error: type[RefuError], wanted: str) -> InputFile:
    """Opens a regular file of 1 to `most` bytes, or a link to one, for reading; `wanted` says what it should be.

    Raises `error` if there is no such file, or it isn't a regular one, is empty (as files in /proc claim to be), is too
    large, or can't be opened.
    """
    try:
        got = _fault(Path(path).stat(), most)
        if not got:
            # Another file may have taken its place by now, so the opened one is checked again; opening it can't block.
            raw = _Sized(path, opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK | os.O_NOCTTY))
            found = os.fstat(raw.fileno())
            got = _fault(found, most)
            if not got:
                return InputFile(raw, found.st_size)
            raw.close()
    except (OSError, ValueError) as cause:  # ValueError: a name that no file system takes
        got = getattr(cause, "strerror", None) or str(cause)
    raise error(f"{os.fspath(path)}: can't be read: {got}; wanted {wanted}")


def read_file(path: str | os.PathLike[str], *, most: int, error: type[RefuError], wanted: str) -> bytes:
    """The content of a regular file, as `open_file` opens it."""
    with open_file(path, most=most, error=error, wanted=wanted) as file:
        try:
            return file.read()
        except OSError as cause:
            raise error(f"{os.fspath(path)}: can't be read: {cause.strerror}; wanted {wanted}") from cause


def read_json(path: str | os.PathLike[str], *, error: type[RefuError], wanted: str) -> Any:
    """The content of a JSON file of finite numbers. Raises `error` as `open_file` does, and if it isn't such a file."""
    content = read_file(path, most=MAX_JSON_BYTES, error=error, wanted=wanted)
    try:
        return parse_json(content)
    except (ValueError, RecursionError) as cause:
        raise error(f"{os.fspath(path)}: can't be read as JSON: {cause}; wanted {wanted}") from cause


def parse_json(text: bytes) -> Any:
    """Parses JSON of finite numbers. Raises `ValueError` for anything else, `RecursionError` if nested too deeply."""
    return json.loads(text, parse_float=_finite, parse_constant=_finite)


def check_no_dead_link(folder: Path, *, error: type[RefuError]) -> None:
    """Raises `error` for a link that leads nowhere, as to a disk that isn't mounted: `mkdir` says "File exists"."""
    if folder.is_symlink() and not folder.exists():
        raise error(f"{folder}: a link to {folder.readlink()}, which isn't there; mount its disk or name another place")


@contextlib.contextmanager
def replacing(path: Path, *, sync: bool = False) -> Iterator[BinaryIO]:
    """A file to write to, which replaces `path` in one step once it is complete; with `sync`, once it is on the disk.

    After an error, an `OSError` of the system for instance, `path` is what it was before.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}")
    try:
        with part.open("wb") as file:
            yield file
            if sync:
                file.flush()
                os.fsync(file.fileno())
        part.replace(path)
    finally:
        with contextlib.suppress(OSError):
            part.unlink()


def write_file(path: Path, content: bytes | memoryview, *, error: type[RefuError], what: str = "the file") -> None:
    """Writes a file as `replacing` does, onto the disk, in a folder that is made if it isn't there.

    Raises `error`, which says `what` it is, if it can't be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path, sync=True) as file:
            file.write(content)
    except OSError as cause:
        raise error(f"{path}: {what} can't be written: {cause.strerror or cause}") from cause


@contextlib.contextmanager
def exclusive(path: Path, *, error: RefuError) -> Iterator[None]:
    """Holds a lock file, and removes it at the end. The lock is released when the process ends, however it ends.

    Raises `error` when another process has it, `OSError` when the file can't be written.
    """
    import fcntl

    with contextlib.ExitStack() as stack:
        while True:
            file = stack.enter_context(path.open("w"))
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as cause:
                raise error from cause
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(path.stat(), os.fstat(file.fileno())):
                    break
            # Its last holder removed the file after it was opened here: another one may be there by now.
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                path.unlink()


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text[:40]} where a finite number was expected")
    return number


def _fault(found: os.stat_result, most: int) -> str:
    """What is wrong with a file, empty if nothing is."""
    if not stat.S_ISREG(found.st_mode):
        return _KINDS.get(stat.S_IFMT(found.st_mode), "not a regular file")
    if not found.st_size:
        return "an empty file"
    if found.st_size > most:
        return f"{found.st_size >> 20} MiB, at most {most >> 20} MiB are read"
    return ""
