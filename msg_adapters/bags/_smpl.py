"""Which topic of a bag carries a body, and its frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from msg_adapters.bags._metadata import TopicInfo
from msg_adapters.bags._reader import BagReader
from msg_adapters.cdr import split_stamp
from msg_adapters.errors import BagError, DecodeError, EncodeError
from msg_adapters.inputs import INPUT_TYPES, KEYPOINT_TYPES, SMPL_TOPIC, Decoder, decoder_for
from refu_core.frames import SmplFrame


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """One message of the body's topic: a frame, or the reason why it isn't one."""

    frame: SmplFrame | None
    error: DecodeError | None
    stamp_ns: int
    """The header's stamp; the log time where the message has none or couldn't be decoded."""
    log_time_ns: int
    topic: str
    raw: bytes
    """The message as it was, in CDR."""

    def __repr__(self) -> str:
        content = self.frame or self.error or f"{len(self.raw)} bytes"
        return f"FrameRecord({self.topic} at {self.stamp_ns} ns: {content!r})"


@dataclass(frozen=True, eq=False)
class SmplBag:
    """A bag and the topic of it that carries a body; iterating yields a `FrameRecord` for each message."""

    reader: BagReader
    topic: TopicInfo
    decoder: Decoder | None
    """None for keypoints, whose records hold only the raw message: who is followed in it is decided later."""

    @property
    def message_count(self) -> int:
        """Messages of the topic."""
        return self.topic.message_count

    def __enter__(self) -> SmplBag:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is open between iterations."""

    def __iter__(self) -> Iterator[FrameRecord]:
        for message in self.reader.messages({self.topic.name}):
            frame, error = None, None
            try:
                if message.message_type != self.topic.message_type:  # two publishers' types, or a newer recording's
                    got = message.message_type or "a message without a type"
                    raise DecodeError(f"wanted {self.topic.message_type}, got {got}")
                if self.decoder is not None:
                    frame = self.decoder.from_bytes(message.data)
                    if not frame.stamp_ns:  # then the time of its receipt is used
                        split_stamp(message.log_time_ns)
                        frame = replace(frame, stamp_ns=message.log_time_ns)
            except DecodeError as cause:
                error = cause
            except EncodeError as cause:
                frame, error = None, DecodeError(f"no stamp, and was received at an impossible time: {cause}")
            stamp_ns = frame.stamp_ns if frame else message.log_time_ns
            yield FrameRecord(frame, error, stamp_ns, message.log_time_ns, message.topic, message.data)


def _listing(topics: Sequence[TopicInfo]) -> str:
    return ", ".join(f"{topic.name} ({topic.message_type or 'no type'})" for topic in topics)


def _choose(path: Path, topics: Sequence[TopicInfo], name: str | None, kinds: Sequence[str]) -> TopicInfo:
    """The topic called `name`, or else the one that can carry a body, judged by its type (`kinds`)."""
    wanted = ", ".join(kinds)
    if name is not None:
        chosen = next((topic for topic in topics if topic.name.lstrip("/") == name.lstrip("/")), None)
        if chosen is None:
            raise BagError(f"{path}: no topic {name}; the bag has {_listing(topics)}")
        if chosen.message_type not in kinds:
            what = "a body" if len(kinds) > 1 else wanted
            raise BagError(f"{path}: {_listing([chosen])} doesn't carry {what}; wanted {wanted}")
        return chosen
    found = [topic for topic in topics if topic.message_type in kinds and topic.message_count]
    # A robot's own joint states have an input type too: before giving up, prefer the name the node listens to.
    usual = [topic for topic in found if topic.name.rsplit("/", maxsplit=1)[-1] == SMPL_TOPIC]
    if len(found) == 1 or len(usual) == 1:
        return (usual or found)[0]
    if found:
        msg = f"{path}: {len(found)} topics could carry the body: {_listing(found)}; choose one by topic"
    else:
        msg = f"{path}: no SMPL topic; the bag has {_listing(topics)}, wanted a topic of {wanted}"
        markers = KEYPOINT_TYPES["keypoint_markers"]
        if any((one.name.rsplit("/", 1)[-1], one.message_type) == (SMPL_TOPIC, markers) for one in topics):
            msg += f"; for keypoints in {SMPL_TOPIC} set the input type to keypoint_markers"
    raise BagError(msg)


def open_smpl_bag(path: str | Path, *, topic: str | None = None, input_type: str | None = None) -> SmplBag:
    """Open a bag and find the topic that carries a body, or people's keypoints where `input_type` is of keypoints.

    Without `topic` it is the only one of an input type (of `input_type` where given), or the only one of those that is
    named `smpl_params`.

    Raises `BagError` when there is no such bag, it has no messages, or none or several of its topics could be meant.
    """
    reader = BagReader(path)
    of_keypoints = [kind for name, kind in KEYPOINT_TYPES.items() if name == input_type]
    kinds = of_keypoints or ([decoder_for(input_type).message_type] if input_type else [*INPUT_TYPES.values()])
    topics = reader.topics
    if any(info.message_type in kinds and not info.message_count for info in topics):
        topics = reader.count()  # don't trust a summary that says a topic is empty
    if not any(info.message_count for info in topics):
        why = "; " + "; ".join(reader.warnings) if reader.warnings else ""
        raise BagError(f"{reader.path}: no message in this bag{why}")
    chosen = _choose(reader.path, topics, topic, kinds)
    if chosen.encoding != "cdr":
        what = f"{chosen.name} is encoded as {chosen.encoding or 'nothing'}"
        raise BagError(f"{reader.path}: {what}; wanted cdr, as ROS 2 writes it")
    decoder = None if of_keypoints else decoder_for(chosen.message_type, definition=chosen.definition or None)
    return SmplBag(reader, chosen, decoder)


def iter_smpl_frames(
    path: str | Path, *, topic: str | None = None, input_type: str | None = None
) -> Iterator[FrameRecord]:
    """The frames of a bag; a message that can't be decoded is a record with its error.

    `topic` and `input_type` choose among topics, and errors are raised, as in `open_smpl_bag`.
    """
    return iter(open_smpl_bag(path, topic=topic, input_type=input_type))
