"""A node that plays motion live as SMPL parameters: an AMASS-style file, a bag, or a march on the spot."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # NumPy reads it; its threads wait for busy cores

import numpy as np
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from msg_adapters import INPUT_TYPES, BagError, Encoder, InputType, Motion, encoder_for, iter_smpl_frames, read_motion
from msg_adapters.motion import MARCH_FPS, march
from refu_core import FrameError, SmplFrame
from refu_core.recordings import SUFFIXES, Axes
from refu_ros._guard import GuardedNode
from refu_ros._interfaces import interface
from refu_ros._parameters import SettingsError, check, declare, listing, parameter
from refu_ros._program import make_executor, on_signals, run, spin

TOPIC = "smpl_params"


_fixed = partial(parameter, live=False)


@dataclass(frozen=True, kw_only=True)
class PublisherOptions:
    """The node's parameters: what is played, and how. Raises `SettingsError` for values that have no meaning."""

    motion: str = _fixed(
        "", "File of motion (docs/guide/inputs.md), .mcap, or rosbag2 directory to play; empty: a march on the spot."
    )
    input_type: str = _fixed("multiarray", f"Message to send: {', '.join(INPUT_TYPES)}.")
    input_axes: str = _fixed(
        "smpl",
        "Axes that are sent: smpl (y up; files are turned), or frame (as files have them).",
        choices=("smpl", "frame"),
    )
    frame_id: str = _fixed("map", "Frame of messages that have a header.")
    fps: float = _fixed(0.0, "Frame rate of a file of motion, in place of its own; 0 for that [Hz].", low=0.0, high=1e4)
    rate: float = _fixed(
        30.0,
        "Messages a second, the motion resampled to it; 0 for the rate it was recorded at [Hz].",
        low=0.0,
        high=1e4,
    )
    loop: bool = _fixed(True, "Start again after the last frame, instead of stopping the node.")
    in_place: bool = _fixed(False, "Hold the horizontal position of the first frame.")
    persons: tuple[str, ...] = _fixed(
        ("",), "Names of several persons: each plays the motion from another time, on <name>/smpl_params."
    )
    spacing: float = _fixed(1.0, "Distance between persons, to the left [m].", low=-1e6, high=1e6)

    def __post_init__(self) -> None:
        check(self)
        if not all(name.isidentifier() for name in self.persons if name):
            msg = f"persons: wanted names of letters, digits and underscores, got {list(self.persons)}"
            raise SettingsError(msg)


def load_motion(path: str, *, axes: Axes = "auto", fps: float = 0.0) -> Motion:
    """The motion of a file, of a bag (evenly spaced, with the betas of its first frame), or `march` for an empty path.

    A file's axes and rate (0 for its own) are as `read_motion` takes them. Raises `MotionFileError` and `BagError`.
    """
    if not path:
        return march()
    if Path(path).suffix.lower() in SUFFIXES:
        return read_motion(path, axes=axes, fps=fps or None)
    frames = [record.frame for record in iter_smpl_frames(path) if record.frame is not None]
    if not frames:
        msg = f"{path}: no frame of its SMPL topic can be decoded; `refu replay {path}` says why"
        raise BagError(msg)
    seconds = (frames[-1].stamp_ns - frames[0].stamp_ns) * 1e-9
    fps = (len(frames) - 1) / seconds if seconds > 0 else MARCH_FPS
    poses, transl = (np.stack(arrays) for arrays in zip(*((f.pose, f.transl) for f in frames), strict=True))
    return Motion(poses, transl, frames[0].betas, fps)


def in_place(motion: Motion, *, up: int) -> Motion:
    """The motion with its translations held where the first frame is, but along the axis `up`."""
    held = np.repeat(motion.transl[:1], len(motion), axis=0)
    held[:, up] = motion.transl[:, up]
    return replace(motion, transl=held)


class SmplPublisher(GuardedNode):
    """Publishes frame after frame at a steady rate, stamped with the time they are sent."""

    def __init__(self, **options: Any) -> None:
        """Declare the parameters and load the motion. Raises `RefuError`, and `ParameterException` for a wrong type."""
        super().__init__("smpl_publisher", **options)
        self.options = declare(self, PublisherOptions)
        self.encode: Encoder = encoder_for(self.options.input_type)
        axes: Axes = "frame" if self.options.input_axes == "frame" else "auto"
        motion = load_motion(self.options.motion, axes=axes, fps=self.options.fps)
        for note in motion.notes:
            self.get_logger().warning(f"{self.options.motion}: {note}")
        self.motion = self._prepare(motion)
        self.finished = False
        self._index = 0
        message_type = INPUT_TYPES[cast("InputType", self.options.input_type)]
        message_class = interface(message_type)
        names = [name for name in self.options.persons if name]
        self._outputs = [
            self.create_publisher(
                message_class,
                f"{name}/{TOPIC}" if name else TOPIC,
                QoSProfile(depth=1),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
            for name in names or ("",)
        ]
        self.create_timer(1 / self.motion.fps, self.guarded("tick", self._tick))
        self.get_logger().info(
            f"{self.options.motion or 'march on the spot'}: {len(self.motion)} frames at {self.motion.fps:g} Hz as "
            f"{message_type} on {', '.join(output.topic_name for output in self._outputs)}"
        )

    def _prepare(self, motion: Motion) -> Motion:
        if self.options.in_place:
            motion = in_place(motion, up=1 if self.options.input_axes == "smpl" else 2)
        if self.options.rate not in (0, motion.fps):
            motion = motion.resampled(self.options.rate)
        return motion

    def _tick(self) -> None:
        if self._index >= len(self.motion) and not self.options.loop:
            self.finished = True
            return
        stamp_ns = self.get_clock().now().nanoseconds
        for i, output in enumerate(self._outputs):
            start = i * len(self.motion) // len(self._outputs)
            try:
                frame = self.motion.frame((self._index + start) % len(self.motion))
            except FrameError as error:  # recordings have such frames; what is sent is always a person
                self.get_logger().warning(f"frame left out: {error}", throttle_duration_sec=5.0)
                continue
            left = np.eye(3)[0 if self.options.input_axes == "smpl" else 1]
            frame = SmplFrame(
                frame.pose,
                betas=frame.betas,
                transl=frame.transl + i * self.options.spacing * left,
                stamp_ns=stamp_ns,
            )
            output.publish(self.encode(frame, frame_id=self.options.frame_id))
        self._index += 1


def _live() -> int:
    node = SmplPublisher()
    told: list[bool] = []  # no Event: one handler may interrupt the other while it holds the lock
    on_signals(partial(told.append, True))
    executor = make_executor()
    executor.add_node(node)
    spin(executor, node, until=lambda: told or node.finished)
    executor.shutdown()
    node.destroy_node()
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the node until SIGINT, SIGTERM or the end of the motion; returns the exit code."""
    return run("smpl_publisher", arguments, description=__doc__, listing=lambda: listing(PublisherOptions), live=_live)


if __name__ == "__main__":
    sys.exit(main())
