"""The live node under load for a long time, recording: whether it grows, slows down, loses or doubles messages."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from msg_adapters import BagReader, decode_marker_array, decoder_for, encoder_for
from refu_core import RefuError
from refu_core.stress import (
    JUDGED_FROM,
    TOLERANCE,
    StressError,
    Yardstick,
    is_slower,
    resident_mb,
    soak_frames,
    wardrobes,
)
from refu_ros.tables import format_table

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from refu_ros.stress import StressOptions

RATE = 30.0
"""Frames a second."""
_DEFAULT_S = 60.0
_QUICK_S = 10.0
_START_S = 180.0
_LAST_S = 5.0
"""How long the last messages may take."""
_SETTLE = 60
"""Frames that are sent before anything is counted."""
_SAMPLE_S = 1.0


@dataclass(frozen=True, kw_only=True)
class NodeSoak:
    """What came of it; tenths are of the time."""

    sent: int
    received: int
    """Different stamps that came back as garments."""
    doubled: int
    """Garments that came more than once."""
    superseded: int
    """Frames that the node dropped for a newer one, by its own count: it was busy."""
    replaced: int
    """Frames that the node never got, going by its recording: the topic's queue holds one, and a newer one came."""
    recorded: int
    """Garments in the bag."""
    not_recorded: int
    """Garments that were received and aren't in the bag, or whose input isn't."""
    recorded_twice: int
    """Messages of the bag whose stamp was there already."""
    nan: int
    """Messages with numbers that aren't finite."""
    memory_mb: tuple[float, float]
    """Largest resident memory of the node in the first and the last tenth."""
    p99_ms: tuple[float, float]
    """99th percentile of the time from sending to receiving, in the first and the last tenth [ms]."""
    cpu_ms: tuple[float, float]
    """99th percentile of the node's processor time a frame, of the seconds of the first and the last tenth [ms]."""
    yardstick_ms: tuple[float, float]
    """99th percentile of the processor time of work that is always the same, in the sender's process [ms]."""
    seconds: float
    exit_code: int

    @property
    def lost(self) -> int:
        """Frames that the node got, that no garment came back for, and that it doesn't say it has dropped."""
        return max(0, self.sent - self.received - self.superseded - self.replaced)

    @property
    def is_slower(self) -> bool:
        """Whether messages come later, and the node computes longer; a few frames aren't judged."""
        if self.sent < JUDGED_FROM:
            return False
        return is_slower(*(last / first for first, last in (self.p99_ms, self.cpu_ms, self.yardstick_ms)))

    @property
    def failures(self) -> int:
        """Of: lost, doubled, not recorded, recorded twice, not finite, grown, slower, not ended well."""
        grown = self.memory_mb[1] > (1 + TOLERANCE) * self.memory_mb[0]
        counts = (self.lost, self.doubled, self.not_recorded, self.recorded_twice, self.nan, self.exit_code)
        return sum(count != 0 for count in counts) + grown + self.is_slower

    def as_dict(self) -> dict[str, Any]:
        """Ready for JSON."""
        row = {name: getattr(self, name) for name in self.__dataclass_fields__}
        row |= {"case": "soak: node", "runs": self.sent, "failures": self.failures, "max_deviation_m": 0.0}
        return {"rows": [row | {"lost": self.lost}], "failures": self.failures}


def node_options(options: StressOptions) -> dict[str, Any]:
    """How long the node runs, and its parameters: the garments of the first body that any is named of."""
    backbone, sdf = options.modes[-1]
    found, _ = wardrobes(options.garments, backbone=backbone, sdf=sdf, weights=options.weights)
    if not found:
        msg = f"nothing to try: no weights of {backbone} {sdf} for {', '.join(options.garments)}"
        raise StressError(msg)
    parameters = {"garments": f"[{', '.join(found[0].garments)}]", "backbone": backbone, "sdf": sdf}
    if options.weights is not None:
        parameters["weights"] = str(options.weights.absolute())
    seconds = 3600 * options.hours if options.hours is not None else _QUICK_S if options.quick else _DEFAULT_S
    return {"seconds": seconds, "parameters": parameters}


