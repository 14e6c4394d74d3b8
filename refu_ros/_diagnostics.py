"""What the node says about itself once a second; each WARN or ERROR is something to act on."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from msg_adapters import DiagnosticStatus
from msg_adapters.bags import RecorderState
from msg_adapters.diagnostics import ERROR, OK, WARN
from msg_adapters.statistics import COARSE_M, Report
from refu_core.modes import FOREIGN_BETAS
from refu_core.options import PipelineOptions
from refu_ros._settings import NodeSettings

_OVER_BUDGET = 0.1
"""Share of the frames that may be superseded before they are worked on."""
_LOW_DISK_BYTES = 1 << 30
_WENT_BACK = "was a clock set back, do frames come out of order, or do two send on one topic?"
_FIRST_INPUT_S = 2.0
"""How long the node listens before it reports that somebody is missing [s]."""


@dataclass(frozen=True, kw_only=True)
class Situation:
    """What the diagnostics need to know besides the report."""

    node: str
    """The node's name with its namespace."""
    state: str
    persons: Sequence[str]
    recording: RecorderState | None
    recording_error: str
    listening_for: float | None = math.inf
    """Time since the inputs were subscribed to [s]; None where they aren't."""
    in_use: PipelineOptions | None = None
    expected: Mapping[str, float] = field(default_factory=dict)
    """Who ought to be here with `follow_humans` (`""`: anybody), and since when, on the steady clock [s]."""
    input_frame: str = ""
    """The sender's frame, where it isn't the markers'."""
    is_untransformed: bool = False
    """Whether the input is shown as if its frame were that of the markers: there is no tf2_msgs."""
    has_foreign_betas: bool = False
    """Whether betas have come without anything saying whose shape space they belong to."""
    doubted: str = ""
    has_no_clock: bool = False
    """Whether the clock is that of a simulation that hasn't begun."""
    n_namesakes: int = 0


def statuses(report: Report, settings: NodeSettings, now: Situation) -> list[DiagnosticStatus]:
    """The statuses of node, input, output and recording."""
    host = socket.gethostname()  # two robots' nodes of one name are told apart by it
    parts = {"node": _node, "input": _input, "garments": _output, "recording": _recording}
    found = []
    for part, judge in parts.items():
        rules, values = judge(report, settings, now)
        level, message = next((level, text) for holds, level, text in rules if holds)
        found.append(DiagnosticStatus(level, f"{now.node}: {part}", message, host, values))
    return found


Judgement = tuple[list[tuple[object, int, str]], dict[str, str]]
"""Rules of condition, level and message, of which the first that holds is reported; and values."""


def _node(report: Report, _: NodeSettings, now: Situation) -> Judgement:
    """What went wrong for reasons other than somebody's frame: senseless requests, clocks, callbacks."""
    faults = sum(n for key, n in report.recent.items() if key.startswith("fault."))
    last = report.reasons["fault"]
    values = {"state": now.state, "last fault": last}
    values |= {f"faults: {where}": str(n) for where, n in sorted(report.group("fault").items())}
    rules: list[tuple[object, int, str]] = [
        (now.has_no_clock, WARN, "use_sim_time is set, and no /clock has come: everything is stamped 0"),
        (faults, WARN, f"{faults} faults, the last: {last}"),
        (True, OK, now.state),
    ]
    return rules, values


def _input(report: Report, settings: NodeSettings, now: Situation) -> Judgement:
    recent, reasons, persons, silent_for = report.recent, report.reasons, now.persons, report.silent_for
    received, invalid, waited = recent["received"], recent["drop.invalid"], now.listening_for or 0.0
    announced = [person for person, since in now.expected.items() if time.monotonic() > since + _FIRST_INPUT_S]
    expected = announced if settings.follow_humans else settings.persons
    missing = [person for person in expected if person not in persons]
    if settings.input_type == "keypoint_markers":  # people in them are called `<person>_<namespace>`
        missing = [name for name in missing if not any(one.startswith(f"{name}_" if name else "") for one in persons)]
    who = ", ".join(filter(None, missing)) or f"{min(silent_for or 0.0, waited):.1f} s"
    silence = f"no input {'from' if any(missing) else 'for'} {who}"
    rules: list[tuple[object, int, str]] = [
        (now.state != "active", OK, "not active"),
        (now.listening_for is None, OK, "not subscribed to: nobody listens to anything, and nothing is recorded"),
        (invalid and invalid >= received, ERROR, f"every message is invalid: {reasons['invalid']}"),
        (invalid, WARN, f"{invalid} of {received} messages are invalid: {reasons['invalid']}"),
        (n := recent["drop.stale_transforms"], WARN, f"{n} messages of transforms weren't read: too many come"),
        (n := recent["drop.transform"], WARN, f"{n} of {received} have no transform: {reasons['transform']}"),
        (n := recent["drop.crowd"], WARN, f"{n} frames of people beyond the first: {reasons['crowd']}"),
        (silent_for is None and waited > _FIRST_INPUT_S, WARN, now.doubted or "no input yet"),
        (n := recent["back_in_time"], WARN, f"{n} stamps went back: {_WENT_BACK}"),
    ]
    if missing and not recent["skip.unwatched"] and silent_for is not None and waited > _FIRST_INPUT_S:
        nobody = received and not persons
        text = f"nobody is here, though {received} messages came" if nobody else silence
        rules.append((True, WARN, "; ".join(filter(None, (text, now.doubted)))))
    if now.is_untransformed and now.input_frame:
        frames = f"{now.input_frame} is taken for {settings.frame_id}"
        rules.append((True, WARN, f"{frames}: install tf2_msgs, or set frame_id if they are the same place"))
    late = f"{recent['late_transform']} frames are placed by older transforms: newer ones came too late, or never"
    rules += [
        (recent["late_transform"], WARN, late),
        (now.doubted, WARN, now.doubted),
        (now.has_foreign_betas, WARN, FOREIGN_BETAS),
        (True, OK, f"{report.rate('received'):.1f} Hz"),
    ]
    way = "shown as" if now.is_untransformed else "transformed to"
    values = {
        "subscribed": "no" if now.listening_for is None else "yes",
        "rate [Hz]": f"{report.rate('received'):.1f}",
        "received": str(report.total["received"]),
        "persons": ", ".join(filter(None, persons)) or str(len(persons)),
        "input type": settings.input_type,
        "frame": f"{now.input_frame}, {way} {settings.frame_id}" if now.input_frame else settings.frame_id,
        "late transforms": str(report.total["late_transform"]),
        "stamps that went back": str(report.total["back_in_time"]),
    }
    return rules, values | {f"dropped: {cause}": str(n) for cause, n in sorted(report.group("drop").items())}


