"""Runs targets: each in a process of its own, which may die, hang or fill its memory without harm to the others."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import mmap
import multiprocessing
import os
import random
import resource
import signal
import struct
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from refu_core import RefuError
from refu_ros.fuzz._files import working_folder
from refu_ros.fuzz._guard import Guard
from refu_ros.fuzz._targets import TARGETS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from multiprocessing.connection import Connection

    from refu_ros.fuzz._guard import Outcome
    from refu_ros.fuzz._target import Target

_LARGEST_INPUT = 1 << 22
_MAX_CORPUS = 2000
_MAX_KEPT = 64 << 10
"""Larger inputs aren't built upon: they are slow, and small ones reach the same lines."""
_BEAT_S = 0.5
_BUSY_S, _SILENT_S = 15.0, 300.0
"""Processor time and time that a process may take without a word: longer, and it hangs where Python can't interrupt."""
_ADDRESS_SPACE = 8 << 30
"""Of memory that is asked for beyond what there is after the start, used or not [bytes]."""


@dataclass(frozen=True, kw_only=True)
class FuzzOptions:
    """What to fuzz and how long; the fields are the options of `refu fuzz`."""

    targets: tuple[str, ...] = ()
    """Names of `TARGETS`; all if empty."""
    executions: int | None = None
    """Of each target; its own number by default."""
    seed: int = 0
    hours: float | None = None
    """Go on with other seeds for so long."""
    output: Path | None = None
    """Folder for the input of each finding."""


@dataclass(frozen=True)
class Finding:
    """An input that a reader must not end on like this."""

    target: str
    kind: str
    """`crash`, `hang`, `memory`, `forbidden`, or `died` with its process."""
    signature: str
    detail: str
    file: str
    """Where the input is kept; empty if nowhere."""


@dataclass
class FuzzRow:
    """Figures of one target."""

    target: str
    what: str
    executions: int = 0
    accepted: int = 0
    """Ended without an error."""
    refused: int = 0
    """Ended with one line that says what is wrong."""
    ways: int = 0
    """Different ways in which an execution ended."""
    corpus: int = 0
    """Inputs that reached something new."""
    failures: int = 0
    """Executions that ended in any other way."""
    peak_mb: float = 0.0
    """Memory beyond what valid input takes [MiB]."""
    slowest_ms: float = 0.0
    """Processor time of the slowest input [ms]."""
    seconds: float = 0.0
    findings: list[Finding] = field(default_factory=list)


def fuzz(options: FuzzOptions, *, report: Callable[[FuzzRow], None] | None = None) -> list[FuzzRow]:
    """Fuzzes targets, one after another; `report` gets each one's figures every half second.

    An interrupt (Ctrl-C) ends it early, with the figures so far.

    Raises `RefuError` for a target that doesn't exist.
    """
    unknown = [name for name in options.targets if name not in TARGETS]
    if unknown:
        msg = f"nothing called {', '.join(unknown)} is fuzzed: wanted {', '.join(TARGETS)}"
        raise RefuError(msg)
    targets = [TARGETS[name] for name in options.targets or TARGETS]
    rows = {target.name: FuzzRow(target.name, target.what) for target in targets}
    end = None if options.hours is None else time.monotonic() + 3600 * options.hours
    with contextlib.suppress(KeyboardInterrupt):
        for round_number in itertools.count():
            for target in targets:
                _run_target(target, rows[target.name], options, options.seed + 1_000_003 * round_number, report)
                if end is not None and time.monotonic() > end:
                    return list(rows.values())
            if end is None:
                break
    return list(rows.values())


def _run_target(
    target: Target, row: FuzzRow, options: FuzzOptions, seed: int, report: Callable[[FuzzRow], None] | None
) -> None:
    wanted = row.executions + (options.executions or target.executions)
    while row.executions < wanted:
        if _run_process(target, row, wanted - row.executions, seed, options.output, report):
            return
        seed += 1  # the process has died: on with other input


def fuzz_target(target: Target, executions: int, *, seed: int = 0, guard: Guard | None = None) -> FuzzRow:
    """Fuzzes a target in this process: for tests, and for debuggers."""
    with tempfile.TemporaryDirectory(dir=working_folder()) as folder:
        row = FuzzRow(target.name, target.what)
        _Search(target, Path(folder), seed, row, None, guard).run(executions, lambda: None)
    return row


