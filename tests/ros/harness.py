"""A node under test in a process of its own, and a peer in this one that talks to it over loopback."""

from __future__ import annotations

import argparse
import fcntl
import functools
import gc
import os
import signal
import tempfile
import time
import weakref
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from sensor_msgs.msg import JointState
from visualization_msgs.msg import MarkerArray

from msg_adapters import Marker, decode_marker_array, encoder_for
from refu_core import SmplFrame
from refu_ros import garment_node
from refu_ros._node import GarmentNode
from refu_ros._program import make_executor
from tests.ros.ready import run_program

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from types import ModuleType

ROOT = Path(__file__).parents[2]
GARMENTS = ("tshirt-male", "short-pant-male")
CHEAP = {
    "input_type": "joint_state",
    "garments": [GARMENTS[0]],
    "backbone": "skinned",
    "sdf": "none",
    "collider": False,
}
"""Parameters of a node that starts soonest, and says what it says in no time."""
PATIENCE_S = 300.0
"""How long anything that has to happen may take, on a machine that has a lot to do: nobody waits any longer for what
has happened, so only what never does takes that long."""
ANSWER_S = 60.0
"""How long a request's answer may take before it counts as lost."""

_TURN_S = 0.004
"""How long a node in the tests' process, and then its peer, does what there is to do, until the test looks again."""
_QUIET_S = 0.05
"""After so long without anything to do an executor has nothing left to do."""


class NodeProcess:
    """`garment_node` with parameters; ended at the end of the block if it still runs."""

    def __init__(
        self,
        log: Path,
        *,
        first: str = "",
        packages: Path | None = None,
        namespace: str = "",
        remaps: Sequence[str] = (),
        **parameters: Any,
    ) -> None:
        self._log = log
        given = [*ros_arguments(parameters), "-r", f"__ns:=/{namespace}"]
        given += [word for remap in remaps for word in ("-r", remap)]
        path = [str(folder) for folder in (ROOT, packages) if folder is not None]
        cwd = log.parent  # of relative paths that a test or a hostile peer names
        self.process = run_program("garment_node", given, log=log, cwd=cwd, path=path, first=first)

    def __enter__(self) -> NodeProcess:
        return self

    def __exit__(self, *error: object) -> None:
        # One that is killed is there for the others for twenty seconds more: the next test would talk to it.
        self.process.terminate()
        try:
            self.process.wait(PATIENCE_S)
        finally:
            self.process.kill()

    @property
    def log(self) -> str:
        """What it has printed."""
        return self._log.read_text(errors="replace")

    def stop(self, *signals: signal.Signals) -> int:
        """Sends signals, one after the other, and waits for the exit status."""
        for number in signals:
            self.process.send_signal(number)
            time.sleep(0.05)
        return self.ends()

    def ends(self) -> int:
        """Waits for the exit status."""
        return self.process.wait(timeout=PATIENCE_S)


def ros_arguments(parameters: dict[str, Any]) -> list[str]:
    """Parameters as a command line has them."""
    return ["--ros-args", *(item for name, value in parameters.items() for item in ("-p", f"{name}:={_yaml(value)}"))]


def _yaml(value: Any) -> str:
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_yaml, value)) + "]"
    return str(value).lower() if isinstance(value, bool) else str(value)


