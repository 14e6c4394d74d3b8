"""Bags: opened by two independent readers, read back whole, cut short, damaged and hostile."""

from __future__ import annotations

import gzip
import os
import resource
import shutil
import signal
import struct
import sys
import tracemalloc
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import yaml
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_ros2.decoder import DecoderFactory
from reference import deserialise
from rosbags.rosbag2 import Reader as RosbagsReader
from scipy.spatial.transform import Rotation

from msg_adapters import (
    INPUT_TYPES,
    MARKER_ARRAY,
    BagError,
    BagReader,
    BagWriter,
    MarkerArrayEncoder,
    MarkerMesh,
    QosProfile,
    encode_diagnostics,
    encoder_for,
    iter_smpl_frames,
    message_definition,
    open_smpl_bag,
)
from msg_adapters.bags._mcap_writer import McapWriter
from msg_adapters.bags._metadata import TopicSummary, dump_metadata
from refu_core import SmplFrame, load_body

if TYPE_CHECKING:
    from collections.abc import Callable

BAGS = Path(__file__).parents[2] / "bags"
START_NS = 1_700_000_000_000_000_000
STEP_NS = 33_333_333
TOPIC = "/smpl_params"


def frame(i: int) -> SmplFrame:
    return SmplFrame(np.full(72, 0.01 * i), transl=[0, 1, 0.1 * i], stamp_ns=START_NS + i * STEP_NS)


def write_bag(path: Path, *, input_type: str = "joint_state", count: int = 40, **options: Any) -> Path:
    encode = encoder_for(input_type)
    with BagWriter(path, **options) as bag:
        bag.add_topic(TOPIC, INPUT_TYPES[input_type])
        for i in range(count):
            bag.write(TOPIC, encode(frame(i)), log_time_ns=frame(i).stamp_ns + 5)
    return bag.file_path


@pytest.fixture
def every_type(tmp_path: Path) -> Path:
    """A bag with a topic of every type that the project writes."""
    mesh = MarkerMesh("skirt-female", np.array([[0, 1, 2]]), 3)
    messages = {f"/in/{name}": (INPUT_TYPES[name], encoder_for(name)(frame(1))) for name in INPUT_TYPES}
    messages["/garments"] = (MARKER_ARRAY, MarkerArrayEncoder([mesh]).encode([np.eye(3)], stamp_ns=7))
    messages["/diagnostics"] = ("diagnostic_msgs/msg/DiagnosticArray", encode_diagnostics([], stamp_ns=7))
    with BagWriter(tmp_path / "bag") as bag:
        for topic, (message_type, data) in messages.items():
            bag.add_topic(topic, message_type, qos=QosProfile(reliability="best_effort", depth=1))
            bag.write(topic, data, log_time_ns=START_NS)
    return tmp_path / "bag"


# ------------------------------------------------------------------------------------------------ what others read


def test_mcap_ros2_decodes_every_message(every_type: Path) -> None:
    with (every_type / "bag_0.mcap").open("rb") as file:
        decoded = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        messages = {channel.topic: message for _, channel, _, message in decoded}
    assert len(messages) == len(INPUT_TYPES) + 2
    names, position = messages["/in/joint_state"].name, messages["/in/joint_state"].position
    np.testing.assert_array_equal(position[names.index("left_hip_x") :][:3], frame(1).pose[1])
    marker = messages["/garments"].markers[0]
    assert marker.ns == "skirt-female"
    assert [(p.x, p.y, p.z) for p in marker.points] == [(0, 1, 0), (0, 0, 1), (1, 0, 0)]


def test_rosbags_opens_the_directory_and_the_file(every_type: Path) -> None:
    for path in (every_type, every_type / "bag_0.mcap"):
        with RosbagsReader(path) as reader:
            read = {connection.topic: (connection, time, data) for connection, time, data in reader.messages()}
            assert reader.message_count == len(read) == len(INPUT_TYPES) + 2
        for connection, time, data in read.values():
            assert time == START_NS
            if connection.msgtype != INPUT_TYPES["smpl_msgs"]:
                assert deserialise(data, connection.msgtype) is not None
            assert connection.msgdef.data == message_definition(connection.msgtype).text
            if path.is_dir():
                assert connection.digest == message_definition(connection.msgtype).type_hash
            (qos,) = connection.ext.offered_qos_profiles
            assert (qos.reliability.name, qos.durability.name, qos.history.name, qos.depth) == (
                "BEST_EFFORT",
                "VOLATILE",
                "KEEP_LAST",
                1,
            )