def soak_node(folder: Path, *, seconds: float, parameters: dict[str, str], progress: bool) -> NodeSoak:
    """Starts `garment_node`, sends it a motion at 30 Hz, and counts what comes back and what is in the bag.

    Args:
        folder: Where the bag and the node's log are written; a new one.
        seconds: How long.
        parameters: Of the node, besides input_type and record.
        progress: Whether a bar is shown.

    Raises:
        RefuError: rclpy isn't importable, the folder isn't new, or the node doesn't start.
    """
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        msg = f'the live node needs rclpy: source a ROS 2 installation, or pip install "refu-ros[ros]" ({error})'
        raise RefuError(msg) from error
    if folder.exists():
        msg = f"{folder}: is there already; name a new folder for the bag and the log"
        raise RefuError(msg)
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    folder.mkdir(parents=True)
    given = {"input_type": "joint_state", "record": str(folder / "bag"), **parameters}
    arguments = [item for name, value in given.items() for item in ("-p", f"{name}:={value}")]
    command = [sys.executable, "-m", "refu_ros.garment_node", "--ros-args", *arguments]
    with (folder / "log.txt").open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, env={**os.environ, "OMP_NUM_THREADS": "1"})
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        peer = _Peer(process, folder / "log.txt")
        peer.wait()
        with tqdm(total=round(seconds * RATE), unit="frame", disable=not progress, leave=False) as bar:
            peer.send_all(seconds, bar.update)
        process.send_signal(signal.SIGINT)
        exit_code = process.wait(timeout=_START_S)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        rclpy.try_shutdown()
    return peer.summary(folder / "bag", exit_code)


class _Peer:
    """Sender and subscriber."""

    def __init__(self, process: subprocess.Popen[bytes], log: Path) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from rclpy.qos import QoSProfile
        from sensor_msgs.msg import JointState
        from visualization_msgs.msg import MarkerArray

        self._process, self._log = process, log
        self._spin = rclpy.spin_once
        self._node = rclpy.create_node("refu_stress")
        self._publisher = self._node.create_publisher(JointState, "smpl_params", QoSProfile(depth=1))
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self._note, QoSProfile(depth=10))
        self._node.create_subscription(MarkerArray, "garments", self._take, QoSProfile(depth=100), raw=True)
        self._encode = encoder_for("joint_state")
        self._frames = soak_frames(np.random.default_rng(0))
        self._came: Counter[int] = Counter()
        self._latency: dict[int, float] = {}
        self._sent: list[int] = []
        self._memory: list[float] = []
        self._cpu: list[float] = []
        self._same: list[float] = []
        self._yardstick = Yardstick()
        self._nan = 0
        self._stale, self._stale_before, self._noted = 0, 0, 0

    def _take(self, data: bytes) -> None:
        now = time.time_ns()
        markers = [marker for marker in decode_marker_array(data) if marker.action == 0]
        if markers:
            stamp = markers[0].stamp_ns
            self._came[stamp] += 1
            self._latency.setdefault(stamp, 1e-6 * (now - stamp))
            self._nan += not all(np.isfinite(marker.points).all() for marker in markers)

    def _note(self, diagnostics: Any) -> None:
        for status in diagnostics.status:
            if status.name == "garment_node: input":
                values = {item.key: item.value for item in status.values}
                self._stale = int(values.get("dropped: stale", "0"))
                self._noted += 1

    def _hear(self, times: int) -> None:
        """Waits until the node has told of itself so often."""
        wanted, end = self._noted + times, time.monotonic() + _LAST_S
        while self._noted < wanted and time.monotonic() < end:
            self._spin(self._node, timeout_sec=0.1)

    def _until(self, end: float) -> None:
        while (left := end - time.monotonic()) > 0:
            self._spin(self._node, timeout_sec=left)

    def _send(self, i: int) -> int:
        stamp = time.time_ns()
        self._publisher.publish(self._encode(replace(self._frames[i % len(self._frames)], stamp_ns=stamp)))
        return stamp

    def wait(self) -> None:
        """Until frames come back; raises `RefuError` where they don't."""
        end = time.monotonic() + _START_S
        while len(self._came) < _SETTLE:
            if self._process.poll() is not None or time.monotonic() > end:
                said = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
                msg = f"the node doesn't dress anybody: {said[-1] if said else 'it says nothing'} ({self._log})"
                raise RefuError(msg)
            self._send(len(self._came))
            self._until(time.monotonic() + 1 / RATE)
        self._hear(2)
        self._stale_before = self._stale

    def send_all(self, seconds: float, tick: Callable[[int], object]) -> None:
        """A frame every 1/30 s."""
        start = last = time.monotonic()
        came, used = len(self._came), _processor_ms(self._process.pid)
        for i in range(round(seconds * RATE)):
            self._until(start + i / RATE)
            self._sent.append(self._send(i))
            self._same.append(self._yardstick.measure())
            if time.monotonic() - last >= _SAMPLE_S:
                last = time.monotonic()
                self._memory.append(resident_mb(self._process.pid))
                came_before, came = came, len(self._came)
                used_before, used = used, _processor_ms(self._process.pid)
                self._cpu.append((used - used_before) / max(1, came - came_before))
            tick(1)
        end = time.monotonic() + _LAST_S
        while time.monotonic() < end and self._sent[-1] not in self._came:
            self._spin(self._node, timeout_sec=0.1)
        self._hear(2)

    def summary(self, bag: Path, exit_code: int) -> NodeSoak:
        """All counts, of what was sent by `send_all` alone."""
        sent = set(self._sent)
        inputs, garments = (Counter({s: n for s, n in counts.items() if s in sent}) for counts in _recorded(bag))
        received = sent & set(self._came)
        latency = [self._latency[stamp] for stamp in self._sent if stamp in self._latency]
        return NodeSoak(
            sent=len(sent),
            received=len(received),
            doubled=sum(self._came[stamp] - 1 for stamp in received),
            superseded=self._stale - self._stale_before,
            replaced=len(sent - set(inputs)),
            recorded=len(garments),
            not_recorded=len(received - set(garments)) + len(set(garments) - set(inputs)),
            recorded_twice=sum(inputs.values()) - len(inputs) + sum(garments.values()) - len(garments),
            nan=self._nan,
            memory_mb=_tenths(self._memory, max),
            p99_ms=_tenths(latency, _p99),
            cpu_ms=_tenths(self._cpu, _p99),
            yardstick_ms=_tenths(self._same, _p99),
            seconds=len(self._sent) / RATE,
            exit_code=exit_code,
        )


