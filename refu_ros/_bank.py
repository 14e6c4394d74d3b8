"""The node's publishers: those for all people live as long as the node, those for one person come and go with them."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.exceptions import InvalidHandle, NameValidationException
from rclpy.qos_overriding_options import QoSOverridingOptions

import msg_adapters as adapters
from refu_core import RefuError
from refu_ros._interfaces import interface, ros_qos

QOS = adapters.QosProfile(reliability="reliable", depth=5)


class Bank:
    """Publishers of a lifecycle node. Only the executor's thread may call `hold`; any may call the rest.

    `on_match` is called when somebody subscribes or unsubscribes.
    """

    def __init__(self, node: Any, on_match: Callable[[], object]) -> None:
        self._node, self._on_match = node, on_match
        self._publishers: dict[str, Any] = {}
        self._refused: set[str] = set()

    def hold(self, wanted: Mapping[str, str], *, lasting: bool = False, until: float = math.inf) -> bool:
        """Keeps publishers of these topics, given with their types, and no others except those that are `lasting`.

        Making one takes milliseconds, a crowd's seconds: returns whether it was done `until` then [s], or is to go on.
        Only lasting ones have QoS overrides: these are parameters, which are never removed. A type whose package is
        missing is left out and logged once. A topic whose name is too long is left out and counts as a fault.
        """
        for topic, kind in wanted.items():
            if topic in self._publishers or kind in self._refused:
                continue
            if time.monotonic() > until:
                return False
            try:
                message_class = interface(kind)
            except RefuError as error:
                self._refused.add(kind)
                self._node.get_logger().info(f"no {topic}: {error}")
                continue
            options = QoSOverridingOptions.with_default_policies() if lasting else None
            told = PublisherEventCallbacks(matched=lambda _: self._on_match())
            try:
                publisher = self._node.create_lifecycle_publisher(
                    message_class, topic, ros_qos(QOS), qos_overriding_options=options, event_callbacks=told
                )
            except NameValidationException as error:  # people's names come from other nodes
                self._node.fault("topics", error)
                continue
            publisher.lasts = lasting
            if self._node.is_active:
                publisher.on_activate(None)
            self._publishers[topic] = publisher
        for topic in [topic for topic, one in self._publishers.items() if topic not in wanted and not one.lasts]:
            self._node.destroy_lifecycle_publisher(self._publishers.pop(topic))
        return True

    def name(self, topic: str) -> str:
        """A topic's full name, after remapping."""
        return str(self._publishers[topic].topic_name)

    def watchers(self, topic: str) -> int:
        with contextlib.suppress(KeyError, InvalidHandle):  # destroyed meanwhile
            return int(self._publishers[topic].get_subscription_count())
        return 0

    def is_watched(self) -> bool:
        return any(self.watchers(topic) for topic in [*self._publishers])

    def send(self, topic: str, data: bytes) -> None:
        """Publishes, if the topic still exists."""
        with contextlib.suppress(KeyError, InvalidHandle):
            self._publishers[topic].publish(data)
