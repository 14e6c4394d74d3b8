"""diagnostic_msgs/DiagnosticArray in CDR, for recording what a run reported."""

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
    writer.fields("TsI", stamp_ns, frame_id, len(statuses))
    for one in statuses:
        writer.fields("BsssI", one.level, one.name, one.message, one.hardware_id, len(one.values))
        for pair in one.values.items():
            writer.fields("ss", *pair)
    return writer.to_bytes()
