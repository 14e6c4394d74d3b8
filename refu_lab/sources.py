"""Where a replay's frames come from (a bag of SMPL parameters or keypoints, or a motion file), and who wears them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import msg_adapters as adapters
from msg_adapters import FrameRecord
from msg_adapters.axes import WORLD_FRAME, up_of, up_of_sender
from msg_adapters.inputs import body_of
from refu_core import FrameError, RefuError, SmplFrame
from refu_core.errors import printable
from refu_core.history import PoseHistory
from refu_core.keypoints import Proportions
from refu_core.modes import FOREIGN_BETAS, ONE_STYLE, BetasSource
from refu_core.recordings import GENDERS, SUFFIXES, upright_turn
from refu_lab.commands.replay import RecordingOptions

if TYPE_CHECKING:  # what a file has may be told without torch
    from refu_core import GarmentPipeline, SmplBody
    from refu_core.body import BodyFit

INPUT_TOPIC = f"/{adapters.SMPL_TOPIC}"
_SHOWN = 8
PLACED_BY_TF = "the person stays at the origin of {}: tf says where that is, and tf isn't read from a bag"


@dataclass(eq=False)
class Source:
    """Frames of a bag or of a motion file, as records of one kind, and who is dressed in them."""

    options: RecordingOptions
    pipeline: GarmentPipeline
    description: str
    """A topic and its type, or a motion file."""
    topic: str
    message_type: str
    decode: Callable[[bytes, int], SmplFrame]
    """Makes a frame of a message, given its bytes and the time that it was received [ns]."""
    records: Iterator[FrameRecord]
    count: int | None
    """Number of records, if the file says it."""
    bag: adapters.SmplBag | None = None
    """The bag that is read; None for a motion file."""
    notes: Sequence[str] = ()
    """What the reader of a motion file assumed."""
    gender: str = "neutral"
    """Gender of the recorded person, where the file says it."""
    is_fitted: bool = False
    """Whether its betas were fitted to the body that wears the garments."""
    frame_id: str = WORLD_FRAME

    track: adapters.Track = field(default_factory=adapters.Track)
    """Finds what is doubtful in a bag's units, stamps and axes; motion files are checked when they are read."""
    history: PoseHistory | None = field(init=False)
    """Adds its past to each frame; None where no garment heeds it (`GarmentPipeline.heeds_past`)."""
    has_betas: bool = False
    has_style: bool = False

    def __post_init__(self) -> None:
        self.history = PoseHistory() if self.pipeline.heeds_past else None

    def frame_of(self, record: FrameRecord) -> SmplFrame:
        """A record's frame, with the body shape that the options ask for.

        Raises `DecodeError` for a record without a frame, and `FrameError` for an impossible body.
        """
        if record.error is not None:
            raise record.error
        frame = self.decode(record.raw, record.log_time_ns)
        frame = frame if frame.stamp_ns else replace(frame, stamp_ns=record.stamp_ns)
        adapters.check_plausible(frame)
        self.has_betas = self.has_betas or bool(frame.betas.any())
        self.has_style = self.has_style or frame.style is not None
        if self.bag is not None:
            self.track.add(frame, received_ns=record.log_time_ns)
        if self.history is not None:
            frame = self.history(frame)
        betas = self.options.known_betas
        return frame if betas is None else replace(frame, betas=np.asarray(betas, np.float32))

    def warnings(self, *, betas_are_told: bool = False) -> list[str]:
        """Warnings about the input, the body and its garments; complete after the last record."""
        options, bag, pipeline = self.options, self.bag, self.pipeline
        is_told = betas_are_told or options.betas_are_told or pipeline.fit is not None
        is_told = is_told or self.is_fitted or options.input_type in adapters.KEYPOINT_TYPES
        is_told = is_told or (bag is not None and bag.topic.betas_of == BetasSource.BUILTIN)
        plain = [name for name, one in pipeline.garments.items() if one.styledirs is None]
        return [
            *body_warnings(pipeline, gender=self.gender),
            *self.notes,
            *(() if bag is None else bag.reader.warnings),
            *self.track.doubts(up=up_of_sender(options.axes, options.frame_id or self.frame_id, np.eye(3))).values(),
            *([FOREIGN_BETAS] if self.has_betas and not is_told else []),
            *([ONE_STYLE.format(", ".join(plain))] if self.has_style and plain else []),
        ]


