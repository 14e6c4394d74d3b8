"""Reading bags as a stream: an `.mcap` file or a rosbag2 directory, whole or cut short."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from msg_adapters.bags import _mcap
from msg_adapters.bags._metadata import MAX_TIME_NS, METADATA_FILE, read_file_paths
from msg_adapters.definitions import full_type_name
from msg_adapters.errors import BagError

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator
    from types import TracebackType

    from typing_extensions import Self


@dataclass(frozen=True)
class TopicInfo:
    """A topic of a bag."""

    name: str
    message_type: str
    """`package/msg/Type`; empty where the bag carries no schema for the topic."""
    encoding: str
    """Message encoding; `cdr` is what ROS 2 writes."""
    message_count: int
    definition: str
    """Text of the message type (`ros2msg`); empty where it is in another language."""
    type_hash: str
    qos: str
    """Offered profiles in YAML, as recorded."""


@dataclass(frozen=True)
class BagMessage:
    """A serialised message."""

    topic: str
    message_type: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes


class _Catalogue:
    """The schemas and channels of one file, as they are met."""

    def __init__(self) -> None:
        self.schemas: dict[int, _mcap.Schema] = {}
        self.channels: dict[int, _mcap.Channel] = {}

    def add(self, opcode: int, content: memoryview) -> None:
        """Take in a schema or channel record; raises `DamageError`."""
        if opcode == _mcap.SCHEMA:
            schema = _mcap.parse_schema(content)
            self.schemas[schema.id] = schema
        elif opcode == _mcap.CHANNEL:
            channel = _mcap.parse_channel(content)
            self.channels[channel.id] = channel

    def message_type(self, channel: _mcap.Channel) -> str:
        schema = self.schemas.get(channel.schema_id)
        return full_type_name(schema.name) if schema else ""

    def topics(self, counts: dict[int, int]) -> dict[str, TopicInfo]:
        """The topics by name; two channels of one topic (two publishers) are one."""
        topics: dict[str, TopicInfo] = {}
        for channel in self.channels.values():
            count = counts.get(channel.id, 0)
            known = topics.get(channel.topic)
            if known:
                topics[channel.topic] = replace(known, message_count=known.message_count + count)
                continue
            schema = self.schemas.get(channel.schema_id)
            text = schema.data.decode("utf-8", "replace") if schema and schema.encoding == "ros2msg" else ""
            topics[channel.topic] = TopicInfo(
                name=channel.topic,
                message_type=self.message_type(channel),
                encoding=channel.encoding,
                message_count=count,
                definition=text,
                type_hash=channel.metadata.get("topic_type_hash", ""),
                qos=channel.metadata.get("offered_qos_profiles", ""),
            )
        return topics


class BagReader:
    """Streams a bag, one chunk in memory at a time.

    A file without its closing records (a recorder that was killed) and damaged chunks aren't errors: what can be read
    is, `truncated` and `warnings` say what couldn't.

    Raises `BagError` when there is no such bag, or it isn't MCAP.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.truncated = False
        """Whether something couldn't be read; final when `messages` is exhausted."""
        self.warnings: list[str] = []
        self._files = self._find_files()
        self._topics: tuple[TopicInfo, ...] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing is open between calls."""

    def _find_files(self) -> list[Path]:
        if not self.path.exists():
            msg = f"{self.path}: no such file or directory"
            raise BagError(msg)
        if not self.path.is_dir():
            files = [self.path]
        elif (self.path / METADATA_FILE).exists():
            files = read_file_paths(self.path)
        else:
            files = sorted(self.path.glob("*.mcap"))
            self._warn(
                f"{self.path}: no {METADATA_FILE} (was the recording interrupted?); its .mcap files are read by name"
            )
        if not files:
            msg = f"{self.path}: no .mcap file in this directory"
            raise BagError(msg)
        for file in files:
            _mcap.open_mcap(file).close()
        return files

    def _warn(self, warning: str) -> None:
        if warning not in self.warnings:
            self.warnings.append(warning)

    def _damage(self, path: Path, what: object) -> None:
        self.truncated = True
        self._warn(f"{path}: damaged: {what}")

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """The bag's topics by name, with message counts: from the summaries, or by reading what there is."""
        if self._topics is None:
            merged: dict[str, TopicInfo] = {}
            for path in self._files:
                for name, topic in self._file_topics(path).items():
                    known = merged.get(name, replace(topic, message_count=0))
                    merged[name] = replace(known, message_count=known.message_count + topic.message_count)
            self._topics = tuple(merged[name] for name in sorted(merged))
        return self._topics

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """The messages of some topics (None: of all), in the order they were recorded.

        Raises `BagError` when a file can't be read any more, or a chunk's compression isn't installed.
        """
        for path in self._files:
            catalogue, _ = self._summary(path)
            for message in self._file_messages(path, catalogue):
                channel = catalogue.channels.get(message.channel_id)
                if channel is None:
                    self._damage(path, f"a message of the undeclared channel {message.channel_id}")
                elif max(message.log_time_ns, message.publish_time_ns) > MAX_TIME_NS:
                    self._damage(path, f"a message on {channel.topic} at a time that ROS can't hold")
                elif topics is None or channel.topic in topics:
                    yield BagMessage(
                        topic=channel.topic,
                        message_type=catalogue.message_type(channel),
                        log_time_ns=message.log_time_ns,
                        publish_time_ns=message.publish_time_ns,
                        data=bytes(message.data),
                    )

    def _summary(self, path: Path) -> tuple[_Catalogue, dict[int, int] | None]:
        """What the file's end says of its channels, and how many messages each has (None: it doesn't)."""
        catalogue = _Catalogue()
        counts: dict[int, int] | None = None
        with _mcap.open_mcap(path) as file:
            summary = _mcap.read_summary(file)
        try:
            for opcode, content in summary or ():
                catalogue.add(opcode, content)
                if opcode == _mcap.STATISTICS:
                    counts = _mcap.parse_message_counts(content)
        except _mcap.DamageError as damage:
            self._damage(path, damage)
        return catalogue, counts

    def _file_topics(self, path: Path) -> dict[str, TopicInfo]:
        catalogue, counts = self._summary(path)
        if counts is None or not catalogue.channels.keys() >= counts.keys():
            counts = {}
            for message in self._file_messages(path, catalogue):
                counts[message.channel_id] = counts.get(message.channel_id, 0) + 1
        return catalogue.topics(counts)

    def _file_messages(self, path: Path, catalogue: _Catalogue) -> Iterator[_mcap.Message]:
        with _mcap.open_mcap(path) as file:
            try:
                for record in _mcap.iter_records(file):
                    yield from self._record_messages(path, record, catalogue)
            except _mcap.DamageError as damage:
                self._damage(path, damage)
            except OSError as error:
                msg = f"{path}: can't be read: {error.strerror}"
                raise BagError(msg) from error

    def _record_messages(self, path: Path, record: _mcap.Record, catalogue: _Catalogue) -> Iterator[_mcap.Message]:
        """The messages of a record of the file; a damaged one is left out, the next one may be whole."""
        try:
            if record.opcode == _mcap.CHUNK:
                for opcode, content in _mcap.split_records(_mcap.unpack_chunk(record.content)):
                    if opcode == _mcap.MESSAGE:
                        yield _mcap.parse_message(content)
                    else:
                        catalogue.add(opcode, content)
            elif record.opcode == _mcap.MESSAGE:
                yield _mcap.parse_message(record.content)
            else:
                catalogue.add(record.opcode, record.content)
        except _mcap.DamageError as damage:
            self._damage(path, f"{damage}, in the record at byte {record.offset}")
