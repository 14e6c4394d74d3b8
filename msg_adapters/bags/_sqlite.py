"""rosbag2's other storage: an SQLite database with a table of topics and one of messages (`.db3`).

A database can contain code: views, generated columns and triggers would run when it is read. So only plain columns of
plain tables are read; anything else in their place is refused.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from msg_adapters.bags._mcap import MAX_CHUNK_BYTES, Budget, DamageError, StoredMessage
from msg_adapters.bags._metadata import TopicInfo
from msg_adapters.definitions import full_type_name
from msg_adapters.errors import BagError
from refu_core.errors import printable

MAGIC = b"SQLite format 3\x00"
_NEEDED = {"topics": {"id", "name", "type", "serialization_format"}, "messages": {"topic_id", "timestamp", "data"}}
_MAX_TOPICS = 1 << 16
_ERRORS = (sqlite3.Error, ValueError, TypeError, OverflowError, MemoryError)
"""What a damaged database may raise: its error message may not be UTF-8, numbers may be text, or too large."""


class SqliteFile:
    """One `.db3` file, opened read-only; damaged parts are reported and left out.

    Raises `BagError` where it isn't a bag.
    """

    def __init__(self, path: Path, report: Callable[[DamageError], None]) -> None:
        self._path, self.report = path, report
        try:
            with self._opened() as database:
                self._columns = {name: _columns(database, name) for name in _NEEDED}
                self._definitions = _columns(database, "message_definitions")
        except DamageError as damage:
            raise BagError(printable(f"{path}: {damage}")) from damage
        for name, needed in _NEEDED.items():
            if missing := needed - self._columns[name]:
                raise BagError(f"{path}: not a bag: wanted rosbag2's table {name!r} with {', '.join(sorted(missing))}")

    @contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        """The open database. Raises `DamageError` where it can't be read any further."""
        # A killed recorder may leave a log of what isn't in the database yet; only then are files beside it read.
        log = self._path.with_name(f"{self._path.name}-wal")
        how = "mode=ro" if log.exists() else "mode=ro&immutable=1"
        try:
            with closing(sqlite3.connect(f"file:{quote(str(self._path.absolute()))}?{how}", uri=True)) as database:
                database.execute("PRAGMA trusted_schema = OFF")
                database.execute("PRAGMA cell_size_check = ON")
                yield database
        except _ERRORS as error:
            raise DamageError("the database can't be read ({})", error) from error

    def topics(self, budget: Budget, *, by_reading: bool) -> tuple[list[tuple[TopicInfo, int]], bool]:  # noqa: ARG002
        """The topics with their message counts, and False: the counts always come from reading, not from a claim."""
        counts = f"SELECT topic_id, count(*) FROM messages GROUP BY topic_id LIMIT {_MAX_TOPICS}"
        try:
            with self._opened() as database:
                found: dict[Any, int] = dict(database.execute(counts).fetchall())
                return [(topic, found.get(n, 0)) for n, topic in self._topics(database, budget).items()], False
        except DamageError as damage:
            self.report(damage)
            return [], False

    def _topics(self, database: sqlite3.Connection, budget: Budget) -> dict[int, TopicInfo]:
        """The topics by number, without message counts."""
        wanted = ["name", "type", "serialization_format"]
        wanted += ["type_description_hash"] * ("type_description_hash" in self._columns["topics"])
        definitions = self._texts(database, budget)
        topics: dict[int, TopicInfo] = {}
        for number, *values in database.execute(f"SELECT id, {', '.join(wanted)} FROM topics LIMIT {_MAX_TOPICS}"):
            texts = [value if isinstance(value, str) else "" for value in values]
            budget.spend("bytes of declarations", sum(map(len, texts)))
            got = dict(zip(wanted, texts, strict=True))
            kind = full_type_name(got["type"])
            topics[int(number)] = TopicInfo(
                name=got["name"],
                message_type=kind,
                encoding=got["serialization_format"],
                message_count=0,
                definition=definitions.get(kind, ""),
                type_hash=got.get("type_description_hash", ""),
            )
        return topics

    def _texts(self, database: sqlite3.Connection, budget: Budget) -> dict[str, str]:
        """Texts of the message types; bags before Iron have none."""
        if not {"topic_type", "encoding", "encoded_message_definition"} <= self._definitions:
            return {}
        found = {}
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        for kind, encoding, text in database.execute(f"{query} LIMIT {_MAX_TOPICS}"):
            if encoding == "ros2msg" and isinstance(kind, str) and isinstance(text, str):
                budget.spend("bytes of declarations", len(text))
                found[full_type_name(kind)] = text
        return found

    def messages(self, budget: Budget) -> Iterator[StoredMessage]:
        """The messages in the order they were recorded."""
        try:
            with self._opened() as database:
                topics = self._topics(database, budget)
                for number, stamp_ns, data in database.execute(
                    "SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"
                ):
                    budget.spend("records")
                    if not (isinstance(number, int) and isinstance(stamp_ns, int) and isinstance(data, bytes)):
                        self.report(DamageError("a message that isn't a topic's number, a time and bytes"))
                    elif len(data) > MAX_CHUNK_BYTES:
                        what = "a message of {} MiB, at most {} are read"
                        self.report(DamageError(what, len(data) >> 20, MAX_CHUNK_BYTES >> 20))
                    elif number not in topics:
                        self.report(DamageError("a message of the undeclared topic {}", number))
                    else:
                        budget.spend("bytes unpacked", len(data))
                        yield topics[number], stamp_ns, stamp_ns, data
        except DamageError as damage:
            self.report(damage)


def _columns(database: sqlite3.Connection, table: str) -> set[str]:
    """Names of a plain table's plain columns; empty if there is no such table, or the name is something else's."""
    kinds = database.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)).fetchall()
    if [kind for kind, _ in kinds] != ["table"] or str(kinds[0][1]).lstrip()[:14].upper().startswith("CREATE VIRTUAL"):
        return set()
    rows: list[Any] = database.execute(f"PRAGMA table_xinfo({table})").fetchall()
    return {str(row[1]) for row in rows if row[6] == 0}  # hidden or generated ones have another number there
