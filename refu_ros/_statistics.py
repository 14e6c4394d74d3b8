"""What the node counts: lock-protected counters, and the change since the last report."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from refu_core.errors import printable

_WINDOW = 1000
"""Latencies that percentiles are taken of."""


@dataclass(frozen=True)
class Report:
    """Counts since the node started, what they grew by since the last report, and latencies."""

    total: Counter[str]
    recent: Counter[str]
    seconds: float
    """Time since the last report."""
    latency_ms: tuple[float, float, float]
    """p50, p95, p99 of the last frames, from receipt to publish."""
    largest_shift: float
    """How far the collider left the skin at most, since the last report [m]."""
    last_error: str
    silent_for: float | None
    """Since the last input of anybody [s]; None if there was none."""
    reasons: dict[str, str] = field(default_factory=dict)
    """The newest reason for each kind of drop, and for a fault."""

    def rate(self, key: str) -> float:
        """Events a second since the last report [Hz]."""
        return self.recent[key] / self.seconds if self.seconds > 0 else 0.0

    def group(self, prefix: str) -> dict[str, int]:
        """Totals of the keys `<prefix>.<what>` by what."""
        return {key.removeprefix(f"{prefix}."): n for key, n in self.total.items() if key.startswith(f"{prefix}.")}


class Statistics:
    """Counters that any thread may raise.

    Keys: received, ticks, frames, drop.<cause>, skip.<kind> (work that nobody needed), fault.<where>,
    penetration.<found|unresolved>, back_in_time (a frame older than its person's frame before), late_transform (a frame
    placed by a transform older than itself), beyond_promise (a frame that "nothing inside" isn't promised for).
    """

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._total: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()
        self._reported_at = clock()
        self._received_at: float | None = None
        self._largest_shift = 0.0
        self._latencies: deque[float] = deque(maxlen=_WINDOW)
        self._reasons: dict[str, str] = {}
        self._error = ""

    def receive(self) -> None:
        """A message came, whatever it holds."""
        with self._lock:
            self._total["received"] += 1
            self._received_at = self._clock()

    def drop(self, cause: str, reason: str = "") -> None:
        """A frame was lost to something that isn't wanted."""
        self.count(f"drop.{cause}", {cause: reason})

    def fault(self, where: str, reason: str) -> None:
        """A callback failed, or a request made no sense."""
        self.count(f"fault.{where}", {"fault": reason})

    def count(self, key: str, reasons: Mapping[str, str] | None = None) -> None:
        """One more of what one of the keys stands for, and why."""
        with self._lock:
            self._total[key] += 1
            self._reasons |= {cause: printable(reason) for cause, reason in (reasons or {}).items() if reason}

    def shift(self, largest: float) -> None:
        """In a frame the collider left the skin by so much [m]."""
        with self._lock:
            self._largest_shift = max(self._largest_shift, largest)

    def publish(self, latencies_ms: list[float], *, found: int, unresolved: int) -> None:
        """A message went out with the frames of so many persons."""
        with self._lock:
            self._total["ticks"] += 1
            self._total["frames"] += len(latencies_ms)
            self._total["penetration.found"] += found
            self._total["penetration.unresolved"] += unresolved
            self._latencies.extend(latencies_ms)

    def set_error(self, text: str) -> None:
        """What keeps the node from doing as it was asked, or empty."""
        with self._lock:
            self._error = printable(text)

    def report(self) -> Report:
        """What there is to say, once a second."""
        with self._lock:
            now = self._clock()
            recent = self._total - self._reported
            seconds, self._reported_at = now - self._reported_at, now
            self._reported = self._total.copy()
            largest_shift, self._largest_shift = self._largest_shift, 0.0
            p50, p95, p99 = np.percentile(self._latencies, (50, 95, 99)) if self._latencies else (0.0, 0.0, 0.0)
            return Report(
                total=self._total.copy(),
                recent=recent,
                seconds=seconds,
                latency_ms=(float(p50), float(p95), float(p99)),
                largest_shift=largest_shift,
                last_error=self._error,
                silent_for=None if self._received_at is None else now - self._received_at,
                reasons=dict(self._reasons),
            )
