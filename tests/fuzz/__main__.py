"""Fuzzes for long, each target in a process of its own, which may die or hang:

    python -m tests.fuzz [TARGET ...] [--seconds N] [--output DIR] [--json FILE]

The suite's targets and strategies, driven by atheris, which looks for input that reaches lines not reached before
(`pip install -e ".[fuzz]"`), or by Hypothesis alone where atheris isn't installed. Exit code 1 for a finding; the
input of each is kept in DIR as a pickle.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib.util
import json
import os
import pickle
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

_ADDRESS_SPACE = 16 << 30
"""That a process may ask for, used or not [bytes]."""
_BATCH = 200
_HAS_ATHERIS = importlib.util.find_spec("atheris") is not None


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="what is fuzzed (default: everything)")
    parser.add_argument("--seconds", type=float, default=60.0, metavar="N", help="for each target (60)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of all that is drawn (0)")
    parser.add_argument("--output", type=Path, default=Path("out/fuzz"), metavar="DIR", help="for findings (out/fuzz)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures as JSON")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child is not None:
        return _fuzz(args.targets[0], args.seconds, args.seed, args.child, args.output)
    from tests.fuzz.targets import TARGETS

    unknown = [name for name in args.targets if name not in TARGETS]
    if unknown:
        parser.error(f"nothing called {', '.join(unknown)} is fuzzed; wanted some of {', '.join(TARGETS)}")
    print(f"driven by {'atheris' if _HAS_ATHERIS else 'Hypothesis'}")
    print(f"{'target':>14}{'executions':>12}{'refused':>10}{'slowest [ms]':>14}{'memory [MB]':>13}{'findings':>10}")
    rows = []
    for name in args.targets or TARGETS:
        row = _run(name, args.seconds, args.seed, args.output)
        figures = f"{row['executions']:>12,}{row['refused']:>10,}{row['slowest_ms']:>14,.0f}{row['peak_mb']:>13,.0f}"
        print(f"{name:>14}{figures}{len(row['findings']):>10}", flush=True)
        for signature in row["findings"]:
            print(f"  {signature}", flush=True)
        rows.append({"target": name, **row})
    findings = sum(len(row["findings"]) for row in rows)
    print(f"{sum(row['executions'] for row in rows):,} executions, {findings} findings")
    if args.json is not None:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")
    return int(findings > 0)


def _run(name: str, seconds: float, seed: int, output: Path) -> dict[str, Any]:
    """Processes for one target until the time is over: one, if none dies."""
    end = time.monotonic() + seconds
    total: dict[str, Any] = {"executions": 0, "refused": 0, "slowest_ms": 0.0, "peak_mb": 0.0, "findings": {}}
    where = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None  # files that live for a millisecond
    while time.monotonic() < end:
        with tempfile.TemporaryDirectory(dir=where) as folder:
            command = [sys.executable, "-m", "tests.fuzz", name, "--child", folder, "--output", str(output)]
            command += ["--seconds", str(end - time.monotonic()), "--seed", str(seed)]
            done = subprocess.run(command, capture_output=True, check=False)
            row = _figures(Path(folder))
            for key in ("executions", "refused"):
                total[key] += row.get(key, 0)
            for key in ("slowest_ms", "peak_mb"):
                total[key] = max(total[key], row.get(key, 0.0))
            total["findings"] |= row.get("findings", {})
            if not row.get("is_done"):
                last = Path(folder, "current")
                detail = done.stderr.decode(errors="replace")[-4000:]
                _keep(
                    output,
                    name,
                    f"the process ended with {done.returncode}",
                    detail,
                    last.read_bytes() if last.exists() else b"",
                )
                total["findings"][f"the process ended with {done.returncode}"] = detail
        seed += 1
    return total


def _figures(folder: Path) -> dict[str, Any]:
    try:
        return dict(json.loads((folder / "figures.json").read_text()))
    except (OSError, ValueError):
        return {}


def _keep(output: Path, name: str, signature: str, detail: str, data: bytes) -> None:
    output.mkdir(parents=True, exist_ok=True)
    path = output / f"{name}-{hashlib.sha256(signature.encode()).hexdigest()[:8]}.pickle"
    path.write_bytes(data)
    path.with_suffix(".txt").write_text(f"{signature}\n{detail}\n", errors="replace")


# In the process of a target -----------------------------------------------------------------------


def _fuzz(name: str, seconds: float, seed: int, folder: Path, output: Path) -> int:
    """Until the time is over; says every second in a file what came of it."""
    with contextlib.ExitStack() as imports:
        if _HAS_ATHERIS:
            import atheris

            imports.enter_context(atheris.instrument_imports(include=["refu_core", "msg_adapters", "refu_ros"]))
        from tests.fuzz.targets import TARGETS
    import torch
    from hypothesis import HealthCheck, Phase, Verbosity, given, settings
    from hypothesis import seed as seeded

    from tests.fuzz.contract import BrokenError, Contract

    torch.set_num_threads(1)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    (folder / "files").mkdir()
    inputs, read = TARGETS[name].open(folder / "files")
    contract, findings = Contract(), {}
    current = folder / "current"
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, resource.RLIM_INFINITY))
    end, said = time.monotonic() + seconds, 0.0

    def say(*, is_done: bool) -> None:
        row = {"executions": contract.executions, "refused": contract.refused, "findings": findings, "is_done": is_done}
        row |= {"slowest_ms": 1e3 * contract.slowest_s, "peak_mb": contract.peak_mb}
        (folder / "new.json").write_text(json.dumps(row))
        (folder / "new.json").replace(folder / "figures.json")

    @given(inputs)
    @settings(
        max_examples=_BATCH,
        suppress_health_check=list(HealthCheck),
        database=None,
        deadline=None,  # the contract has limits of its own
        phases=[Phase.generate],
        verbosity=Verbosity.quiet,
    )
    def once(value: Any) -> None:
        nonlocal said
        current.write_bytes(pickle.dumps(value))
        try:
            contract.hold(read, value)
        except BrokenError as error:
            if error.signature not in findings:
                findings[error.signature] = str(error)
                _keep(output, name, error.signature, str(error), current.read_bytes())
        now = time.monotonic()
        if now > said + 1 or now > end:
            said = now
            say(is_done=now > end)
        if now > end:
            os._exit(0)  # libFuzzer has no other way out

    if _HAS_ATHERIS:
        # Its own limits are off: the contract's hold. Inputs are choices of the strategies, so 64 KiB are many.
        options = [f"-seed={seed + 1}", "-timeout=300", "-rss_limit_mb=0", "-max_len=65536", "-len_control=0"]
        atheris.Setup([sys.argv[0], *options], once.hypothesis.fuzz_one_input)
        atheris.Fuzz()
    while True:
        seed += 1
        seeded(seed)(once)()


if __name__ == "__main__":
    sys.exit(main())
