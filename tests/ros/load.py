"""The live node under load, recording: whether it grows, slows down, loses or doubles messages:

    python -m tests.ros.load [--hours H] [--seed S] [--output DIR]

The T-shirt of the default mode at 30 Hz. Exit code 1 for a failure; DIR, a new folder, keeps the bag and the log.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from collections import Counter
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rclpy
from rclpy.qos import QoSProfile
from visualization_msgs.msg import MarkerArray

from msg_adapters import BagReader, decode_marker_array, decoder_for
from refu_lab.stress._soak import JUDGED_FROM, TOLERANCE, Yardstick, is_slower, resident_mb, soak_frames
from tests.ros.harness import PATIENCE_S, NodeProcess, Peer, start

if TYPE_CHECKING:
    from collections.abc import Callable

RATE = 30.0
"""Frames a second."""
_LAST_S = 60.0
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


class LoadPeer(Peer):
    """Sends a motion at 30 Hz, and counts what comes back: it keeps no garment."""

    def __init__(self, *, seed: int) -> None:
        self._frames = soak_frames(np.random.default_rng(seed))
        self._came: Counter[int] = Counter()
        self._latency: dict[int, float] = {}
        self._sent: list[int] = []
        self._memory: list[float] = []
        self._cpu: list[float] = []
        self._same: list[float] = []
        self._yardstick = Yardstick()
        self._nan = 0
        self._stale_before = 0
        super().__init__()

    def watch(self) -> None:
        """Listens to the garments."""
        self.node.create_subscription(MarkerArray, "garments", self._take, QoSProfile(depth=100), raw=True)

    def _take(self, data: bytes) -> None:
        now = time.time_ns()
        markers = [marker for marker in decode_marker_array(data) if marker.action == 0]
        if markers:
            stamp = markers[0].stamp_ns
            self._came[stamp] += 1
            self._latency.setdefault(stamp, 1e-6 * (now - stamp))
            self._nan += not all(np.isfinite(marker.points).all() for marker in markers)

    def _stale(self) -> int:
        """Frames that were dropped for a newer one, by what the node tells of itself from now on."""
        self.forget_reports()
        self.spin_until(
            lambda: sum(status.name == "garment_node: input" for d in self.diagnostics for status in d.status) > 1,
            "the node tells of itself",
        )
        return self.count("input", "dropped: stale")

    def _send_now(self, i: int) -> int:
        stamp = time.time_ns()
        self.send(replace(self._frames[i % len(self._frames)], stamp_ns=stamp))
        return stamp

    def settle(self) -> None:
        """Until frames come back; fails where they don't."""
        self.wait_for_node()
        end = time.monotonic() + PATIENCE_S
        while len(self._came) < _SETTLE:
            assert time.monotonic() < end, "the node doesn't dress anybody: see its log"
            self._send_now(len(self._came))
            self.spin(1 / RATE)
        self._stale_before = self._stale()

    def send_all(self, seconds: float, process: int) -> None:
        """A frame every 1/30 s to the node, which is this `process`."""
        start = last = time.monotonic()
        came, used = len(self._came), _processor_ms(process)
        for i in range(round(seconds * RATE)):
            self.spin(start + i / RATE - time.monotonic())
            self._sent.append(self._send_now(i))
            self._same.append(self._yardstick.measure())
            if time.monotonic() - last >= _SAMPLE_S:
                last = time.monotonic()
                self._memory.append(resident_mb(process))
                came_before, came = came, len(self._came)
                used_before, used = used, _processor_ms(process)
                self._cpu.append((used - used_before) / max(1, came - came_before))
                self.forget_reports()
        end = time.monotonic() + _LAST_S
        while time.monotonic() < end and self._sent[-1] not in self._came:
            rclpy.spin_once(self.node, timeout_sec=0.1)

    def summary(self, node: NodeProcess, bag: Path) -> NodeSoak:
        """Ends the node; all counts, of what was sent by `send_all` alone."""
        superseded = self._stale() - self._stale_before
        exit_code = node.stop(signal.SIGINT)
        sent = set(self._sent)
        inputs, garments = (Counter({s: n for s, n in counts.items() if s in sent}) for counts in _recorded(bag))
        received = sent & set(self._came)
        latency = [self._latency[stamp] for stamp in self._sent if stamp in self._latency]
        return NodeSoak(
            sent=len(sent),
            received=len(received),
            doubled=sum(self._came[stamp] - 1 for stamp in received),
            superseded=superseded,
            replaced=len(sent - set(inputs)),
            recorded=len(garments),
            not_recorded=len(received - set(garments)) + len(set(garments) - set(inputs)),
            recorded_twice=sum(inputs.values()) - len(inputs) + sum(garments.values()) - len(garments),
            nan=self._nan,
            memory_mb=_tenths(self._memory, max),
            p99_ms=_tenths(latency, _p99),
            cpu_ms=_tenths(self._cpu, _p99),
            yardstick_ms=_tenths(self._same, _p99),
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
                markers = [marker for marker in decode_marker_array(message.data) if marker.action == 0]
                garments.update(marker.stamp_ns for marker in markers[:1])
    return inputs, garments


def soak_node(folder: Path, *, seconds: float, seed: int = 0, **parameters: object) -> NodeSoak:
    """Starts `garment_node` with these parameters, sends it a motion, and counts what comes back and what is recorded.

    The bag and the node's log are written to `folder`.
    """
    bag = folder / "bag"
    with NodeProcess(folder / "log.txt", input_type="joint_state", record=str(bag), **parameters) as node:
        peer = LoadPeer(seed=seed)
        peer.settle()
        peer.send_all(seconds, node.process.pid)
        result = peer.summary(node, bag)
        peer.close()
    return result


def main() -> int:
    """The command line."""
    args = start(sys.modules[__name__])
    result = soak_node(args.output, seconds=3600 * args.hours, seed=args.seed, garments=["tshirt-male"])
    for field in fields(result):
        value = getattr(result, field.name)
        print(f"{field.name:>16}  {'{:.2f} → {:.2f}'.format(*value) if isinstance(value, tuple) else value}")
    print(f"{'lost':>16}  {result.lost}")
    print(f"{result.failures} FAILED" if result.failures else "nothing failed")
    return int(result.failures > 0)


if __name__ == "__main__":
    sys.exit(main())
