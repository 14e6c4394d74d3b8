"""Messages about people: decoded to frames, with keypoints followed over time; and who is tracked (REP-155)."""

from __future__ import annotations

from array import array
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from msg_adapters.cdr import NS_PER_S, Buffer, CdrReader
from msg_adapters.errors import DecodeError
from msg_adapters.inputs import KEYPOINT_TYPES, decode_keypoints, decoder_for, frame_id_of
from refu_core.errors import FrameError
from refu_core.frames import PLAUSIBLE_ANGLE, PLAUSIBLE_COEFFICIENT, PLAUSIBLE_TRANSL, SmplFrame
from refu_core.keypoints import MOST_PEOPLE, People, Proportions, Skeleton, TrackerSettings, keypoint_layout
from refu_core.modes import FOREIGN_BETAS, ONE_STYLE
from refu_core.options import DressOptions
from refu_core.recordings import FASTEST, LONGEST_TURN, axis_of, upright_share

if TYPE_CHECKING:
    from refu_core.body import SmplBody

Array = NDArray[np.float64]

MAX_STAMP_NS = 2**31 * NS_PER_S
"""From here on a stamp doesn't fit a message."""
_LOOKED_AT = 100
"""Frames of a sender that are judged together."""


def check_plausible(frame: SmplFrame) -> None:
    """Raises `FrameError` for numbers that no body has.

    Being finite isn't enough: such numbers would overflow further on, where the cause is hard to tell.
    """
    for name, value, limit in (
        ("pose", frame.pose, PLAUSIBLE_ANGLE),
        ("betas", frame.betas, PLAUSIBLE_COEFFICIENT),
        ("style", 0.0 if frame.style is None else frame.style, PLAUSIBLE_COEFFICIENT),
        ("transl", frame.transl, PLAUSIBLE_TRANSL),
    ):
        largest = float(np.abs(value).max())
        if largest > limit:
            raise FrameError(f"{name}: wanted magnitudes up to {limit:g}, got {largest:g}")
    check_stamp(frame.stamp_ns)


def check_stamp(stamp_ns: int) -> None:
    """Raises `FrameError` for a time [ns] that no message holds, or before the clock's beginning."""
    if not 0 <= stamp_ns < MAX_STAMP_NS:
        raise FrameError(f"wanted a stamp that fits a ROS time, got {stamp_ns} ns")


class InputStream:
    """Messages of one input type, of parameters or of keypoints, from untrusted senders. Not thread-safe.

    Raises `DecodeError` where there is no such input type.
    """

    def __init__(self, input_type: str) -> None:
        self.is_of_keypoints = input_type in KEYPOINT_TYPES
        self._input_type = input_type
        self._decoder = None if self.is_of_keypoints else decoder_for(input_type)
        self.message_type = KEYPOINT_TYPES[input_type] if self._decoder is None else self._decoder.message_type
        self._people: tuple[People, int] | None = None
        """Who is followed, and how many keypoints each has."""
        self._followed: tuple[object, ...] = ()

    def follow(
        self, body: SmplBody, layout: str, *, betas: tuple[float, ...] | None = None, smoothing: float = 1.0
    ) -> None:
        """Says whose keypoints will come, before they do; if anything has changed, people are followed anew.

        Args:
            body: the one that is dressed; keypoints are taken to be of somebody with its proportions.
            layout: which points of the body come, one of `refu_core.keypoints.LAYOUTS`.
            betas: the people's shape (10,) where it is known; estimated from the lengths of bones if not given.
            smoothing: see `TrackerSettings`.
        """
        followed = body, layout, betas, smoothing
        if self.is_of_keypoints and followed != self._followed:
            points = keypoint_layout(layout)
            skeleton = Skeleton(points, Proportions.of_body(body))
            people = People(skeleton, betas=betas, settings=TrackerSettings(smoothing=smoothing))
            self._followed, self._people = followed, (people, len(points))

    def frames(self, data: Buffer, now_ns: int, *, sender: str = "") -> tuple[dict[str, SmplFrame], dict[str, str]]:
        """Everybody in a message by name, and the frame id of each: empty where the message names none.

        The name is the sender's; for keypoints that of the namespace, if any, is appended. A message without a stamp
        (no header, or an empty one) counts as stamped now. Raises `DecodeError` for a message that can't be read, and
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
            raise DecodeError(f"{len(people)} people in a message; up to {MOST_PEOPLE} are followed")
        for name, seen in people.items():
            person = "_".join(word for word in (sender, name) if word)
            frame_ids[person] = seen.frame_id
            times = {"stamp_ns": seen.stamp_ns or now_ns, "now_ns": now_ns}
            if (own := followed.update(person, seen.points, confidence=seen.confidence, **times)) is not None:
                frames[person] = own
        return frames, frame_ids

    def predicted(self, now_ns: int) -> dict[str, SmplFrame]:
        """The predicted frame at `now_ns` of everybody whose keypoints are followed."""
        return {} if self._people is None else self._people[0].at(now_ns)


class Track:
    """Collects one person's frames to judge how their numbers are meant: units, stamps and axes."""

    def __init__(self) -> None:
        self._rows = array("d")  # only a few numbers per frame: recordings are long
        self._last_ns: tuple[int, int] | None = None
        """The last frame's stamp and time of receipt, where that is known."""
        self._n_leaps, self._leap_s = 0, 0.0
        """How often times of receipt leapt though stamps didn't, and how far the first time [s]."""

    def __len__(self) -> int:
        return len(self._rows) // _NUMBERS

    def add(self, frame: SmplFrame, *, received_ns: int | None = None) -> None:
        """Takes in the next frame, and when it was received, where a recording says it."""
        if received_ns is not None:
            stamp_ns, before_ns = (frame.stamp_ns, received_ns) if self._last_ns is None else self._last_ns
            waited_s, passed_s = 1e-9 * (received_ns - before_ns), 1e-9 * (frame.stamp_ns - stamp_ns)
            if waited_s < min(passed_s, 0.0) - _LEAST_LEAP_S or waited_s > max(passed_s, 0.0) + _LONGEST_S:
                self._n_leaps += 1
                self._leap_s = self._leap_s or waited_s
            self._last_ns = frame.stamp_ns, received_ns
        longest = float(np.linalg.norm(frame.pose, axis=1).max())
        self._rows.extend((longest, 1e-9 * frame.stamp_ns, *frame.pose[0], *frame.transl))

    def doubts(self, *, up: Array | None) -> dict[str, str]:
        """What is doubtful in most frames: a sentence for each that is.

        Of `angles`, `pace`, `stamps`, `receipt` (leaps in any frame) and `axes`. `up` is said to be up for the
        sender, shape (3,); y in SMPL's axes. None: nothing is said of it.
        """
        rows = np.frombuffer(self._rows).reshape(-1, _NUMBERS)
        if not len(rows):
            return {}
        found = {}
        longest, steps = float(np.median(rows[:, 0])), np.diff(rows[:, 1])
        if longest > LONGEST_TURN:
            found["angles"] = f"rotation vectors are as long as {longest:.0f} in most frames, wanted radians: degrees?"
        way, told = np.linalg.norm(np.diff(rows[:, 5:], axis=0), axis=1), steps >= _SHORTEST_S
        if told.any() and (pace := float(np.median(way[told] / steps[told]))) > FASTEST:
            why = "translations in cm or mm? Or two senders on one topic?"
            found["pace"] = f"people move by {pace:.0f} m/s in most frames: {why}"
        if len(steps) and (n_still := int((steps <= 0).sum())) > len(steps) / 2:
            found["stamps"] = f"stamps don't advance in {n_still} of {len(rows)} frames: does the sender's clock run?"
        elif len(steps) and not _SHORTEST_S <= (step := float(np.median(steps))) <= _LONGEST_S:
            found["stamps"] = f"frames are {step:.2g} s apart by their stamps: are those in another unit?"
        elif self._last_ns is not None and (n_back := int((steps < 0).sum())):
            found["stamps"] = f"stamps go back in {n_back} of {len(rows)} frames: {_BACK}"
        if self._n_leaps:
            times = f"times of receipt leap in {self._n_leaps} of {len(rows)} frames, at first by {self._leap_s:+.1f} s"
            found["receipt"] = f"{times}, and stamps don't: did the recorder's clock? A bag that is written keeps them"
        roots = rows[:, 2:5]
        if up is not None and (share := upright_share(roots, up)) < 0.5:
            along = f", heads are towards {axis}" if (axis := axis_of(roots)) else ""
            said = _OF_SMPL if up[1] > 0 else _OF_FRAME.format("z" if up[2] > 0 else "-y")
            found["axes"] = f"people are upright in {100 * share:.0f} % of {len(rows)} frames{along}: {said}"
        return found


