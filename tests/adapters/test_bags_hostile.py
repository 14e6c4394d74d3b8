"""Bags made to hang, crash or fool their reader: read or refused in two seconds and 600 MB."""

from __future__ import annotations

import os
import shutil
import struct
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import zstandard

sys.path.insert(0, str(Path(__file__).parents[1]))
from limits import refusal, run_limited

from msg_adapters import BagReader, BagWriter, encoder_for, open_smpl_bag
from refu_core import SmplFrame

if TYPE_CHECKING:
    from collections.abc import Callable

MAGIC = b"\x89MCAP0\r\n"
BAG = Path(__file__).parents[2] / "bags" / "walk" / "walk_0.mcap"
KEY = "rosbag2_bagfile_information:\n  storage_identifier: mcap\n"
MIB = 1 << 20
FRAME = encoder_for("multiarray")(SmplFrame(np.zeros(72)))


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


def schema(number: int = 1, data: bytes = b"", name: bytes = b"std_msgs/msg/Float32MultiArray") -> bytes:
    return record(3, struct.pack("<H", number) + text(name) + text(b"ros2msg") + text(data))


def channel(number: int = 1, topic: bytes = b"/smpl_params", metadata: bytes = b"") -> bytes:
    return record(4, struct.pack("<HH", number, 1) + text(topic) + text(b"cdr") + text(metadata))


def message(number: int = 1, data: bytes = FRAME) -> bytes:
    return record(5, struct.pack("<HIQQ", number, 0, 1, 1) + data)


DECLARED = schema() + channel()
NOISE = record(0x10, np.random.default_rng(0).bytes(60_000))
"""Makes a chunk large for its size on the disk to be honest."""


def chunk(records: bytes) -> bytes:
    packed = zstandard.compress(records)
    head = struct.pack("<QQQI", 0, 0, len(records), 0) + text(b"zstd") + struct.pack("<Q", len(packed))
    return record(6, head + packed)


def closed(data: bytes, summary: bytes) -> bytes:
    end = record(0x0F, bytes(4))
    return data + end + summary + record(2, struct.pack("<QQI", len(MAGIC + data + end), 0, 0)) + MAGIC


def statistics(counts: bytes, total: int = 0) -> bytes:
    return record(0x0B, struct.pack("<QHIIIIQQ", total, 1, 1, 0, 0, 1, 0, 0) + text(counts))


def schema_of_all() -> bytes:
    channels = b"".join(channel(i, b"/t%d" % i) for i in range(2, 65_536))
    return chunk(NOISE + schema(data=b"int32 x\n" * 100_000) + channels)


def long_names() -> bytes:
    return b"".join(
        chunk(NOISE + b"".join(channel(i, b"/%d-%d" % (c, i) + bytes([97]) * 4000) for i in range(2, 20_000)))
        for c in range(2)
    )


