"""Where results are kept: a folder of this machine or, by fsspec, any other that a URL names.

A result is written elsewhere first and then put into its place in one step: a reader, or a run that goes on where this
one was ended, finds all of it or nothing.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from refu_core import RefuError
from refu_core._files import exclusive, parse_json

SCRATCH = ".partial"
"""Folder of what isn't finished."""


def is_url(text: str) -> bool:
    """Whether a text names a place by protocol, s3:// or gs:// say."""
    return "://" in text


def filesystem(place: str) -> tuple[Any, str]:
    """fsspec's file system of a path or URL, and the path in it. Raises `RefuError` for a protocol that isn't there."""
    import fsspec

    try:
        fs, path = fsspec.url_to_fs(place)
    except (ImportError, ValueError) as error:
        msg = f"{place}: {error}"
        raise RefuError(msg) from error
    return fs, str(path)


@contextmanager
def fetched(source: str) -> Iterator[Path]:
    """A file or folder, on this machine. Raises `RefuError` where a URL can't be read."""
    if not is_url(source):
        yield Path(source)
        return
    fs, path = filesystem(source)
    with tempfile.TemporaryDirectory(prefix="refu-") as folder:
        here = Path(folder) / path.rstrip("/").rsplit("/", maxsplit=1)[-1]
        try:
            fs.get(path, str(here), recursive=fs.isdir(path))
        except OSError as error:
            msg = f"{source}: can't be read: {error}"
            raise RefuError(msg) from error
        yield here


@dataclass(frozen=True)
class Folder:
    """A folder by path or URL. Whatever can't be read or written raises `RefuError`."""

    place: str

    def at(self, name: str) -> str:
        """Path or URL of what is called so in it."""
        return f"{self.place.rstrip('/')}/{name}"

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """An empty folder of this machine; what is left in it when the block is left is gone."""
        with self._errors():
            if is_url(self.place):
                own = Path(tempfile.mkdtemp(prefix="refu-"))
            else:
                own = Path(self.place) / SCRATCH / uuid.uuid4().hex
                own.mkdir(parents=True)
        try:
            yield own
        finally:
            shutil.rmtree(own, ignore_errors=True)

    def put(self, path: Path, name: str) -> None:
        """Puts a file or folder of `scratch` into its place; what was there is replaced."""
        with self._errors():
            if is_url(self.place):
                fs, there = filesystem(self.at(name))
                fs.makedirs(fs._parent(there), exist_ok=True)
                if path.is_dir():
                    fs.put(f"{path}/", f"{there}/", recursive=True)
                else:
                    fs.put_file(str(path), there)
                return
            place = Path(self.at(name))
            place.parent.mkdir(parents=True, exist_ok=True)
            if path.is_dir() and place.exists():  # a folder can't replace a full one in one step
                place.rename(path.with_name(f"{path.name}.old"))
            path.replace(place)

    def put_text(self, text: str, name: str) -> None:
        """Writes a file."""
        with self.scratch() as folder:
            file = folder / "text"
            file.write_text(text, encoding="utf-8")
            self.put(file, name)

    def put_json(self, content: Any, name: str) -> None:
        """Writes plain values."""
        self.put_text(json.dumps(content, indent=1, allow_nan=False) + "\n", name)

    def read_json(self, name: str) -> Any:
        """Plain values; None where there are none, or they can't be read."""
        fs, path = filesystem(self.at(name))
        try:
            return parse_json(fs.cat_file(path))
        except (OSError, ValueError, RecursionError):
            return None

    def start(self, name: str) -> bytes | None:
        """The first 64 bytes of a file; None where there is none."""
        fs, path = filesystem(self.at(name))
        try:
            return bytes(fs.cat_file(path, 0, 64))
        except FileNotFoundError:
            return None
        except OSError:
            return b""

    def size(self, name: str) -> int | None:
        """Of a file [bytes]; None where there is none."""
        fs, path = filesystem(self.at(name))
        try:
            return int(fs.size(path))
        except OSError:
            return None

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keeps other runs out, of this machine's folders; the lock goes with the process, however that ends.

        Afterwards what runs that were killed have left unfinished is removed.
        """
        if is_url(self.place):
            yield
            return
        folder = Path(self.place)
        msg = f"{self.place}: another run writes into this folder; wait for it, or give another one"
        with contextlib.ExitStack() as stack:
            with self._errors():
                folder.mkdir(parents=True, exist_ok=True)
                stack.enter_context(exclusive(folder / ".lock", error=RefuError(msg)))
            try:
                yield
            finally:
                shutil.rmtree(folder / SCRATCH, ignore_errors=True)
        with contextlib.suppress(OSError):
            os.unlink(folder / ".lock")  # noqa: PTH108

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            msg = f"{self.place}: can't be written: {error.strerror or error}"
            raise RefuError(msg) from error