class _Search:
    """Grows a corpus from a target's seeds: what reaches something new is built upon."""

    def __init__(
        self, target: Target, folder: Path, seed: int, row: FuzzRow, output: Path | None, guard: Guard | None = None
    ) -> None:
        self._target, self._row, self._output = target, row, output
        self._reader = target.open(folder)
        self._rng = random.Random(f"{target.name} {seed}")
        self._corpus = list(self._reader.seeds)
        self._n_seeds = len(self._corpus)
        self._ways: set[str] = set()
        self._guard = guard or Guard(seconds=target.seconds, memory_mb=target.memory_mb)
        self.current: Callable[[bytes], None] = lambda _: None
        """Told each input before it is executed."""

    def run(self, executions: int, beat: Callable[[], None]) -> None:
        """So many executions, the seeds first."""
        seeds = list(self._corpus)
        small = min(seeds, key=len) if seeds else b""
        self._guard.run(self._reader.execute, seeds[0] if seeds else small)
        self._guard.start()
        started = last = time.monotonic()
        for i in range(executions):
            data = seeds[i] if i < len(seeds) else self._next()
            self.current(data)
            self._take(self._guard.run(self._reader.execute, data), data, is_seed=i < len(seeds))
            now = time.monotonic()
            if now - last > _BEAT_S:
                last = now
                self._row.seconds += now - started
                started = now
                self._figures()
                beat()
        self._row.seconds += time.monotonic() - started
        self._figures()

    def _next(self) -> bytes:
        # The newest entries are the ones whose surroundings are least known.
        # Descendants of damaged input are refused early, so that every third begins with the seeds.
        places = (self._corpus[: self._n_seeds], self._corpus, self._corpus[-20:])
        parent = self._rng.choice(self._rng.choice(places))
        if len(parent) > _MAX_KEPT:
            parent = self._corpus[0]
        data = self._reader.mutate(self._rng, parent, self._rng.choice(self._corpus))
        return data if len(data) <= _LARGEST_INPUT else data[:_LARGEST_INPUT]

    def _take(self, outcome: Outcome, data: bytes, *, is_seed: bool) -> None:
        row = self._row
        row.executions += 1
        row.accepted += outcome.kind == "ok"
        row.refused += outcome.kind == "refused"
        if outcome.is_new and not is_seed and len(data) <= _MAX_KEPT:
            if len(self._corpus) < _MAX_CORPUS:
                self._corpus.append(data)
            else:
                self._corpus[self._rng.randrange(self._n_seeds, _MAX_CORPUS)] = data
        is_known = outcome.signature in self._ways
        self._ways.add(outcome.signature)
        if outcome.is_finding:
            row.failures += 1
            if not is_known:
                row.findings.append(
                    keep(row.target, outcome.kind, outcome.signature, outcome.detail, data, self._output)
                )

    def _figures(self) -> None:
        row = self._row
        row.ways, row.corpus = max(row.ways, len(self._ways)), max(row.corpus, len(self._corpus))
        row.peak_mb = max(row.peak_mb, self._guard.peak_mb)
        row.slowest_ms = max(row.slowest_ms, self._guard.slowest_ms)


def keep(target: str, kind: str, signature: str, detail: str, data: bytes, output: Path | None) -> Finding:
    """A finding, its input written where there is a folder for it."""
    file = ""
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
        path = output / f"{target}-{kind}-{hashlib.sha256(signature.encode()).hexdigest()[:8]}.bin"
        path.write_bytes(data)
        path.with_suffix(".txt").write_text(f"{signature}\n{detail}\n", errors="replace")
        file = str(path)
    return Finding(target, kind, signature, detail, file)


