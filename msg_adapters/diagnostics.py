"""diagnostic_msgs/DiagnosticArray in CDR, for recording what a run had to say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from msg_adapters.cdr import CdrWriter

DIAGNOSTIC_ARRAY = "diagnostic_msgs/msg/DiagnosticArray"
OK, WARN, ERROR, STALE = range(4)


@dataclass(frozen=True)
class DiagnosticStatus:
    """State of one part at one time."""

    level: int
    """`OK`, `WARN`, `ERROR` or `STALE`."""
    name: str
    message: str
    hardware_id: str = ""
    values: Mapping[str, str] = field(default_factory=dict)


def encode_diagnostics(statuses: Sequence[DiagnosticStatus], *, stamp_ns: int, frame_id: str = "") -> bytes:
    """The statuses as one `diagnostic_msgs/DiagnosticArray`.

    Raises `EncodeError` when a value doesn't fit the message.
    """
    writer = CdrWriter()
    writer.header(stamp_ns, frame_id)
    writer.numbers("I", len(statuses))
    for status in statuses:
        writer.numbers("B", status.level)
        writer.string(status.name)
        writer.string(status.message)
        writer.string(status.hardware_id)
        writer.numbers("I", len(status.values))
        for key, value in status.values.items():
            writer.string(key)
            writer.string(value)
    return writer.to_bytes()