_BACK = "two senders on one topic, a clock set back, or parts out of order? Frames are taken as they were recorded"
_OF_SMPL = "input_axes is smpl (y up). Where it isn't, set it to frame"
_OF_FRAME = (
    "input_axes is frame, and frame_id has {} up (-y with optical in its name, else z). Where it hasn't, change one"
)
_NUMBERS = 8
_SHORTEST_S, _LONGEST_S = 1e-3, 5.0
"""The shortest and longest plausible step between frames whose stamps are in nanoseconds [s]."""
_LEAST_LEAP_S = 0.1
"""Times of receipt may go back by this much where a recorder's threads overtake each other [s]."""


class Doubts:
    """Warnings about frames that come, each given once."""

    def __init__(self) -> None:
        self.has_foreign_betas = False
        """Whether betas have come without anything saying whose shape space they belong to."""
        self.of_senders: dict[str, str] = {}
        """Doubts about each sender's newest frames: units and stamps, but not axes; a person lying down may be ill."""
        self._tracks: dict[str, Track] = {}
        self._said: set[str] = set()

    def of(self, sender: str, frame: SmplFrame, options: DressOptions, *, up: Array | None) -> list[str]:
        """New warnings about a sender's frame of parameters; `up` is as in `Track.doubts`."""
        found = {}
        if not options.betas_are_told and frame.betas.any():
            self.has_foreign_betas = True
            found["betas"] = FOREIGN_BETAS
        if frame.style is not None and "style" not in self._said and (plain := options.of_one_style):
            found["style"] = ONE_STYLE.format(", ".join(plain))
        track = self._tracks.setdefault(sender, Track())
        track.add(frame)
        if len(track) >= _LOOKED_AT:
            doubts = self._tracks.pop(sender).doubts(up=up)
            self.of_senders[sender] = "; ".join(text for kind, text in doubts.items() if kind != "axes")
            found |= doubts
        new = [text for kind, text in found.items() if kind not in self._said]
        self._said |= found.keys()
        return new

    def forget(self, sender: str) -> None:
        """Forgets a sender who has left: people come and go for days."""
        self._tracks.pop(sender, None)
        self.of_senders.pop(sender, None)


IDS_LIST = "hri_msgs/msg/IdsList"


def decode_ids(data: Buffer) -> list[str]:
    """The ids of a `hri_msgs/IdsList` in CDR. Raises `DecodeError` for anything that isn't one."""
    reader = CdrReader(data)
    reader.fields("Ts")
    ids = reader.strings()
    reader.finish()
    return ids
