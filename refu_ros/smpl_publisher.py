"""A node that plays motion live as SMPL parameters: an AMASS-style file, a bag, or a march on the spot."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # NumPy reads it; its threads wait for busy cores

import numpy as np
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from msg_adapters import INPUT_TYPES, BagError, Encoder, InputType, Motion, encoder_for, iter_smpl_frames, read_motion
from msg_adapters.march import MARCH_FPS, march
from refu_core import FrameError, RefuError, SmplFrame
from refu_core.recordings import SUFFIXES, Axes
from refu_ros._guard import GuardedNode
from refu_ros._interfaces import interface
from refu_ros._program import make_executor, on_signals, run, spin

TOPIC = "smpl_params"


@dataclass(frozen=True, kw_only=True)
class PublisherOptions:
    """The node's parameters: what is played, and how."""

    motion: str = ""
    input_type: InputType = "multiarray"
    input_axes: Literal["smpl", "frame"] = "smpl"
    frame_id: str = "map"
    fps: float = 0.0
    rate: float = 30.0
    loop: bool = True
    in_place: bool = False
    persons: tuple[str, ...] = ()
    spacing: float = 1.0


DESCRIPTIONS = {
    "motion": "file of motion (docs/guide/inputs.md), .mcap, or rosbag2 directory to play; empty: a march on the spot",
    "input_type": f"message to send: {', '.join(INPUT_TYPES)}",
    "input_axes": "axes that are sent: smpl (y up; files are turned), or frame (as a file has them: z up)",
    "frame_id": "frame_id of messages that have a header",
    "fps": "frame rate of a file of motion, in place of its own; 0 for that [Hz]",
    "rate": "messages a second, the motion resampled to it [Hz]; 0 for the rate it was recorded at",
    "loop": "start again after the last frame, instead of stopping the node",
    "in_place": "hold the horizontal position of the first frame",
    "persons": "names of several persons: each plays the motion from another time, on <name>/smpl_params",
    "spacing": "distance between persons, to the left [m]",
}
"""What each parameter is for."""


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
        self.options = self._declare()
        self.encode: Encoder = encoder_for(self.options.input_type)
        axes: Axes = "frame" if self.options.input_axes == "frame" else "auto"
        motion = load_motion(self.options.motion, axes=axes, fps=self.options.fps)
        for note in motion.notes:
            self.get_logger().warning(f"{self.options.motion}: {note}")
        self.motion = self._prepare(motion)
        self.finished = False
        self._index = 0
        message_class = interface(INPUT_TYPES[self.options.input_type])
        names = self.options.persons
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
            f"{INPUT_TYPES[self.options.input_type]} on {', '.join(output.topic_name for output in self._outputs)}"
        )

    def _declare(self) -> PublisherOptions:
        values: dict[str, Any] = {}
        for field in fields(PublisherOptions):
            # An empty list has no type of its own in rclpy: one empty name stands for no name.
            default = [""] if field.name == "persons" else field.default
            number = isinstance(default, float)
            descriptor = ParameterDescriptor(
                description=DESCRIPTIONS[field.name],
                read_only=True,
                dynamic_typing=number,  # whole numbers are fine for floats (`rate:=30`); ROS alone would refuse them
            )
            value = self.declare_parameter(field.name, default, descriptor).value
            values[field.name] = float(value) if number and type(value) is int else value
        values["persons"] = tuple(name for name in values["persons"] if name)
        options = PublisherOptions(**values)
        numbers = (options.rate, options.fps, options.spacing)
        if not all(isinstance(n, float) and np.isfinite(n) for n in numbers) or min(numbers[:2]) < 0:
            rate, fps, spacing = numbers
            msg = f"wanted finite numbers, rate >= 0, got rate {rate!r}, fps {fps!r}, spacing {spacing!r}"
            raise RefuError(msg)
        if not all(name.isidentifier() for name in options.persons):
            msg = f"persons: wanted names of letters, digits and underscores, got {list(options.persons)}"
            raise RefuError(msg)
        if options.input_axes not in ("smpl", "frame"):
            msg = f"wanted input_axes smpl or frame, got {options.input_axes!r}"
            raise RefuError(msg)
        return options

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


def _listing() -> str:
    defaults = {field.name: field.default for field in fields(PublisherOptions)}
    return "\n".join(
        ["parameters:", *(f"  {name:<12}{text} ({defaults[name]!r})" for name, text in DESCRIPTIONS.items())]
    )


def _live() -> int:
    node = SmplPublisher()
    told = threading.Event()
    on_signals(told.set)
    executor = make_executor()
    executor.add_node(node)
    spin(executor, node, until=lambda: told.is_set() or node.finished)
    executor.shutdown()
    node.destroy_node()
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the node until SIGINT, SIGTERM or the end of the motion; returns the exit code."""
    return run("smpl_publisher", arguments, description=__doc__, listing=_listing, live=_live)


if __name__ == "__main__":
    sys.exit(main())
