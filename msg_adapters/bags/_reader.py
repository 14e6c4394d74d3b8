"""Reading bags as a stream: an `.mcap` or `.db3` file or a rosbag2 directory, whole or cut short."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from msg_adapters.bags import _mcap
from msg_adapters.bags._metadata import MAX_TIME_NS, METADATA_FILE, TopicInfo, read_file_paths
from msg_adapters.bags._sqlite import MAGIC as SQLITE_MAGIC
from msg_adapters.bags._sqlite import SqliteFile
from msg_adapters.cdr import Buffer
from msg_adapters.errors import BagError
from refu_core.errors import printable

BAG_SUFFIXES = (".mcap", ".db3")
_MAX_WARNINGS = 20
_Found = tuple[TopicInfo | None, int, int, int, Buffer]
"""A message's topic (None: undeclared), the topic's number, log time and publish time [ns], and the message."""
_IMPOSSIBLE_TIME = "a message on {} at a time that ROS can't hold"


@dataclass(frozen=True)
class BagMessage:
    """A serialised message."""

    topic: str
    message_type: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes


@dataclass
class _Damage:
    first: str
    count: int = 1


class _Catalogue:
    """The schemas and channels of one file, as they are met."""

    def __init__(self, budget: _mcap.Budget) -> None:
        self.schemas: dict[int, _mcap.Schema] = {}
        self.channels: dict[int, _mcap.Channel] = {}
        self._budget = budget
        self._known: dict[tuple[int, bytes], bytes] = {}
        self._topics: dict[int, TopicInfo] = {}

    def add(self, opcode: int, content: memoryview) -> None:
        """Take in a schema or channel record; raises `DamageError`."""
        if opcode not in (_mcap.SCHEMA, _mcap.CHANNEL):
            return
        raw = bytes(content)
        key = opcode, raw[:2]  # its number
        if self._known.get(key) == raw:  # each chunk may have it, and so has the summary
            return
        self._budget.spend("bytes of declarations", len(content))
        if opcode == _mcap.SCHEMA:
            schema = _mcap.parse_schema(content)
            self.schemas[schema.id] = schema
        else:
            channel = _mcap.parse_channel(content, self._budget)
            self.channels[channel.id] = channel
        self._known[key] = raw
        self._topics.clear()

    def topic(self, number: int) -> TopicInfo | None:
        """The topic of a channel; None for one that wasn't declared."""
        if number not in self._topics and (channel := self.channels.get(number)):
            schema = self.schemas.get(channel.schema_id)
            self._topics[number] = TopicInfo(
                name=channel.topic,
                message_type=schema.type_name if schema else "",
                encoding=channel.encoding,
                message_count=0,
                definition=schema.definition if schema else "",
                type_hash=channel.metadata.get("topic_type_hash", ""),
                qos=channel.metadata.get("offered_qos_profiles", ""),
                betas_of=channel.metadata.get(_mcap.BETAS_OF, ""),
            )
        return self._topics.get(number)