FILES: dict[str, Callable[[], bytes]] = {
    "empty records": lambda: DECLARED + message() + chunk(NOISE + record(0x10, b"") * (40_000_000 // 9)),
    "empty messages": lambda: DECLARED + chunk(message() + NOISE + message(data=b"") * (40_000_000 // 31)),
    "chunks of zeros": lambda: DECLARED + message() + chunk(message(data=bytes(8 * MIB))) * 500,
    "great messages": lambda: DECLARED + message() + chunk(NOISE + message(data=bytes(100_000_000))) * 4,
    "undeclared channels": lambda: DECLARED + message() + chunk(b"".join(message(i) for i in range(2, 65_536))),
    "bad records": lambda: DECLARED + message() + record(5, b"") * 50_000,
    "channels of one schema": lambda: DECLARED + message() + schema_of_all(),
    "channels with long names": lambda: DECLARED + message() + long_names(),
    "a channel's metadata": lambda: DECLARED + message() + chunk(NOISE + channel(2, b"/x", text(b"") * 10**6)),
    "a type's long name": lambda: schema(name=b"a/" + b"b" * MIB) + channel() + channel(2) + message() * 5_000,
    "a summary of nothing": lambda: closed(DECLARED + message(), record(0x08, b"") * 60_000),
    "statistics of millions": lambda: closed(DECLARED + message(), DECLARED + statistics(b"\1\0" * 10**6)),
    "zeros": lambda: DECLARED + message() + bytes(8 * MIB),
    "unknown records": lambda: DECLARED + message() + record(255, b"") * 200_000,
}


@pytest.mark.parametrize("name", FILES)
def test_work_is_bounded_by_the_bytes_on_disk(tmp_path: Path, name: str) -> None:
    path = tmp_path / "hostile.mcap"
    path.write_bytes(MAGIC + FILES[name]())

    def read() -> None:
        bag = open_smpl_bag(path, topic="smpl_params") if name != "a type's long name" else BagReader(path)
        n_good = sum(item.frame is not None for item in bag) if name != "a type's long name" else _exhaust(bag)
        warnings = bag.warnings if isinstance(bag, BagReader) else bag.reader.warnings
        assert n_good >= 1  # what is good is read
        assert len(warnings) <= 3
        assert all(len(line) < 350 and line.isprintable() for line in warnings)

    assert run_limited(read).error == ""


def _exhaust(reader: Any) -> int:
    return sum(1 for _ in reader.messages())


def test_damage_is_summed_up(tmp_path: Path) -> None:
    path = tmp_path / "bad.mcap"
    path.write_bytes(MAGIC + DECLARED + message() + record(5, b"") * 7 + chunk(b"\x1b[31m")[:-40] + record(5, b"x") * 2)
    reader = BagReader(path)
    for _ in range(2):  # reading twice doesn't count twice
        assert len(list(reader.messages())) == 1
        first, *_ = reader.warnings
        assert "a message record of 0 bytes" in first
        assert first.endswith("(and 6 more like it)")


def test_a_bag_far_smaller_than_its_work_says_so(tmp_path: Path) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(MAGIC + FILES["empty messages"]())
    reader = BagReader(path)
    assert len(list(reader.messages())) > 1_000
    assert reader.truncated
    assert "more records than a bag of this size has" in reader.warnings[0]


def test_honest_bags_are_within_the_budget(tmp_path: Path) -> None:
    """The smallest messages there are, at times as regular as no clock's: nothing is easier to compress."""
    with BagWriter(tmp_path / "bag.mcap") as bag:
        bag.add_topic("/flag", "std_msgs/Bool", definition="bool data")
        for i in range(40_000):
            bag.write("/flag", b"\0\1\0\0\1", log_time_ns=1_700_000_000_000_000_000 + i * 1_000_000)
    reader = BagReader(tmp_path / "bag.mcap")
    assert sum(1 for _ in reader.messages()) == 40_000
    assert not reader.truncated


@pytest.mark.parametrize("claim", [statistics(struct.pack("<HQ", 1, 0)), statistics(b"")], ids=["zero", "nothing"])
def test_a_summary_is_not_believed_that_there_is_nothing(tmp_path: Path, claim: bytes) -> None:
    path = tmp_path / "liar.mcap"
    path.write_bytes(MAGIC + closed(DECLARED + message(), DECLARED + claim))
    bag = open_smpl_bag(path)
    assert (bag.message_count, len(list(bag))) == (1, 1)


def test_a_summary_is_not_believed_that_the_body_is_empty(tmp_path: Path) -> None:
    path = tmp_path / "liar.mcap"
    other = record(4, struct.pack("<HH", 2, 2) + text(b"/other") + text(b"cdr") + text(b""))
    declared = DECLARED + schema(2, name=b"std_msgs/msg/Bool") + other
    claim = statistics(struct.pack("<HQHQ", 1, 0, 2, 5), 5)
    path.write_bytes(MAGIC + closed(declared + message(), declared + claim))
    for topic in (None, "/smpl_params"):
        bag = open_smpl_bag(path, topic=topic)
        assert (bag.message_count, len(list(bag))) == (1, 1)


# metadata.yaml ------------------------------------------------------------------------------------

LIST = "  relative_file_paths:\n"


def filled(head: str, unit: str) -> str:
    return head + unit * ((MIB - len(head)) // len(unit))


METADATA = {
    "base 60": KEY + "  version: " + "1:" * 500_000 + "1\n  relative_file_paths: [a.mcap]\n",
    "digits": KEY + "  version: " + "9" * 1_000_000 + "\n  relative_file_paths: [a.mcap]\n",
    "empty numbers": KEY + '  version: !!int ""\n  duration: !!float ""\n  relative_file_paths: [a.mcap]\n',
    "one file often": filled(KEY + LIST, "  - a.mcap\n"),
    "one file by many ways": KEY + LIST + "".join(f"  - {i}/a.mcap\n" for i in range(40_000)),
}
NO_METADATA = {
    "a long list": KEY + "  relative_file_paths: [" + "a," * 500_000 + "a]\n",
    "open lists": filled("a: ", "["),
    "open mappings": filled("a: ", "{a: "),
    "open blocks": filled("", "- "),
    "directives": "".join(f"%TAG !a{i}! b\n" for i in range(60_000)),
    "directives on old lines": "a: b\n..." + "".join(f"\r%TAG !a{i}! b" for i in range(60_000)),
    "aliases": "- &a x\n" + "- *a\n" * 200_000,
    "anchors": "".join(f"- &a{i} b\n" for i in range(90_000)),
    "keys": "".join(f"k{i}: 1\n" for i in range(80_000)),
    "two values": "--- a\n--- b\n",
    "a list as a key": "? [a]\n: b\n",
    "no list": KEY,
    "numbers for names": KEY + LIST + "  - 5\n",
    "a NUL": KEY + LIST + '  - "a\\0.mcap"\n',
    "a lone surrogate": KEY + LIST + '  - "\\uD800.mcap"\n',
    "an escape": KEY + LIST + '  - "\\e[31m.mcap"\n',
    "a long name": KEY + LIST + "  - " + "x" * 100_000 + "\n",
    "the directory": KEY + LIST + "  - ..\n  - ''\n",
}


def bag_with(folder: Path, metadata: str) -> Path:
    shutil.copyfile(BAG, folder / "a.mcap")
    (folder / "metadata.yaml").write_text(metadata)
    return folder


@pytest.mark.parametrize("name", METADATA)
def test_metadata_that_takes_its_time_is_read(tmp_path: Path, name: str) -> None:
    path = bag_with(tmp_path, METADATA[name])
    assert run_limited(lambda: _holds(open_smpl_bag(path).message_count, 300)).error == ""


def _holds(got: object, wanted: object) -> None:
    assert got == wanted


@pytest.mark.parametrize("name", NO_METADATA)
def test_metadata_that_is_none_is_refused(tmp_path: Path, name: str) -> None:
    said = refusal(partial(BagReader, bag_with(tmp_path, NO_METADATA[name])))
    assert said.isprintable()
    assert len(said) <= 310


def test_metadata_that_is_too_large_or_not_utf8_is_refused(tmp_path: Path) -> None:
    path = bag_with(tmp_path, filled("", "#\n") + "##")
    assert "at most 1 MiB" in refusal(partial(BagReader, path))
    for content in (bytes(range(256)), "a: b".encode("utf-16")):
        (path / "metadata.yaml").write_bytes(content)
        assert "not rosbag2 metadata" in refusal(partial(BagReader, path))


@pytest.mark.parametrize("place", ["bag.mcap", "bag/metadata.yaml", "bag/a.mcap", "bag/listed.mcap"])
@pytest.mark.parametrize("kind", ["fifo", "device", "directory", "loop", "empty"])
def test_special_files_are_refused(tmp_path: Path, place: str, kind: str) -> None:
    path = tmp_path / place
    path.parent.mkdir(exist_ok=True)
    if path.name == "listed.mcap":
        (path.parent / "metadata.yaml").write_text(KEY + "  relative_file_paths: [listed.mcap]\n")
    match kind:
        case "fifo":
            os.mkfifo(path)
        case "device":
            path.symlink_to("/dev/zero")
        case "directory":
            path.mkdir()
        case "loop":
            path.symlink_to(path.name)
        case "empty":
            path.touch()
    assert refusal(partial(open_smpl_bag, tmp_path / place.split("/")[0]))


@pytest.mark.parametrize(
    "path", ["a\0b", "a\udc80b", 300 * "x", 3000 * "x/", "\x1b[31m", "/dev/null", "/proc/self/mem", ""]
)
def test_names_that_are_no_bag(path: str) -> None:
    said = refusal(partial(open_smpl_bag, path))
    assert said.isprintable()
    assert len(said) <= 310
