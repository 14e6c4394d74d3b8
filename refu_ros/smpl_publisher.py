"""A node that plays motion live as SMPL parameters: an AMASS-style file, a bag, or a march on the spot."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # NumPy reads it; its threads wait for busy cores

import numpy as np
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from msg_adapters import INPUT_TYPES, SMPL_TOPIC, WORLD_FRAME, Encoder, encoder_for, load_motion
from refu_core import FrameError
from refu_core.errors import printable
from refu_core.options import check, fixed
from refu_core.recordings import Axes
from refu_ros._guard import GuardedNode
from refu_ros._interfaces import interface
from refu_ros._program import hear, run, spin
from refu_ros._settings import AXES, declare, listing, require_names


@dataclass(frozen=True, kw_only=True)
class PublisherOptions:
    """The node's parameters: what is played, and how. Raises `SettingsError` for values that have no meaning."""

    motion: str = fixed(
        "", "File of motion (docs/guide/inputs.md), .mcap or rosbag2 directory; empty: a march.", metavar="FILE"
    )
    input_type: str = fixed("multiarray", f"Message to send: {', '.join(INPUT_TYPES)}.")
    input_axes: str = fixed("smpl", "Axes that are sent: smpl (y up), or frame (as files have them).", choices=AXES)
    frame_id: str = fixed(WORLD_FRAME, "Frame of messages that have a header.")
    fps: float = fixed(0.0, "Frame rate of a file of motion, in place of its own; 0 for that [Hz].", within=(0.0, 1e4))
    rate: float = fixed(30.0, "Messages a second, resampled to that; 0 for the recording's [Hz].", within=(0.0, 1e4))
    loop: bool = fixed(True, "Start again after the last frame, instead of stopping the node.")
    in_place: bool = fixed(False, "Hold the horizontal position of the first frame.")
    persons: tuple[str, ...] = fixed(
        ("",), "Names of several persons: each plays the motion from another time, on <name>/smpl_params."
    )
    spacing: float = fixed(1.0, "Distance between persons, to the left [m].", within=(-1e6, 1e6))

    def __post_init__(self) -> None:
        check(self)
        require_names(self.persons, self.frame_id or WORLD_FRAME)


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
            self.get_logger().warning(printable(f"{self.options.motion}: {note}"))
        if self.options.in_place:
            motion = motion.in_place(up=1 if self.options.input_axes == "smpl" else 2)
        if self.options.rate not in (0, motion.fps):
            motion = motion.resampled(self.options.rate)
        self.motion = motion
        self.finished = False
        self._index = 0
        message_type = INPUT_TYPES[self.options.input_type]
        self._outputs = [
            self.create_publisher(
                interface(message_type),
                f"{name}/{SMPL_TOPIC}" if name else SMPL_TOPIC,
                QoSProfile(depth=1),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
            for name in [*filter(None, self.options.persons)] or ("",)
        ]
        self.create_timer(1 / self.motion.fps, self.guarded("tick", self._tick))
        self.get_logger().info(
            f"{self.options.motion or 'march on the spot'}: {len(self.motion)} frames at {self.motion.fps:g} Hz as "
            f"{message_type} on {', '.join(output.topic_name for output in self._outputs)}"
            f"{', as soon as /clock runs (use_sim_time)' * bool(self.get_parameter('use_sim_time').value)}"
        )

    def _tick(self) -> None:
        if self._index >= len(self.motion) and not self.options.loop:
            self.finished = True
            return
        stamp_ns = self.get_clock().now().nanoseconds
        for i, output in enumerate(self._outputs):
            try:
                frame = self.motion.frame((self._index + i * len(self.motion) // len(self._outputs)) % len(self.motion))
            except FrameError as error:  # recordings have such frames; what is sent is always a person
                self.get_logger().warning(f"{self.motion.source}: frame left out: {error}", throttle_duration_sec=5.0)
                continue
            left = np.eye(3)[0 if self.options.input_axes == "smpl" else 1]
            frame = replace(frame, transl=frame.transl + i * self.options.spacing * left, stamp_ns=stamp_ns)
            output.publish(self.encode(frame, frame_id=self.options.frame_id))
        self._index += 1


def _live() -> int:
    node, told = SmplPublisher(), list[bool]()
    hear(told)
    spin(node, until=lambda: told or node.finished)
    node.destroy_node()
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the node until SIGINT, SIGTERM or the end of the motion; returns the exit code."""
    return run("smpl_publisher", arguments, description=__doc__, listing=lambda: listing(PublisherOptions), live=_live)


if __name__ == "__main__":
    sys.exit(main())