def _tenths(values: list[float], of: Callable[[list[float]], float]) -> tuple[float, float]:
    n = max(1, len(values) // 10)
    return (of(values[:n]), of(values[-n:])) if values else (1.0, 1.0)


def _p99(values: list[float]) -> float:
    return float(np.percentile(values, 99))


def _processor_ms(process: int) -> float:
    """Processor time that all threads of a process have taken [ms]."""
    total = 0
    for task in Path(f"/proc/{process}/task").iterdir():
        with contextlib.suppress(FileNotFoundError):  # a thread that has just ended
            total += int((task / "schedstat").read_text(encoding="ascii").split()[0])
    return 1e-6 * total


def _recorded(bag: Path) -> tuple[Counter[int], Counter[int]]:
    """How often each stamp is in a bag: of inputs, and of garments."""
    decode = decoder_for("joint_state")
    inputs: Counter[int] = Counter()
    garments: Counter[int] = Counter()
    with BagReader(bag) as reader:
        for message in reader.messages():
            if message.topic == "/smpl_params":
                inputs[decode.from_bytes(message.data).stamp_ns] += 1
            elif message.topic == "/garments":
                garments.update(_stamps(message.data))
    return inputs, garments


def _stamps(data: bytes) -> Iterator[int]:
    """The stamp of a message's garments, once."""
    markers = [marker for marker in decode_marker_array(data) if marker.action == 0]
    return iter(markers[0].stamp_ns for _ in markers[:1])


def node_table(result: NodeSoak) -> str:
    """What `refu stress --node` prints."""
    rows = [
        ("sent in", f"{result.seconds:.0f} s", str(result.sent)),
        ("came back as garments", "", str(result.received)),
        ("superseded by a newer one", "", str(result.superseded)),
        ("replaced in the topic's queue, which holds one", "", str(result.replaced)),
        ("lost", "", str(result.lost)),
        ("doubled", "", str(result.doubled)),
        ("recorded garments", "", str(result.recorded)),
        ("not recorded", "", str(result.not_recorded)),
        ("recorded twice", "", str(result.recorded_twice)),
        ("messages with NaN", "", str(result.nan)),
        ("memory, first → last tenth", "", "{:.0f} → {:.0f} MB".format(*result.memory_mb)),
        ("latency p99, first → last tenth", "", "{:.1f} → {:.1f} ms".format(*result.p99_ms)),
        ("processor time a frame p99, first → last tenth", "", "{:.1f} → {:.1f} ms".format(*result.cpu_ms)),
        ("the same of a fixed piece of work", "", "{:.2f} → {:.2f} ms".format(*result.yardstick_ms)),
        ("exit code", "", str(result.exit_code)),
    ]
    verdict = "nothing failed" if not result.failures else f"{result.failures} FAILED"
    return f"{format_table(('live node, 30 Hz, recording', '', ''), rows)}\n\n{verdict}"
