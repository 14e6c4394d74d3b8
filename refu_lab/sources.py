"""Where a replay's frames come from: a bag of SMPL parameters or of keypoints, or a file of motion."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

import msg_adapters as adapters
from refu_core import FrameError, RefuError
from refu_core.keypoints import Proportions
from refu_core.modes import BetasSource
from refu_core.recordings import SUFFIXES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from msg_adapters import FrameRecord
    from refu_core import SmplBody, SmplFrame
    from refu_lab.replay import ReplayOptions

INPUT_TOPIC = "/smpl_params"


@dataclass(eq=False)
class Source:
    """Frames of a bag or of a motion file, as records of one kind."""

    description: str
    """A topic and its type, or a motion file."""
    topic: str
    message_type: str
    decoder: adapters.Decoder
    records: Iterator[FrameRecord]
    count: int | None
    """Records, where the file says how many there are."""
    bag: adapters.SmplBag | None = None
    """What is read; None for a motion file."""
    notes: Sequence[str] = ()
    """What the reader of a motion file took for granted."""
    gender: str = "neutral"
    """Whose motion it is, where the file says it."""

    @property
    def betas_are_known(self) -> bool:
        """Whether the file itself says that its betas are the built-in body's."""
        return self.bag is not None and self.bag.topic.betas_of == BetasSource.BUILTIN

    def frame_of(self, record: FrameRecord, betas: Sequence[float] | None = None) -> SmplFrame:
        """A record's frame, with `betas` in place of its own where they are given.

        Raises `DecodeError` for a record that has none.
        """
        if record.error is not None:
            raise record.error
        frame = replace(self.decoder.from_bytes(record.raw), stamp_ns=record.stamp_ns)
        return frame if betas is None else replace(frame, betas=np.asarray(betas, np.float32))

    @property
    def warnings(self) -> list[str]:
        """What was wrong with the file as a whole; complete after the last record."""
        return [*self.notes, *(self.bag.reader.warnings if self.bag else ())]


@contextmanager
def open_source(options: ReplayOptions, body: Callable[[], SmplBody]) -> Iterator[Source]:
    """Opens the input; `body` is whose bones keypoints have, and isn't asked for where there are none.

    Raises `RefuError` for an input that can't be read, or with options that it has no use for.
    """
    if options.input.suffix.lower() in SUFFIXES:
        motion = adapters.read_motion(options.input, fps=options.fps, axes=options.input_axes, person=options.person)
        description = f"{options.input.name}, {len(motion)} frames at {motion.fps:g} Hz"
        records, decoder = _motion_records(motion, INPUT_TOPIC), adapters.decoder_for("multiarray")
        message_type = adapters.INPUT_TYPES["multiarray"]
        yield Source(
            *(description, INPUT_TOPIC, message_type, decoder, records, len(motion)),
            notes=motion.notes,
            gender=motion.gender,
        )
        return
    if options.fps is not None or options.input_axes in ("z-up", "y-down"):
        what = "--fps" if options.fps is not None else f"--input-axes {options.input_axes}"
        msg = f"{options.input}: {what} is for files of motion ({', '.join(SUFFIXES)}); bags take smpl or frame"
        raise RefuError(msg)
    is_of_keypoints = options.input_type in adapters.KEYPOINT_TYPES
    own = _keypoint_decoder(options, body()) if is_of_keypoints else None
    with adapters.open_smpl_bag(options.input, topic=options.topic, input_type=options.input_type, decoder=own) as bag:
        topic, kind = bag.topic.name, bag.topic.message_type
        records = bag.undecoded() if is_of_keypoints else iter(bag)
        yield Source(f"{topic} ({kind})", topic, kind, bag.decoder, records, bag.message_count, bag)


def _motion_records(motion: adapters.Motion, topic: str) -> Iterator[FrameRecord]:
    encode = adapters.encoder_for("multiarray")
    for i in range(len(motion)):
        stamp_ns = round(1e9 * i / motion.fps)
        frame, error, raw = None, None, b""
        try:
            frame = motion.frame(i)
            raw = encode(frame)
        except FrameError as cause:  # one bad frame of a clip is skipped like one bad message of a bag
            error = adapters.DecodeError(str(cause))
        yield adapters.FrameRecord(
            frame=frame, error=error, stamp_ns=stamp_ns, log_time_ns=stamp_ns, topic=topic, raw=raw
        )


def _keypoint_decoder(options: ReplayOptions, body: SmplBody) -> adapters.Decoder:
    """A decoder that follows one person: `options.person`, or who comes first."""
    assert options.input_type is not None
    stream = adapters.KeypointStream(
        options.input_type, options.keypoints, Proportions.of_body(body), betas=options.betas
    )
    followed = options.person

    def from_bytes(data: bytes | bytearray | memoryview) -> SmplFrame:
        nonlocal followed
        people, _ = stream.frames(data, 0)
        followed = followed if followed is not None or not people else next(iter(people))
        if followed not in people:
            msg = f"{followed or 'nobody'} isn't to be seen; who is: {', '.join(people) or 'nobody'}"
            raise adapters.DecodeError(msg)
        return people[followed]

    def from_message(message: object) -> SmplFrame:
        msg = f"wanted the bytes of a message of keypoints, got {type(message).__name__}"
        raise adapters.DecodeError(msg)

    types = dict(adapters.KEYPOINT_TYPES)
    message_type = next(kind for name, kind in types.items() if name == options.input_type)
    return adapters.Decoder("pose_array", message_type, from_bytes, from_message)