def _run_process(
    target: Target,
    row: FuzzRow,
    executions: int,
    seed: int,
    output: Path | None,
    report: Callable[[FuzzRow], None] | None,
) -> bool:
    """Fuzzes in a process of its own and brings `row` up to date; False if the process died, which is a finding."""
    # The libraries are loaded once, in the server that all processes are forked from.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["refu_ros.fuzz"])
    with tempfile.TemporaryDirectory(dir=working_folder()) as folder:
        current = Path(folder) / "current"
        current.write_bytes(bytes(8 + _LARGEST_INPUT))
        receiver, sender = context.Pipe(duplex=False)
        arguments = (target.name, executions, seed, folder, output, sender)
        process = context.Process(target=_work, args=arguments, name=f"fuzz {target.name}")
        process.start()
        sender.close()
        before, latest, done = FuzzRow(**{**vars(row), "findings": list(row.findings)}), None, False
        try:
            with contextlib.suppress(EOFError):
                while _wait(receiver, process.pid or 0, limit=_BUSY_S + 10 * target.seconds):
                    latest, done = receiver.recv()
                    _add(row, before, latest)
                    if report is not None:
                        report(row)
        finally:
            if process.is_alive() and not done:
                process.kill()
            process.join()
            receiver.close()
        if done:
            return True
        data = current.read_bytes()
        (size,) = struct.unpack_from("<Q", data)
        what = (
            f"its process ended with {process.exitcode}" if process.exitcode != -signal.SIGKILL else "killed, or silent"
        )
        row.executions += latest is None  # or it would start for ever
        row.failures += 1
        row.findings.append(keep(target.name, "died", f"died: {what}", what, data[8 : 8 + size], output))
        return False


def _wait(receiver: Connection, pid: int, *, limit: float) -> bool:
    """Whether the process has said something, before it took `limit` seconds of processor time or five minutes."""
    started, used = time.monotonic(), _processor_seconds(pid)
    while not receiver.poll(1.0):
        if time.monotonic() - started > _SILENT_S or _processor_seconds(pid) - used > limit:
            return False
    return True


def _processor_seconds(pid: int) -> float:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", maxsplit=1)[1].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _add(row: FuzzRow, before: FuzzRow, latest: FuzzRow) -> None:
    """What a process has done, on top of those before it."""
    for name in ("executions", "accepted", "refused", "failures", "seconds"):
        setattr(row, name, getattr(before, name) + getattr(latest, name))
    for name in ("ways", "corpus", "peak_mb", "slowest_ms"):
        setattr(row, name, max(getattr(before, name), getattr(latest, name)))
    known = {finding.signature for finding in before.findings}
    row.findings = before.findings + [finding for finding in latest.findings if finding.signature not in known]


def _work(name: str, executions: int, seed: int, folder: str, output: Path | None, sender: Connection) -> None:
    """What the process does."""
    import torch

    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    sys.stderr = sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115
    target = TARGETS[name]
    row = FuzzRow(target.name, target.what)
    search = _Search(target, Path(folder), seed, row, output)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _ADDRESS_SPACE, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with (Path(folder) / "current").open("r+b") as file, mmap.mmap(file.fileno(), 0) as shared:

        def show(data: bytes) -> None:
            shared[: 8 + len(data)] = struct.pack("<Q", len(data)) + data

        search.current = show
        search.run(executions, lambda: sender.send((row, False)))
    sender.send((row, True))
    sender.close()


def fuzz_dict(rows: Sequence[FuzzRow]) -> dict[str, Any]:
    """The machine-readable result (`--json`)."""
    return {
        "executions": sum(row.executions for row in rows),
        "failures": sum(row.failures for row in rows),
        "rows": [asdict(row) for row in rows],
    }


def fuzz_table(rows: Sequence[FuzzRow]) -> str:
    """What `refu fuzz` prints."""
    columns = ("executions", "accepted", "refused", "ways", "failures", "slowest [ms]", "memory [MiB]")
    lines = [f"{'target':>14}" + "".join(f"{column:>13}" for column in columns)]
    for row in rows:
        numbers = (row.executions, row.accepted, row.refused, row.ways, row.failures, row.slowest_ms, row.peak_mb)
        lines.append(f"{row.target:>14}" + "".join(f"{number:>13,.0f}" for number in numbers))
    total, failures = sum(row.executions for row in rows), sum(row.failures for row in rows)
    lines.append(f"{'total':>14}{total:>13,}{failures:>52,}")
    for row in rows:
        lines += [
            f"{row.target}: {finding.kind}: {finding.signature} {finding.file}".rstrip() for finding in row.findings
        ]
    return "\n".join(lines)


@contextlib.contextmanager
def fuzz_progress(*, quiet: bool) -> Iterator[Callable[[FuzzRow], None]]:
    """A counter of executions, which `fuzz` takes as its `report`."""
    from tqdm import tqdm

    with tqdm(unit="execution", disable=quiet or None, unit_scale=True) as bar:
        done: dict[str, int] = {}

        def report(row: FuzzRow) -> None:
            bar.set_description(row.target, refresh=False)
            bar.set_postfix(failures=row.failures, refresh=False)
            bar.update(row.executions - done.get(row.target, 0))
            done[row.target] = row.executions

        yield report
