"""Hostile peers: everything that a ROS graph lets others ask of the node, say to it and do around it, at random:

    python -m tests.ros.peers [--hours H] [--seed S] [--output DIR]

Exit code 1 where the node didn't stay up; DIR, a new folder, keeps its log and what it recorded.
"""

from __future__ import annotations

import math
import random
import signal
import sys
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import rclpy
import rclpy.parameter
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from type_description_interfaces.srv import GetTypeDescription
from visualization_msgs.msg import MarkerArray

from msg_adapters import decode_marker_array, encoder_for
from refu_core import SmplFrame
from refu_core.options import specs_of
from refu_ros._settings import NodeSettings
from tests.ros.harness import CHEAP, PATIENCE_S, NodeProcess, start

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

SPECS = specs_of(NodeSettings)
_PENDING, _ENTITIES = 40, 12
"""Requests without an answer, and peers at once, at most."""
_QUEUED = 8
"""Requests of one service without an answer: DDS keeps ten."""
_ANSWER_S = PATIENCE_S
_FOREIGN = ("", "use_sim_time", "start_type_description_service", "qos_overrides./garments.publisher.depth", "nobody")
_SHUTDOWNS = {
    Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,
    Transition.TRANSITION_INACTIVE_SHUTDOWN,
    Transition.TRANSITION_ACTIVE_SHUTDOWN,
}
"""To end the node so is to tell it to end: peers don't."""
_LIFECYCLE = (1, 2, 3, 4)


@dataclass
class PeersResult:
    """What was tried, and what the node made of it."""

    tries: Counter[str] = field(default_factory=Counter)
    unanswered: Counter[str] = field(default_factory=Counter)
    """Requests to a service that didn't get an answer, however long they waited."""
    faults: dict[str, int] = field(default_factory=dict)
    """What the node has counted, by its diagnostics."""
    problems: list[str] = field(default_factory=list)
    """How it failed to stay up."""

    @property
    def failures(self) -> int:
        """Problems, and requests without an answer."""
        return len(self.problems) + sum(self.unanswered.values())


