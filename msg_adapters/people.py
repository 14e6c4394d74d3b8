"""Messages of people: who is in them, as frames; keypoints are followed; who is tracked, as REP-155 has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from msg_adapters.cdr import NS_PER_S, Buffer, CdrReader
from msg_adapters.errors import DecodeError
from msg_adapters.inputs import INPUT_TYPES, KEYPOINT_TYPES, decode_keypoints, decoder_for, frame_id_of
from refu_core.errors import FrameError
from refu_core.frames import PLAUSIBLE_ANGLE, PLAUSIBLE_COEFFICIENT, PLAUSIBLE_TRANSL, SmplFrame
from refu_core.keypoints import MOST_PEOPLE, People, Proportions, Skeleton, TrackerSettings, keypoint_layout
from refu_core.modes import FOREIGN_BETAS, ONE_STYLE
from refu_core.options import DressOptions
from refu_core.recordings import axis_of, upright_share

if TYPE_CHECKING:
    from refu_core.body import SmplBody

_MAX_STAMP_NS = 2**31 * NS_PER_S
_LOOKED_AT = 100
"""Frames that have come before people are said to lie."""


def check_plausible(frame: SmplFrame) -> None:
    """Finite is not enough: numbers no body has would overflow further on, where they are hard to tell apart.

    Raises `FrameError`.
    """
    for name, value, limit in (
        ("pose", frame.pose, PLAUSIBLE_ANGLE),
        ("betas", frame.betas, PLAUSIBLE_COEFFICIENT),
        ("style", 0.0 if frame.style is None else frame.style, PLAUSIBLE_COEFFICIENT),
        ("transl", frame.transl, PLAUSIBLE_TRANSL),
    ):
        largest = float(np.abs(value).max())
        if largest > limit:
            msg = f"{name}: wanted magnitudes up to {limit:g}, got {largest:g}"
            raise FrameError(msg)
    check_stamp(frame.stamp_ns)


def check_stamp(stamp_ns: int) -> None:
    """Raises `FrameError` for a time [ns] that no message holds, or before the clock's beginning."""
    if not 0 <= stamp_ns < _MAX_STAMP_NS:
        msg = f"wanted a stamp that fits a ROS time, got {stamp_ns} ns"
        raise FrameError(msg)


class InputStream:
    """Messages of one input type, of parameters or of keypoints, from senders who may mean harm. Not thread-safe.

    Raises `DecodeError` where there is no such input type.
    """

    def __init__(self, input_type: str) -> None:
        self.is_of_keypoints = input_type in KEYPOINT_TYPES
        self._input_type = input_type
        self._decoder = None if self.is_of_keypoints else decoder_for(input_type)
        self.message_type = (INPUT_TYPES | KEYPOINT_TYPES)[input_type]
        self._people: tuple[People, int] | None = None
        """Who is followed, and how many keypoints each has."""
        self._followed: tuple[object, ...] = ()

    def follow(
        self, body: SmplBody, layout: str, *, betas: tuple[float, ...] | None = None, smoothing: float = 1.0
    ) -> None:
        """Says whose keypoints come, before they do; people begin anew where that is new.

        Args:
            body: that is dressed: keypoints are of somebody with its proportions.
            layout: which points of the body come, one of `refu_core.keypoints.LAYOUTS`.
            betas: the people's shape (10,) where it is known; estimated from the lengths of bones if not given.
            smoothing: of `TrackerSettings`.
        """
        followed = body, layout, betas, smoothing
        if self.is_of_keypoints and followed != self._followed:
            points = keypoint_layout(layout)
            skeleton = Skeleton(points, Proportions.of_body(body))
            people = People(skeleton, betas=betas, settings=TrackerSettings(smoothing=smoothing))
            self._followed, self._people = followed, (people, len(points))

    def frames(self, data: Buffer, now_ns: int, *, sender: str = "") -> tuple[dict[str, SmplFrame], dict[str, str]]:
        """Everybody in a message by name, and the frame that each is in: empty where the message names none.

        The name is the sender's; of keypoints also that of the namespace, as far as there are such. What has no stamp,
        for want of a header or with an empty one, is of now. Raises `DecodeError` for a message that can't be read, and
        `FrameError` for numbers that make no body.
        """
        if self._decoder is not None:
            frame = self._decoder.from_bytes(data)
            frame = frame if frame.stamp_ns else replace(frame, stamp_ns=now_ns)
            return {sender: frame}, {sender: frame_id_of(data, self._decoder.input_type)}
        assert self._people is not None, "nobody is followed"
        followed, n_points = self._people
        frames, frame_ids = {}, {}
        people = decode_keypoints(self._input_type, data, n_points)
        if len(people) > MOST_PEOPLE:
            msg = f"{len(people)} people in a message; up to {MOST_PEOPLE} are followed"
            raise DecodeError(msg)
        for name, seen in people.items():
            person = "_".join(word for word in (sender, name) if word)
            frame_ids[person] = seen.frame_id
            own = followed.update(
                person, seen.points, confidence=seen.confidence, stamp_ns=seen.stamp_ns or now_ns, now_ns=now_ns
            )
            if own is not None:
                frames[person] = own
        return frames, frame_ids

    def predicted(self, now_ns: int) -> dict[str, SmplFrame]:
        """Everybody whose keypoints are followed, by now."""
        return {} if self._people is None else self._people[0].at(now_ns)


class Doubts:
    """What is to be said of frames that come, each thing once: nobody says whose the betas are, or people lie."""

    def __init__(self) -> None:
        self.has_foreign_betas = False
        """Whether betas have come of which nobody knew what they are of."""
        self._is_styled = self._lie = False
        self._roots: list[NDArray[np.float32]] = []

    def of(self, frames: Sequence[SmplFrame], options: DressOptions, *, is_y_up: bool) -> str:
        """What is to be said now of frames of parameters, or nothing; `is_y_up`: they are said to be in SMPL's axes."""
        if not (self.has_foreign_betas or options.betas_are_told) and any(frame.betas.any() for frame in frames):
            self.has_foreign_betas = True
            return FOREIGN_BETAS
        if not self._is_styled and any(frame.style is not None for frame in frames):
            self._is_styled = True
            if plain := options.of_one_style:
                return ONE_STYLE.format(", ".join(plain))
        return self._of_axes(frames) if is_y_up and not self._lie else ""

    def _of_axes(self, frames: Sequence[SmplFrame]) -> str:
        self._roots += [frame.pose[0] for frame in frames]
        if len(self._roots) < _LOOKED_AT:
            return ""
        roots, self._roots = np.array(self._roots, np.float64), []
        share, axis = upright_share(roots), axis_of(roots)
        self._lie = share < 0.5  # as of a recording
        along = f", and their heads are towards {axis}" if axis else ""
        text = f"people were upright in {100 * share:.0f} % of {len(roots)} frames{along}: input_axes is smpl (y up). "
        return text + "Where it isn't, set input_axes to frame, and frame_id to the sender's frame" if self._lie else ""


IDS_LIST = "hri_msgs/msg/IdsList"


def decode_ids(data: Buffer) -> list[str]:
    """The ids of a `hri_msgs/IdsList` in CDR. Raises `DecodeError` for anything that isn't one."""
    reader = CdrReader(data)
    reader.fields("Ts")
    ids = reader.strings()
    reader.finish()
    return ids
