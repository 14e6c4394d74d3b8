"""rosbag2's metadata (version 9, ROS 2 Jazzy): what a bag's directory holds, in YAML."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from msg_adapters.errors import BagError
from refu_core._files import read_file

BETAS_OF = "betas_of"
"""Key in a topic's metadata that says whose shape space its betas belong to."""
METADATA_FILE = "metadata.yaml"
VERSION = 9
STORAGES = ("mcap", "sqlite3")
"""The storages that can be read; only MCAP is written."""
MAX_TIME_NS = 2**63 - 1
"""rosbag2 keeps times in signed 64 bits."""
_KEY = "rosbag2_bagfile_information"
_MAX_BYTES = 1 << 20
_MAX_EVENTS, _MAX_DEPTH = 100_000, 30
_UNREADABLE = (yaml.YAMLError, KeyError, TypeError, AttributeError, ValueError)
_NUMBER = re.compile(r"[-+]?\d{1,19}")
_DIRECTIVE = re.compile(r"(?:^|[\r\n\x85\u2028\u2029])\ufeff?%")
_PARSER = getattr(yaml, "CBaseLoader", yaml.BaseLoader)
_FOREVER = {"sec": 9223372036, "nsec": 854775807}  # rmw's infinite duration: 2^63 - 1 nanoseconds


@dataclass(frozen=True)
class QosProfile:
    """Quality of service a topic was offered with; `ros2 bag play` offers it again."""

    reliability: Literal["reliable", "best_effort"] = "reliable"
    depth: int = 10

    def to_metadata(self) -> dict[str, Any]:
        return {
            "history": "keep_last",
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": "volatile",
            "deadline": _FOREVER,
            "lifespan": _FOREVER,
            "liveliness": "automatic",
            "liveliness_lease_duration": _FOREVER,
            "avoid_ros_namespace_conventions": False,
        }

    def to_yaml(self) -> str:
        """The profile as it stands in an MCAP channel's metadata: a list of one."""
        return _dump([self.to_metadata()])


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
    betas_of: str = ""
    """Whose shape space the messages' β belong to: `builtin`, or empty where the bag doesn't say."""


@dataclass(frozen=True)
class TopicSummary:
    name: str
    message_type: str
    type_hash: str
    qos: QosProfile
    channel: int


class _Dumper(yaml.SafeDumper):
    """Writes repeated values out instead of referring to them: rosbag2's parser knows no aliases."""

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002
        return True


def _load(content: bytes) -> Any:
    """The value of a YAML document as rosbag2 writes it: each scalar is text, an integer, a Boolean or null.

    It is built from the parser's events, to leave out whatever takes more than linear time or makes anything but plain
    values: aliases, directives, tags, base-60 numbers, a thousand nested lists.

    Raises one of `_UNREADABLE`.
    """
    text = str(content, "utf-8")
    nodes: list[list[Any]] = [[]]
    """The items of all open collections; a mapping's are its keys and values in turn."""
    is_odd = _DIRECTIVE.search(text) is not None
    for count, event in enumerate(yaml.parse(text, Loader=_PARSER)):
        is_odd |= count > _MAX_EVENTS or len(nodes) > _MAX_DEPTH or isinstance(event, yaml.AliasEvent)
        if is_odd:
            raise yaml.YAMLError("directives, aliases, or more than is read")
        if isinstance(event, yaml.ScalarEvent):
            nodes[-1].append(_scalar(event.value) if event.implicit[0] else event.value)
        elif isinstance(event, (yaml.SequenceStartEvent, yaml.MappingStartEvent)):
            nodes.append([])
        elif isinstance(event, (yaml.SequenceEndEvent, yaml.MappingEndEvent)):
            items = nodes.pop()
            is_list = isinstance(event, yaml.SequenceEndEvent)
            nodes[-1].append(items if is_list else dict(zip(items[::2], items[1::2], strict=True)))
    return nodes[0][0] if nodes[0] else None


def _scalar(text: str) -> Any:
    if _NUMBER.fullmatch(text):
        return int(text)
    return {"true": True, "false": False, "null": None, "~": None, "": None}.get(text, text)


def _dump(value: Any) -> str:
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False, default_flow_style=False)


def dump_metadata(
    *, file_name: str, topics: Sequence[TopicSummary], counts: Mapping[int, int], start_ns: int, end_ns: int
) -> tuple[str, str]:
    """Describe a bag of one file for rosbag2: the texts of metadata.yaml and of the MCAP file's own metadata record.

    rosbag2 wants the bare mapping in the record, and the same mapping under one key in metadata.yaml. Times are log
    times [ns], `counts` the messages of each channel.
    """
    count = sum(counts.values())
    duration = {"nanoseconds": end_ns - start_ns}
    start = {"nanoseconds_since_epoch": start_ns}
    information = {
        "version": VERSION,
        "storage_identifier": "mcap",
        "duration": duration,
        "starting_time": start,
        "message_count": count,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.message_type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [topic.qos.to_metadata()],
                    "type_description_hash": topic.type_hash,
                },
                "message_count": counts.get(topic.channel, 0),
            }
            for topic in topics
        ],
        # Chunks are compressed inside the MCAP file; these two mean rosbag2's own compression around it.
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file_name],
        "files": [{"path": file_name, "starting_time": start, "duration": duration, "message_count": count}],
        "custom_data": None,
        "ros_distro": "jazzy",
    }
    return _dump({_KEY: information}), _dump(information)


def read_file_paths(directory: Path) -> list[Path]:
    """The files of a rosbag2 directory in order, as its metadata.yaml lists them.

    Raises `BagError` where the metadata can't be read, or names another storage or a compression of whole files.
    """
    path = directory / METADATA_FILE
    content = read_file(path, most=_MAX_BYTES, error=BagError, wanted="rosbag2's metadata")
    try:
        information = _load(content)[_KEY]
        storage = str(information["storage_identifier"])
        packed = [str(information.get(f"compression_{key}") or "none").lower() for key in ("mode", "format")]
        # Only file names are used: old versions list paths with the directory, and a bag is read from one directory.
        names = [name.replace("\\", "/").rsplit("/", maxsplit=1)[-1] for name in information["relative_file_paths"]]
    except _UNREADABLE as error:
        msg = f"{path}: not rosbag2 metadata ({type(error).__name__}); give one of the bag's files instead"
        raise BagError(msg) from error
    if storage not in STORAGES or (packed[0] != "none" and packed != ["message", "zstd"]):
        only = f"apart from messages in zstd only plain {' or '.join(STORAGES)} is read"
        how = f"stored as {storage} with compression mode {packed[0]} and format {packed[1]}: {only}"
        raise BagError(f"{directory}: {how}; convert it with `ros2 bag convert`")
    return [directory / name for name in dict.fromkeys(names)]