class Peer:
    """Sender, raw subscriber and operator."""

    def __init__(self, *persons: str, topic: str = "{}/smpl_params", namespace: str = "") -> None:
        self.node = rclpy.create_node("peer", namespace=namespace)
        self._publishers = {
            person: self.node.create_publisher(
                JointState, topic.format(person) if person else "smpl_params", QoSProfile(depth=1)
            )
            for person in persons or ("",)
        }
        self.garments: list[list[Marker]] = []
        self.diagnostics: list[DiagnosticArray] = []
        self._from_ns = 0
        self._subscription: Any = None
        self._clients: dict[str, Any] = {}
        self._encode = encoder_for("joint_state")
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._report, 10)
        self.watch()

    def _report(self, report: DiagnosticArray, info: dict[str, Any]) -> None:
        if info["source_timestamp"] >= self._from_ns:
            self.diagnostics.append(report)

    def forget_reports(self) -> None:
        """Only what is reported from now on counts, and nothing that is still on its way."""
        self._from_ns = time.time_ns()
        self.diagnostics.clear()

    def watch(self) -> None:
        """Listens to the garments."""
        self._subscription = self.node.create_subscription(
            MarkerArray, "garments", lambda data: self.garments.append(decode_marker_array(data)), 10, raw=True
        )

    def unwatch(self) -> None:
        """Listens no longer."""
        self.node.destroy_subscription(self._subscription)

    def spin_until(
        self, condition: Callable[[], Any], what: str, *, timeout: float = PATIENCE_S, turn: float = 0.02
    ) -> None:
        """Fails with `what` when it doesn't come true."""
        end = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < end, f"waited {timeout} s in vain: {what}"
            rclpy.spin_once(self.node, timeout_sec=turn)

    def spin(self, seconds: float) -> None:
        """For so long."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            rclpy.spin_once(self.node, timeout_sec=left)

    def wait_for_node(self) -> None:
        """Until it listens, and what it sends arrives."""
        self.spin_until(
            lambda: (
                all(publisher.get_subscription_count() for publisher in self._publishers.values())
                and self.node.count_publishers("garments")
            ),
            "the node listens",
        )

    def listeners(self, person: str = "") -> int:
        """How many subscriptions a person's topic has."""
        return int(self._publishers[person or next(iter(self._publishers))].get_subscription_count())

    def fall_silent(self, person: str) -> None:
        """A person's topic is gone."""
        self.node.destroy_publisher(self._publishers.pop(person))

    def send(self, frame: SmplFrame, person: str = "") -> None:
        """A good frame."""
        self.send_raw(self._encode(frame), person)

    def send_raw(self, data: bytes, person: str = "") -> None:
        """Any bytes."""
        self._publishers[person].publish(data)

    def seen(self, stamp_ns: int, ns: str = GARMENTS[0]) -> Marker | None:
        """The marker with that stamp, if it has come."""
        for markers in reversed(self.garments):
            for marker in markers:
                if marker.stamp_ns == stamp_ns and marker.ns == ns:
                    return marker
        return None

    def shown(self) -> set[str]:
        """The namespaces of the garments that a viewer shows who has got all messages since `garments` was cleared."""
        last = {marker.ns: marker.action for markers in self.garments for marker in markers}
        return {ns for ns, action in last.items() if action == 0}

    def dress(self, frame: SmplFrame, person: str = "") -> Marker:
        """Sends a frame (again and again: input is best effort) until its T-shirt comes back."""
        ns = f"{person}/{GARMENTS[0]}" if person else GARMENTS[0]
        end = time.monotonic() + PATIENCE_S
        while (marker := self.seen(frame.stamp_ns, ns)) is None:
            assert time.monotonic() < end, f"no garment for {person or 'the frame'}"
            self.send(frame, person)
            again = time.monotonic() + 0.1
            while time.monotonic() < again and self.seen(frame.stamp_ns, ns) is None:
                rclpy.spin_once(self.node, timeout_sec=0.02)
        return marker

    def status(self, part: str) -> tuple[int, str, dict[str, str]]:
        """Level, message and values of the newest status of a part of the node."""
        for array in reversed(self.diagnostics):
            for status in array.status:
                if status.name.rpartition("/")[2] == f"garment_node: {part}":
                    return status.level[0], status.message, {item.key: item.value for item in status.values}
        return -1, "", {}

    def count(self, part: str, key: str) -> int:
        """A counter of the diagnostics."""
        return int(self.status(part)[2].get(key, "0"))

    def call(self, service_type: Any, name: str, request: Any) -> Any:
        """A service's answer, asked for again by another client where none comes within `ANSWER_S`.

        While a client and its service find each other, the answer to a request may be lost for good.
        """
        for _ in range(int(PATIENCE_S / ANSWER_S)):
            client = self._clients.get(name)
            if client is None:  # one is kept: between a pair that has found each other nothing is lost
                client = self._clients[name] = self.node.create_client(service_type, name)
            assert client.wait_for_service(timeout_sec=PATIENCE_S), name
            future = client.call_async(request)
            end = time.monotonic() + ANSWER_S
            self.spin_until(lambda: future.done() or time.monotonic() > end, name)  # noqa: B023 - ends here
            if future.done():
                return future.result()
            self.node.destroy_client(self._clients.pop(name))
        raise AssertionError(f"asked for {PATIENCE_S} s in vain: {name}")

    def set(self, **parameters: Any) -> list[Any]:
        """Sets parameters of the node; returns a result for each."""
        values = [Parameter(name, value=value).to_parameter_msg() for name, value in parameters.items()]
        request = SetParameters.Request(parameters=values)
        return list(self.call(SetParameters, "garment_node/set_parameters", request).results)

    def close(self) -> None:
        """Leaves the graph."""
        self.node.destroy_node()


