"""Encode and decode a garment's MarkerArray: ours beside rosbags', mcap-ros2's and rclpy's serialisation.

    python benchmarks/cdr.py [--triangles 19000] [--repeat 200] [--json FILE]

Every contender starts from the same vertices and ends with the message's bytes (or the other way round). The ratio is
to our encoder's (decoder's) median in the same run.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from msg_adapters import (
    MARKER_ARRAY,
    MarkerArrayEncoder,
    MarkerMesh,
    decode_marker_array,
    message_definition,
    vertices_from_points,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

SLOW_RUNS = 5  # contenders take hundreds of milliseconds: a few runs tell


class Scene(NamedTuple):
    """A tube of cloth, like a skirt."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int64]

    @classmethod
    def of(cls, triangles: int) -> Scene:
        """Of at least so many triangles, with the ratio of vertices to triangles that garments have."""
        columns = max(int(np.sqrt(triangles / 2)), 3)
        rows = -(-triangles // (2 * columns)) + 1
        angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, columns, endpoint=False), np.linspace(0, 1, rows))
        radius = 0.2 + 0.1 * height + 0.01 * np.sin(9 * angle)
        vertices = np.stack([radius * np.cos(angle), 1 - 0.6 * height, radius * np.sin(angle)], axis=-1)
        index = np.arange(rows * columns).reshape(rows, columns)
        a, b = index[:-1], np.roll(index, -1, axis=1)[:-1]
        c, d = np.roll(index, -1, axis=1)[1:], index[1:]
        faces = np.concatenate([np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))])
        return cls(vertices.reshape(-1, 3).astype(np.float32), faces[:triangles])


class Row(NamedTuple):
    """Times of one contender [ms]."""

    task: str
    name: str
    median: float
    p5: float
    p95: float
    ratio: float


def measure(function: Callable[[], object], runs: int) -> NDArray[np.float64]:
    """Times of `runs` calls [ms], after one that isn't counted."""
    function()
    times = np.empty(runs)
    for i in range(runs):
        start = time.perf_counter()
        function()
        times[i] = (time.perf_counter() - start) * 1e3
    return times


def corner_points(scene: Scene) -> list[tuple[float, float, float]]:
    """What a message object is filled with: each triangle corner in ROS axes."""
    points: list[tuple[float, float, float]] = (
        scene.vertices[:, [2, 0, 1]].astype(np.float64)[scene.faces.ravel()].tolist()
    )
    return points


def ours(scene: Scene) -> Iterator[tuple[str, str, Callable[[], object]]]:
    encoder = MarkerArrayEncoder([MarkerMesh("skirt", scene.faces, len(scene.vertices))])
    data = encoder.encode([scene.vertices], stamp_ns=0)
    transl = np.array([1.0, 0.9, -2.0])

    def decode() -> object:
        return vertices_from_points(decode_marker_array(data)[0].points, scene.faces)

    yield "encode", "msg_adapters", lambda: encoder.encode([scene.vertices], stamp_ns=1, transl=transl)
    yield "decode", "msg_adapters (views)", lambda: decode_marker_array(data)
    yield "decode", "msg_adapters (to vertices)", decode


def rosbags(scene: Scene) -> Iterator[tuple[str, str, Callable[[], object]]]:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    point = store.types["geometry_msgs/msg/Point"]
    data = MarkerArrayEncoder([MarkerMesh("skirt", scene.faces, len(scene.vertices))]).encode(
        [scene.vertices], stamp_ns=0
    )
    message: Any = store.deserialize_cdr(data, MARKER_ARRAY)

    def encode() -> bytes:
        message.markers[0].points = [point(*p) for p in corner_points(scene)]
        return bytes(store.serialize_cdr(message, MARKER_ARRAY))

    if encode() != data:
        msg = "rosbags writes other bytes"
        raise AssertionError(msg)
    yield "encode", "rosbags", encode
    yield "decode", "rosbags", lambda: store.deserialize_cdr(data, MARKER_ARRAY)


def mcap_ros2(scene: Scene) -> Iterator[tuple[str, str, Callable[[], object]]]:
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory

    schema = Schema(id=1, name=MARKER_ARRAY, encoding="ros2msg", data=message_definition(MARKER_ARRAY).text.encode())
    reader: Any = DecoderFactory().decoder_for("cdr", schema)
    data = MarkerArrayEncoder([MarkerMesh("skirt", scene.faces, len(scene.vertices))]).encode(
        [scene.vertices], stamp_ns=0
    )
    yield "decode", "mcap-ros2-support", lambda: reader(data)


def rclpy(scene: Scene) -> Iterator[tuple[str, str, Callable[[], object]]]:
    from geometry_msgs.msg import Point
    from rclpy.serialization import deserialize_message, serialize_message
    from visualization_msgs.msg import Marker, MarkerArray

    data = MarkerArrayEncoder([MarkerMesh("skirt", scene.faces, len(scene.vertices))]).encode(
        [scene.vertices], stamp_ns=0
    )

    def encode() -> bytes:
        marker = Marker(ns="skirt", type=Marker.TRIANGLE_LIST)
        marker.points = [Point(x=x, y=y, z=z) for x, y, z in corner_points(scene)]
        return bytes(serialize_message(MarkerArray(markers=[marker])))

    yield "encode", "rclpy", encode
    yield "decode", "rclpy", lambda: deserialize_message(data, MarkerArray)


def measured(contender: Callable[[Scene], Iterator[Any]], scene: Scene, runs: int) -> list[tuple[str, str, Any]]:
    """Task, name and times [ms] of what a contender offers; nothing where it isn't installed."""
    try:
        return [(task, name, measure(function, runs)) for task, name, function in contender(scene)]
    except ImportError as error:
        print(f"{contender.__name__} isn't installed: {error}")
        return []


def run(triangles: int, repeat: int) -> list[Row]:
    """All contenders that are installed, ours first."""
    scene = Scene.of(triangles)
    times = measured(ours, scene, repeat)
    for contender in (rosbags, mcap_ros2, rclpy):
        times += measured(contender, scene, min(repeat, SLOW_RUNS))
    base = {task: float(np.median(found)) for task, _, found in reversed(times)}  # ours, being first, stays
    rows = []
    for task, name, found in times:
        p5, median, p95 = (float(x) for x in np.percentile(found, [5, 50, 95]))
        rows.append(Row(task, name, median, p5, p95, median / base[task]))
    return sorted(rows, key=lambda row: row.task, reverse=True)


def main() -> None:
    """Measure, print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--triangles", type=int, default=19_000)
    parser.add_argument("--repeat", type=int, default=200)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = run(arguments.triangles, arguments.repeat)
    print(f"{arguments.triangles} triangles\n{'task':8}{'by':28}{'median ms':>10}{'p5 ... p95':>20}{'ratio':>9}")
    for row in rows:
        spread = f"{row.p5:.3f} ... {row.p95:.3f}"
        print(f"{row.task:8}{row.name:28}{row.median:10.3f}{spread:>20}{row.ratio:8.1f}x")
    if arguments.json:
        arguments.json.write_text(json.dumps({"rows": [row._asdict() for row in rows]}, indent=2))


if __name__ == "__main__":
    main()
