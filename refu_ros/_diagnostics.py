"""What the node says about itself once a second; each WARN or ERROR is something to act on."""

from __future__ import annotations

import math
import socket
from collections.abc import Sequence
from dataclasses import dataclass, replace

from msg_adapters import DiagnosticStatus
from msg_adapters.bags import RecorderState
from msg_adapters.diagnostics import ERROR, OK, WARN
from refu_core.modes import FOREIGN_BETAS
from refu_ros._settings import NodeSettings, PipelineKey
from refu_ros._statistics import Report

_OVER_BUDGET = 0.1
"""Share of the frames that may be superseded before they are worked on."""
_LOW_DISK_BYTES = 1 << 30
_FIRST_INPUT_S = 2.0
"""How long after the node has begun to listen nobody is missed yet [s]."""


@dataclass(frozen=True, kw_only=True)
class Situation:
    """What a report says nothing of."""

    node: str
    """Its name with the namespace."""
    state: str
    """The lifecycle's."""
    persons: Sequence[str]
    """Those in the scene."""
    recording: RecorderState | None
    recording_error: str
    listening_for: float | None = math.inf
    """Time since the inputs were subscribed to [s]; None where they aren't."""
    in_use: PipelineKey | None = None
    """What is computed with."""
    input_frame: str = ""
    """The sender's, where it isn't the markers'."""
    is_transformed: bool = False
    """Whether there are transforms of it."""
    has_foreign_betas: bool = False
    """Whether nobody knows what the betas mean that came."""
    n_namesakes: int = 0
    """Other nodes of this name."""


def statuses(report: Report, settings: NodeSettings, now: Situation) -> list[DiagnosticStatus]:
    """Node, input, output and recording."""
    host = socket.gethostname()  # two robots' nodes of one name are told apart by it
    return [replace(make(report, settings, now), hardware_id=host) for make in (_node, _input, _output, _recording)]


def _node(report: Report, _: NodeSettings, now: Situation) -> DiagnosticStatus:
    """What went wrong though nobody's frame was the reason: requests without sense, clocks, callbacks."""
    name, state = f"{now.node}: node", now.state
    faults = {key: n for key, n in report.recent.items() if key.startswith("fault.")}
    values = {"state": state, "last fault": report.reasons.get("fault", "")}
    values |= {f"faults: {where}": str(n) for where, n in sorted(report.group("fault").items())}
    if not faults:
        return DiagnosticStatus(OK, name, state, values=values)
    message = f"{sum(faults.values())} faults, the last: {report.reasons.get('fault', '')}"
    return DiagnosticStatus(WARN, name, message, values=values)


def _input(report: Report, settings: NodeSettings, now: Situation) -> DiagnosticStatus:
    persons, listening_for, input_frame = now.persons, now.listening_for, now.input_frame
    invalid, received = report.recent["drop.invalid"], report.recent["received"]
    missing = [] if settings.follow_humans else [person for person in settings.persons if person not in persons]
    level, message = OK, f"{report.rate('received'):.1f} Hz"
    if now.state != "active":
        message = "not active"
    elif listening_for is None:
        message = "not subscribed to: nobody listens to anything, and nothing is recorded"
    elif invalid and invalid == received:
        level, message = ERROR, f"every message is invalid: {report.reasons.get('invalid', '')}"
    elif invalid:
        level, message = WARN, f"{invalid} of {received} messages are invalid: {report.reasons.get('invalid', '')}"
    elif untransformed := report.recent["drop.transform"]:
        level, message = WARN, f"{untransformed} of {received} have no transform: {report.reasons.get('transform', '')}"
    elif crowded := report.recent["drop.crowd"]:
        level, message = WARN, f"{crowded} frames of people beyond the first: {report.reasons.get('crowd', '')}"
    elif report.silent_for is None and listening_for > _FIRST_INPUT_S:
        level, message = WARN, "no input yet"
    elif report.recent["back_in_time"]:
        level = WARN
        message = (
            f"{report.recent['back_in_time']} stamps went back: was a clock set back, or do two send on one topic?"
        )
    elif missing and report.silent_for is not None and listening_for > _FIRST_INPUT_S:
        who = ", ".join(filter(None, missing))
        level = WARN
        message = f"no input from {who}" if who else f"no input for {min(report.silent_for, listening_for):.1f} s"
        if received and not persons:
            message = f"nobody is here, though {received} messages came"
    elif now.has_foreign_betas:
        level, message = WARN, FOREIGN_BETAS
    way = "transformed to" if now.is_transformed else "shown as"
    values = {
        "subscribed": "no" if listening_for is None else "yes",
        "rate [Hz]": f"{report.rate('received'):.1f}",
        "received": str(report.total["received"]),
        "persons": ", ".join(filter(None, persons)) or str(len(persons)),
        "input type": settings.input_type,
        "frame": f"{input_frame}, {way} {settings.frame_id}" if input_frame else settings.frame_id,
        "late transforms": str(report.total["late_transform"]),
        "stamps that went back": str(report.total["back_in_time"]),
    }
    values |= {f"dropped: {cause}": str(n) for cause, n in sorted(report.group("drop").items())}
    return DiagnosticStatus(level, f"{now.node}: input", message, values=values)


