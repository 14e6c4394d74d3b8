"""std_msgs/Float32MultiArray: blocks of numbers one after another, each declared by a dimension's label.

`layout.dim` holds one dimension per block, in the order of the data: `pose` (72 rotation vector components [rad]),
`betas` (10), `transl` (3, [m]) and `style` (4, a garment's γ); all but the pose are optional. A block starts `stride`
numbers after the one before it (0 stands for its size), the first one at `layout.data_offset`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.axes import WORLD_FRAME
from msg_adapters.cdr import Buffer, CdrReader, CdrWriter
from msg_adapters.errors import DecodeError, decoding
from refu_core.frames import SmplFrame

MESSAGE_TYPE = "std_msgs/msg/Float32MultiArray"
_LABELS = ("pose", "betas", "transl", "style")
_LABELLING = "label layout.dim pose (72) and, if there, betas (10), transl (3) and style (4), in the order of the data"
_MAX_DIMENSIONS = 16
_MIN_DIMENSION_BYTES = 12


def _blocks(dimensions: Sequence[tuple[Any, ...]], offset: int, data: NDArray[Any]) -> dict[str, Any]:
    """The declared blocks by label; each of `dimensions` is a label, a size and a stride."""
    if not dimensions:
        raise DecodeError(f"the layout of {data.size} numbers isn't declared; {_LABELLING}")
    blocks: dict[str, Any] = {}
    start = end = offset
    for label, size, stride in dimensions:
        if label not in _LABELS or label in blocks:
            what = "label" if label not in _LABELS else "second"
            raise DecodeError(f"unexpected {what} {label!r} in layout.dim; {_LABELLING}")
        if stride and stride < size:
            raise DecodeError(f"the stride of {label} must be 0 or at least its size {size}, got {stride}")
        end = start + size
        blocks[label] = data[start:end]
        start += stride or size
    if data.size not in (end, start):
        msg = f"the layout declares {end} numbers, the data has {data.size}; check sizes, strides and data_offset"
        raise DecodeError(msg)
    if "pose" not in blocks:
        raise DecodeError(f"the layout declares {', '.join(blocks)} but no pose; {_LABELLING}")
    return blocks


def from_bytes(data: Buffer) -> SmplFrame:
    """The frame of a message in CDR; its stamp is 0, this type has no header."""
    with decoding(MESSAGE_TYPE):
        reader = CdrReader(data)
        count = reader.length(item_bytes=_MIN_DIMENSION_BYTES)
        if count > _MAX_DIMENSIONS:
            raise DecodeError(f"{count} dimensions in layout.dim; {_LABELLING}")
        dimensions = [reader.fields("sII") for _ in range(count)]
        (offset,) = reader.fields("I")
        values = reader.array("f4", reader.length(item_bytes=4))
        reader.finish()
        return SmplFrame(**_blocks(dimensions, offset, values))


def to_bytes(frame: SmplFrame, *, frame_id: str = WORLD_FRAME) -> bytes:  # noqa: ARG001 - the type has no header
    """The message in CDR: pose, betas, transl, and style where the frame has one."""
    blocks: dict[str, NDArray[Any]] = {"pose": frame.pose.ravel(), "betas": frame.betas, "transl": frame.transl}
    if frame.style is not None:
        blocks["style"] = frame.style
    writer = CdrWriter()
    writer.fields("I", len(blocks))
    for label, block in blocks.items():
        writer.fields("sII", label, block.size, block.size)
    writer.fields("I", 0)
    writer.sequence("f4", np.concatenate(list(blocks.values())))
    return writer.to_bytes()
