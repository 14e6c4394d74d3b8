"""One MCAP file of a bag: its topics, as they are met, and its messages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from msg_adapters.bags import _mcap
from msg_adapters.bags._mcap import Budget, DamageError
from msg_adapters.bags._metadata import BETAS_OF, TopicInfo
from msg_adapters.cdr import Buffer
from msg_adapters.definitions import full_type_name
from msg_adapters.errors import BagError

StoredMessage = tuple[TopicInfo, int, int, Buffer]
"""A message's topic, log time and publish time [ns], and the message."""


class _Catalogue:
    """The schemas and channels of one file, as they are met."""

    def __init__(self, budget: Budget) -> None:
        self._budget = budget
        self._schemas: dict[int, tuple[str, str]] = {}
        """Type and `ros2msg` text."""
        self._channels: dict[int, tuple[int, str, str, dict[str, str]]] = {}
        """Schema's number, topic, encoding and metadata."""
        self._known: dict[tuple[int, bytes], bytes] = {}
        self._topics: dict[int, TopicInfo] = {}

    @property
    def numbers(self) -> list[int]:
        """The numbers of all channels."""
        return [*self._channels]

    def add(self, opcode: int, content: memoryview) -> None:
        """Take in a schema or channel record; raises `DamageError`."""
        if opcode not in (_mcap.SCHEMA, _mcap.CHANNEL):
            return
        raw = bytes(content)
        key = opcode, raw[:2]  # its number
        if self._known.get(key) == raw:  # each chunk may repeat it, and so does the summary
            return
        self._budget.spend("bytes of declarations", len(content))
        fields = _mcap.Fields(content)
        number = fields.number(2)
        if opcode == _mcap.SCHEMA:
            name, encoding = fields.string(), fields.string()
            text = str(fields.take(fields.number(4)), "utf-8", "replace") if encoding == "ros2msg" else ""
            self._schemas[number] = full_type_name(name), text
        else:
            schema, topic, encoding = fields.number(2), fields.string(), fields.string()
            self._channels[number] = schema, topic, encoding, fields.string_map(self._budget)
        self._known[key] = raw
        self._topics.clear()

    def topic(self, number: int) -> TopicInfo | None:
        """The topic of a channel; None for one that wasn't declared."""
        if number not in self._topics and number in self._channels:
            schema, topic, encoding, metadata = self._channels[number]
            message_type, definition = self._schemas.get(schema, ("", ""))
            type_hash, betas_of = metadata.get("topic_type_hash", ""), metadata.get(BETAS_OF, "")
            self._topics[number] = TopicInfo(topic, message_type, encoding, 0, definition, type_hash, betas_of)
        return self._topics.get(number)


class McapFile:
    """Reads an MCAP file; damaged parts are reported and left out. Raises `BagError` where it can't be read."""

    def __init__(self, path: Path, report: Callable[[DamageError], None]) -> None:
        self._path, self.report = path, report

    def topics(self, budget: Budget, *, by_reading: bool) -> tuple[list[tuple[TopicInfo, int]], bool]:
        """The topics with their message counts, and whether these are only claimed by the summary.

        The summary is trusted if it declares every channel that it counts, and not `by_reading`.
        """
        catalogue, counts = self._summary(budget)
        claimed = not by_reading and counts is not None and counts.keys() <= {*catalogue.numbers}
        if not claimed or counts is None:
            counts = Counter(channel for channel, *_ in self._all_messages(catalogue, budget))
        found = ((catalogue.topic(number), counts.get(number, 0)) for number in catalogue.numbers)
        return [(topic, count) for topic, count in found if topic is not None], claimed

    def messages(self, budget: Budget) -> Iterator[StoredMessage]:
        """The messages in the order they were recorded."""
        catalogue, _ = self._summary(budget)
        for channel, log_ns, publish_ns, data in self._all_messages(catalogue, budget):
            topic = catalogue.topic(channel)
            if topic is None:
                self.report(DamageError("a message of the undeclared channel {}", channel))
            else:
                yield topic, log_ns, publish_ns, data

    @contextmanager
    def _opened(self) -> Iterator[BinaryIO]:
        """The open file; damage ends the `with` block and is reported."""
        file, _ = _mcap.open_bag_file(self._path)
        with file:
            try:
                yield file
            except DamageError as damage:
                self.report(damage)
            except OSError as error:
                raise BagError(f"{self._path}: can't be read: {error.strerror}") from error

    def _summary(self, budget: Budget) -> tuple[_Catalogue, Mapping[int, int] | None]:
        """The channels that the summary at the file's end declares, and their message counts (None: it gives none)."""
        catalogue = _Catalogue(budget)
        counts: dict[int, int] | None = None
        with self._opened() as file:
            for opcode, content in _mcap.read_summary(file):
                catalogue.add(opcode, content)
                if opcode == _mcap.STATISTICS:
                    counts = _mcap.parse_message_counts(content)
        return catalogue, counts

    def _all_messages(self, catalogue: _Catalogue, budget: Budget) -> Iterator[tuple[int, int, int, memoryview]]:
        with self._opened() as file:
            for opcode, content, place in _mcap.iter_records(file):
                try:
                    if opcode == _mcap.CHUNK:
                        for inner, record in _mcap.split_records(_mcap.unpack_chunk(content, budget)):
                            budget.spend("records")
                            if inner == _mcap.MESSAGE:
                                yield _mcap.parse_message(record)
                            else:
                                catalogue.add(inner, record)
                    elif opcode == _mcap.MESSAGE:
                        yield _mcap.parse_message(content)
                    else:
                        catalogue.add(opcode, content)
                except DamageError as damage:  # noqa: PERF203 - the next record may be whole
                    damage.where = f", in the record at byte {place}"
                    self.report(damage)
