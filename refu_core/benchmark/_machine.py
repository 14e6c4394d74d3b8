"""What this machine can do at best, on one core."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

_MIB = 1 << 20


class Rates(NamedTuple):
    """Measured on one core, as good as it got."""

    copy_gb_s: float
    """Bytes read and written by a copy between arrays far larger than any cache [GB/s]."""
    gemm_gflop_s: float
    """float32 products of large matrices [GFLOP/s]."""

    def limit_ms(self, n_bytes: float, flops: float) -> float:
        """No program that moves so many bytes and computes so much takes less [ms]."""
        return 1e3 * max(n_bytes / (1e9 * self.copy_gb_s), flops / (1e9 * self.gemm_gflop_s))


def measure_rates(*, quick: bool = False) -> Rates:
    """Streams and multiplies, by the processor's time; the best of several, as whatever disturbs only slows down."""
    size, n, repeats = (32 * _MIB, 384, 3) if quick else (256 * _MIB, 1024, 9)
    source = np.ones(size // 8)
    target = np.empty_like(source)
    a = torch.ones(n, n)
    product = torch.empty(n, n)
    copy = _best(lambda: np.copyto(target, source), repeats)
    gemm = _best(lambda: torch.mm(a, a, out=product), repeats)
    return Rates(2e-9 * size / copy, 2e-9 * n**3 / gemm)


def _best(run: Callable[[], object], repeats: int) -> float:
    run()
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        run()
        seconds.append(time.process_time() - start)
    return max(min(seconds), 1e-9)


def load_average() -> float | None:
    """Processes that wanted a core in the last minute; None where the system doesn't say."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else None


def machine_facts(device: str) -> dict[str, Any]:
    """Processor, cores, device and versions: plain values, ready for JSON."""
    facts: dict[str, Any] = {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "torch": torch.__version__,
    }
    if torch.device(device).type == "cuda":
        facts["gpu"] = torch.cuda.get_device_name(device)
    return facts


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
