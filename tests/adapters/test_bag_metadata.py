"""What bags say of themselves, held key by key against what rosbag2's reader decodes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.reader import make_reader
from mcap.writer import Writer

from msg_adapters import INPUT_TYPES, BagReader, BagWriter, QosProfile, encoder_for, open_smpl_bag
from refu_core import SmplFrame

BAGS = Path(__file__).parents[2] / "bags"
SHIPPED = sorted(path.parent for path in BAGS.glob("*/metadata.yaml"))
KEY = "rosbag2_bagfile_information"

# What rosbag2_storage/yaml.hpp of ROS 2 Jazzy reads: each key, the type it is converted to, and the version of the
# metadata from which on it is read. A missing key, or one that can't be converted, is an exception of yaml-cpp.
BAG = {
    "version": ("int", 0),
    "storage_identifier": ("string", 0),
    "duration": ({"nanoseconds": ("uint64", 0)}, 0),
    "starting_time": ({"nanoseconds_since_epoch": ("uint64", 0)}, 0),
    "message_count": ("uint64", 0),
    "topics_with_message_count": ("topics", 0),
    "relative_file_paths": ("strings", 0),
    "compression_format": ("string", 3),
    "compression_mode": ("string", 3),
    "files": ("files", 5),
    "custom_data": ("map", 6),
    "ros_distro": ("string", 8),
}
TOPIC = {
    "name": ("string", 0),
    "type": ("string", 0),
    "serialization_format": ("string", 0),
    "offered_qos_profiles": ("profiles", 9),  # a sequence from version 9 on; text of one in 4 to 8
    "type_description_hash": ("string", 7),
}
FILE = {
    "path": ("string", 0),
    "starting_time": ({"nanoseconds_since_epoch": ("uint64", 0)}, 0),
    "duration": ({"nanoseconds": ("uint64", 0)}, 0),
    "message_count": ("uint64", 0),
}
TIME = {"sec": ("uint64", 0), "nsec": ("uint64", 0)}
# rosbag2_storage/qos.cpp; the names are those of rmw/qos_string_conversions.
PROFILE = {
    "history": (("system_default", "keep_last", "keep_all", "unknown"), 9),
    "depth": ("int", 0),
    "reliability": (("system_default", "reliable", "best_effort", "unknown", "best_available"), 9),
    "durability": (("system_default", "transient_local", "volatile", "unknown", "best_available"), 9),
    "deadline": (TIME, 0),
    "lifespan": (TIME, 0),
    "liveliness": (("system_default", "automatic", "manual_by_topic", "unknown", "best_available"), 9),
    "liveliness_lease_duration": (TIME, 0),
    "avoid_ros_namespace_conventions": (("true", "false"), 0),
}
RANGES = {"int": (-(2**31), 2**31), "uint64": (0, 2**64)}


def decode(value: Any, kind: Any, version: int) -> None:
    """Holds a node of YAML, whose scalars are all text, against the type it is converted to."""
    if isinstance(kind, dict):
        assert isinstance(value, dict), value
        for key, (inner, since) in kind.items():
            if version >= since:
                decode(value[key], inner, version)
    elif isinstance(kind, tuple):
        assert value in kind
    elif kind in RANGES:
        assert re.fullmatch(r"-?\d+", value), value
        assert RANGES[kind][0] <= int(value) < RANGES[kind][1]
    elif kind == "string":
        assert isinstance(value, str)
    elif kind == "map":
        assert value in ("null", "") or isinstance(value, dict)
    else:
        assert isinstance(value, list), value
        inner = {
            "topics": {"topic_metadata": (TOPIC, 0), "message_count": ("uint64", 0)},
            "files": FILE,
            "profiles": PROFILE,
            "strings": "string",
        }[kind]
        for item in value:
            decode(item, inner, version)


def decode_bag(file: Path) -> dict[str, Any]:
    """Decodes the metadata of a bag as rosbag2_storage_mcap does of the file and rosbag2_storage of the directory.

    Returns the file's.
    """
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert [index.name for index in summary.metadata_indexes] == ["rosbag2"]  # it is found by its index
        (record,) = reader.iter_metadata()
    found: dict[str, Any] = yaml.load(record.metadata["serialized_metadata"], Loader=yaml.BaseLoader)
    decode(found, BAG, int(found["version"]))
    for channel in summary.channels.values():
        profiles = yaml.load(channel.metadata["offered_qos_profiles"], Loader=yaml.BaseLoader)
        decode(profiles, "profiles", int(found["version"]))
        assert "topic_type_hash" in channel.metadata
    beside = file.parent / "metadata.yaml"
    if beside.exists():
        whole = yaml.load(beside.read_text(), Loader=yaml.BaseLoader)
        assert whole == {KEY: found}
    return found


def write_bag(path: Path) -> Path:
    with BagWriter(path) as bag:
        for name, qos in (("/a", QosProfile()), ("/b", QosProfile("best_effort", 1))):
            bag.add_topic(name, INPUT_TYPES["multiarray"], qos=qos)
            bag.write(name, encoder_for("multiarray")(SmplFrame([0.0] * 72)), log_time_ns=7)
    return bag.file_path


@pytest.mark.parametrize("name", ["bag", "bag.mcap"])
def test_rosbag2_decodes_what_is_written(tmp_path: Path, name: str) -> None:
    found = decode_bag(write_bag(tmp_path / name))
    assert (found["version"], found["storage_identifier"], found["message_count"]) == ("9", "mcap", "2")
    assert [topic["topic_metadata"]["name"] for topic in found["topics_with_message_count"]] == ["/a", "/b"]


def test_rosbag2_decodes_an_empty_bag(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "bag")
    bag.finish()
    assert decode_bag(bag.file_path)["topics_with_message_count"] == []


@pytest.mark.parametrize("bag", SHIPPED, ids=lambda path: path.name)
def test_rosbag2_decodes_the_bags_that_ship(bag: Path) -> None:
    (file,) = bag.glob("*.mcap")
    assert int(decode_bag(file)["message_count"]) > 50


def test_bags_with_the_old_record_are_read(tmp_path: Path) -> None:
    """The first recordings had the key in the record that belongs into metadata.yaml alone."""
    data = encoder_for("multiarray")(SmplFrame([0.0] * 72))
    path = tmp_path / "old.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema(INPUT_TYPES["multiarray"], "ros2msg", b"")
        writer.add_message(writer.register_channel("/smpl_params", "cdr", schema), 1, data, 1)
        writer.add_metadata("rosbag2", {"serialized_metadata": f"{KEY}:\n  version: 9\n"})
        writer.finish()
    assert [record.raw for record in open_smpl_bag(path)] == [data]
    assert BagReader(path).warnings == []
