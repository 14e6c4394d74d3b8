"""smpl_msgs/Smpl, the message of idra-lab's smpl_ros: a header and fixed arrays.

The package has no release, so a bag's own definition of the message, where it has one, gives the order and the
precision of the arrays; only the names and sizes are relied on.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from msg_adapters.axes import WORLD_FRAME
from msg_adapters.cdr import Buffer, CdrReader, CdrWriter
from msg_adapters.definitions import message_definition
from msg_adapters.errors import DecodeError, decoding
from refu_core.frames import N_BETAS, N_JOINTS, SmplFrame

MESSAGE_TYPE = "smpl_msgs/msg/Smpl"
_SIZES = {"global_orient": 3, "body_pose": (N_JOINTS - 1) * 3, "betas": N_BETAS, "transl": 3}
_KINDS = {"float32": "f4", "float64": "f8"}
_HEADER = re.compile(r"std_msgs/(msg/)?Header\s+header")
_ARRAY = re.compile(r"(?P<type>float32|float64)\[(?P<size>\d{1,4})\]\s+(?P<name>[a-z]\w*)")

Layout = tuple[tuple[str, str, int], ...]
"""Name, numpy kind and size of each array that follows the header."""


def parse_layout(definition: str) -> Layout:
    """The arrays of a `.msg` text.

    Raises `DecodeError` for a definition that is more than a header and fixed float arrays, or lacks a needed one.
    """
    own = definition.split("\n====", maxsplit=1)[0]
    lines = [*filter(None, (line.split("#", maxsplit=1)[0].strip() for line in own.splitlines()))]
    with decoding(MESSAGE_TYPE):
        if not lines or not _HEADER.fullmatch(lines[0]):
            raise DecodeError(f"wanted a definition that starts with 'std_msgs/Header header', got {lines[:1]}")
        layout = []
        for line in lines[1:]:
            field = _ARRAY.fullmatch(line)
            if field is None:
                msg = f"wanted fixed float arrays in the definition, got {line!r}; convert to another input type"
                raise DecodeError(msg)
            layout.append((field["name"], _KINDS[field["type"]], int(field["size"])))
        sizes = {name: size for name, _, size in layout}
        for name, size in _SIZES.items():
            if sizes.get(name) != size:
                raise DecodeError(f"wanted {name}[{size}] in the definition, got {sizes.get(name, 'no such field')}")
    return tuple(layout)


def bytes_decoder(definition: str | None) -> Callable[[Buffer], SmplFrame]:
    """A decoder of CDR bytes laid out as `definition` says (None: the published message)."""
    layout = parse_layout(definition or message_definition(MESSAGE_TYPE).text)

    def from_bytes(data: Buffer) -> SmplFrame:
        with decoding(MESSAGE_TYPE):
            reader = CdrReader(data)
            stamp_ns, _ = reader.fields("Ts")
            values = {name: reader.array(kind, size) for name, kind, size in layout}
            reader.finish()
            pose = np.concatenate([values["global_orient"], values["body_pose"]])
            return SmplFrame(pose, values["betas"], values["transl"], stamp_ns=stamp_ns)

    return from_bytes


def to_bytes(frame: SmplFrame, *, frame_id: str = WORLD_FRAME) -> bytes:
    """The message in CDR; its keypoints are zero."""
    pose = frame.pose.ravel()
    values = {"global_orient": pose[:3], "body_pose": pose[3:], "betas": frame.betas, "transl": frame.transl}
    writer = CdrWriter()
    writer.fields("Ts", frame.stamp_ns, frame_id)
    for name, kind, size in parse_layout(message_definition(MESSAGE_TYPE).text):
        writer.array(kind, values.get(name, np.zeros(size)))
    return writer.to_bytes()