def _output(report: Report, settings: NodeSettings, now: Situation) -> DiagnosticStatus:
    state, in_use, n_namesakes = now.state, now.in_use, now.n_namesakes
    stale, received = report.recent["drop.stale"], report.recent["received"]
    causes = ("device", "failed", "not_finite")
    failed = sum(report.recent[f"drop.{cause}"] for cause in causes)
    p50, p95, p99 = report.latency_ms
    level, message = OK, f"{report.rate('ticks'):.1f} Hz, latency p95 {p95:.1f} ms"
    if report.last_error:
        level, message = ERROR, report.last_error
    elif state != "active":
        message = f"not active but {state}"
    elif failed:
        reason = next((report.reasons[cause] for cause in causes if report.recent[f"drop.{cause}"]), "")
        level, message = ERROR, f"{failed} frames failed: {reason}"
    elif n_namesakes:
        level, message = WARN, f"{n_namesakes + 1} nodes have this name: start others with -r __node:=another_name"
    elif stale > _OVER_BUDGET * received:
        level = WARN
        message = f"over budget: {stale} of {received} frames were superseded; latency p95 {p95:.1f} ms"
    elif now.listening_for is None:
        message = "nobody listens"
    found, unresolved = report.total["penetration.found"], report.total["penetration.unresolved"]
    values = {
        "rate [Hz]": f"{report.rate('ticks'):.1f}",
        "messages": str(report.total["ticks"]),
        "frames": str(report.total["frames"]),
        "latency p50 [ms]": f"{p50:.1f}",
        "latency p95 [ms]": f"{p95:.1f}",
        "latency p99 [ms]": f"{p99:.1f}",
        "penetrating vertices found": str(found),
        "penetrating vertices resolved": str(max(found - unresolved, 0)),
        "penetrating vertices unresolved": str(unresolved),
        "skin moved by the collider, at most [mm]": f"{1e3 * report.largest_shift:.1f}",
        "frames beyond the promised poses and shapes": str(report.total["beyond_promise"]),
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
    values |= {f"skipped: {kind}": str(n) for kind, n in sorted(report.group("skip").items())}
    return DiagnosticStatus(level, f"{now.node}: garments", message, values=values)


def _recording(_: Report, settings: NodeSettings, now: Situation) -> DiagnosticStatus:
    state, error, name = now.recording, now.recording_error, f"{now.node}: recording"
    level, message = (ERROR, f"not recording: {error}") if error else (OK, "not recording")
    if state is None:
        return DiagnosticStatus(level, name, message)
    if not error:
        message = f"{state.written} messages in {state.path}"
        if state.free_bytes is not None and state.free_bytes < _LOW_DISK_BYTES:
            level, message = WARN, f"disk nearly full: {state.free_bytes / 1e6:.0f} MB left"
        elif state.dropped:
            level, message = WARN, f"{state.dropped} messages not recorded: the disk is too slow"
        elif state.at_risk_s > settings.record_sync_period:
            level, message = WARN, f"a power cut would take the last {state.at_risk_s:.1f} s: the disk is too slow"
    values = {
        "path": str(state.path),
        "messages": str(state.written),
        "queued": str(state.queued),
        "dropped": str(state.dropped),
        "at risk in a power cut [s]": f"{state.at_risk_s:.1f}",
        "size [MB]": f"{state.size_bytes / 1e6:.1f}",
        "disk free [MB]": "unknown" if state.free_bytes is None else f"{state.free_bytes / 1e6:.0f}",
    }
    return DiagnosticStatus(level, name, message, values=values)
