"""Finds recordings by file, folder, glob and URL."""

from __future__ import annotations

import glob
import os
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from msg_adapters import BAG_SUFFIXES
from refu_core import RefuError
from refu_core.recordings import SUFFIXES as MOTION_SUFFIXES
from refu_core.recordings import is_named_as_motion
from refu_lab.fleet._storage import filesystem, is_url

SUFFIXES = (*BAG_SUFFIXES, *MOTION_SUFFIXES)
_METADATA = "metadata.yaml"
_MAGIC = re.compile(r"[*?\[]")
_SPLIT = re.compile(r"(.+)_\d+")


@dataclass(frozen=True)
class Input:
    """A bag or a file of motion."""

    source: str
    """A path or a URL."""
    name: str
    """Unique name of its results: a relative path with slashes, without a suffix unless names would be equal, or one
    the folder of another: reports are folders."""


def is_plain(inputs: Sequence[str]) -> bool:
    """Whether this is the plain path of a single recording on this machine."""
    if len(inputs) != 1 or is_url(inputs[0]):
        return False
    path = Path(inputs[0])
    if path.is_dir():
        return list(_find(inputs[0])) in ([], [str(path)])
    return not _MAGIC.search(inputs[0]) or path.exists()


def find_recordings(inputs: Sequence[str], *, results: Sequence[str | None] = ()) -> list[Input]:
    """The recordings that paths, folders, globs (with **) and URLs stand for, each once, sorted within each of them.

    A folder with `metadata.yaml`, or whose recordings are all called FOLDER_0, FOLDER_1, …, is one rosbag2 bag; any
    other is searched. Whatever is in the folders or URLs of `results` is left out.

    Raises `RefuError` if one of `inputs` stands for nothing.
    """
    sources: dict[str, str] = {}
    written = tuple(f"{_whole(place)}/" for place in results if place is not None)
    for text in inputs:
        found = [source for source in _find(text) if not written or not f"{_whole(source)}/".startswith(written)]
        if not found:
            where = " beside the results" if written else ""
            raise RefuError(f"{text}: no recording there{where}; wanted {', '.join(SUFFIXES)} or rosbag2 folders")
        for source in found:
            sources.setdefault(source if is_url(source) else str(_place(source)), source)
    return list(_named(sources.values()))


def find_data_sets(inputs: Sequence[str]) -> list[Path]:
    """Data sets of `refu simulate`, given as their folders, as globs, and as folders of data sets.

    Raises `RefuError` for a glob that nothing matches.
    """
    found: list[Path] = []
    for text in inputs:
        is_glob = _MAGIC.search(text) and not Path(text).exists()
        paths = [Path(match) for match in sorted(glob.glob(text))] if is_glob else [Path(text)]  # noqa: PTH207
        if not paths:
            raise RefuError(f"{text}: nothing there; wanted folders of data sets")
        for path in paths:
            inner = sorted(card.parent for card in path.glob("*/card.json")) if path.is_dir() else []
            found += [path] if (path / "card.json").exists() or not inner else inner
    return found


def _whole(place: str) -> str:
    """A path or URL as a full URL, with links resolved."""
    fs, path = filesystem(place if is_url(place) else os.path.realpath(place))
    return str(fs.unstrip_protocol(path)).rstrip("/")


def _find(text: str) -> Iterator[str]:
    if is_url(text):
        fs, path = filesystem(text)
        try:
            for match in sorted(map(str, fs.glob(path))) if _MAGIC.search(path) else [path]:
                yield from map(fs.unstrip_protocol, _walk(fs.walk(match), match) if fs.isdir(match) else [match])
        except OSError as error:
            raise RefuError(f"{text}: can't be listed: {error}") from error
        return
    is_glob = _MAGIC.search(text) and not Path(text).exists()
    for match in sorted(glob.glob(text, recursive=True)) if is_glob else [text]:  # noqa: PTH207  (from anywhere)
        if Path(match).is_dir():
            yield from _walk(os.walk(match), match)
        elif Path(match).exists():
            yield match


def _walk(steps: Iterable[tuple[str, Any, Iterable[str]]], folder: str) -> Iterator[str]:
    """Recordings in a folder, from the steps of `os.walk`; the folder itself if it is a bag."""
    bags: list[PurePosixPath] = []
    for place, files in sorted((PurePosixPath(place), [*files]) for place, _, files in steps):
        is_hidden = any(part.startswith(".") for part in place.relative_to(folder).parts)
        if is_hidden or any(bag in place.parents for bag in bags):
            continue
        mine = sorted(filter(_is_recording, files))
        stems = [_SPLIT.fullmatch(Path(name).stem) if name.endswith(BAG_SUFFIXES) else None for name in mine]
        of_one = [stem is not None and stem[1] == Path(place).absolute().name for stem in stems]
        if _METADATA in files or (mine and all(of_one)):
            bags.append(place)
            yield str(place)
        else:
            yield from (str(place / name) for name in mine)


def _is_recording(name: str) -> bool:
    return is_named_as_motion(name) or (name.endswith(BAG_SUFFIXES) and not name.startswith("."))


def _place(source: str) -> PurePosixPath:
    """Where a recording is, without `..`: results would be written outside of their folder. Raises `RefuError`."""
    if not is_url(source):  # a link in it may lead elsewhere: only the system knows what is above that
        path = Path(source).absolute()
        return PurePosixPath(path if ".." not in path.parts else Path(os.path.realpath(path.parent), path.name))
    place = PurePosixPath(source.partition("://")[2])
    if ".." in place.parts:
        raise RefuError(f"{source}: wanted a name without '..', which leads out of a folder: rename it")
    return place


def _named(sources: Collection[str]) -> Iterator[Input]:
    """The inputs, named by what distinguishes their paths."""
    paths = {source: _place(source) for source in sources}
    one_root = len({path.is_absolute() for path in paths.values()}) == 1
    shared = os.path.commonpath([path.parent for path in paths.values()]) if one_root else ""
    short = {
        source: path.relative_to(shared) if shared else PurePosixPath(*[part for part in path.parts if part != "/"])
        for source, path in paths.items()
    }
    in_stores = Counter(paths.values())
    for source, path in paths.items():
        if in_stores[path] > 1 and is_url(source):
            short[source] = PurePosixPath(f"{source.partition('://')[0]}:", short[source])
    bare = {s: r.with_suffix("") if r.suffix.lower() in SUFFIXES else r for s, r in short.items()}
    count = Counter(place for name in bare.values() for place in (name, *name.parents))
    for source in sources:
        name = bare[source] if count[bare[source]] == 1 else short[source]
        yield Input(source, name.as_posix())
