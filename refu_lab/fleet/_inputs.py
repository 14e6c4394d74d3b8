"""Recordings by file, folder, glob and URL."""

from __future__ import annotations

import glob
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from msg_adapters import BAG_SUFFIXES
from refu_core import RefuError
from refu_core.recordings import SUFFIXES as MOTION_SUFFIXES
from refu_lab.fleet._storage import filesystem, is_url

SUFFIXES = (*BAG_SUFFIXES, *MOTION_SUFFIXES)
"""Of recordings that a folder is searched for."""
_METADATA = "metadata.yaml"
_MAGIC = re.compile(r"[*?\[]")
_SPLIT = re.compile(r"(.+)_\d+")


@dataclass(frozen=True)
class Input:
    """A bag or a file of motion."""

    source: str
    """A path or a URL."""
    name: str
    """What its results are called: a relative path without a suffix, with slashes; no other one has it."""


def is_plain(inputs: Sequence[str]) -> bool:
    """Whether this is one recording on this machine, named as it is."""
    if len(inputs) != 1 or is_url(inputs[0]):
        return False
    path = Path(inputs[0])
    if path.is_dir():
        return list(_walk(inputs[0])) == [inputs[0].rstrip("/")] or not any(_walk(inputs[0]))
    return not _MAGIC.search(inputs[0]) or path.exists()


def find_recordings(inputs: Sequence[str]) -> list[Input]:
    """The recordings that paths, folders, globs (with **) and URLs stand for, each once, sorted within each of them.

    A folder with `metadata.yaml`, or with files FOLDER_0, FOLDER_1, … alone, is one rosbag2 bag; any other is searched.

    Raises `RefuError` where one stands for nothing.
    """
    sources: dict[str, None] = {}
    for text in inputs:
        found = list(_find(text))
        if not found:
            msg = f"{text}: no recording there; wanted bags or motions ({', '.join(SUFFIXES)}, rosbag2 folders)"
            raise RefuError(msg)
        sources |= dict.fromkeys(found)
    return list(_named(sources))


def find_data_sets(inputs: Sequence[str]) -> list[Path]:
    """Data sets of `refu simulate`: folders as they are, globs, and folders of data sets.

    Raises `RefuError` for a glob that nothing matches.
    """
    found: list[Path] = []
    for text in inputs:
        is_glob = _MAGIC.search(text) and not Path(text).exists()
        paths = [Path(match) for match in sorted(glob.glob(text))] if is_glob else [Path(text)]  # noqa: PTH207
        if not paths:
            msg = f"{text}: nothing there; wanted folders of data sets"
            raise RefuError(msg)
        for path in paths:
            inner = sorted(card.parent for card in path.glob("*/card.json")) if path.is_dir() else []
            found += [path] if (path / "card.json").exists() or not inner else inner
    return found


def _find(text: str) -> Iterator[str]:
    if is_url(text):
        yield from _find_remote(text)
    elif _MAGIC.search(text) and not Path(text).exists():
        for match in sorted(glob.glob(text, recursive=True)):  # noqa: PTH207  (patterns are of the user, from anywhere)
            yield from _walk(match) if Path(match).is_dir() else [match]
    elif Path(text).is_dir():
        yield from _walk(text)
    elif Path(text).exists():
        yield text


def _walk(folder: str) -> Iterator[str]:
    """Recordings in a folder; itself where it is one."""
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        mine, is_bag = _of_folder(Path(place).absolute().name, files)
        if is_bag:
            folders.clear()
            yield place.rstrip("/")
        else:
            yield from (str(Path(place) / name) for name in mine)


def _of_folder(folder: str, files: Iterable[str]) -> tuple[list[str], bool]:
    """Names of a folder's recordings, and whether they are one bag."""
    mine = sorted(name for name in files if name.endswith(SUFFIXES) and not name.startswith("."))
    if _METADATA in files:
        return mine, True
    stems = [_SPLIT.fullmatch(Path(name).stem) if name.endswith(BAG_SUFFIXES) else None for name in mine]
    return mine, bool(mine) and all(stem is not None and stem[1] == folder for stem in stems)


def _find_remote(url: str) -> Iterator[str]:
    fs, path = filesystem(url)
    full: Any = fs.unstrip_protocol
    try:
        for match in sorted(map(str, fs.glob(path))) if _MAGIC.search(path) else [path]:
            if not fs.isdir(match):
                yield full(match)
                continue
            bags: list[str] = []
            for place, _, files in sorted(fs.walk(match), key=lambda step: str(step[0])):
                if any(place == bag or place.startswith(f"{bag}/") for bag in bags):
                    continue
                mine, is_bag = _of_folder(PurePosixPath(place).name, list(files))
                bags += [place] if is_bag else []
                yield from [full(place)] if is_bag else [full(f"{place}/{name}") for name in mine]
    except OSError as error:
        msg = f"{url}: can't be listed: {error}"
        raise RefuError(msg) from error


def _named(sources: Iterable[str]) -> Iterator[Input]:
    """With what distinguishes their paths as names."""
    paths = {
        source: PurePosixPath(source.partition("://")[2] if is_url(source) else str(Path(source).absolute()))
        for source in sources
    }
    shared = (
        os.path.commonpath([path.parent for path in paths.values()])
        if len({p.is_absolute() for p in paths.values()}) == 1
        else ""
    )
    short = {}
    for source, path in paths.items():
        relative = path.relative_to(shared) if shared else PurePosixPath(*[part for part in path.parts if part != "/"])
        short[source] = relative
    bare = {s: r.with_suffix("") if r.suffix in SUFFIXES else r for s, r in short.items()}
    count = Counter(bare.values())
    for source in sources:
        name = bare[source] if count[bare[source]] == 1 else short[source]
        yield Input(source, name.as_posix())