class HostilePeers:
    """Peers of `garment_node` (in the namespace of this process), who draw what they do from a seed.

    The node should have the parameters `CHEAP`, and record nothing anywhere but in `folder`.
    """

    def __init__(self, folder: Path, *, seed: int, node: str = "garment_node") -> None:
        self.result = PeersResult()
        self._random = random.Random(seed)
        self._folder, self._name = folder, node
        self._node = rclpy.create_node("hostile", use_global_arguments=False)
        self._input = self._node.create_publisher(JointState, "smpl_params", QoSProfile(depth=1))
        self._clock = self._node.create_publisher(Clock, "/clock", QoSProfile(depth=1))
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._note, 10)
        self._encode = encoder_for("joint_state")
        self._clients: dict[str, Any] = {}
        self._pending: deque[tuple[str, float, Any]] = deque()
        self._entities: list[tuple[Callable[[Any], object], Any]] = []
        self._kinds: dict[str, Callable[[], object]] = {
            "set_parameters": lambda: self._ask(SetParameters, parameters=self._parameters()),
            "set_parameters_atomically": lambda: self._ask(SetParametersAtomically, parameters=self._parameters()),
            "get_parameters": lambda: self._ask(GetParameters, names=self._names()),
            "describe_parameters": lambda: self._ask(DescribeParameters, names=self._names()),
            "get_parameter_types": lambda: self._ask(GetParameterTypes, names=self._names()),
            "list_parameters": lambda: self._ask(ListParameters, prefixes=self._names(), depth=self._number(2**64)),
            "change_state": self._change_state,
            "get_state": lambda: self._ask(GetState),
            "get_available_states": lambda: self._ask(GetAvailableStates),
            "get_available_transitions": lambda: self._ask(GetAvailableTransitions),
            "get_type_description": lambda: self._ask(
                GetTypeDescription, type_name=self._text(), type_hash=self._text(), include_type_sources=True
            ),
            "record": lambda: self._ask(SetBool, data=self._random.random() < 0.5),
            "clock": self._send_clock,
            "bytes": self._send_bytes,
            "frame": lambda: self.send(self._random.randrange(10**9), frame_id=self._text()),
            "come": self._come,
            "go": self._go,
        }

    # What they do ---------------------------------------------------------------------------------

    def wait(self, seconds: float = PATIENCE_S) -> None:
        """Until the node is there."""
        end = time.monotonic() + seconds
        while not self._node.count_publishers("garments") and time.monotonic() < end:
            self._spin(0.1)

    def attack(self, seconds: float = math.inf, *, tries: float = math.inf, alive: Callable[[], bool]) -> None:
        """Everything at random for so long, or so often, or until the node isn't alive any more."""
        end = time.monotonic() + seconds
        names = [*self._kinds]
        while self.result.tries.total() < tries and time.monotonic() < end and alive():
            kind = self._random.choice(names)
            if len(self._pending) < _PENDING:
                self._kinds[kind]()
                self.result.tries[kind] += 1
            self._spin(0.002)
        if not alive():
            self.result.problems.append("the node has ended")

    def recover(self, *, alive: Callable[[], bool], seconds: float = 2 * PATIENCE_S) -> None:
        """Sets everything back and waits for one good frame's garment; says in the result what doesn't come about."""
        end = time.monotonic() + seconds
        while self._entities:
            self._go()
        while self._pending and time.monotonic() < end and alive():
            self._spin(0.05)
        came: list[int] = []
        self._node.create_subscription(
            MarkerArray,
            "garments",
            lambda data: came.extend(marker.stamp_ns for marker in decode_marker_array(data) if marker.action == 0),
            10,
            raw=True,
        )
        good = [_parameter(n, v) for n, v in {"use_sim_time": False, **_SAFE}.items()]
        step, stamp = 0, 4 * 10**17
        while stamp not in came and time.monotonic() < end and alive():
            if step % 20 == 0:  # whatever state it is in, after these it is active
                self._ask(SetParameters, parameters=good)
                for number in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE):
                    self._ask(ChangeState, transition=Transition(id=number))
            self.send(stamp)
            self._spin(0.1)
            step += 1
        if stamp not in came:
            self.result.problems.append("the next good frame isn't dressed")
        while not self._has_counted() and time.monotonic() < end and alive():
            self._input.publish(b"\0\1\0\0nonsense")
            self._ask(ChangeState, transition=Transition(id=255))
            self._ask(SetParameters, parameters=[_parameter("margin", "wide")])
            self._spin(0.2)
        if not self._has_counted():
            self.result.problems.append(f"not every fault is counted: {self.result.faults}")
        while self._pending:
            self._spin(0.1)

    def _has_counted(self) -> bool:
        return all(self.result.faults.get(what) for what in ("invalid", "change_state", "refused parameters"))

    def close(self) -> None:
        """Leaves the graph."""
        self._node.destroy_node()

    def send(self, stamp_ns: int, *, frame_id: str = "map") -> None:
        """A good frame, but for the name of its frame."""
        pose = np.random.default_rng(stamp_ns).normal(0, 0.1, (24, 3)).astype(np.float32)
        self._input.publish(self._encode(SmplFrame(pose, stamp_ns=stamp_ns), frame_id=frame_id))

    def _spin(self, seconds: float) -> None:
        rclpy.spin_once(self._node, timeout_sec=seconds)
        while self._pending and (self._pending[0][2].done() or time.monotonic() > self._pending[0][1] + _ANSWER_S):
            kind, _, future = self._pending.popleft()
            self.result.unanswered[kind] += not future.done()

    def _note(self, diagnostics: Any) -> None:
        for status in diagnostics.status:
            for item in status.values:
                if item.key.startswith(("faults: ", "dropped: ")):
                    self.result.faults[item.key.split(": ")[1]] = int(item.value)

    # What they say --------------------------------------------------------------------------------

    def _ask(self, service: Any, **fields: Any) -> None:
        name = {"SetBool": "record"}.get(service.__name__, _snake(service.__name__))
        if name not in self._clients:
            self._clients[name] = self._node.create_client(service, f"{self._name}/{name}")
        client = self._clients[name]
        waiting = sum(kind == name for kind, *_ in self._pending)
        if client.service_is_ready() and waiting < _QUEUED:
            self._pending.append((name, time.monotonic(), client.call_async(service.Request(**fields))))

    def _number(self, top: int) -> int:
        return self._random.choice((0, 1, top - 1, self._random.randrange(top)))

    def _count(self) -> int:
        return self._random.choice((0, 1, 1, 2, 4, 10, 24, self._random.choice((1000, 100_000))))

    def _text(self) -> str:
        texts = (
            "",
            "/",
            "~nosuchuser/x",
            "/proc/nope",
            "a/" * 3000,
            "x" * self._count(),
            "\x1b[2J",
            "\u202e\ud7ff",
            "%s%n",
            ".",
        )
        own = tuple(one.default for one in SPECS.values() if isinstance(one.default, str))
        return self._random.choice((*texts, *own, str(self._folder / "bag"), str(self._folder / "other" / "bag")))

    def _names(self) -> list[str]:
        names = (*SPECS, *_FOREIGN, "x" * 5000, "a.b.c", "\n")
        if self._random.random() < 0.02:
            return [self._random.choice(names)] * 100_000
        return self._random.choices(names, k=self._random.randrange(5))

    def _parameters(self) -> list[Any]:
        names = (*SPECS, *_FOREIGN)
        n = self._random.choice((1, 1, 1, 2, 5)) if self._random.random() < 0.99 else 5000
        return [Parameter(name=self._random.choice(names), value=self._value()) for _ in range(n)]

    def _value(self) -> Any:
        n, number = (
            self._count(),
            self._random.choice((0.0, 0.03, 1.0, 30.0, -1.0, 1e308, 5e-324, float("nan"), float("inf"))),
        )
        known = self._random.choice([one.default for one in SPECS.values()])
        known = [*known] if isinstance(known, tuple) else known
        if isinstance(known, str) and "/" in known:
            known = ""
        kind = self._random.choice((*range(11), 77, 255))
        return self._random.choice(
            (
                _value_of(known),
                ParameterValue(
                    type=kind,
                    bool_value=True,
                    integer_value=self._number(2**63) - self._random.choice((0, 2**62)),
                    double_value=number,
                    string_value=self._text(),
                    byte_array_value=[b"\xff"] * n if kind == 5 else [],
                    bool_array_value=[True] * n if kind == 6 else [],
                    integer_array_value=[1] * n if kind == 7 else [],
                    double_array_value=[number] * n if kind == 8 else [],
                    string_array_value=[self._text() for _ in range(min(n, 10))] if kind == 9 else [],
                ),
            )
        )

    def _change_state(self) -> None:
        number = self._random.choice((*_LIFECYCLE * 4, *range(256)))
        labels = ("", "", "", "configure", "activate", "cleanup", "transition_success", self._text())
        label = self._random.choice(labels)
        if number not in _SHUTDOWNS and "shutdown" not in label:
            self._ask(ChangeState, transition=Transition(id=number, label=label))

    def _send_clock(self) -> None:
        clock = Clock()
        clock.clock.sec = self._random.choice((-(2**31), -1, 0, 5, 2**31 - 1, self._random.randrange(2**31)))
        clock.clock.nanosec = self._number(2**32)
        self._clock.publish(clock)

    def _send_bytes(self) -> None:
        data = bytearray(self._encode(SmplFrame(np.zeros((24, 3), np.float32), stamp_ns=1)))
        for _ in range(self._random.randrange(1, 30)):
            data[self._random.randrange(len(data))] = self._random.randrange(256)
        cut = self._random.choice((len(data), self._random.randrange(len(data)), 0))
        self._input.publish(bytes(data[: max(cut, 4)]))

    def _come(self) -> None:
        """Somebody looks, or sends, with qualities that fit or don't."""
        if len(self._entities) >= _ENTITIES:
            return
        qos = QoSProfile(
            depth=self._random.choice((1, 5, 1000)),
            reliability=self._random.choice((ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT)),
            durability=self._random.choice((DurabilityPolicy.VOLATILE, DurabilityPolicy.TRANSIENT_LOCAL)),
        )
        topic = self._random.choice(("garments", "body", "smpl_params", "garment_node/transition_event"))
        if topic == "smpl_params":
            self._entities.append((self._node.destroy_publisher, self._node.create_publisher(JointState, topic, qos)))
        elif topic in ("garments", "body"):
            subscription = self._node.create_subscription(MarkerArray, topic, lambda _: None, qos, raw=True)
            self._entities.append((self._node.destroy_subscription, subscription))

    def _go(self) -> None:
        if self._entities:
            destroy, entity = self._entities.pop(self._random.randrange(len(self._entities)))
            destroy(entity)


