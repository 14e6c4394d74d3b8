"""A node that no peer can end: what a callback raises is counted and logged, and the node goes on."""

from __future__ import annotations

import functools
import math
import time
import weakref
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy.action import ActionServer
from rclpy.exceptions import InvalidHandle
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node, SetParametersResult

from msg_adapters import check_stamp
from msg_adapters.statistics import Statistics
from refu_core import RefuError
from refu_core.errors import printable

_CLOCK = "/clock"
_MOST_ITEMS = 1000
"""The most entries of a list in a request to rclpy's own services: it works through them one by one, and serves nobody
else meanwhile."""
LOG_PERIOD_S = 5.0
"""Shortest time between two log messages of the same kind [s]."""


class GuardedNode(Node):  # type: ignore[misc]
    """A node whose callbacks, rclpy's own included, all go through `guarded`.

    Executors end at the first exception, and the C++ one forgets requests that came with the one that failed. So a
    guard around the executor alone isn't enough.
    """

    def __init__(self, name: str, **options: Any) -> None:
        self.statistics = Statistics()
        self._said: dict[str, float] = {}
        super().__init__(name, **options)
        # rclpy's own group never drops what is gone: topics of everybody who has come and left.
        group, there = self.default_callback_group, self.default_callback_group.entities
        group.add_entity = lambda entity: there.add(weakref.ref(entity, there.discard))
        for service in self.services:  # rclpy's own: parameters, lifecycle, type description
            what = service.srv_name.rsplit("/", 1)[-1]
            service.callback = self.guarded(what, _bounded(service.callback), answer_no)

    def fault(self, what: str, error: Exception) -> None:
        """Counts and logs what has gone wrong, in a callback or elsewhere."""
        text, now = printable(f"{what}: {_reason(error)}"), time.monotonic()
        self.statistics.fault(what, text)
        if now > self._said.get(what, -math.inf) + LOG_PERIOD_S:  # one kind's flood doesn't hide another
            self._said[what] = now
            self.get_logger().warning(text)

    def guarded(
        self, what: str, callback: Callable[..., Any], otherwise: Callable[..., Any] = lambda *_, **__: None
    ) -> Callable[..., Any]:
        """The callback, made safe: if it raises, it returns what `otherwise` makes of the error and the arguments."""

        @functools.wraps(callback)
        def call(*arguments: Any, **options: Any) -> Any:
            try:
                return callback(*arguments, **options)
            except Exception as error:
                self.fault(what, error)
                return otherwise(error, *arguments, **options)

        return call

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], *arguments: Any, **options: Any
    ) -> Any:
        """Like rclpy's, but guarded; also for the clock, which rclpy subscribes to itself."""

        def checked(message: Any) -> None:
            # A time that no message can carry would raise wherever a stamp is made, in rclpy itself, too.
            check_stamp(message.clock.sec * 10**9 + message.clock.nanosec)
            callback(message)

        taken = self.guarded(topic, checked if topic == _CLOCK else callback)
        return super().create_subscription(msg_type, topic, taken, *arguments, **options)

    def add_waitable(self, waitable: Any) -> None:
        """Like rclpy's, but guarded, for actions and for the events of publishers and subscriptions.

        An event may still be queued, or about to be waited for by another thread, when its publisher or subscription is
        destroyed. Then there is nothing left to take, and the executor would raise.
        """
        take, add = waitable.take_data, waitable.add_to_wait_set

        def add_to_wait_set(wait_set: Any) -> None:
            waitable._event_index = None  # of the wait set before
            with suppress(InvalidHandle):
                add(wait_set)

        def take_data() -> Any:
            with suppress(InvalidHandle):
                return take()

        if isinstance(waitable, ActionServer):
            waitable.take_data = self.guarded("action", take, lambda *_: {})
        else:
            waitable.callback, waitable.add_to_wait_set = self.guarded("event", waitable.callback), add_to_wait_set
            waitable.take_data = self.guarded("event", take_data)
        super().add_waitable(waitable)


def transition(method: Callable[..., TransitionCallbackReturn]) -> Callable[..., TransitionCallbackReturn]:
    """A lifecycle callback that reports what rclpy would swallow; the lifecycle goes on with `on_error`."""

    @functools.wraps(method)
    def call(node: GuardedNode, state: Any) -> TransitionCallbackReturn:
        return node.guarded(method.__name__, method, lambda *_: TransitionCallbackReturn.ERROR)(node, state)

    return call


def _reason(error: Exception) -> str:
    return str(error) if isinstance(error, RefuError) else f"{type(error).__name__}: {error}"


def _bounded(callback: Callable[..., Any]) -> Callable[..., Any]:
    def call(request: Any, response: Any) -> Any:
        for name, kind in request.get_fields_and_field_types().items():
            if kind.startswith("sequence") and len(getattr(request, name)) > _MOST_ITEMS:
                raise RefuError(f"wanted up to {_MOST_ITEMS} {name} in a request, got {len(getattr(request, name))}")
        return callback(request, response)

    return call


def answer_no(error: Exception, request: Any, response: Any) -> Any:
    """The answer to a request that can't be met: `success` is false by default; the reason goes where there is room."""
    refused = SetParametersResult(successful=False, reason=printable(_reason(error)))
    if hasattr(response, "message"):
        response.message = printable(_reason(error))
    if hasattr(response, "results"):
        response.results = [*response.results, *[refused] * (len(request.parameters) - len(response.results))]
    elif isinstance(getattr(response, "result", None), SetParametersResult):
        response.result = refused
    return response
