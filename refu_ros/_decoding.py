"""What the node makes of a message: a frame of SMPL parameters, or everybody whose keypoints are in it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from msg_adapters import INPUT_TYPES, KEYPOINT_TYPES, KeypointStream, decoder_for, frame_id_of
from refu_core import SmplFrame
from refu_core.keypoints import Proportions
from refu_core.modes import FOREIGN_BETAS, ONE_STYLE
from refu_core.recordings import axis_of, upright_share
from refu_ros._scene import check_plausible
from refu_ros._settings import NodeSettings

if TYPE_CHECKING:
    from refu_core import SmplBody

_LOOKED_AT = 100
"""Frames that have come before people are said to lie."""


class InputDecoder:
    """`use` it before messages come: keypoints are of somebody with the body's proportions."""

    def __init__(self, settings: NodeSettings) -> None:
        self._settings, self._layout = settings, settings.layout
        self.message_type = dict([*INPUT_TYPES.items(), *KEYPOINT_TYPES.items()])[settings.input_type]  # type: ignore[index]
        self._decoder = decoder_for(self._layout) if settings.input_type in INPUT_TYPES else None
        self._stream: KeypointStream | None = None
        self._body: SmplBody | None = None
        self._is_doubted = self._is_styled = self._lie = False
        self._roots: list[NDArray[np.float32]] = []

    @property
    def is_steady(self) -> bool:
        """Whether frames come from `predicted`, at a rate of their own, and not with the messages."""
        return self._decoder is None and self._settings.keypoint_rate > 0

    def use(self, settings: NodeSettings, body: SmplBody) -> None:
        """Other settings or another body; people who are followed begin anew where that matters to them."""
        before, self._settings = self._settings, settings
        new = settings.keypoints, settings.keypoint_smoothing, settings.known_betas
        old = before.keypoints, before.keypoint_smoothing, before.known_betas
        if self._decoder is None and (body is not self._body or new != old):
            name, smoothing, betas = new
            proportions, self._body = Proportions.of_body(body), body
            self._stream = KeypointStream(settings.input_type, name, proportions, betas=betas, smoothing=smoothing)

    def frames(self, sender: str, data: bytes, now_ns: int) -> tuple[dict[str, SmplFrame], str]:
        """The people in a sender's message, and the frame that it is in; empty where the message names none.

        Raises `AdapterError` and `FrameError` for a message that can't be read, or of a body that can't be.
        """
        if self._decoder is not None:
            frame = self._decoder.from_bytes(data)
            if frame.stamp_ns == 0:  # no header, or an empty one: when it came is the best there is
                frame = replace(frame, stamp_ns=now_ns)
            frames, frame_id = {sender: frame}, frame_id_of(data, self._layout)
        else:
            assert self._stream is not None
            frames, frame_id = self._stream.frames(data, now_ns, sender=sender)
        for frame in frames.values():
            check_plausible(frame)
        return frames, frame_id

    @property
    def has_foreign_betas(self) -> bool:
        """Whether betas arrived, and nothing says what they are of."""
        return self._is_doubted and not self._settings.betas_are_told

    def doubt(self, frames: Iterable[SmplFrame]) -> str:
        """What is to be said of frames, each thing once: nobody says whose the betas are, or people lie.

        Keypoints' betas are measured on the body that is dressed, and their axes those of `frame_id`.
        """
        if self._decoder is None:
            return ""
        frames = [*frames]
        if not (self._is_doubted or self._settings.betas_are_told) and any(frame.betas.any() for frame in frames):
            self._is_doubted = True
            return FOREIGN_BETAS
        if not self._is_styled and any(frame.style is not None for frame in frames):
            self._is_styled = True
            if plain := self._settings.of_one_style:
                return ONE_STYLE.format(", ".join(plain))
        return "" if self._lie or self._settings.axes != "smpl" else self._doubt_of_axes(frames)

    def _doubt_of_axes(self, frames: Iterable[SmplFrame]) -> str:
        self._roots += [frame.pose[0] for frame in frames]
        if len(self._roots) < _LOOKED_AT:
            return ""
        roots, self._roots = np.array(self._roots, np.float64), []
        share, axis = upright_share(roots), axis_of(roots)
        self._lie = share < 0.5  # as of a recording
        if not self._lie:
            return ""
        along = f", and their heads are towards {axis}" if axis else ""
        return (
            f"people were upright in {100 * share:.0f} % of {len(roots)} frames{along}: input_axes is smpl (y up). "
            "Where it isn't, set input_axes to frame, and frame_id to the sender's frame"
        )

    def predicted(self, now_ns: int) -> dict[str, SmplFrame]:
        """Everybody who is followed, by now."""
        return {} if self._stream is None else self._stream.predicted(now_ns)
