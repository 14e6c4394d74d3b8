"""Messages of people: keypoints to frames, everybody in them followed; who is tracked, as REP-155 has it."""

from __future__ import annotations

from numpy.typing import ArrayLike

from msg_adapters.cdr import Buffer, CdrReader
from msg_adapters.errors import DecodeError
from msg_adapters.inputs import KEYPOINT_TYPES, decode_keypoints
from refu_core.frames import SmplFrame
from refu_core.keypoints import LAYOUTS, MOST_PEOPLE, People, Proportions, Skeleton, TrackerSettings, keypoint_layout


class KeypointStream:
    """Messages of one input type, from one sender or several. Not thread-safe.

    Args:
        input_type: a key of `KEYPOINT_TYPES`.
        layout: which points of the body come, one of `refu_core.keypoints.LAYOUTS`.
        proportions: of the body that is dressed.
        betas: the people's shape (10,) where it is known; estimated from the lengths of bones if not given.
        smoothing: of `TrackerSettings`.

    Raises:
        DecodeError: no such input type or layout.
    """

    def __init__(
        self,
        input_type: str,
        layout: str,
        proportions: Proportions,
        *,
        betas: ArrayLike | None = None,
        smoothing: float = 1.0,
    ) -> None:
        if input_type not in KEYPOINT_TYPES or layout not in LAYOUTS:
            msg = f"wanted {' or '.join(KEYPOINT_TYPES)} of {', '.join(LAYOUTS)}; got {input_type!r} of {layout!r}"
            raise DecodeError(msg)
        self._input_type = input_type
        self._skeleton = Skeleton(keypoint_layout(layout), proportions)
        self._people = People(self._skeleton, betas=betas, settings=TrackerSettings(smoothing=smoothing))

    def frames(self, data: Buffer, now_ns: int, *, sender: str = "") -> tuple[dict[str, SmplFrame], str]:
        """Everybody in a message by name, and the frame that it is in.

        A name is the sender's and that of the namespace, as far as there are such. Raises `DecodeError`.
        """
        frames, frame_id = {}, ""
        people = decode_keypoints(self._input_type, data, len(self._skeleton.layout))
        if len(people) > MOST_PEOPLE:
            msg = f"{len(people)} people in a message; up to {MOST_PEOPLE} are followed"
            raise DecodeError(msg)
        for name, seen in people.items():
            person, frame_id = "_".join(word for word in (sender, name) if word), frame_id or seen.frame_id
            frame = self._people.update(
                person, seen.points, confidence=seen.confidence, stamp_ns=seen.stamp_ns or now_ns, now_ns=now_ns
            )
            if frame is not None:
                frames[person] = frame
        return frames, frame_id

    def predicted(self, now_ns: int) -> dict[str, SmplFrame]:
        """Everybody who is followed, by now."""
        return self._people.at(now_ns)


IDS_LIST = "hri_msgs/msg/IdsList"
_MIN_STRING_BYTES = 4


def decode_ids(data: Buffer) -> list[str]:
    """The ids of a `hri_msgs/IdsList` in CDR. Raises `DecodeError` for anything that isn't one."""
    reader = CdrReader(data)
    reader.fields("Ts")
    ids = [reader.string() for _ in range(reader.length(item_bytes=_MIN_STRING_BYTES))]
    reader.finish()
    return ids
