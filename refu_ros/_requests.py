"""Services and an action with types of our own, where the package `refu_msgs` is installed."""

from __future__ import annotations

import importlib.util
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any

from rclpy.action import ActionServer, CancelResponse
from rclpy.task import Future as RosFuture

from msg_adapters.bags import free_path
from refu_core import RefuError
from refu_core.errors import printable
from refu_ros._asked import asked_frame, asked_path, asked_settings
from refu_ros._bag_job import BagJob
from refu_ros._dresser import Dresser
from refu_ros._guard import answer_no
from refu_ros._interfaces import interface

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from refu_core.realtime import PipelineOutput
    from refu_ros._node import GarmentNode

_KEPT_S = 60
"""For how long a bag's result may be asked for, by who lost the connection meanwhile [s]."""


class Requests:
    """All of it belongs to the executor's thread; work is done in others, and answered from there."""

    def __init__(self, node: GarmentNode) -> None:
        self._node = node
        self._dresser = Dresser()
        self._job: BagJob | None = None
        self._goal: Any = None
        self._pool: ThreadPoolExecutor | None = None
        try:
            dress, record = interface("refu_msgs/srv/Dress"), interface("refu_msgs/srv/Record")
            self._replay = interface("refu_msgs/action/ReplayBag")
            self._garment, self._mesh = interface("refu_msgs/msg/Garment"), interface("shape_msgs/msg/Mesh")
            self._corner, self._point = interface("shape_msgs/msg/MeshTriangle"), interface("geometry_msgs/msg/Point")
        except RefuError as error:
            node.get_logger().info(f"no ~/dress, ~/record_bag and ~/replay_bag: {error}")
            return
        node.create_service(record, "~/record_bag", node.guarded("record_bag", self._on_record, answer_no))
        service = node.create_service(dress, "~/dress", node.guarded("dress", self._on_dress, answer_no))
        service.send_response = node.guarded("dress", partial(_send_when_done, service.send_response))
        if importlib.util.find_spec("refu_lab") is not None:
            taken: Any = {"cancel_callback": node.guarded("replay_bag", self._on_cancel), "result_timeout": _KEPT_S}
            ActionServer(node, self._replay, "~/replay_bag", self._on_replay, **taken)

    def close(self) -> None:
        """Ends what is under way. More may be asked for afterwards."""
        if self._job is not None:
            self._job.cancel()
        if self._pool is not None:
            self._pool.shutdown()
        self._pool = self._job = None
        self._dresser.close()

    def _on_record(self, request: Any, response: Any) -> Any:
        path = str(asked_path(self._node.settings, request.path)) if request.path else ""
        done = self._node.record(on=request.start, path=path)
        response.success, response.message, response.path = done
        return response

    # One frame ------------------------------------------------------------------------------------

    def _on_dress(self, request: Any, response: Any) -> Any:
        settings = asked_settings(request, self._node.settings)
        frame = asked_frame(request)
        response.header = request.header
        asked = self._dresser.ask(frame, settings, partial(self._dressed, response))
        answer: Future[Any] = Future()
        said = self._node.guarded("dress", asked.result, partial(answer_no, request=request, response=response))
        asked.add_done_callback(lambda _: answer.set_result(said()))
        return answer

    def _dressed(self, response: Any, output: PipelineOutput, placed: dict[str, NDArray[np.float64]]) -> Any:
        for name, points in placed.items():
            stats = output.stats.garments[name]
            corners = [self._corner(vertex_indices=face) for face in output[name].faces.astype("u4")]
            mesh = self._mesh(triangles=corners, vertices=[self._point(x=x, y=y, z=z) for x, y, z in points.tolist()])
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
            try:
                done = await self._wait(job, goal)
            finally:
                self._job = self._goal = None
        except Exception as error:
            self._node.fault("replay_bag", error)
            result.message = printable(error)
        else:
            _fill(result, done, job.output)
        if goal.is_cancel_requested:
            goal.canceled()
        elif result.success:
            goal.succeed()
        else:
            goal.abort()
        return result

    def _begin(self, goal: Any) -> BagJob:
        request = goal.request
        if self._job is not None:
            msg = "another bag is being dressed: wait for it, or cancel it"
            raise RefuError(msg)
        settings = asked_settings(request, self._node.settings)
        bag = asked_path(settings, request.bag)
        if not bag.exists():
            msg = f"no bag {request.bag!r} in {settings.bags}"
            raise RefuError(msg)
        output = free_path(bag.with_name(f"{bag.stem}-dressed.mcap"))
        self._node.get_logger().info(printable(f"dressing {bag} as {output}"))
        self._job, self._goal = BagJob(bag, output, settings), goal
        return self._job

    def _wait(self, job: BagJob, goal: Any) -> RosFuture:
        told = self._node.guarded("replay_bag", lambda n, of: goal.publish_feedback(self._feedback(n, of)))
        future = RosFuture(executor=self._node.executor)

        def wait() -> None:
            try:
                future.set_result(job.wait(told))
            except Exception as error:
                future.set_exception(error)

        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, "bag")
        self._pool.submit(wait)
        return future

    def _feedback(self, n: int, of: int) -> Any:
        return self._replay.Feedback(frames_done=n, frames_total=of)

    def _on_cancel(self, goal: Any) -> CancelResponse:
        if self._job is not None and goal == self._goal:
            self._job.cancel()
        return CancelResponse.ACCEPT


def _send_when_done(send: Any, response: Any, header: Any) -> None:
    """An answer that isn't there yet is sent from the thread that makes it; meanwhile the executor goes on."""
    if isinstance(response, Future):
        response.add_done_callback(lambda done: send(done.result(), header))
    else:
        send(response, header)


def _fill(result: Any, done: dict[str, Any], output: object) -> None:
    result.output, result.frames = str(output), done["frames"]
    for name, figures in done["garments"].items():
        result.garments.append(name)
        result.vfcp_percent.append(float(figures["vfcp_percent"]))
        result.cfmp_percent.append(float(figures["cfmp_percent"]))
    result.success = not done["interrupted"]
    said = ["cancelled: the bag has the frames that were done"] if done["interrupted"] else done["warnings"]
    result.message = printable("; ".join(said))