class NodeHere:
    """A node in this process, and a peer that doesn't watch yet; both move when the test waits."""

    def __init__(self, *persons: str, executor: Any = None, remaps: Sequence[str] = (), **parameters: Any) -> None:
        renamed = [word for remap in remaps for word in ("-r", remap)]
        self.node = GarmentNode(cli_args=[*ros_arguments(parameters), *renamed])
        self.peer = Peer(*persons)
        self.peer.unwatch()
        self._executor = executor or make_executor()
        self._executor.add_node(self.node)
        assert garment_node.started(self.node)

    def until(self, condition: Callable[[], Any], what: str, **options: Any) -> None:
        """Fails with `what` when it doesn't come true."""

        def both() -> Any:
            # All that comes: one event at a time, the node would fall behind a test that sends each time it looks.
            self._executor.spin_until_future_complete(Future(), timeout_sec=_TURN_S)
            return condition()

        self.peer.spin_until(both, what, turn=_TURN_S, **options)

    def close(self) -> None:
        """Leaves the graph; fails if something still holds the node, which the next test would meet there."""
        self.peer.close()
        begun = time.monotonic()
        while time.monotonic() < begun + _QUIET_S:  # rclpy's executor never frees what it hasn't come to, nor the node
            begun = time.monotonic()
            self._executor.spin_once(timeout_sec=_QUIET_S)
        self._executor.remove_node(self.node)
        self.node.close()
        self.node.destroy_node()
        node, executor, end = weakref.ref(self.node), self._executor, begun + PATIENCE_S
        del self.node, self._executor
        gc.collect()  # only then is the node gone from the graph
        while node() is not None:  # something came after the last look
            assert time.monotonic() < end, "something holds the node"
            executor.spin_once(timeout_sec=_QUIET_S)
            gc.collect()


def frame(i: int, *, stamp_ns: int | None = None, transl: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> SmplFrame:
    """A waving, walking person; a stamp of its own for each `i`."""
    pose = np.zeros((24, 3))
    pose[16, 2], pose[17, 2] = -0.9 + 0.3 * np.sin(0.3 * i), 0.9 - 0.3 * np.sin(0.3 * i)
    pose[1, 0], pose[2, 0] = 0.3 * np.sin(0.2 * i), -0.3 * np.sin(0.2 * i)
    stamp = 10**9 + i * 33_333_333 if stamp_ns is None else stamp_ns
    return SmplFrame(pose=pose, transl=np.array(transl), stamp_ns=stamp)


def start(module: ModuleType) -> argparse.Namespace:
    """The command line of a test that goes on for as long as one likes: hours, seed, and a new folder; starts rclpy."""
    name = Path(str(module.__file__)).stem
    parser = argparse.ArgumentParser(
        prog=f"python -m tests.ros.{name}",
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--hours", type=float, default=1 / 60, metavar="H", help="for how long (a minute)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of all that is drawn (0)")
    parser.add_argument(
        "--output", type=Path, default=Path("out", name), metavar="DIR", help=f"for log and bags (out/{name})"
    )
    args = parser.parse_args()
    args.output = args.output.absolute()
    if args.output.exists():
        parser.error(f"{args.output} is there already; name a new folder")
    args.output.mkdir(parents=True)
    isolate()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    return args


def isolate() -> None:
    """Keeps tests on this machine and apart from other tests and robots."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(own_domain())
    os.environ.setdefault("OMP_NUM_THREADS", "1")


@functools.cache
def own_domain() -> int:
    """A domain that no other test process on this machine has got: each keeps a lock as long as it runs."""
    for domain in range(1, 101):
        path = Path(tempfile.gettempdir(), f"refu-ros-domain-{os.getuid()}-{domain}.lock")
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
        else:
            return domain
    pytest.fail("a hundred other processes test ROS nodes on this machine")
