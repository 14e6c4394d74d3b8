"""Bags in rosbag2's SQLite storage: as another program writes them, in several files, damaged and hostile."""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
import struct
import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from msg_adapters import BagError, BagReader, decoder_for, encoder_for, open_smpl_bag
from refu_core import SmplFrame
from tests.limits import refusal, run_limited

TOPIC = "/smpl_params"
TYPE = "sensor_msgs/msg/JointState"
START_NS = 1_700_000_000_000_000_000
PAYLOADS = [encoder_for("joint_state")(SmplFrame(np.full(72, 0.01 * i), stamp_ns=START_NS + i)) for i in range(12)]
TOPICS = "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
MESSAGES = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory that rosbags has written."""
    path = tmp_path_factory.mktemp("bags") / "recorded"
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        store = get_typestore(Stores.ROS2_JAZZY)
        other = writer.add_connection("/chatter", "std_msgs/msg/String", typestore=store)
        connection = writer.add_connection(TOPIC, TYPE, typestore=store)
        for i, data in enumerate(PAYLOADS):
            writer.write(connection, START_NS + i, data)
            writer.write(other, START_NS + i, b"\x00\x01\x00\x00\x02\x00\x00\x00a\x00")
    return path


def handmade(path: Path, *statements: str, messages: list[tuple[object, ...]] | None = None) -> Path:
    """A database of these statements, as Foxy lays it out by default, with rows (topic, time, bytes)."""
    with sqlite3.connect(path) as database:
        for statement in statements or (TOPICS, MESSAGES):
            database.execute(statement)
        if messages is not None:
            database.execute("INSERT INTO topics VALUES (1, ?, ?, 'cdr')", (TOPIC, TYPE))
            database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", messages)
    database.close()
    return path


def rows(first: int, last: int) -> list[tuple[object, ...]]:
    return [(1, START_NS + i, PAYLOADS[i]) for i in range(first, last)]


def payloads(path: Path) -> list[bytes]:
    return [message.data for message in BagReader(path).messages([TOPIC])]


def test_directory_and_file_of_another_writer(bag: Path) -> None:
    for path in (bag, bag / "recorded.db3"):
        reader = BagReader(path)
        topics = {topic.name: (topic.message_type, topic.message_count) for topic in reader.topics}
        assert topics == {TOPIC: (TYPE, len(PAYLOADS)), "/chatter": ("std_msgs/msg/String", len(PAYLOADS))}
        assert [message.data for message in reader.messages([TOPIC])] == PAYLOADS
        assert [m.log_time_ns for m in reader.messages()] == [START_NS + i // 2 for i in range(2 * len(PAYLOADS))]
        assert not reader.truncated
        assert not reader.warnings
    decode = decoder_for("joint_state").from_bytes
    with open_smpl_bag(bag) as records:
        found = list(records)
    for record, data in zip(found, PAYLOADS, strict=True):
        assert record.frame is not None
        np.testing.assert_array_equal(record.frame.pose, decode(data).pose)


def test_files_of_an_interrupted_recording_are_read_in_their_order(tmp_path: Path) -> None:
    folder = tmp_path / "long"
    folder.mkdir()
    for i in range(len(PAYLOADS)):  # 0 to 11: by the alphabet, 10 comes before 2
        handmade(folder / f"long_{i}.db3", messages=rows(i, i + 1))
    reader = BagReader(folder)
    assert [message.data for message in reader.messages()] == PAYLOADS
    assert "was the recording interrupted" in reader.warnings[0]


def test_log_that_a_killed_recorder_left_is_read(tmp_path: Path) -> None:
    handmade(tmp_path / "live.db3", messages=rows(0, 3))
    recorder = sqlite3.connect(tmp_path / "live.db3")
    recorder.execute("PRAGMA journal_mode = WAL")
    recorder.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows(3, 5))
    recorder.commit()
    for name in ("live.db3", "live.db3-wal"):  # as they are on the disk while the recorder is alive
        shutil.copy(tmp_path / name, tmp_path / f"killed{name[4:]}")
    recorder.close()
    assert payloads(tmp_path / "killed.db3") == PAYLOADS[:5]


def test_log_that_cannot_be_read_where_it_is_costs_nothing_else() -> None:
    """SQLite makes a file beside it first: bags on a read-only disk, or of another user, weren't read at all."""
    with tempfile.TemporaryDirectory() as folder:
        path = handmade(Path(folder, "live.db3"), messages=rows(0, 3))
        recorder = sqlite3.connect(path)
        recorder.execute("PRAGMA journal_mode = WAL")
        recorder.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows(3, 5))
        recorder.commit()
        killed = Path(folder, "killed")
        killed.mkdir()
        for name in ("live.db3", "live.db3-wal"):
            shutil.copy(Path(folder, name), killed)
        recorder.close()
        Path(folder).chmod(0o755)
        killed.chmod(0o555)
        is_root = os.geteuid() == 0
        if is_root:  # who may write wherever permissions say no
            os.setresuid(65534, 65534, 0)
        try:
            reader = BagReader(killed / "live.db3")
            assert [message.data for message in reader.messages()] == PAYLOADS[:3]
        finally:
            if is_root:
                os.setresuid(0, 0, 0)
            killed.chmod(0o755)
        assert "live.db3-wal is left out" in reader.warnings[0]