def test_the_file_is_laid_out_as_rosbag2_lays_it_out(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", chunk_bytes=4096)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        statistics = summary.statistics
        assert (statistics.message_count, statistics.message_start_time) == (40, START_NS + 5)
        assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
        assert len(summary.chunk_indexes) > 10
        (schema,) = summary.schemas.values()
        assert (schema.name, schema.encoding) == (INPUT_TYPES["joint_state"], "ros2msg")
        assert [m.log_time for _, _, m in reader.iter_messages()] == [frame(i).stamp_ns + 5 for i in range(40)]
    information = yaml.safe_load((tmp_path / "bag" / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert (information["version"], information["storage_identifier"]) == (9, "mcap")
    assert information["relative_file_paths"] == ["bag_0.mcap"]
    assert information["duration"]["nanoseconds"] == 39 * STEP_NS


def reference_bag(path: Path, *, chunk_bytes: int, messages: list[tuple[int, int, int]]) -> None:
    """As `BagWriter` writes it, by the mcap package."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_bytes, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="refu-ros")
        channels = []
        for topic, message_type in TWO_TOPICS:
            definition = message_definition(message_type)
            schema = writer.register_schema(message_type, "ros2msg", definition.text.encode())
            metadata = {"offered_qos_profiles": QosProfile().to_yaml(), "topic_type_hash": definition.type_hash}
            channels.append(writer.register_channel(topic, "cdr", schema, metadata))
        counts = [0, 0]
        for topic_number, time_ns, size in messages:
            data = content(time_ns, size)
            writer.add_message(channels[topic_number], time_ns, data, time_ns, counts[topic_number])
            counts[topic_number] += 1
        writer.flush()
        times = [time_ns for _, time_ns, _ in messages]
        summaries = [
            TopicSummary(topic, kind, message_definition(kind).type_hash, QosProfile(), channel)
            for (topic, kind), channel in zip(TWO_TOPICS, channels, strict=True)
        ]
        end, sent = max(times, default=0), dict(zip(channels, counts, strict=True))
        when = {"start_ns": min(times, default=end), "end_ns": end}
        _, record = dump_metadata(file_name=path.name, topics=summaries, counts=sent, **when)
        writer.add_metadata("rosbag2", {"serialized_metadata": record})
        writer.finish()


TWO_TOPICS = [("/garments", MARKER_ARRAY), (TOPIC, INPUT_TYPES["joint_state"])]


def content(seed: int, size: int) -> bytes:
    return np.random.default_rng(seed).integers(0, 9, size, np.uint8).tobytes()


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 1), st.integers(0, 2**40), st.integers(0, 5000)), max_size=12),
    st.sampled_from([1, 3000, 1 << 20]),
)
def test_the_file_is_the_mcap_packages_own(
    tmp_path_factory: pytest.TempPathFactory, messages: list[tuple[int, int, int]], chunk_bytes: int
) -> None:
    """Byte for byte, also where chunks are packed in the background."""
    folder = tmp_path_factory.mktemp("own")
    wanted = folder / "wanted" / "bag.mcap"
    wanted.parent.mkdir()
    reference_bag(wanted, chunk_bytes=chunk_bytes, messages=messages)
    for in_background in (False, True):
        path = folder / str(in_background) / "bag.mcap"
        with BagWriter(path, chunk_bytes=chunk_bytes, in_background=in_background) as bag:
            for topic, message_type in TWO_TOPICS:
                bag.add_topic(topic, message_type)
            for topic_number, time_ns, size in messages:
                bag.write(TWO_TOPICS[topic_number][0], content(time_ns, size), log_time_ns=time_ns)
        assert path.read_bytes() == wanted.read_bytes()


# ------------------------------------------------------------------------------------------------ there and back


@pytest.mark.parametrize("input_type", INPUT_TYPES)
@pytest.mark.parametrize("name", ["bag", "bag.mcap"])
def test_round_trip(tmp_path: Path, input_type: str, name: str) -> None:
    path = write_bag(tmp_path / name, input_type=input_type)
    assert path.parent == (tmp_path / "bag" if name == "bag" else tmp_path)
    bag = open_smpl_bag(tmp_path / name)
    records = list(bag)
    assert bag.message_count == len(records) == 40
    assert bag.topic.message_type == INPUT_TYPES[input_type]
    assert not bag.reader.truncated
    assert bag.reader.warnings == []
    for i, record in enumerate(records):
        assert record.frame is not None
        # Float32MultiArray has no stamp: when it was received has to do.
        assert record.stamp_ns == record.frame.stamp_ns == frame(i).stamp_ns + (5 if input_type == "multiarray" else 0)
        assert (record.log_time_ns, record.topic) == (frame(i).stamp_ns + 5, TOPIC)
        np.testing.assert_allclose(record.frame.pose, frame(i).pose, atol=1e-6)
        assert record.raw == encoder_for(input_type)(frame(i))


def test_several_files_are_read_in_order(tmp_path: Path) -> None:
    bag = tmp_path / "split"
    bag.mkdir()
    for part in range(3):
        file = write_bag(tmp_path / f"{part}.mcap", count=part + 2)
        shutil.move(file, bag / f"z{2 - part}.mcap")
    names = ["split/z2.mcap", "split/z1.mcap", "z0.mcap"]  # bags of old versions list the directory too
    metadata = {"storage_identifier": "mcap", "relative_file_paths": names, "compression_mode": "NONE"}
    (bag / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": metadata}))
    reader = BagReader(bag)
    assert [topic.message_count for topic in reader.topics] == [9]
    times = [message.log_time_ns for message in reader.messages()]
    assert times == [frame(i).stamp_ns + 5 for part in range(3) for i in range(part + 2)]


def test_a_topic_says_whose_betas_it_has(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag.mcap") as bag:
        bag.add_topic(TOPIC, INPUT_TYPES["joint_state"], betas_of="builtin")
        bag.write(TOPIC, encoder_for("joint_state")(frame(0)), log_time_ns=1)
    (topic,) = BagReader(tmp_path / "bag.mcap").topics
    assert topic.betas_of == "builtin"
    with RosbagsReader(tmp_path / "bag.mcap") as reader:  # others don't mind
        assert reader.message_count == 1
    assert all(
        topic.betas_of == "builtin" for name in ("walk", "reach_squat") for topic in BagReader(BAGS / name).topics
    )
    (topic,) = BagReader(write_bag(tmp_path / "silent.mcap", count=1)).topics
    assert topic.betas_of == ""


@pytest.mark.parametrize("compression", [CompressionType.LZ4, CompressionType.NONE])
def test_two_channels_of_one_topic_are_one(tmp_path: Path, compression: CompressionType) -> None:
    data = encoder_for("joint_state")(frame(0))
    with (tmp_path / "two.mcap").open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start(profile="ros2")
        schema = writer.register_schema("sensor_msgs/JointState", "ros2msg", b"")  # the short name occurs as well
        for _ in range(2):
            channel = writer.register_channel(TOPIC, "cdr", schema)
            writer.add_message(channel, START_NS, data, START_NS - 3)
        writer.finish()
    pytest.importorskip("lz4")
    bag = open_smpl_bag(tmp_path / "two.mcap")
    assert [record.raw for record in bag] == [data, data]
    assert all(m.publish_time_ns == m.log_time_ns - 3 for m in bag.reader.messages())
    assert bag.message_count == 2


def test_only_the_topics_asked_for(every_type: Path) -> None:
    reader = BagReader(every_type)
    assert {m.topic for m in reader.messages({"/garments", "/nothing"})} == {"/garments"}
    assert all(m.publish_time_ns == m.log_time_ns == START_NS for m in reader.messages())


def test_bad_messages_are_records_and_the_rest_goes_on(tmp_path: Path) -> None:
    nan = bytearray(encoder_for("joint_state")(frame(1)))
    nan[-40:-32] = struct.pack("<d", np.nan)
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic(TOPIC, INPUT_TYPES["joint_state"])
        for i, data in enumerate(
            [encoder_for("joint_state")(frame(0)), b"", bytes(nan), encoder_for("joint_state")(frame(3))]
        ):
            bag.write(TOPIC, data, log_time_ns=100 + i)
    records = list(iter_smpl_frames(tmp_path / "bag"))
    assert [record.frame is None for record in records] == [False, True, True, False]
    assert [record.stamp_ns for record in records] == [frame(0).stamp_ns, 101, 102, frame(3).stamp_ns]
    assert "header of 4 bytes, got 0 bytes" in str(records[1].error)
    assert "NaN" in str(records[2].error)
    for record in records:
        assert (len(repr(record).splitlines()), len(repr(record)) < 300) == (1, True)


def test_messages_of_another_type_on_the_topic_are_named(tmp_path: Path) -> None:
    """They were read as what they aren't, each with a reason of its own that named no type."""
    kinds = "joint_state", "pose_array"
    with (tmp_path / "two.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        for i in range(6):
            kind = kinds[i % 2]
            schema = writer.register_schema(INPUT_TYPES[kind], "ros2msg", b"")
            channel = writer.register_channel(TOPIC, "cdr", schema)
            writer.add_message(channel, START_NS + i, encoder_for(kind)(frame(i)), START_NS + i)
        writer.finish()
    bag = open_smpl_bag(tmp_path / "two.mcap")
    said = [str(record.error) for record in bag if record.error is not None]
    assert said == [f"wanted {INPUT_TYPES['joint_state']}, got {INPUT_TYPES['pose_array']}"] * 3


def test_a_channel_in_another_encoding_costs_nothing_else(tmp_path: Path) -> None:
    """The bag was refused where a bridge had declared its JSON before the node its CDR."""
    data = encoder_for("joint_state")(frame(1))
    with (tmp_path / "two.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        for encoding, schema, content in (("json", "jsonschema", b"{}"), ("cdr", "ros2msg", data)):
            number = writer.register_schema(INPUT_TYPES["joint_state"], schema, b"")
            writer.add_message(writer.register_channel(TOPIC, encoding, number), START_NS, content, 2**64 - 1)
        writer.finish()
    bag = open_smpl_bag(tmp_path / "two.mcap")
    assert [record.frame is None for record in bag] == [True, False]
    # A publish time that nobody has set is all ones; the log time stands for it.
    assert [message.publish_time_ns for message in bag.reader.messages()] == [START_NS] * 2
    assert bag.reader.warnings == []


@pytest.mark.parametrize("last", ["missing", "empty", "packed"])
@pytest.mark.parametrize("listed", [True, False])
def test_one_file_that_cannot_be_read_costs_nothing_else(tmp_path: Path, last: str, *, listed: bool) -> None:
    """A recorder opens the next file of a split bag, and the power fails: none of the bag could be read."""
    first = write_bag(tmp_path / "bag")
    second = first.with_name("bag_1.mcap")
    metadata = first.with_name("metadata.yaml")
    if listed:
        metadata.write_text(metadata.read_text().replace("- bag_0.mcap\n", "- bag_0.mcap\n  - bag_1.mcap\n"))
    else:
        metadata.unlink()
    if last == "empty":
        second.touch()
    elif last == "packed":
        second = second.with_name("bag_1.mcap" if listed else "bag_1.mcap.zstd")
        second.write_bytes(zstandard.compress(first.read_bytes()))
    elif not listed:
        second.symlink_to("nowhere")
    reader = BagReader(tmp_path / "bag")
    assert len([*reader.messages()]) == 40
    assert reader.truncated
    (said,) = (line for line in reader.warnings if "left out" in line)
    assert str(second) in said
    assert ("zstd -d" in said) == (last == "packed")
    first.unlink()
    with pytest.raises(BagError, match="bag_"):
        BagReader(tmp_path / "bag")


def test_files_that_the_metadata_does_not_list_are_named_once(tmp_path: Path) -> None:
    """Half of a split bag wasn't read, and nothing said so."""
    bag = write_bag(tmp_path / "bag").parent
    assert BagReader(bag).warnings == []
    for name in ("bag_1.mcap", "bag_2.db3", "notes.txt"):
        (bag / name).write_bytes(b"")
    reader = BagReader(bag)
    for _ in range(2):
        assert len([*reader.messages()]) == 40
        assert reader.warnings == [f"{bag}: metadata.yaml doesn't list bag_1.mcap and 1 more: not read"]
    assert not reader.truncated


def test_a_message_received_at_an_impossible_time(tmp_path: Path) -> None:
    data = encoder_for("multiarray")(frame(0))
    path = tmp_path / "late.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel(
            TOPIC, "cdr", writer.register_schema(INPUT_TYPES["multiarray"], "ros2msg", b"")
        )
        for time in (2**62, 2**63, 5):
            writer.add_message(channel, time, data, 0)
        writer.finish()
    bag = open_smpl_bag(path)
    first, last = bag
    assert "impossible time" in str(first.error)
    assert last.frame is not None
    assert "a time that ROS can't hold" in bag.reader.warnings[0]


# ------------------------------------------------------------------------------------------------ choosing the topic


def test_the_usual_name_decides(tmp_path: Path) -> None:
    def write(path: Path, topics: list[str]) -> Path:
        with BagWriter(path) as bag:
            for topic in topics:
                bag.add_topic(topic, INPUT_TYPES["joint_state"])
                bag.write(topic, encoder_for("joint_state")(frame(0)), log_time_ns=1)
        return path

    assert open_smpl_bag(write(tmp_path / "a", ["/body"])).topic.name == "/body"
    assert (
        open_smpl_bag(write(tmp_path / "b", ["/joint_states", "/anna/smpl_params"])).topic.name == "/anna/smpl_params"
    )
    two = write(tmp_path / "c", ["/anna/smpl_params", "/ben/smpl_params"])
    with pytest.raises(BagError, match=r"2 topics could carry the body: /anna.* \(sensor_.*\), /ben.*one by topic"):
        open_smpl_bag(two)
    assert open_smpl_bag(two, topic="ben/smpl_params").topic.name == "/ben/smpl_params"
    assert [one.topic for one in iter_smpl_frames(two, topic="/ben/smpl_params")] == ["/ben/smpl_params"]
    with pytest.raises(BagError, match=r"no topic /carl; the bag has /anna"):
        open_smpl_bag(two, topic="/carl")
    with pytest.raises(BagError, match="doesn't carry std_msgs/msg/Float32MultiArray"):
        open_smpl_bag(two, topic="/ben/smpl_params", input_type="multiarray")
    with pytest.raises(BagError, match="no SMPL topic"):
        open_smpl_bag(two, input_type="multiarray")


def test_bags_without_a_body(tmp_path: Path, every_type: Path) -> None:
    with pytest.raises(BagError, match=r"4 topics could carry the body"):
        open_smpl_bag(every_type)
    with pytest.raises(BagError, match=r"/garments \(visualization_msgs/msg/MarkerArray\) doesn't carry a body"):
        open_smpl_bag(every_type, topic="/garments")
    with BagWriter(tmp_path / "none") as bag:
        bag.add_topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        bag.write("/diagnostics", encode_diagnostics([], stamp_ns=0), log_time_ns=0)
    with pytest.raises(BagError, match=r"no SMPL topic; the bag has /diagnostics \(diag.*wanted a topic of std_msgs"):
        open_smpl_bag(tmp_path / "none")
    with BagWriter(tmp_path / "markers") as bag:
        bag.add_topic("/ann/smpl_params", MARKER_ARRAY)
        bag.write("/ann/smpl_params", bytes([0, 1, 0, 0, 0, 0, 0, 0]), log_time_ns=0)
    with pytest.raises(BagError, match="for keypoints in smpl_params set the input type to keypoint_markers"):
        open_smpl_bag(tmp_path / "markers")
    BagWriter(tmp_path / "empty").finish()
    with pytest.raises(BagError, match="no message in this bag"):
        open_smpl_bag(tmp_path / "empty")


def test_other_encodings_are_named(tmp_path: Path) -> None:
    with (tmp_path / "json.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(INPUT_TYPES["multiarray"], "jsonschema", b"{}")
        writer.add_message(writer.register_channel(TOPIC, "json", schema), 1, b"{}", 1)
        writer.finish()
    with pytest.raises(BagError, match="encoded as json; wanted cdr"):
        open_smpl_bag(tmp_path / "json.mcap")


def make_sqlite(path: Path) -> None:
    path.write_bytes(b"SQLite format 3\0" + bytes(100))


def make_other_storage(path: Path) -> None:
    path.mkdir()
    metadata = {"storage_identifier": "my_storage", "relative_file_paths": ["a.own"], "compression_mode": ""}
    (path / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": metadata}))


def make_missing_file_bag(path: Path) -> None:
    path.mkdir()
    metadata = {"storage_identifier": "mcap", "relative_file_paths": ["gone.mcap"]}
    (path / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": metadata}))


def make_odd_metadata(path: Path) -> None:
    path.mkdir()
    (path / "metadata.yaml").write_text("- just a list")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda _: None, "No such file or directory; wanted a .mcap or .db3 file"),
        (Path.touch, "an empty file"),
        (Path.mkdir, "no .mcap or .db3 file in this directory; wanted .* a file of motion"),
        (
            lambda path: path.write_text("hello, world"),
            "not an MCAP file; wanted a .mcap or .db3 file, a rosbag2 directory",
        ),
        (lambda path: path.write_text("version https://git-lfs.github.com/spec/v1"), "`git lfs pull`"),
        (lambda path: path.write_bytes(gzip.compress(b"")), "unpack it with `gunzip`"),
        (lambda path: (path.mkdir(), (path / "0.db3").write_text("hello, world")), "not an SQLite file; wanted"),
        (make_sqlite, "the database can.t be read"),
        (make_other_storage, "stored as my_storage .* only plain mcap or sqlite3 is read; convert it"),
        (make_missing_file_bag, "gone.mcap: can.t be .*: No such file"),
        (make_odd_metadata, "not rosbag2 metadata"),
    ],
)
def test_what_is_no_bag(tmp_path: Path, make: Callable[[Path], Any], message: str) -> None:
    make(tmp_path / "bag")
    with pytest.raises(BagError, match=message) as caught:
        open_smpl_bag(tmp_path / "bag")
    assert "\n" not in str(caught.value)
    assert str(tmp_path / "bag") in str(caught.value)


# ------------------------------------------------------------------------------------------------ cut and damaged


def test_a_bag_cut_anywhere_gives_what_is_before_the_cut(tmp_path: Path) -> None:
    whole = write_bag(tmp_path / "whole.mcap", chunk_bytes=4096).read_bytes()
    stamps = [frame(i).stamp_ns for i in range(40)]
    counts = []
    for cut in sorted({*range(0, len(whole), 61), *range(len(whole) - 40, len(whole))}):
        path = tmp_path / "cut.mcap"
        path.write_bytes(whole[:cut])
        try:
            bag = open_smpl_bag(path)
        except BagError:
            counts.append(0)
            continue
        read = [record.stamp_ns for record in bag]
        assert read == stamps[: len(read)]
        # What is cut off the summary isn't missed; what is cut off the data is.
        assert len(read) == 40 or bag.reader.truncated
        assert len(read) == bag.message_count
        counts.append(len(read))
    assert counts == sorted(counts)
    assert {0, 40} < set(counts)
    assert len(set(counts)) > 10


def test_a_directory_whose_recording_was_interrupted(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", chunk_bytes=4096)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    path.write_bytes(path.read_bytes()[:3000])
    path.rename(path.with_name("²1.mcap"))  # ² is a digit, and no number
    bag = open_smpl_bag(tmp_path / "bag")
    assert 0 < len(list(bag)) < 40
    assert "was the recording interrupted?" in bag.reader.warnings[0]


@pytest.mark.parametrize("index", [0, 3])  # the first one declares the topic; the summary does so again
def test_a_damaged_chunk_is_left_out(tmp_path: Path, index: int) -> None:
    path = write_bag(tmp_path / "bag.mcap", chunk_bytes=4096)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[index]
    data = bytearray(path.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length - 5] ^= 0xFF
    path.write_bytes(data)
    reader = BagReader(path)
    times = {m.log_time_ns for m in reader.messages()}
    missing = {frame(i).stamp_ns + 5 for i in range(40)} - times
    assert missing == {t for t in missing if chunk.message_start_time <= t <= chunk.message_end_time} != set()
    assert reader.truncated
    assert f"in the record at byte {chunk.chunk_start_offset}" in reader.warnings[0]


@settings(max_examples=400)
@given(st.data())
def test_damaged_bags_raise_nothing_else(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder = tmp_path_factory.getbasetemp()
    whole = folder / "fuzz.mcap"
    if not whole.exists():
        write_bag(whole, count=6, chunk_bytes=2048)
    content = bytearray(whole.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(content) - 1))
        new = data.draw(st.one_of(st.binary(min_size=1, max_size=8), st.just(b"\xff" * 8), st.just(bytes(8))))
        content[at : at + len(new)] = new
    path = folder / "damaged.mcap"
    path.write_bytes(content)
    try:
        records = list(iter_smpl_frames(path))
    except BagError as error:
        records = []
        message = str(error)
        assert "\n" not in message
    assert len(records) <= 6


def chunk_record(*, size: int, packed: bytes, compression: bytes = b"zstd") -> bytes:
    content = struct.pack("<QQQI", 0, 0, size, 0)
    content += struct.pack("<I", len(compression)) + compression + struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 0x06, len(content)) + content


@pytest.mark.parametrize(
    ("record", "message"),
    [
        (chunk_record(size=2**60, packed=zstandard.compress(bytes(1000))), "at most 128 are read"),
        (chunk_record(size=1000, packed=zstandard.compress(bytes(1 << 28))), "unpacks to 1001 bytes where 1000"),
        (chunk_record(size=1000, packed=b"no zstd"), "zstd can't unpack"),
        (chunk_record(size=7, packed=b"1234567", compression=b"rot13"), "unknown compression 'rot13'"),
        (chunk_record(size=7, packed=b"1234567", compression=b""), "7 bytes where a record should start"),
        (struct.pack("<BQ", 0x06, 2**63), "wants 9223372036854775808 bytes"),
        (struct.pack("<BQ", 0x05, 3) + b"abc", "a message record of 3 bytes"),
        (struct.pack("<BQHIQQ", 0x05, 22, 9, 0, 0, 0), "undeclared channel 9"),
        (struct.pack("<BQHI", 0x03, 6, 1, 2**32 - 1), "a field of 4294967295 bytes where 0 are left"),
    ],
)
def test_hostile_records(tmp_path: Path, record: bytes, message: str) -> None:
    path = tmp_path / "hostile.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + record)
    tracemalloc.start()
    with pytest.raises(BagError, match=r"no message in this bag") as caught:
        open_smpl_bag(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 << 20
    assert message in str(caught.value) or message in "".join(warnings_of(path))


def warnings_of(path: Path) -> list[str]:
    reader = BagReader(path)
    assert list(reader.messages()) == []
    return reader.warnings


def test_reading_and_writing_stream(tmp_path: Path) -> None:
    """A bag far larger than a chunk passes through in the memory of a few chunks."""
    blob = np.random.default_rng(0).bytes(1 << 20)
    tracemalloc.start()
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/garments", MARKER_ARRAY)
        for i in range(48):
            bag.write("/garments", blob, log_time_ns=i)
    assert sum(len(m.data) for m in BagReader(tmp_path / "bag").messages()) == 48 << 20
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 24 << 20


# ------------------------------------------------------------------------------------------------ the writer's errors


def test_the_writer_says_what_is_wrong(tmp_path: Path) -> None:
    bag = BagWriter(tmp_path / "bag")
    with pytest.raises(BagError, match="no definition of my_msgs/msg/Thing is built in"):
        bag.add_topic("/thing", "my_msgs/Thing")
    bag.add_topic("/thing", "my_msgs/Thing", definition="int32 x", type_hash="RIHS01_0")
    bag.add_topic("/thing", "my_msgs/msg/Thing")
    with pytest.raises(BagError, match="/thing already carries my_msgs/msg/Thing"):
        bag.add_topic("/thing", MARKER_ARRAY)
    with pytest.raises(BagError, match="/other isn't declared"):
        bag.write("/other", b"", log_time_ns=0)
    for time in (-1, 2**63):
        with pytest.raises(BagError, match="a bag's times are nanoseconds"):
            bag.write("/thing", b"", log_time_ns=time)
    bag.write("/thing", b"\0\1\0\0", log_time_ns=0)
    bag.finish()
    bag.finish()
    with pytest.raises(BagError, match="the bag is finished"):
        bag.write("/thing", b"", log_time_ns=0)
    with pytest.raises(BagError, match="the directory isn't empty"):
        BagWriter(tmp_path / "bag")
    assert [t.definition for t in BagReader(tmp_path / "bag").topics] == ["int32 x"]


def test_overwriting_touches_nothing_but_a_bag(tmp_path: Path) -> None:
    file, directory = tmp_path / "a.mcap", tmp_path / "b"
    for path in (file, directory):
        write_bag(path, count=3)
        with pytest.raises(BagError, match=r"choose another path, or --overwrite it"):
            write_bag(path)
        write_bag(path, count=2, overwrite=True)
        assert len(list(iter_smpl_frames(path))) == 2
    for other in ("thesis.tex", "monday.mcap"):
        (directory / other).touch()
        with pytest.raises(BagError, match=f"holds other files than a bag's: {other}"):
            write_bag(directory, overwrite=True)
        (directory / other).unlink()
    assert len(list(iter_smpl_frames(directory))) == 2


@pytest.mark.parametrize("name", ["a.mcap", "b"])
def test_what_is_overwritten_stays_until_the_new_bag_is_whole(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    write_bag(path, count=3)
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    writer = BagWriter(path, overwrite=True)
    writer.add_topic("/thing", MARKER_ARRAY)
    writer.write("/thing", b"\0\1\0\0", log_time_ns=0)
    writer.sync()
    assert len(list(iter_smpl_frames(path))) == 3
    writer.discard()
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before
    for file in before:  # of a process that was killed
        file.with_name(f"{file.name}.partial").write_bytes(b"torn")
    write_bag(path, count=2, overwrite=True)
    assert len(list(iter_smpl_frames(path))) == 2
    assert {file for file in tmp_path.rglob("*") if file.is_file()} == before.keys()
    link = tmp_path / "link.mcap"
    if path.is_file():
        link.symlink_to(path)
        write_bag(link, count=1, overwrite=True)
        assert link.is_symlink()
        assert len(list(iter_smpl_frames(path))) == 1


def test_paths_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for path in (tmp_path / "file" / "bag", tmp_path / "file" / "bag.mcap"):
        with pytest.raises(BagError, match=r"can't be written: (Not a directory|File exists)"):
            BagWriter(path)
    with pytest.raises(BagError, match="wanted a name in UTF-8"):
        BagWriter(tmp_path / "\udcff")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/dev/full is Linux's")
@pytest.mark.parametrize("in_background", [False, True])
def test_a_full_disk_is_one_line(tmp_path: Path, in_background: bool) -> None:
    (tmp_path / "full.mcap").symlink_to("/dev/full")
    with pytest.raises(BagError, match=r"can't be written: No space left on device"):
        write_bag(tmp_path / "full.mcap", overwrite=True, in_background=in_background)


@pytest.mark.parametrize("in_background", [False, True])
def test_a_disk_that_fills_up_leaves_what_it_took(tmp_path: Path, in_background: bool) -> None:
    """Whichever call it is that says so."""
    pid = os.fork()
    if pid == 0:  # the limit is a process's own
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))
        try:
            write_bag(tmp_path / "bag.mcap", count=400, chunk_bytes=4096, in_background=in_background)
        except BagError as error:
            os._exit(0 if "File too large" in str(error) else 1)
        os._exit(2)
    assert os.waitpid(pid, 0)[1] == 0
    bag = open_smpl_bag(tmp_path / "bag.mcap")
    assert len(list(bag)) > 10
    assert bag.reader.truncated
    assert "without its closing records" in bag.reader.warnings[0]  # nothing torn


@pytest.mark.parametrize("in_background", [False, True])
def test_a_kill_leaves_all_but_the_chunks_in_hand(tmp_path: Path, in_background: bool) -> None:
    pid = os.fork()
    if pid == 0:
        with BagWriter(tmp_path / "bag.mcap", chunk_bytes=1, in_background=in_background) as bag:  # a chunk a message
            bag.add_topic(TOPIC, INPUT_TYPES["joint_state"])
            for i in range(30):
                bag.write(TOPIC, encoder_for("joint_state")(frame(i)), log_time_ns=i)
            os.kill(os.getpid(), signal.SIGKILL)
    assert os.waitpid(pid, 0)[1] == signal.SIGKILL
    assert len(list(open_smpl_bag(tmp_path / "bag.mcap"))) >= 30 - in_background


def test_an_interrupted_run_leaves_a_whole_bag(tmp_path: Path) -> None:
    def interrupted() -> None:
        with BagWriter(tmp_path / "bag") as bag:
            bag.add_topic(TOPIC, INPUT_TYPES["joint_state"])
            for i in range(5):
                bag.write(TOPIC, encoder_for("joint_state")(frame(i)), log_time_ns=i)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    bag = open_smpl_bag(tmp_path / "bag")
    assert len(list(bag)) == 5
    assert bag.reader.warnings == []


@pytest.mark.parametrize("in_background", [False, True])
def test_an_interrupt_within_a_write_leaves_what_is_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_background: bool
) -> None:
    def torn() -> None:
        with BagWriter(tmp_path / "bag.mcap", chunk_bytes=4096, in_background=in_background) as bag:
            bag.add_topic(TOPIC, INPUT_TYPES["joint_state"])
            for i in range(30):
                if i == 20:
                    monkeypatch.setattr(McapWriter, "_end_chunk", interrupt)
                bag.write(TOPIC, encoder_for("joint_state")(frame(i)), log_time_ns=i)

    def interrupt(_: McapWriter) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        torn()
    monkeypatch.undo()
    bag = open_smpl_bag(tmp_path / "bag.mcap")
    assert 15 < len(list(bag)) <= 21
    assert bag.reader.truncated


# ------------------------------------------------------------------------------------------------ the bags we ship


@pytest.mark.parametrize(("name", "input_type"), [("walk", "multiarray"), ("reach_squat", "joint_state")])
def test_shipped_bags(name: str, input_type: str) -> None:
    bag = open_smpl_bag(BAGS / name)
    records = list(bag)
    assert bag.decoder.input_type == input_type
    assert len(records) == 300
    frames = [record.frame for record in records if record.frame is not None]
    assert len(frames) == 300
    assert np.allclose(np.diff([f.stamp_ns for f in frames]), 1e9 / 30, atol=1)
    assert any(f.betas.any() for f in frames) == (name == "reach_squat")
    turns = np.diff([Rotation.from_rotvec(f.pose).as_quat() for f in frames], axis=0)
    assert np.linalg.norm(turns, axis=-1).max() * 2 * 30 < 8  # [rad/s]
    # The feet stand on the floor: the bags were made with the body that is built in now.
    shown = frames[::15]
    body = load_body("male")
    posed = body([f.pose for f in shown], betas=[shown[0].betas], transl=np.array([f.transl for f in shown]))
    assert posed.vertices[:, :, 1].amin(dim=1).abs().max() < 0.01
    with RosbagsReader(BAGS / name) as reader:
        assert reader.message_count == 300