def _output(report: Report, settings: NodeSettings, now: Situation) -> Judgement:
    recent, total, in_use = report.recent, report.total, now.in_use
    stale, received = recent["drop.stale"], recent["received"]
    causes = [cause for cause in ("device", "failed", "not_finite") if recent[f"drop.{cause}"]]
    failed = sum(recent[f"drop.{cause}"] for cause in causes)
    p50, p95, p99 = report.latency_ms
    namesakes = f"{now.n_namesakes + 1} nodes have this name: start others with -r __ns:=/another_namespace"
    late = f"over budget: {stale} of {received} frames were superseded; latency p95 {p95:.1f} ms"
    rules: list[tuple[object, int, str]] = [
        (report.last_error, ERROR, report.last_error),
        (now.state != "active", OK, f"not active but {now.state}"),
        (failed, ERROR, f"{failed} frames failed: {report.reasons[causes[0]] if causes else ''}"),
        (now.n_namesakes, WARN, namesakes),
        (stale > _OVER_BUDGET * received, WARN, late),
        (recent["coarse"], WARN, f"people are over {COARSE_M:g} m away, and points are float32: use a local frame_id"),
        (now.listening_for is None, OK, "nobody listens"),
        (True, OK, f"{report.rate('ticks'):.1f} Hz, latency p95 {p95:.1f} ms"),
    ]
    found, unresolved = total["penetration.found"], total["penetration.unresolved"]
    values = {
        "rate [Hz]": f"{report.rate('ticks'):.1f}",
        "messages": str(total["ticks"]),
        "frames": str(total["frames"]),
        "latency p50 [ms]": f"{p50:.1f}",
        "latency p95 [ms]": f"{p95:.1f}",
        "latency p99 [ms]": f"{p99:.1f}",
        "penetrating vertices found": str(found),
        "penetrating vertices resolved": str(max(found - unresolved, 0)),
        "penetrating vertices unresolved": str(unresolved),
        "skin moved by the collider, at most [mm]": f"{1e3 * report.largest_shift:.1f}",
        "frames beyond the promised poses and shapes": str(total["beyond_promise"]),
    }
    if in_use is not None:
        values |= {
            "garments": ", ".join(in_use.garments),
            "body": in_use.body or in_use.betas_from or "the garments' own",
            "backbone": in_use.backbone,
            "sdf": in_use.sdf,
            "weights": in_use.weights or "those that ship",
            "device": in_use.device,
            "collider": "yes" if in_use.collider else "no",
        }
        if in_use != settings.pipeline:
            values["asked for"] = str(settings.pipeline)
    return rules, values | {f"skipped: {kind}": str(n) for kind, n in sorted(report.group("skip").items())}


def _recording(_: Report, settings: NodeSettings, now: Situation) -> Judgement:
    state, error = now.recording, now.recording_error
    rules: list[tuple[object, int, str]] = [(error, ERROR, f"not recording: {error}")]
    if state is None:
        return [*rules, (True, OK, "not recording")], {}
    is_nearly_full = state.free_bytes is not None and state.free_bytes < _LOW_DISK_BYTES
    free = "unknown" if state.free_bytes is None else f"{state.free_bytes / 1e6:.0f}"
    is_at_risk = state.at_risk_s > settings.record_sync_period
    rules += [
        (is_nearly_full, WARN, f"disk nearly full: {free} MB left"),
        (state.dropped, WARN, f"{state.dropped} messages not recorded: a disk too slow, or too many topics"),
        (is_at_risk, WARN, f"a power cut would take the last {state.at_risk_s:.1f} s: the disk is too slow"),
        (True, OK, f"{state.written} messages in {state.path}"),
    ]
    return rules, {
        "path": str(state.path),
        "messages": str(state.written),
        "queued": str(state.queued),
        "dropped": str(state.dropped),
        "at risk in a power cut [s]": f"{state.at_risk_s:.1f}",
        "size [MB]": f"{state.size_bytes / 1e6:.1f}",
        "disk free [MB]": free,
    }
