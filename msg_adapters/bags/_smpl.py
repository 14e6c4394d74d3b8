"""Which topic of a bag carries a body, and its frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from msg_adapters.bags._metadata import TopicInfo
from msg_adapters.bags._reader import BagReader
from msg_adapters.cdr import split_stamp
from msg_adapters.errors import BagError, DecodeError, EncodeError
from msg_adapters.inputs import INPUT_TYPES, Decoder, decoder_for
from refu_core.frames import SmplFrame

_USUAL_NAME = "smpl_params"


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


class SmplBag:
    """A bag and the topic of it that carries a body; iterating yields a `FrameRecord` for each message."""

    def __init__(self, reader: BagReader, topic: TopicInfo, decoder: Decoder) -> None:
        self.reader = reader
        self.topic = topic
        self.decoder = decoder

    @property
    def message_count(self) -> int:
        """Messages of the topic."""
        return self.topic.message_count

    def undecoded(self) -> Iterator[FrameRecord]:
        """Each message as it is, stamped with its log time: for a decoder that remembers and so may see it but once."""
        for message in self.reader.messages({self.topic.name}):
            log = message.log_time_ns
            yield FrameRecord(
                frame=None, error=None, stamp_ns=log, log_time_ns=log, topic=message.topic, raw=message.data
            )

    def __enter__(self) -> SmplBag:
        return self

    def __exit__(self, *_: object) -> None:
        """Nothing is open between iterations."""

    def __iter__(self) -> Iterator[FrameRecord]:
        for message in self.reader.messages({self.topic.name}):
            frame, error = None, None
            try:
                frame = self.decoder.from_bytes(message.data)
                if not frame.stamp_ns:
                    frame = _stamped(frame, message.log_time_ns)
            except DecodeError as cause:
                frame, error = None, cause
            yield FrameRecord(
                frame=frame,
                error=error,
                stamp_ns=frame.stamp_ns if frame else message.log_time_ns,
                log_time_ns=message.log_time_ns,
                topic=message.topic,
                raw=message.data,
            )


def _stamped(frame: SmplFrame, log_time_ns: int) -> SmplFrame:
    """The frame with the time it was received; a time that no message can hold is the message's fault."""
    try:
        split_stamp(log_time_ns)
    except EncodeError as error:
        msg = f"no stamp, and was received at an impossible time: {error}"
        raise DecodeError(msg) from error
    return replace(frame, stamp_ns=log_time_ns)


def _listing(topics: tuple[TopicInfo, ...] | list[TopicInfo]) -> str:
    return ", ".join(f"{topic.name} ({topic.message_type or 'no type'})" for topic in topics)


def _choose(
    path: Path, topics: tuple[TopicInfo, ...], name: str | None, input_type: str | None, own: Decoder | None
) -> TopicInfo:
    if name is not None:
        chosen = next((topic for topic in topics if topic.name.lstrip("/") == name.lstrip("/")), None)
        if chosen is None:
            msg = f"{path}: no topic {name}; the bag has {_listing(topics)}"
            raise BagError(msg)
        wanted = own.message_type if own else input_type and decoder_for(input_type).message_type
        known = (wanted,) if own else INPUT_TYPES.values()
        if wanted not in (None, chosen.message_type) or chosen.message_type not in known:
            msg = f"{path}: {_listing([chosen])} doesn't carry {wanted or 'a body'}; wanted {wanted or _supported()}"
            raise BagError(msg)
        return chosen
    types = {decoder_for(input_type).message_type} if input_type and not own else set(INPUT_TYPES.values())
    types = {own.message_type} if own else types
    found = [topic for topic in topics if topic.message_type in types and topic.message_count]
    # A robot's own joint states are of an input type too: the name the node listens to decides before giving up.
    usual = [topic for topic in found if topic.name.rsplit("/", maxsplit=1)[-1] == _USUAL_NAME]
    if len(found) == 1 or len(usual) == 1:
        return (usual or found)[0]
    if found:
        msg = f"{path}: {len(found)} topics could carry the body: {_listing(found)}; choose one with --topic"
    else:
        wanted = own.message_type if own else _supported()
        msg = f"{path}: no SMPL topic; the bag has {_listing(topics)}, wanted a topic of {wanted}"
    raise BagError(msg)


def _supported() -> str:
    return ", ".join(INPUT_TYPES.values())


def open_smpl_bag(
    path: str | Path, *, topic: str | None = None, input_type: str | None = None, decoder: Decoder | None = None
) -> SmplBag:
    """Open a bag and find the topic that carries a body; a `decoder` of one's own is used for its type of message.

    Without `topic` it is the only one of an input type (of `input_type` where given), or the only one of those named
    `smpl_params`.

    Raises `BagError` when there is no such bag, it has no messages, or no topic, or several, could be meant.
    """
    reader = BagReader(path)
    topics = reader.topics
    if not any(info.message_count for info in topics):
        why = "; " + "; ".join(reader.warnings) if reader.warnings else ""
        msg = f"{reader.path}: no message in this bag{why}"
        raise BagError(msg)
    try:
        chosen = _choose(reader.path, topics, topic, input_type, decoder)
        doubtful = not chosen.message_count
    except BagError:
        types = {decoder.message_type} if decoder else set(INPUT_TYPES.values())
        doubtful = any(not info.message_count and info.message_type in types for info in topics)
        if not doubtful:
            raise
    if doubtful:  # a summary isn't believed that a topic is empty
        chosen = _choose(reader.path, reader.count(), topic, input_type, decoder)
    if chosen.encoding != "cdr":
        msg = (
            f"{reader.path}: {chosen.name} is encoded as {chosen.encoding or 'nothing'}; wanted cdr, as ROS 2 writes it"
        )
        raise BagError(msg)
    return SmplBag(reader, chosen, decoder or decoder_for(chosen.message_type, definition=chosen.definition or None))


def iter_smpl_frames(
    path: str | Path, *, topic: str | None = None, input_type: str | None = None
) -> Iterator[FrameRecord]:
    """The frames of a bag; a message that can't be decoded is a record with its error. Raises as `open_smpl_bag`."""
    return iter(open_smpl_bag(path, topic=topic, input_type=input_type))
