"""rosbag2's other storage: an SQLite database with a table of topics and one of messages (`.db3`).

A database is a program of its own: views, generated columns and triggers would run for whoever reads it. What is read
are plain columns of plain tables; anything else in their place is refused.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from msg_adapters.bags._mcap import MAX_CHUNK_BYTES, Budget, DamageError
from msg_adapters.bags._metadata import TopicInfo
from msg_adapters.definitions import full_type_name
from msg_adapters.errors import BagError

MAGIC = b"SQLite format 3\x00"
_NEEDED = {"topics": {"id", "name", "type", "serialization_format"}, "messages": {"topic_id", "timestamp", "data"}}
_MAX_TOPICS = 1 << 16
_UNREADABLE = "the database can't be read on ({})"


class SqliteFile:
    """One `.db3` file, opened to read and never written to. Raises `BagError` where it isn't a bag's."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with self._open() as database:
                self._columns = {name: _columns(database, name) for name in _NEEDED}
                self._definitions = _columns(database, "message_definitions")
        except (sqlite3.Error, OverflowError) as error:
            msg = f"{path}: the database can't be read: {error}"
            raise BagError(msg) from error
        for name, needed in _NEEDED.items():
            if missing := needed - self._columns[name]:
                msg = f"{path}: not a bag: wanted rosbag2's table {name!r} with {', '.join(sorted(missing))}"
                raise BagError(msg)

    @contextmanager
    def _open(self) -> Iterator[sqlite3.Connection]:
        # A recorder that was killed may leave a log of what isn't in the database yet; only then others are looked at.
        log = self.path.with_name(f"{self.path.name}-wal")
        how = "mode=ro" if log.exists() else "mode=ro&immutable=1"
        with closing(sqlite3.connect(f"file:{quote(str(self.path.absolute()))}?{how}", uri=True)) as database:
            database.execute("PRAGMA trusted_schema = OFF")
            database.execute("PRAGMA cell_size_check = ON")
            yield database

    def topics(self, budget: Budget) -> dict[int, TopicInfo]:
        """The topics by their numbers, without their messages' count. Raises `DamageError`."""
        has = self._columns["topics"]
        wanted = ["name", "type", "serialization_format"]
        wanted += [name for name in ("offered_qos_profiles", "type_description_hash") if name in has]
        topics: dict[int, TopicInfo] = {}
        try:
            with self._open() as database:
                definitions = self._texts(database, budget)
                rows = database.execute(f"SELECT id, {', '.join(wanted)} FROM topics LIMIT {_MAX_TOPICS}")
                for number, *values in rows:
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
                        qos=got.get("offered_qos_profiles", ""),
                    )
        except (sqlite3.Error, ValueError, TypeError, OverflowError) as error:
            raise DamageError(_UNREADABLE, error) from error
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

    def counts(self) -> dict[int, int]:
        """Messages of each topic's number, by reading. Raises `DamageError`."""
        try:
            with self._open() as database:
                rows = database.execute(
                    f"SELECT topic_id, count(*) FROM messages GROUP BY topic_id LIMIT {_MAX_TOPICS}"
                )
                return {number: count for number, count in rows if isinstance(number, int)}
        except (sqlite3.Error, OverflowError) as error:
            raise DamageError(_UNREADABLE, error) from error

    def messages(self, budget: Budget) -> Iterator[tuple[int, int, bytes] | DamageError]:
        """Topic's number, time [ns] and bytes of each message in the order of recording, or what is wrong with one.

        Raises `DamageError` where the file can't be read on.
        """
        try:
            with self._open() as database:
                for topic, stamp, data in database.execute(
                    "SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"
                ):
                    budget.spend("records")
                    if not (isinstance(topic, int) and isinstance(stamp, int) and isinstance(data, bytes)):
                        yield DamageError("a message that isn't a topic's number, a time and bytes")
                    elif len(data) > MAX_CHUNK_BYTES:
                        yield DamageError(
                            "a message of {} MiB, at most {} are read", len(data) >> 20, MAX_CHUNK_BYTES >> 20
                        )
                    else:
                        budget.spend("bytes unpacked", len(data))
                        yield topic, stamp, data
        except (sqlite3.Error, OverflowError, MemoryError) as error:
            raise DamageError(_UNREADABLE, error) from error


def _columns(database: sqlite3.Connection, table: str) -> set[str]:
    """Names of a plain table's plain columns; none where there is no such table, or something else of its name."""
    kinds = database.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)).fetchall()
    if [kind for kind, _ in kinds] != ["table"] or str(kinds[0][1]).lstrip()[:14].upper().startswith("CREATE VIRTUAL"):
        return set()
    rows: list[Any] = database.execute(f"PRAGMA table_xinfo({table})").fetchall()
    return {str(row[1]) for row in rows if row[6] == 0}  # hidden or generated ones have another number there