def open_source(options: RecordingOptions, pipeline: GarmentPipeline | None = None) -> Source:
    """Opens the input, and loads the pipeline that the options ask for, unless it is given.

    A bad input is reported before torch is imported, where that can be told without a body. Raises `RefuError` for an
    input that can't be read, or with options that don't apply to it, and as `RecordingOptions.load_pipeline`.
    """
    load = cache(lambda: pipeline or options.load_pipeline())
    if options.keypoints is not None and options.input_type not in adapters.KEYPOINT_TYPES:
        raise RefuError(f"{options.input}: --keypoints goes with --input-type {' or '.join(adapters.KEYPOINT_TYPES)}")
    if options.input.suffix.lower() in SUFFIXES:
        if options.topic is not None or options.input_type is not None:
            what = "--topic" if options.topic is not None else "--input-type"
            raise RefuError(f"{options.input}: {what} is for bags, this is a file of motion")
        motion = adapters.read_motion(
            options.input,
            fps=options.fps,
            axes=options.input_axes,
            person=options.person,
            worn=Proportions.of_body(load().body) if options.input.exists() else None,  # else it is reported at once
        )
        description = printable(f"{options.input.name}, {len(motion)} frames at {motion.fps:g} Hz")
        up = upright_turn(motion.poses[:, 0].astype(np.float64))[1] if options.axes == "frame" else None
        kind, decode = adapters.INPUT_TYPES["multiarray"], _decoding(adapters.decoder_for("multiarray"), lambda _: up)
        read = description, INPUT_TOPIC, kind, decode, _motion_records(motion), len(motion)
        said: dict[str, Any] = {"notes": motion.notes, "gender": motion.gender, "is_fitted": motion.is_fitted}
        return Source(options, load(), *read, **said)
    if options.fps is not None or options.input_axes not in ("auto", "smpl", "frame"):
        what = "--fps" if options.fps is not None else f"--input-axes {options.input_axes}"
        msg = f"{options.input}: {what} is for files of motion ({', '.join(SUFFIXES)})"
        msg += "" if options.fps is not None else "; the axes of bags are smpl or frame"
        raise RefuError(msg)
    if options.person is not None and options.input_type not in adapters.KEYPOINT_TYPES:
        raise RefuError(f"{options.input}: --person is for keypoints and files of motion; of bags, --topic says whose")
    bag = adapters.open_smpl_bag(options.input, topic=options.topic, input_type=options.input_type)
    topic, kind = bag.topic.name, bag.topic.message_type
    given, is_placed = _frame_of_first(bag)
    notes = [PLACED_BY_TF.format(given)] if is_placed else []
    if bag.decoder is None:
        decode = _follower(options, load().body, notes)
    else:
        input_type = bag.decoder.input_type

        def up_in(data: bytes) -> NDArray[np.float64] | None:
            return None if options.axes == "smpl" else up_of(options.frame_id or adapters.frame_id_of(data, input_type))

        decode = _decoding(bag.decoder, up_in)
    frame_id = given if given and (is_placed or options.axes == "frame") else WORLD_FRAME
    read = printable(f"{topic} ({kind})"), topic, kind, decode, iter(bag), bag.message_count
    return Source(options, load(), *read, bag, notes, frame_id=frame_id)


def _frame_of_first(bag: adapters.SmplBag) -> tuple[str, bool]:
    """The frame_id of a bag's first message, and whether it is the frame of one body, as in ROS4HRI.

    It is empty where the message has none, or can't be read.
    """
    record = next(iter(bag), None)
    try:
        if record is None or record.error is not None:
            return "", False
        if bag.topic.message_type == adapters.MARKER_ARRAY:
            return next((marker.frame_id for marker in adapters.decode_marker_array(record.raw)), ""), False
        kind = "pose_array" if bag.decoder is None else bag.decoder.input_type
        return adapters.frame_id_of(record.raw, kind), kind == "joint_state" and body_of(record.raw) is not None
    except adapters.DecodeError:
        return "", False


