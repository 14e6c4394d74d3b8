"""Which decoder and encoder belong to which input type."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Protocol, cast

from msg_adapters.axes import WORLD_FRAME
from msg_adapters.cdr import Buffer, CdrReader
from msg_adapters.definitions import full_type_name
from msg_adapters.errors import DecodeError
from msg_adapters.inputs import _joint_state, _multiarray, _pose_array, _smpl
from refu_core.frames import SmplFrame

_CODECS: dict[str, ModuleType] = {
    "multiarray": _multiarray,
    "joint_state": _joint_state,
    "pose_array": _pose_array,
    "smpl_msgs": _smpl,
}
INPUT_TYPES: dict[str, str] = {name: codec.MESSAGE_TYPE for name, codec in _CODECS.items()}
SMPL_TOPIC = "smpl_params"
"""Name of the topic that a person's parameters are usually on, below the person's own name."""


class Encoder(Protocol):
    """Turns a frame into a message's CDR bytes."""

    def __call__(self, frame: SmplFrame, *, frame_id: str = WORLD_FRAME) -> bytes:
        """The message in CDR; raises `EncodeError` for a stamp or numbers outside the message's range."""


@dataclass(frozen=True)
class Decoder:
    """Turns messages of one type into frames."""

    input_type: str
    message_type: str
    from_bytes: Callable[[Buffer], SmplFrame]
    """The frame of a message in CDR; raises `DecodeError`. Its stamp is 0 where the message has none."""


def _input_type(name: str) -> str:
    full_name = full_type_name(str(name))
    for input_type, message_type in INPUT_TYPES.items():
        if name == input_type or full_name == message_type:
            return input_type
    known = ", ".join(f"{input_type} ({message_type})" for input_type, message_type in INPUT_TYPES.items())
    raise DecodeError(f"wanted an input type, got {name!r}; there are {known}")


def decoder_for(name: str, *, definition: str | None = None) -> Decoder:
    """The decoder of an input type or of a message type's name.

    `definition` is the `.msg` text that came with the messages; smpl_msgs, which has no release, is read by it.
    Raises `DecodeError` for a name that isn't an input type, and for a definition without the fields wanted.
    """
    input_type = _input_type(name)
    codec = _CODECS[input_type]
    from_bytes = _smpl.bytes_decoder(definition) if input_type == "smpl_msgs" else codec.from_bytes
    return Decoder(input_type, codec.MESSAGE_TYPE, from_bytes)


def encoder_for(name: str) -> Encoder:
    """The encoder of an input type or of a message type's name; raises `DecodeError` for any other name."""
    return cast("Encoder", _CODECS[_input_type(name)].to_bytes)


def frame_id_of(data: Buffer, input_type: str) -> str:
    """The frame of a message that could be decoded: its header's `frame_id`; empty where its type has no header.

    A body of ROS4HRI is in its own frame, `body_<id>`, whatever camera the header names.
    """
    if input_type == "multiarray":
        return ""
    if input_type == "joint_state" and (body := _joint_state.body_of(data)):
        return f"body_{body}"
    return str(CdrReader(data).fields("Ts")[1])
