"""The independent implementations that the adapters are compared with, and frames to compare them on."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from msg_adapters import INPUT_TYPES
from refu_core import SmplFrame

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

SMPL_MSG = """\
std_msgs/Header header
float64[69] body_pose
float64[3] transl
float64[3] global_orient
float64[10] betas
float64[72] keypoints
"""


@cache
def typestore() -> Typestore:
    """rosbags' own definitions of ROS 2 Jazzy's messages, and smpl_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(SMPL_MSG, "smpl_msgs/msg/Smpl"))
    return store


def serialise(message: Any, message_type: str, *, little_endian: bool = True) -> bytes:
    return bytes(typestore().serialize_cdr(message, message_type, little_endian=little_endian))


def deserialise(data: bytes, message_type: str) -> Any:
    return typestore().deserialize_cdr(data, message_type)


def make(message_type: str, *values: Any) -> Any:
    return typestore().types[message_type](*values)


def header(stamp_ns: int = 0, frame_id: str = "map") -> Any:
    time = make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 10**9))
    return make("std_msgs/msg/Header", time, frame_id)


input_types = st.sampled_from(sorted(INPUT_TYPES))
stamps = st.integers(0, 2**31 * 10**9 - 1)
texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=20)


def floats(shape: tuple[int, ...], bound: float, dtype: type = np.float32) -> st.SearchStrategy[Any]:
    width = 32 if dtype is np.float32 else 64
    return hnp.arrays(dtype, shape, elements=st.floats(-bound, bound, width=width))


@st.composite
def frames(draw: st.DrawFn) -> SmplFrame:
    return SmplFrame(
        pose=draw(floats((24, 3), 2.0)),
        betas=draw(floats((10,), 8.0)),
        transl=draw(floats((3,), 1e5, np.float64)),
        stamp_ns=draw(stamps),
    )