def _motion_records(motion: adapters.Motion) -> Iterator[FrameRecord]:
    encode = adapters.encoder_for("multiarray")
    for i in range(len(motion)):
        frame, error, stamp_ns = None, None, round(1e9 * i / motion.fps)
        try:
            frame = motion.frame(i)
        except FrameError as cause:  # one bad frame of a clip is skipped like one bad message of a bag
            error = adapters.DecodeError(str(cause))
        raw = b"" if frame is None else encode(frame)
        yield FrameRecord(frame, error, stamp_ns, stamp_ns, INPUT_TOPIC, raw)


_Up = Callable[[bytes], "NDArray[np.float64] | None"]
"""Gives the up direction in a message's axes, shape (3,), or None for SMPL's axes."""


def _decoding(decoder: adapters.Decoder, up_of_message: _Up) -> Callable[[bytes, int], SmplFrame]:
    def decode(data: bytes, _: int) -> SmplFrame:
        frame, up = decoder.from_bytes(data), up_of_message(data)
        return frame if up is None else replace(frame, up=up)

    return decode


def _follower(options: RecordingOptions, body: SmplBody, notes: list[str]) -> Callable[[bytes, int], SmplFrame]:
    """Decodes keypoint messages to the frames of one person: `options.person`, or the first one to appear.

    If no person was asked for, `notes` says who else is there.
    """
    assert options.input_type is not None
    stream = adapters.InputStream(options.input_type)
    stream.follow(body, options.keypoints or "zed38", betas=options.known_betas)
    followed = options.person
    others: dict[str, None] = {}

    def decode(data: bytes, received_ns: int) -> SmplFrame:
        nonlocal followed
        people, frame_ids = stream.frames(data, received_ns)
        followed = followed if followed is not None or not people else next(iter(people))
        if followed not in people:
            msg = "nobody is to be seen: of too few keypoints there are finite numbers, with confidence"
            if people:
                msg = f"{followed} isn't to be seen; who is: {', '.join(people)}"
            raise adapters.DecodeError(msg)
        if options.person is None and (new := people.keys() - others.keys() - {followed}):
            others.update(dict.fromkeys(sorted(new)))
            listing = ", ".join([*others][:_SHOWN]) + (" …" if len(others) > _SHOWN else "")
            notes[:] = [f"{1 + len(others)} persons: {followed} is taken; also {listing} (--person chooses another)"]
        return replace(people[followed], up=up_of(options.frame_id or frame_ids[followed]))

    return decode


def body_facts(pipeline: GarmentPipeline) -> dict[str, Any]:
    """The body as plain values for JSON; for a named body, also how far the built-in mesh is from its surface [mm]."""
    facts: dict[str, Any] = {"name": pipeline.body.name, "fingerprint": pipeline.body.fingerprint}
    return facts if pipeline.fit is None else facts | fit_facts(pipeline.fit)


def fit_facts(fit: BodyFit) -> dict[str, float]:
    """How far the built-in mesh is from the body's surface, hands, feet and head left out [mm]."""
    found = fit.registration
    return {"fit_mean_mm": 1e3 * found.mean_distance, "fit_p99_mm": 1e3 * found.far_distance}


def body_warnings(pipeline: GarmentPipeline, *, gender: str = "") -> list[str]:
    """Warnings about the body, for a recording of the given `gender` (empty if the recording doesn't say it)."""
    warnings = pipeline.warnings
    # The body's own by its name, like SMPL_FEMALE or basicModel_f_lbs_10_207_0_v1.0.0, where that says one.
    known = [GENDERS[word] for word in re.split(r"[^a-z]+", pipeline.body.name.lower()) if word in GENDERS][:1]
    said = gender.strip().lower()
    if said in ("male", "female") and known not in ([], [said]):
        warnings.append(
            f"the recording is of a {said} body and is dressed as {pipeline.body.name}: name a body (body, "
            f"--body {said} or a file), and garments are transferred to it"
        )
    return warnings
