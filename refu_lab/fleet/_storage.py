"""Where results are kept: a folder on this machine or, through fsspec, any other that a URL names.

A result is written elsewhere first and then put into its place in one step (a folder at a URL file by file): a reader,
or a run that resumes this one, finds all of it or nothing.
"""

from __future__ import annotations

import shutil
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from refu_core import RefuError
from refu_core._files import exclusive, parse_json

SCRATCH = ".partial"
"""Name of the folder for unfinished results."""


def is_url(text: str) -> bool:
    """Whether a text has a protocol, such as s3:// or gs://."""
    return "://" in text


def filesystem(place: str) -> tuple[Any, str]:
    """fsspec's file system for a path or URL, and the path in it. Raises `RefuError` for an unknown protocol."""
    import fsspec

    try:
        fs, path = fsspec.url_to_fs(place)
    except (ImportError, ValueError) as error:
        raise RefuError(f"{place}: {error}") from error
    return fs, str(path)


@contextmanager
def fetched(source: str) -> Iterator[Path]:
    """A file or folder as a path on this machine. Raises `RefuError` if a URL can't be read."""
    if not is_url(source):
        yield Path(source)
        return
    fs, path = filesystem(source)
    with tempfile.TemporaryDirectory(prefix="refu-") as folder:
        here = Path(folder) / path.rstrip("/").rsplit("/", maxsplit=1)[-1]
        try:
            is_folder = fs.isdir(path)
            if any(".." in name.split("/") for name in (fs.find(path) if is_folder else [path])):
                raise RefuError(
                    f"{source}: wanted names without '..', which lead out of a folder: rename what has them"
                )
            fs.get(path, str(here), recursive=is_folder)
        except OSError as error:
            raise RefuError(f"{source}: can't be read: {error}") from error
        yield here


@dataclass(frozen=True)
class Folder:
    """A folder by path or URL. Raises `RefuError` for whatever can't be written."""

    place: str

    def at(self, name: str) -> str:
        return f"{self.place.rstrip('/')}/{name}"

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """An empty folder on this machine, deleted with its content when the block ends.

        What is in it is called as it will be in its place, which errors name instead.
        """
        with self._errors():
            if is_url(self.place):
                own = Path(tempfile.mkdtemp(prefix="refu-"))
            else:
                own = Path(self.place) / SCRATCH / uuid.uuid4().hex
                own.mkdir(parents=True)
        try:
            yield own
        except RefuError as error:
            if is_url(self.place):  # the disk of this machine is at fault
                raise
            raise type(error)(str(error).replace(str(own), self.place.rstrip("/"))) from error
        finally:
            shutil.rmtree(own, ignore_errors=True)

    def put(self, path: Path, name: str) -> None:
        """Moves a file or folder from `scratch` into its place, replacing what was there."""
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
        with self.scratch() as folder:
            file = folder / "text"
            file.write_text(text, encoding="utf-8", errors="backslashreplace")
            self.put(file, name)

    def read_json(self, name: str) -> Any:
        """Reads plain values; None if the file is missing or can't be read."""
        fs, path = filesystem(self.at(name))
        try:
            return parse_json(fs.cat_file(path))
        except (OSError, ValueError, RecursionError):
            return None

    def start(self, name: str) -> bytes | None:
        """The first 64 bytes of a file; None if it doesn't exist, empty if it can't be read."""
        fs, path = filesystem(self.at(name))
        try:
            return bytes(fs.cat_file(path, 0, 64))
        except FileNotFoundError:
            return None
        except OSError:
            return b""

    def size(self, name: str) -> int | None:
        """Size of a file [bytes]; None if it doesn't exist."""
        fs, path = filesystem(self.at(name))
        try:
            return int(fs.size(path))
        except OSError:
            return None

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keeps other runs out of a folder on this machine; the lock ends with the process, however that ends.

        Afterwards, unfinished results are removed, including those of runs that were killed.
        """
        if is_url(self.place):
            yield
            return
        folder = Path(self.place)
        msg = f"{self.place}: another run writes into this folder; wait for it, or give another one"
        with ExitStack() as stack:
            with self._errors():
                folder.mkdir(parents=True, exist_ok=True)
                stack.enter_context(exclusive(folder / ".lock", error=RefuError(msg)))
            try:
                yield
            finally:
                shutil.rmtree(folder / SCRATCH, ignore_errors=True)

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise RefuError(f"{self.place}: can't be written: {error.strerror or error}") from error
