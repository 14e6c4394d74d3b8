"""Encode and decode a garment's MarkerArray: ours against rosbags', mcap-ros2's and rclpy's serialisation.

    python benchmarks/cdr.py [--garment skirt-female] [--repeat 200] [--json FILE]

Every contender starts from the same vertices and ends with the message's bytes (or the other way round). Times are
CPU times; the ratio is to our encoder's (decoder's) median in the same run.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from msg_adapters import (
    MARKER_ARRAY,
    MarkerArrayEncoder,
    MarkerMesh,
    decode_marker_array,
    message_definition,
    vertices_from_points,
)
from refu_core import load_garment
from refu_lab.benchmark import measure, one_core
from refu_lab.tables import format_table, write_json

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

SLOW_RUNS = 5  # the other contenders take hundreds of milliseconds: a few runs are enough
Contender = tuple[str, str, "Callable[[], object]"]
"""Task, name, and what is timed."""


class SentGarment:
    """What is sent: vertices in SMPL axes [m], shape (V, 3), faces (F, 3), and the message."""

    def __init__(self, name: str) -> None:
        template = load_garment(name)
        self.vertices: NDArray[np.float32] = template.v_template.numpy()
        self.faces: NDArray[np.int64] = template.faces.numpy()
        self.encoder = MarkerArrayEncoder([MarkerMesh(name, self.faces, len(self.vertices))])
        self.data = self.encoder.encode([self.vertices], stamp_ns=0)

    def corner_points(self) -> list[tuple[float, float, float]]:
        """The points that fill a message object: each triangle corner in ROS axes."""
        points: list[tuple[float, float, float]] = (
            self.vertices[:, [2, 0, 1]].astype(np.float64)[self.faces.ravel()].tolist()
        )
        return points


def ours(garment: SentGarment) -> Iterator[Contender]:
    """Our own contenders: the first row of each task, which the others are compared with."""
    transl = np.array([1.0, 0.9, -2.0])

    def decode() -> object:
        return vertices_from_points(decode_marker_array(garment.data)[0].points, garment.faces)

    yield "encode", "msg_adapters", lambda: garment.encoder.encode([garment.vertices], stamp_ns=1, transl=transl)
    yield "decode", "msg_adapters (views)", lambda: decode_marker_array(garment.data)
    yield "decode", "msg_adapters (to vertices)", decode


def rosbags(garment: SentGarment) -> Iterator[Contender]:
    """rosbags' serialiser, whose bytes must equal ours."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    point = store.types["geometry_msgs/msg/Point"]
    message: Any = store.deserialize_cdr(garment.data, MARKER_ARRAY)

    def encode() -> bytes:
        message.markers[0].points = [point(*p) for p in garment.corner_points()]
        return bytes(store.serialize_cdr(message, MARKER_ARRAY))

    if encode() != garment.data:
        msg = "rosbags writes other bytes"
        raise AssertionError(msg)
    yield "encode", "rosbags", encode
    yield "decode", "rosbags", lambda: store.deserialize_cdr(garment.data, MARKER_ARRAY)


def mcap_ros2(garment: SentGarment) -> Iterator[Contender]:
    """mcap-ros2-support, which only reads."""
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory

    schema = Schema(id=1, name=MARKER_ARRAY, encoding="ros2msg", data=message_definition(MARKER_ARRAY).text.encode())
    reader: Any = DecoderFactory().decoder_for("cdr", schema)
    yield "decode", "mcap-ros2-support", lambda: reader(garment.data)


def rclpy(garment: SentGarment) -> Iterator[Contender]:
    """ROS's own messages, filled in Python."""
    from geometry_msgs.msg import Point
    from rclpy.serialization import deserialize_message, serialize_message
    from visualization_msgs.msg import Marker, MarkerArray

    def encode() -> bytes:
        marker = Marker(ns="skirt", type=Marker.TRIANGLE_LIST)
        marker.points = [Point(x=x, y=y, z=z) for x, y, z in garment.corner_points()]
        return bytes(serialize_message(MarkerArray(markers=[marker])))

    yield "encode", "rclpy", encode
    yield "decode", "rclpy", lambda: deserialize_message(garment.data, MarkerArray)


def rows(garment: SentGarment, repeat: int) -> list[dict[str, Any]]:
    """Times of all contenders that are installed [ms], ours first."""
    found: list[dict[str, Any]] = []
    base: dict[str, float] = {}
    for offered in (ours, rosbags, mcap_ros2, rclpy):
        try:
            contenders = list(offered(garment))
        except ImportError as error:
            print(f"{offered.__name__} isn't installed: {error}")
            continue
        runs = repeat if offered is ours else min(repeat, SLOW_RUNS)
        calls = {f"{task} {name}": (lambda _, call=call: call()) for task, name, call in contenders}
        times = measure(calls, [[None] * (runs + 1)], rounds=1)
        for task, name, _ in contenders:
            timing = times[f"{task} {name}"]
            low, high = timing.quartiles
            ratio = timing.median / base.setdefault(task, timing.median)
            found.append({"task": task, "name": name, "ms": timing.median, "q1": low, "q3": high, "ratio": ratio})
    return sorted(found, key=lambda row: str(row["task"]), reverse=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--garment", default="skirt-female")
    parser.add_argument("--repeat", type=int, default=200)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    garment = SentGarment(arguments.garment)
    with one_core():
        found = rows(garment, arguments.repeat)
    cells = [
        (r["task"], r["name"], f"{r['ms']:.3f}", f"{r['q1']:.3f} … {r['q3']:.3f}", f"{r['ratio']:.1f}x") for r in found
    ]
    print(f"{len(garment.faces)} triangles")
    print(format_table(("task", "by", "median ms", "quartiles", "ratio"), cells))
    if arguments.json:
        write_json(arguments.json, {"rows": found})


if __name__ == "__main__":
    main()