_SAFE: dict[str, Any] = {
    name: [*one.default] if isinstance(one.default, tuple) else one.default
    for name, one in SPECS.items()
    if one.live and name not in ("garments", "backbone", "sdf")
}
_SAFE |= {name: value for name, value in CHEAP.items() if name != "input_type"}
"""Parameters with which a frame is dressed soon."""


def _value_of(value: Any) -> Any:
    return rclpy.parameter.Parameter("x", value=value).get_parameter_value()


def _parameter(name: str, value: Any) -> Any:
    return Parameter(name=name, value=_value_of(value))


def _snake(name: str) -> str:
    return "".join(f"_{c.lower()}" if c.isupper() else c for c in name).lstrip("_")


def main() -> int:
    """Starts `garment_node`, lets hostile peers at it for so long, and looks whether it still works."""
    args = start(sys.modules[__name__])
    log = args.output / "log.txt"
    with NodeProcess(log, **CHEAP, use_sim_time=True) as node:
        peers = HostilePeers(args.output, seed=args.seed)
        peers.wait()
        peers.attack(3600 * args.hours, alive=lambda: node.process.poll() is None)
        peers.recover(alive=lambda: node.process.poll() is None)
        peers.close()
        if (status := node.stop(signal.SIGINT)) != 0:
            peers.result.problems.append(f"it ended with status {status}: see {log}")
    result = peers.result
    print(f"{'what peers did':>27}{'tries':>10}{'unanswered':>12}")
    for kind, n in sorted(result.tries.items()):
        print(f"{kind:>27}{n:>10,}{result.unanswered[kind]:>12}")
    print("counted by the node:", ", ".join(f"{what} {n}" for what, n in sorted(result.faults.items())))
    print(*result.problems, f"{result.failures} FAILED" if result.failures else "the node stayed up", sep="\n")
    return int(result.failures > 0)


if __name__ == "__main__":
    sys.exit(main())
