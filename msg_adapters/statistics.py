"""What the node counts: lock-protected counters, and the change since the last report."""

from __future__ import annotations

import threading
import time
from collections import Counter, defaultdict, deque
from dataclasses import dataclass

import numpy as np

from refu_core.errors import printable

COARSE_M = 8192.0
"""From so far on, float32 has coordinates to a millimetre at best: points and polygons are of it [m]."""
_WINDOW = 1000
"""How many of the newest latencies the percentiles are taken of."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """Counts since the node started, what they grew by since the last report, and latencies."""

    total: Counter[str]
    recent: Counter[str]
    seconds: float
    latency_ms: tuple[float, float, float]
    """p50, p95, p99 of the last frames, from receipt to publish."""
    largest_shift: float
    """How far the collider moved the skin at most, since the last report [m]."""
    last_error: str
    silent_for: float | None
    """Time since the last input of anybody [s]; None if there was none."""
    reasons: defaultdict[str, str]
    """The newest reason for each kind of drop, and for a fault; empty where there is none."""

    def rate(self, key: str) -> float:
        """Events a second since the last report [Hz]."""
        return self.recent[key] / self.seconds if self.seconds > 0 else 0.0

    def group(self, prefix: str) -> dict[str, int]:
        """Totals of the keys `<prefix>.<what>` by what."""
        return {key.removeprefix(f"{prefix}."): n for key, n in self.total.items() if key.startswith(f"{prefix}.")}


class Statistics:
    """Counters that any thread may raise.

    Keys: received, ticks, frames, drop.<cause>, skip.<kind> (work that nobody needed), fault.<where>,
    penetration.<found|unresolved>, back_in_time (a frame older than its person's previous one), late_transform (a frame
    placed by a transform older than itself), coarse (a frame `COARSE_M` or farther away), beyond_promise (a frame that
    "nothing inside" isn't promised for).
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._total: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()
        self._reported_at = time.monotonic()
        self._received_at: float | None = None
        self._largest_shift = 0.0
        self._latencies: deque[float] = deque(maxlen=_WINDOW)
        self._reasons: defaultdict[str, str] = defaultdict(str)
        self._error = ""

    def count(self, key: str) -> None:
        with self._lock:
            self._total[key] += 1

    def receive(self) -> None:
        """Counts a message that came, whatever it holds."""
        self._received_at = time.monotonic()
        self.count("received")

    def drop(self, cause: str, reason: str = "") -> None:
        """Counts a frame that was lost, with the reason."""
        self._because(f"drop.{cause}", cause, reason)

    def fault(self, where: str, reason: str) -> None:
        """Counts a callback that failed, or a request that made no sense."""
        self._because(f"fault.{where}", "fault", reason)

    def _because(self, key: str, kind: str, reason: str) -> None:
        with self._lock:
            self._total[key] += 1
            self._reasons[kind] = printable(reason) or self._reasons[kind]

    def shift(self, largest: float) -> None:
        """Notes how far the collider moved the skin in a frame [m]."""
        with self._lock:
            self._largest_shift = max(self._largest_shift, largest)

    def publish(self, latencies_ms: list[float], *, found: int, unresolved: int) -> None:
        """Counts a message that went out, with one latency for each person in it."""
        counts = {"ticks": 1, "frames": len(latencies_ms)}
        counts |= {"penetration.found": found, "penetration.unresolved": unresolved}
        with self._lock:
            self._total.update(counts)
            self._latencies.extend(latencies_ms)

    def set_error(self, text: str) -> None:
        """Notes what keeps the node from doing as it was asked, or empty."""
        self._error = printable(text)

    def report(self) -> Report:
        """The report on the time since the last one; to be called once a second."""
        with self._lock:
            now, total = time.monotonic(), self._total.copy()
            p50, p95, p99 = np.percentile(self._latencies or (0.0,), (50, 95, 99)).tolist()
            report = Report(
                total=total,
                recent=total - self._reported,
                seconds=now - self._reported_at,
                latency_ms=(p50, p95, p99),
                largest_shift=self._largest_shift,
                last_error=self._error,
                silent_for=None if self._received_at is None else now - self._received_at,
                reasons=self._reasons.copy(),
            )
            self._reported, self._reported_at, self._largest_shift = total, now, 0.0
            return report
