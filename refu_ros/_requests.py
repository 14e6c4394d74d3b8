"""Requests to the node: for a recording and, where the package `refu_msgs` is installed, for a dressed frame or bag.

Requests aren't trusted.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from concurrent.futures import Future, wait
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rclpy.action import ActionServer, CancelResponse
from rclpy.serialization import deserialize_message
from rclpy.task import Future as RosFuture

from msg_adapters import MESH, encode_mesh
from msg_adapters.bags import free_path, path_in
from refu_core import RefuError
from refu_core.errors import printable
from refu_ros._beside import NOT_BEGUN, BagJob, RequestDresser, asked_frame, asked_settings
from refu_ros._guard import answer_no
from refu_ros._interfaces import interface

if TYPE_CHECKING:
    from refu_core.realtime import PipelineOutput
    from refu_ros._node import GarmentNode

_KEPT_S = 60
"""How long a bag's result is kept for a client that lost the connection meanwhile [s]."""


class Requests:
    """The node's services and action, on the executor's thread; other threads do the work and send the answers."""

    def __init__(self, node: GarmentNode) -> None:
        self._node = node
        self._dresser = RequestDresser()
        self._job: BagJob | None = None
        self._goal: Any = None
        self._offer(interface("std_srvs/srv/SetBool"), "record", self._on_switch)
        try:
            dress, record = interface("refu_msgs/srv/Dress"), interface("refu_msgs/srv/Record")
            self._replay = interface("refu_msgs/action/ReplayBag")
            self._answer = dress.Response
            self._garment, self._mesh = interface("refu_msgs/msg/Garment"), interface(MESH)
        except RefuError as error:
            node.get_logger().info(f"no ~/dress, ~/record_bag and ~/replay_bag: {error}")
            return
        self._offer(record, "record_bag", self._on_record)
        service = self._offer(dress, "dress", self._on_dress)
        service.send_response = node.guarded("dress", partial(self._send, service.send_response))
        if importlib.util.find_spec("refu_lab") is not None:
            taken: Any = {"cancel_callback": node.guarded("replay_bag", self._on_cancel), "result_timeout": _KEPT_S}
            ActionServer(node, self._replay, "~/replay_bag", self._on_replay, **taken)

    def close(self) -> None:
        """Ends what is under way. Further requests may follow."""
        if self._job is not None:
            self._job.cancel()
            wait([self._job.done])
        self._job = None
        self._dresser.close()

    def _offer(self, kind: Any, name: str, answer: Callable[[Any, Any], Any]) -> Any:
        return self._node.create_service(kind, f"~/{name}", self._node.guarded(name, answer, answer_no))

    def _on_switch(self, request: Any, response: Any) -> Any:
        response.message, _ = self._node.record(on=request.data)
        response.success = True
        return response

    def _on_record(self, request: Any, response: Any) -> Any:
        path = str(path_in(self._node.settings.bags, request.path)) if request.path else ""
        response.message, response.path = self._node.record(on=request.start, path=path)
        response.success = True
        return response

    # One frame ------------------------------------------------------------------------------------

    def _on_dress(self, request: Any, response: Any) -> Any:
        settings, frame = asked_settings(request, self._node.settings), asked_frame(request)
        response.header = request.header
        settings = settings.changed({"frame_id": request.header.frame_id.lstrip("/") or settings.frame_id})
        return self._dresser.ask(frame, settings, partial(self._dressed, response))

    def _send(self, send: Callable[[Any, Any], object], answer: Any, header: Any) -> None:
        """Sends an answer; one that isn't ready is sent by the thread that makes it, while the executor goes on."""

        def refused(error: Exception) -> Any:
            return answer_no(error, None, self._answer())

        if isinstance(answer, Future):
            said = self._node.guarded("dress", answer.result, refused)
            answer.add_done_callback(lambda _: send(said(), header))
        else:
            send(answer, header)

    def _dressed(self, response: Any, output: PipelineOutput, placed: dict[str, NDArray[np.float64]]) -> Any:
        for name, points in placed.items():
            stats = output.stats.garments[name]
            mesh = deserialize_message(encode_mesh(points, output[name].faces), self._mesh)
            own = {"n_inside": stats.n_inside, "n_unresolved": stats.n_unresolved}
            response.garments.append(self._garment(name=name, mesh=mesh, **own))
        response.largest_shift = float(output.stats.shift.largest)
        response.within_promise = bool(output.stats.within_promise)
        response.success = True
        return response

    # A bag ----------------------------------------------------------------------------------------

    async def _on_replay(self, goal: Any) -> Any:
        result = self._replay.Result()
        try:
            job = self._begin(goal)
            future = RosFuture(executor=self._node.executor)
            job.done.add_done_callback(future.set_result)
            try:
                done = (await future).result()
            finally:
                self._job = self._goal = None
            _fill(result, done, job.output)
        except Exception as error:
            self._node.fault("replay_bag", error)
            result.message = printable(error)
        if goal.is_cancel_requested:
            goal.canceled()
        elif result.success:
            goal.succeed()
        else:
            goal.abort()
        return result

    def _begin(self, goal: Any) -> BagJob:
        request = goal.request
        if goal.is_cancel_requested:  # between being accepted and getting its turn
            raise RefuError(NOT_BEGUN)
        if self._job is not None:
            raise RefuError("another bag is being dressed: wait for it, or cancel it")
        settings = asked_settings(request, self._node.settings)
        bag = path_in(settings.bags, request.bag)
        if not bag.exists():
            raise RefuError(f"no bag {request.bag!r} in {settings.bags}")
        output = free_path(bag.with_name(f"{bag.stem}-dressed.mcap"))
        self._node.get_logger().info(printable(f"dressing {bag} as {output}"))

        def tell(done: int, total: int) -> None:
            goal.publish_feedback(self._replay.Feedback(frames_done=done, frames_total=total))

        self._job = BagJob(bag, output, settings, self._node.guarded("replay_bag", tell), topic=request.topic)
        self._goal = goal
        return self._job

    def _on_cancel(self, goal: Any) -> CancelResponse:
        if self._job is not None and goal == self._goal:
            self._job.cancel()
        return CancelResponse.ACCEPT


def _fill(result: Any, done: dict[str, Any], output: object) -> None:
    result.output, result.frames = str(output), done["frames"]
    for name, figures in done["garments"].items():
        result.garments.append(name)
        for metric in ("vfcp_percent", "cfmp_percent"):  # None: cancelled before its first frame
            getattr(result, metric).append(math.nan if figures[metric] is None else figures[metric])
    result.success = not done["interrupted"]
    said = ["cancelled: the bag has the frames that were done"] if done["interrupted"] else done["warnings"]
    result.message = printable("; ".join(said))
