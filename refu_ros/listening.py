"""Messages of a running node for programs that aren't nodes themselves: raw bytes, in a thread of their own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from msg_adapters import QosProfile
from refu_core import RefuError
from refu_ros._program import make_room


class LiveTopics:
    """Subscribes to topics, by message type; each message goes to `take(topic, data)`, from one thread.

    `close` it when it is done with. Raises `RefuError` where rclpy isn't there, and for names that no topic
    has.
    """

    def __init__(self, topics: Mapping[str, str], take: Callable[[str, bytes], object]) -> None:
        make_room()
        try:
            import rclpy
            from rclpy.executors import SingleThreadedExecutor
            from rclpy.signals import SignalHandlerOptions

            from refu_ros._interfaces import interface, ros_qos
        except ImportError as error:
            raise RefuError(f'source a ROS 2 installation, or pip install "refu-ros[ros]" ({error})') from error
        self._context = rclpy.Context()
        try:
            rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
            node = rclpy.create_node("refu_view", context=self._context, enable_rosout=False)
            self._node: Any = node
            # Whoever publishes serves this; a reliable subscription would get nothing from a best-effort publisher.
            qos = ros_qos(QosProfile(reliability="best_effort", depth=1))
            for topic, kind in topics.items():
                node.create_subscription(interface(kind), topic, partial(take, topic), qos, raw=True)
        except Exception as error:
            self._context.try_shutdown()
            raise RefuError(f"no topics {', '.join(topics)}: {error}") from error
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(node)
        self._thread = threading.Thread(target=self._executor.spin, name="topics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        self._context.try_shutdown()