class BagReader:
    """Streams a bag, one chunk in memory at a time.

    A file without its closing records (a recorder that was killed) and damaged chunks aren't errors: what can be read
    is, `truncated` and `warnings` say what couldn't. What a pass may cost is bounded by the size of the bag, see
    `_mcap.Budget`.

    Raises `BagError` when there is no such bag, or it is neither MCAP nor rosbag2's SQLite.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.truncated = False
        """Whether something couldn't be read; final when `messages` is exhausted."""
        self._notes: list[str] = []
        self._damages: dict[tuple[Path, str], _Damage] = {}
        """Of the last pass: the first damage of each kind in each file, and how often it occurs."""
        self._claimed = False
        """Whether a summary was asked how many messages there are."""
        self._size = 0
        self._databases: dict[Path, SqliteFile] = {}
        """Those of the files that are SQLite's."""
        self._files = self._find_files()
        self._topics: tuple[TopicInfo, ...] | None = None

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is open between calls."""

    @property
    def warnings(self) -> list[str]:
        """What the last pass couldn't read: a line for each kind of damage in a file, with how often it occurs."""
        lines = [
            damage.first if damage.count == 1 else f"{damage.first} (and {damage.count - 1} more like it)"
            for damage in self._damages.values()
        ]
        more = len(lines) - _MAX_WARNINGS
        return self._notes + lines[:_MAX_WARNINGS] + ([f"{self.path}: {more} warnings more"] if more > 0 else [])

    def _find_files(self) -> list[Path]:
        if not os.path.isdir(self.path):  # noqa: PTH112 - whatever the name is, this answers
            files = [self.path]
        elif os.path.lexists(self.path / METADATA_FILE):
            files = read_file_paths(self.path)
        else:
            try:
                files = sorted((f for f in self.path.iterdir() if f.suffix in BAG_SUFFIXES), key=_by_number)
            except OSError as error:
                msg = f"{self.path}: can't be read: {error.strerror}"
                raise BagError(msg) from error
            self._notes.append(
                f"{self.path}: no {METADATA_FILE} (was the recording interrupted?); its files are read by name"
            )
        if not files:
            msg = f"{self.path}: no {' or '.join(BAG_SUFFIXES)} file in this directory"
            raise BagError(msg)
        for path in files:
            if _mcap.starts_with(path, SQLITE_MAGIC):
                self._databases[path] = SqliteFile(path)
                self._size += path.stat().st_size
                continue
            with _mcap.open_mcap(path) as file:
                self._size += os.fstat(file.fileno()).st_size
        return files

    def _damage(self, path: Path, damage: _mcap.DamageError, where: str = "") -> None:
        self.truncated = True
        known = self._damages.get((path, damage.template))
        if known:
            known.count += 1
        else:
            self._damages[path, damage.template] = _Damage(printable(f"{path}: damaged: {damage}{where}"))

    def _begin(self) -> _mcap.Budget:
        self._damages = {}
        return _mcap.Budget(self._size)

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """The bag's topics by name, with message counts: from the summaries, or by reading what there is."""
        if self._topics is None:
            self._topics = self._merge_topics(claimed=True)
            if not any(topic.message_count for topic in self._topics):
                return self.count()
        return self._topics

    def count(self) -> tuple[TopicInfo, ...]:
        """The topics with message counts by reading, whatever the summaries claim."""
        if self._topics is None or self._claimed:
            self._topics = self._merge_topics(claimed=False)
            self._claimed = False
        return self._topics

    def _merge_topics(self, *, claimed: bool) -> tuple[TopicInfo, ...]:
        """Two channels of one topic (two publishers, or two files) are one."""
        budget = self._begin()
        merged: dict[str, TopicInfo] = {}
        for path in self._files:
            for topic, count in self._file_topics(path, budget, claimed=claimed):
                known = merged.get(topic.name, topic)
                merged[topic.name] = replace(known, message_count=known.message_count + count)
        return tuple(merged[name] for name in sorted(merged))

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """The messages of some topics (None: of all), in the order they were recorded.

        Raises `BagError` when a file can't be read any more, or a chunk's compression isn't installed.
        """
        budget = self._begin()
        for path in self._files:
            of_file = self._database_messages if path in self._databases else self._mcap_messages
            for topic, number, log_ns, publish_ns, data in of_file(path, budget):
                if topic is None:
                    what = "topic" if path in self._databases else "channel"
                    self._damage(path, _mcap.DamageError(f"a message of the undeclared {what} {{}}", number))
                elif min(log_ns, publish_ns) < 0 or max(log_ns, publish_ns) > MAX_TIME_NS:
                    self._damage(path, _mcap.DamageError(_IMPOSSIBLE_TIME, topic.name))
                elif topics is None or topic.name in topics:
                    yield BagMessage(topic.name, topic.message_type, log_ns, publish_ns, bytes(data))

    def _database_messages(self, path: Path, budget: _mcap.Budget) -> Iterator[_Found]:
        try:
            topics = self._databases[path].topics(budget)
            for message in self._databases[path].messages(budget):
                if isinstance(message, _mcap.DamageError):
                    self._damage(path, message)
                else:
                    number, stamp_ns, data = message
                    yield topics.get(number), number, stamp_ns, stamp_ns, data
        except _mcap.DamageError as damage:
            self._damage(path, damage)

    def _mcap_messages(self, path: Path, budget: _mcap.Budget) -> Iterator[_Found]:
        catalogue, _ = self._summary(path, budget)
        for one in self._file_messages(path, catalogue, budget):
            yield catalogue.topic(one.channel_id), one.channel_id, one.log_time_ns, one.publish_time_ns, one.data

    def _summary(self, path: Path, budget: _mcap.Budget) -> tuple[_Catalogue, dict[int, int] | None]:
        """What the file's end says of its channels, and how many messages each has (None: it doesn't)."""
        catalogue = _Catalogue(budget)
        counts: dict[int, int] | None = None
        try:
            with _mcap.open_mcap(path) as file:
                for opcode, content in _mcap.read_summary(file):
                    catalogue.add(opcode, content)
                    if opcode == _mcap.STATISTICS:
                        counts = _mcap.parse_message_counts(content)
        except _mcap.DamageError as damage:
            self._damage(path, damage)
        except OSError as error:
            raise _unreadable(path, error) from error
        return catalogue, counts

    def _file_topics(self, path: Path, budget: _mcap.Budget, *, claimed: bool) -> list[tuple[TopicInfo, int]]:
        """With how many messages each has."""
        if path in self._databases:
            try:
                counts = self._databases[path].counts()
                return [(topic, counts.get(n, 0)) for n, topic in self._databases[path].topics(budget).items()]
            except _mcap.DamageError as damage:
                self._damage(path, damage)
                return []
        catalogue, summed = self._summary(path, budget)
        if claimed and summed is not None and catalogue.channels.keys() >= summed.keys():
            self._claimed = True
        else:
            summed = Counter(message.channel_id for message in self._file_messages(path, catalogue, budget))
        found = ((catalogue.topic(number), summed.get(number, 0)) for number in catalogue.channels)
        return [(topic, count) for topic, count in found if topic is not None]

    def _file_messages(self, path: Path, catalogue: _Catalogue, budget: _mcap.Budget) -> Iterator[_mcap.Message]:
        with _mcap.open_mcap(path) as file:
            try:
                for record in _mcap.iter_records(file):
                    yield from self._record_messages(path, record, catalogue, budget)
            except _mcap.DamageError as damage:
                self._damage(path, damage)
            except OSError as error:
                raise _unreadable(path, error) from error

    def _record_messages(
        self, path: Path, record: _mcap.Record, catalogue: _Catalogue, budget: _mcap.Budget
    ) -> Iterator[_mcap.Message]:
        """The messages of a record of the file; a damaged one is left out, the next one may be whole."""
        try:
            if record.opcode == _mcap.CHUNK:
                for opcode, content in _mcap.split_records(_mcap.unpack_chunk(record.content, budget)):
                    budget.spend("records")
                    if opcode == _mcap.MESSAGE:
                        yield _mcap.parse_message(content)
                    else:
                        catalogue.add(opcode, content)
            elif record.opcode == _mcap.MESSAGE:
                yield _mcap.parse_message(record.content)
            else:
                catalogue.add(record.opcode, record.content)
        except _mcap.DamageError as damage:
            self._damage(path, damage, f", in the record at byte {record.offset}")


def _by_number(path: Path) -> list[Any]:
    """Orders bag_2.mcap before bag_10.mcap, as they were recorded."""
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)]


def _unreadable(path: Path, error: OSError) -> BagError:
    return BagError(f"{path}: can't be read: {error.strerror}")
