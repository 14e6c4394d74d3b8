"""rosbag2's metadata (version 9, ROS 2 Jazzy): what a bag's directory holds, in YAML."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import yaml

from msg_adapters.errors import BagError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

METADATA_FILE = "metadata.yaml"
VERSION = 9
MAX_TIME_NS = 2**63 - 1
"""rosbag2 keeps times in signed 64 bits."""
_KEY = "rosbag2_bagfile_information"
_MAX_BYTES = 1 << 20
_FOREVER = {"sec": 9223372036, "nsec": 854775807}  # rmw's infinite duration: 2^63 - 1 nanoseconds


@dataclass(frozen=True)
class QosProfile:
    """Quality of service a topic was offered with; `ros2 bag play` offers it again."""

    reliability: Literal["reliable", "best_effort"] = "reliable"
    durability: Literal["volatile", "transient_local"] = "volatile"
    history: Literal["keep_last", "keep_all"] = "keep_last"
    depth: int = 10

    def to_metadata(self) -> dict[str, Any]:
        """The profile as rosbag2 writes it."""
        return {
            "history": self.history,
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": self.durability,
            "deadline": dict(_FOREVER),
            "lifespan": dict(_FOREVER),
            "liveliness": "automatic",
            "liveliness_lease_duration": dict(_FOREVER),
            "avoid_ros_namespace_conventions": False,
        }

    def to_yaml(self) -> str:
        """The profile as it stands in an MCAP channel's metadata: a list of one."""
        return _dump([self.to_metadata()])


@dataclass(frozen=True)
class TopicSummary:
    """A topic's entry in the metadata."""

    name: str
    message_type: str
    type_hash: str
    qos: str
    """The offered profiles in YAML."""
    message_count: int


class _Dumper(yaml.SafeDumper):
    """Writes repeated values out instead of referring to them: rosbag2's parser knows no aliases."""

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002
        return True


class _Loader(yaml.SafeLoader):
    """Refuses aliases, which rosbag2 doesn't write: a few lines of them stand for more text than fits any memory."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            msg = "aliases aren't read"
            raise yaml.YAMLError(msg)
        return super().compose_node(parent, index)


def _dump(value: Any) -> str:
    return yaml.dump(value, Dumper=_Dumper, sort_keys=False, default_flow_style=False)


def dump_metadata(*, file_name: str, topics: Sequence[TopicSummary], start_ns: int, end_ns: int) -> str:
    """The text of metadata.yaml for a bag of one file; times are log times [ns]."""
    count = sum(topic.message_count for topic in topics)
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
                    "offered_qos_profiles": yaml.safe_load(topic.qos) or [],
                    "type_description_hash": topic.type_hash,
                },
                "message_count": topic.message_count,
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
    return _dump({_KEY: information})


def read_file_paths(directory: Path) -> list[Path]:
    """The MCAP files of a rosbag2 directory in order, as its metadata.yaml lists them.

    Raises `BagError` where the metadata can't be read, or names another storage or rosbag2's own compression.
    """
    path = directory / METADATA_FILE
    try:
        with path.open("rb") as file:
            text = file.read(_MAX_BYTES + 1)
        if len(text) > _MAX_BYTES:
            msg = f"{path}: larger than {_MAX_BYTES >> 20} MiB"
            raise BagError(msg)
        information = yaml.load(text, Loader=_Loader)[_KEY]
        storage = str(information["storage_identifier"])
        compression = str(information.get("compression_mode") or "none").lower()
        names = [str(name) for name in information["relative_file_paths"]]
    except OSError as error:
        msg = f"{path}: can't be read: {error.strerror}"
        raise BagError(msg) from error
    except (yaml.YAMLError, KeyError, TypeError, AttributeError, ValueError, RecursionError) as error:
        if isinstance(error, BagError):
            raise
        msg = f"{path}: not rosbag2 metadata ({type(error).__name__}); give one of the bag's .mcap files instead"
        raise BagError(msg) from error
    if storage != "mcap" or compression != "none":
        msg = f"{directory}: stored as {storage} with compression mode {compression}, only plain mcap is read; "
        msg += "convert it with `ros2 bag convert`"
        raise BagError(msg)
    # Only names count: bags of old versions list paths that include the directory, and a bag is read from one place.
    return [directory / name.replace("\\", "/").rsplit("/", maxsplit=1)[-1] for name in names]
