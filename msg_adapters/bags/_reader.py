"""Reading bags as a stream: an `.mcap` or `.db3` file or a rosbag2 directory, whole or cut short."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from msg_adapters.bags._mcap import (
    MAGIC,
    WANTED_FILE,
    ZSTD_MAGIC,
    Budget,
    DamageError,
    McapFile,
    open_bag_file,
    unpack_message,
)
from msg_adapters.bags._metadata import MAX_TIME_NS, METADATA_FILE, TopicInfo, read_file_paths
from msg_adapters.bags._sqlite import MAGIC as SQLITE_MAGIC
from msg_adapters.bags._sqlite import SqliteFile
from msg_adapters.errors import BagError
from refu_core.errors import printable

BAG_SUFFIXES = (".mcap", ".db3")
_MAX_WARNINGS = 20
_FOREIGN = {
    b"#ROSBAG": "convert it with `rosbags-convert`",
    ZSTD_MAGIC: "unpack it with `zstd -d`",
    b"\x1f\x8b": "unpack it with `gunzip`",
    b"version https://": "Git LFS holds its content: fetch it with `git lfs pull`",
}
"""What to do with other files, by their first bytes."""


@dataclass(frozen=True)
class BagMessage:
    """A serialised message."""

    topic: str
    message_type: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes


class BagReader:
    """Streams a bag, one chunk in memory at a time.

    A file without its closing records (a recorder that was killed) and damaged chunks aren't errors: what can be read
    is read, and `truncated` and `warnings` say what couldn't be. Nor are files of a directory that aren't there or
    can't be read, as long as one can. The cost of a pass is bounded by the bag's size; see `_mcap.Budget`.

    Raises `BagError` when there is no such bag, or it is neither MCAP nor rosbag2's SQLite.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.truncated = False
        """Whether something couldn't be read; final when `messages` is exhausted."""
        self._notes: list[str] = []
        self._damages: dict[tuple[Path, str], str] = {}
        """The first damage of each kind in each file, in the last pass."""
        self._n_damages: Counter[tuple[Path, str]] = Counter()
        self._claimed = False
        """Whether message counts were taken from a summary."""
        self._size = 0
        self._files: list[McapFile | SqliteFile] = []
        errors = []
        for path in self._find_files():
            try:
                self._files.append(self._open(path))
            except BagError as error:  # noqa: PERF203 - a file is missing, or empty after a power cut: others hold most
                errors.append(error)
        if not self._files:
            raise errors[0]
        self._notes += [printable(f"left out: {error}") for error in errors[:_MAX_WARNINGS]]
        self.truncated = bool(errors)
        self._topics: tuple[TopicInfo, ...] | None = None

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is open between calls."""

    @property
    def warnings(self) -> list[str]:
        """What the last pass couldn't read: a line for each kind of damage in a file, with how often it occurs."""
        lines = [
            first if (n := self._n_damages[key]) == 1 else f"{first} (and {n - 1} more like it)"
            for key, first in self._damages.items()
        ]
        more = len(lines) - _MAX_WARNINGS
        return self._notes + lines[:_MAX_WARNINGS] + ([f"{self.path}: {more} warnings more"] if more > 0 else [])

    def _find_files(self) -> list[Path]:
        if not os.path.isdir(self.path):  # noqa: PTH112 - whatever the name is, this answers
            return [self.path]
        if os.path.lexists(self.path / METADATA_FILE):
            files = read_file_paths(self.path)
            with suppress(OSError):
                others = sorted(one.name for one in {*filter(_is_of_bag, self.path.iterdir())} - {*files})
                if others:
                    named = f"{others[0]}{f' and {len(others) - 1} more' * (len(others) > 1)}"
                    self._notes.append(printable(f"{self.path}: {METADATA_FILE} doesn't list {named}: not read"))
        else:
            try:
                files = sorted(filter(_is_of_bag, self.path.iterdir()), key=_by_number)
            except OSError as error:
                raise BagError(f"{self.path}: can't be read: {error.strerror}") from error
            missing = f"no {METADATA_FILE} (was the recording interrupted?); its files are read by name"
            self._notes.append(f"{self.path}: {missing}")
        if not files:
            raise BagError(f"{self.path}: no {' or '.join(BAG_SUFFIXES)} file in this directory; wanted {WANTED_FILE}")
        return files

    def _open(self, path: Path) -> McapFile | SqliteFile:
        file, start = open_bag_file(path)
        with file:
            self._size += os.fstat(file.fileno()).st_size
        report = partial(self._report, path)
        if start.startswith(SQLITE_MAGIC):
            return SqliteFile(path, report)
        if start.startswith(MAGIC):
            return McapFile(path, report)
        hint = next((hint for magic, hint in _FOREIGN.items() if start.startswith(magic)), f"wanted {WANTED_FILE}")
        wanted = "SQLite" if path.suffix == ".db3" else "MCAP"
        raise BagError(f"{path}: not an {wanted} file; {hint}")

    def _report(self, path: Path, damage: DamageError) -> None:
        self.truncated = True
        key = path, damage.template
        self._n_damages[key] += 1
        if key not in self._damages:
            self._damages[key] = printable(f"{path}: damaged: {damage}")

    def _begin(self) -> Budget:
        self._damages.clear()
        self._n_damages.clear()
        return Budget(self._size)

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """The bag's topics by name, with message counts: from the summaries, or by reading the bag."""
        if self._topics is None:
            self._topics = self._merge_topics(by_reading=False)
            if not any(topic.message_count for topic in self._topics):
                return self.count()
        return self._topics

    def count(self) -> tuple[TopicInfo, ...]:
        """The topics with message counts found by reading the bag, whatever the summaries claim."""
        if self._topics is None or self._claimed:
            self._topics = self._merge_topics(by_reading=True)
        return self._topics

    def _merge_topics(self, *, by_reading: bool) -> tuple[TopicInfo, ...]:
        """The topics, with channels of the same topic (two publishers, or two files) merged into one."""
        budget = self._begin()
        self._claimed = False
        merged: dict[str, TopicInfo] = {}
        for file in self._files:
            topics, claimed = file.topics(budget, by_reading=by_reading)
            self._claimed |= claimed
            for topic, count in topics:
                known = merged.get(topic.name, topic)
                read = known if known.encoding == "cdr" else topic  # a JSON channel may be declared before it
                merged[topic.name] = replace(read, message_count=known.message_count + count)
        return tuple(merged[name] for name in sorted(merged))

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """The messages of some topics (None: all topics), in the order they were recorded.

        Raises `BagError` when a file can't be read any more, or a chunk's compression isn't installed.
        """
        budget = self._begin()
        for file in self._files:
            for topic, log_ns, publish_ns, data in file.messages(budget):
                if not 0 <= log_ns <= MAX_TIME_NS:
                    file.report(DamageError("a message on {} at a time that ROS can't hold", topic.name))
                elif topics is None or topic.name in topics:
                    try:
                        whole = unpack_message(data, budget) if topic.encoding == "cdr" else data
                    except DamageError as damage:
                        file.report(damage)
                        continue
                    sent_ns = publish_ns if publish_ns <= MAX_TIME_NS else log_ns  # often never set by its recorder
                    yield BagMessage(topic.name, topic.message_type, log_ns, sent_ns, bytes(whole))


def _is_of_bag(path: Path) -> bool:
    return Path(path.name.removesuffix(".zstd")).suffix in BAG_SUFFIXES


def _by_number(path: Path) -> list[Any]:
    """Orders bag_2.mcap before bag_10.mcap, as they were recorded."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)]