def test_what_is_before_a_cut_is_read(tmp_path: Path) -> None:
    """A copy that wasn't finished: SQLite doesn't open it unless it is told to."""
    whole = handmade(tmp_path / "whole.db3", messages=rows(0, 12) * 100).read_bytes()
    cut = tmp_path / "cut.db3"
    cut.write_bytes(whole[: len(whole) // 2])
    reader = BagReader(cut)
    found = [message.data for message in reader.messages()]
    assert found == (PAYLOADS * 100)[: len(found)]
    assert len(found) > 400
    assert "damaged" in reader.warnings[0]


def test_messages_compressed_one_by_one_are_read(bag: Path, tmp_path: Path) -> None:
    """As `ros2 bag record --compression-mode message` writes them, with their metadata and without."""
    packed = [(1, START_NS + i, zstandard.compress(data)) for i, data in enumerate(PAYLOADS)]
    bomb = zstandard.compress(bytes(200 << 20))
    streamed = zstandard.ZstdCompressor(write_content_size=False).compress(PAYLOADS[0])
    bad = [(1, START_NS, data) for data in (bomb, streamed, packed[0][2][:-9], packed[0][2][:5])]
    path = handmade(tmp_path / "recorded.db3", messages=[*packed, *bad])
    reader = BagReader(path)
    assert [message.data for message in reader.messages()] == PAYLOADS
    assert len(reader.warnings) == 4
    assert "unpacks to 200 MiB" in reader.warnings[0]
    metadata = (bag / "metadata.yaml").read_text()
    for key, value in (("format", "zstd"), ("mode", "MESSAGE")):
        metadata = re.sub(rf"compression_{key}: .*", f"compression_{key}: {value}", metadata)
    (tmp_path / "metadata.yaml").write_text(metadata)
    assert payloads(tmp_path) == PAYLOADS


def test_a_name_that_is_no_text(tmp_path: Path) -> None:
    plain = handmade(tmp_path / "plain.db3", messages=rows(0, 2))
    assert payloads(plain.rename(tmp_path / "\udcff.db3")) == PAYLOADS[:2]


def test_bad_rows_are_left_out(tmp_path: Path) -> None:
    odd = [(1, START_NS, "text"), (1, -5, b"early"), (1, None, b"never"), (77, START_NS, b"whose?")]
    path = handmade(tmp_path / "odd.db3", messages=[*rows(0, 1), *odd, *rows(1, 2)])
    reader = BagReader(path)
    assert [message.data for message in reader.messages()] == PAYLOADS[:2]
    assert reader.truncated
    assert len(reader.warnings) == 3
    assert "(and 1 more like it)" in reader.warnings[0]


@pytest.mark.parametrize(
    "statements",
    [
        (TOPICS, "CREATE TABLE other(id INTEGER)"),
        (TOPICS, "CREATE VIEW messages AS SELECT 1 AS topic_id, 2 AS timestamp, zeroblob(999999999) AS data"),
        (
            TOPICS,
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data AS (zeroblob(999999999)) VIRTUAL)",
        ),
        (TOPICS, "CREATE VIRTUAL TABLE messages USING fts4(topic_id, timestamp, data)"),
        (TOPICS.replace(", serialization_format TEXT", ""), MESSAGES),
    ],
)
def test_programs_in_the_place_of_tables_are_refused(tmp_path: Path, statements: tuple[str, ...]) -> None:
    path = handmade(tmp_path / "program.db3", *statements)
    with pytest.raises(BagError, match=r"program\.db3: not a bag: wanted rosbag2's table"):
        BagReader(path)


def test_what_a_damaged_database_is_called_need_not_be_text(tmp_path: Path) -> None:
    """SQLite says of which table the definition is damaged, in whatever bytes its name has."""
    path = handmade(tmp_path / "named.db3", messages=rows(0, 1))
    damaged = (
        path.read_bytes()
        .replace(b"tabletopics", b"tablet\xff\x1bics")
        .replace(b"CREATE TABLE topics", b"CREATE TABLE (opics")
    )
    path.write_bytes(damaged)
    with pytest.raises(BagError, match=r"named\.db3: the database can't be read") as caught:
        BagReader(path)
    assert str(caught.value).isprintable()


def shared(path: Path, *, table: str, depth: int) -> Path:
    """A bag of which each page of a table is there 583 times, and so on, `depth` times: 28 KB with 10¹¹ rows."""
    handmade(path, messages=rows(0, 1))
    with sqlite3.connect(path) as database:
        (root,) = database.execute("SELECT rootpage FROM sqlite_master WHERE name = ?", (table,)).fetchone()
    database.close()
    data = bytearray(path.read_bytes())
    (size,) = struct.unpack_from(">H", data, 16)
    at = slice((root - 1) * size, root * size)
    data += data[at]
    for i in range(depth):
        n = (size - 12) // 7
        page = struct.pack(">BHHHBI", 5, 0, n, size - 5 * n, 0, len(data) // size)
        page += b"".join(struct.pack(">H", size - 5 * (k + 1)) for k in range(n))
        page += bytes(size - 5 * n - len(page)) + struct.pack(">IB", len(data) // size, 0x7F) * n
        data[at if i == depth - 1 else slice(len(data), None)] = page
    struct.pack_into(">I", data, 28, len(data) // size)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("table", ["messages", "topics"])
def test_pages_that_are_shared_take_no_time(tmp_path: Path, table: str) -> None:
    path = shared(tmp_path / "shared.db3", table=table, depth=4)

    def read() -> None:
        reader = BagReader(path)
        counted = sum(topic.message_count for topic in reader.topics)
        assert sum(1 for _ in reader.messages()) == counted
        assert (counted > 10_000) == (table == "messages")  # nothing is told apart where topics are endless
        assert "of this size has; the rest is left out" in reader.warnings[0]

    assert run_limited(read).error == ""


def test_a_scheme_that_is_shared_takes_no_time(tmp_path: Path) -> None:
    """Its rows are parsed by SQLite itself, before the first query."""
    path = shared(tmp_path / "shared.db3", table="messages", depth=4)
    data = bytearray(path.read_bytes())
    size, root = struct.unpack_from(">H", data, 16)[0], 3
    data[100:size] = data[(root - 1) * size : root * size - 100]
    path.write_bytes(data)
    assert refusal(lambda: BagReader(path))


@given(st.data())
def test_damage_is_a_warning_or_one_clear_error(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    whole = handmade(folder / "whole.db3", messages=rows(0, 12)).read_bytes()
    cut = whole[: data.draw(st.integers(20, len(whole)))]
    changed = bytearray(cut)
    for at in data.draw(st.lists(st.integers(16, len(cut) - 1), max_size=20)):
        changed[at] = data.draw(st.integers(0, 255))
    path = folder / "damaged.db3"
    path.write_bytes(bytes(changed))
    found: list[bytes] = []
    with suppress(BagError):  # and nothing else
        found = [message.data for message in BagReader(path).messages()]
    assert len(found) <= 100
    assert all(isinstance(payload, bytes) for payload in found)
