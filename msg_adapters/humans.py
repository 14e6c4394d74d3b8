"""hri_msgs/IdsList: who is tracked, as REP-155 has it on `/humans/bodies/tracked`."""

from __future__ import annotations

from msg_adapters.cdr import Buffer, CdrReader

IDS_LIST = "hri_msgs/msg/IdsList"
_MIN_STRING_BYTES = 4


def decode_ids(data: Buffer) -> list[str]:
    """The ids of a `hri_msgs/IdsList` in CDR. Raises `DecodeError` for anything that isn't one."""
    reader = CdrReader(data)
    reader.fields("Ts")
    ids = [reader.string() for _ in range(reader.length(item_bytes=_MIN_STRING_BYTES))]
    reader.finish()
    return ids
