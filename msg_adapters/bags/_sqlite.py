"""rosbag2's other storage: an SQLite database with a table of topics and one of messages (`.db3`).

A database can contain code: views, generated columns and triggers would run when it is read. So only plain columns of
plain tables are read; anything else in their place is refused. Its pages may also be shared: a few kilobytes can hold
more rows than anybody can count, each as long as the file. So SQLite's steps are bounded by the file's size, too.
"""

from __future__ import annotations

import os
import sqlite3
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

from msg_adapters.bags._mcap import MAX_CHUNK_BYTES, Budget, DamageError, StoredMessage
from msg_adapters.bags._metadata import TopicInfo
from msg_adapters.definitions import full_type_name
from msg_adapters.errors import BagError

MAGIC = b"SQLite format 3\x00"
_NEEDED = {"topics": {"id", "name", "type", "serialization_format"}, "messages": {"topic_id", "timestamp", "data"}}
_MAX_TOPICS = 1 << 16
_LONGEST_SQL = 4000
"""Of a statement, those that made the tables included [bytes]; rosbag2's have a few hundred."""
_STEPS = 10_000
"""Steps of SQLite's machine between two looks at how many are left; a row takes about ten."""
_ERRORS = (OSError, sqlite3.Error, ValueError, TypeError, OverflowError, MemoryError)
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
            raise BagError(f"{path}: {damage}") from damage
        for name, needed in _NEEDED.items():
            if missing := needed - self._columns[name]:
                raise BagError(f"{path}: not a bag: wanted rosbag2's table {name!r} with {', '.join(sorted(missing))}")

    @contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        """The open database. Raises `DamageError` where it can't be read any further."""
        # A killed recorder may leave a log of what isn't in the database yet; only then are files beside it read.
        log, index = (self._path.with_name(f"{self._path.name}-{end}") for end in ("wal", "shm"))
        how = "mode=ro&immutable=1"
        try:
            if log.exists() and log.stat().st_size:
                if index.exists() or os.access(self._path.parent, os.W_OK):
                    how = "mode=ro"
                else:
                    what = "{} is left out: SQLite reads it only in a folder it may write to; copy both files to one"
                    self.report(DamageError(what, log.name))
            place = quote(os.fsencode(self._path.absolute()))
            with closing(sqlite3.connect(f"file:{place}?{how}", uri=True, timeout=1.0)) as database:
                # `messages` may be paused for long between two steps, so it is steps that count, not seconds.
                looks = iter(range(200 + 4 * self._path.stat().st_size // _STEPS))
                database.set_progress_handler(lambda: next(looks, None) is None, _STEPS)
                if sys.version_info >= (3, 11):
                    database.setlimit(sqlite3.SQLITE_LIMIT_SQL_LENGTH, _LONGEST_SQL)
                database.execute("PRAGMA trusted_schema = OFF")
                database.execute("PRAGMA cell_size_check = ON")
                try:
                    database.execute("PRAGMA schema_version").fetchone()
                except sqlite3.DatabaseError:  # it is cut short: only whoever may mend a database reads what is left
                    database.execute("PRAGMA writable_schema = ON")
                yield database
        except _ERRORS as error:
            raise DamageError("the database can't be read ({})", error) from error

    def topics(self, budget: Budget, *, by_reading: bool) -> tuple[list[tuple[TopicInfo, int]], bool]:  # noqa: ARG002
        """The topics with their message counts, and False: the counts always come from reading, not from a claim."""
        topics: dict[int, TopicInfo] = {}
        found: Counter[int] = Counter()
        try:
            with self._opened() as database:
                topics = self._topics(database, budget)
                numbers = "SELECT topic_id FROM messages WHERE typeof(topic_id) = 'integer'"
                found.update(number for (number,) in _rows(database, numbers, budget) if number in topics)
        except DamageError as damage:
            self.report(damage)
        return [(topic, found[number]) for number, topic in topics.items()], False

    def _topics(self, database: sqlite3.Connection, budget: Budget) -> dict[int, TopicInfo]:
        """The topics by number, without message counts."""
        of_type = "type_description_hash" if "type_description_hash" in self._columns["topics"] else "''"
        definitions = self._texts(database, budget)
        topics: dict[int, TopicInfo] = {}
        query = f"SELECT id, name, type, serialization_format, {of_type} FROM topics LIMIT {_MAX_TOPICS}"
        for number, *values in _rows(database, query, budget, "bytes of declarations"):
            name, kind, encoding, type_hash = (value if isinstance(value, str) else "" for value in values)
            kind = full_type_name(kind)
            topics[int(number)] = TopicInfo(name, kind, encoding, 0, definitions.get(kind, ""), type_hash)
        return topics

    def _texts(self, database: sqlite3.Connection, budget: Budget) -> dict[str, str]:
        """Texts of the message types; bags before Iron have none."""
        if not {"topic_type", "encoding", "encoded_message_definition"} <= self._definitions:
            return {}
        found = {}
        query = f"SELECT topic_type, encoding, encoded_message_definition FROM message_definitions LIMIT {_MAX_TOPICS}"
        for kind, encoding, text in _rows(database, query, budget, "bytes of declarations"):
            if encoding == "ros2msg" and isinstance(kind, str) and isinstance(text, str):
                found[full_type_name(kind)] = text
        return found

    def messages(self, budget: Budget) -> Iterator[StoredMessage]:
        """The messages in the order they were recorded."""
        try:
            with self._opened() as database:
                topics = self._topics(database, budget)
                query = "SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"
                for number, stamp_ns, data in _rows(database, query, budget):
                    if not (isinstance(number, int) and isinstance(stamp_ns, int) and isinstance(data, bytes)):
                        self.report(DamageError("a message that isn't a topic's number, a time and bytes"))
                    elif len(data) > MAX_CHUNK_BYTES:
                        what = "a message of {} MiB, at most {} are read"
                        self.report(DamageError(what, len(data) >> 20, MAX_CHUNK_BYTES >> 20))
                    elif number not in topics:
                        self.report(DamageError("a message of the undeclared topic {}", number))
                    else:
                        yield topics[number], stamp_ns, stamp_ns, data
        except DamageError as damage:
            self.report(damage)


def _rows(
    database: sqlite3.Connection, query: str, budget: Budget, what: str = "bytes unpacked"
) -> Iterator[tuple[Any, ...]]:
    """The rows of a query, whose texts and bytes are spent as `what`."""
    row: tuple[Any, ...]
    for row in database.execute(query):
        budget.spend("records")
        budget.spend(what, sum(len(value) for value in row if isinstance(value, (str, bytes))))
        yield row


def _columns(database: sqlite3.Connection, table: str) -> set[str]:
    """Names of a plain table's plain columns; empty if there is no such table, or the name is something else's."""
    kinds = database.execute("SELECT type, sql FROM sqlite_master WHERE name = ?", (table,)).fetchall()
    if [kind for kind, _ in kinds] != ["table"] or str(kinds[0][1]).lstrip()[:14].upper().startswith("CREATE VIRTUAL"):
        return set()
    rows: list[Any] = database.execute(f"PRAGMA table_xinfo({table})").fetchall()
    return {str(row[1]) for row in rows if row[6] == 0}  # hidden or generated ones have another number there
