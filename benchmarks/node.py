"""The node under load: sender, `garment_node` and raw subscriber as processes of their own, over loopback.

    python benchmarks/node.py                              # one person, T-shirt and short pant at 30 Hz, 60 s
    python benchmarks/node.py --persons 4 --rate 10        # four persons, two garments each
    python benchmarks/node.py --nobody                     # nobody listens: what the node costs then, and how long
                                                           # late viewers wait
    python benchmarks/node.py --nobody -p lazy:=false      # the same for a node that stays subscribed
    python benchmarks/node.py --points                     # the subscriber reads typed points instead of markers

Prints how many frames came out, latencies from the sender's stamp to the subscriber, whether they grow, how long the
node takes to answer parameter changes meanwhile, and its share of a core. Needs rclpy (extra `ros`).
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

GARMENTS = ("tshirt-male", "short-pant-male")
LATE_VIEWERS = 12
UNTIL_KILLED_S = 3600.0
REST_S = 8.0
"""The node stays subscribed for some seconds after the last viewer leaves; after this time it has unsubscribed [s]."""


def names(persons: int) -> list[str]:
    return [f"p{i}" for i in range(persons)] if persons > 1 else [""]


def start_ros(name: str) -> Any:
    import rclpy

    rclpy.init(args=[])
    return rclpy.create_node(name)


def send(options: argparse.Namespace) -> dict[str, Any]:
    """The sender: procedural motion, stamped when it is sent."""
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import JointState

    from msg_adapters import encoder_for
    from refu_core import SmplFrame

    node = start_ros("sender")
    persons = names(options.persons)
    topics = [f"{person}/smpl_params" if person else "smpl_params" for person in persons]
    publishers = [node.create_publisher(JointState, topic, QoSProfile(depth=1)) for topic in topics]
    while not (node.count_publishers("garments") and (options.nobody or all(map(node.count_subscribers, topics)))):
        time.sleep(0.05)
    time.sleep(3.0)  # the subscriber may still be looking for the node
    encode = encoder_for("joint_state")
    sent: dict[str, list[int]] = {person: [] for person in persons}
    start = time.monotonic()
    for i in range(round(options.seconds * options.rate)):
        time.sleep(max(0.0, start + i / options.rate - time.monotonic()))
        for k, (person, publisher) in enumerate(zip(persons, publishers, strict=True)):
            stamp = time.time_ns()
            publisher.publish(encode(SmplFrame(pose=pose(i / options.rate + k), stamp_ns=stamp)))
            sent[person].append(stamp)
    return {"sent": sent}


def pose(t: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Somebody who walks and waves."""
    joints = np.zeros((24, 3))
    swing = np.sin(4.0 * t)
    joints[1, 0], joints[2, 0] = 0.4 * swing, -0.4 * swing
    joints[4, 0], joints[5, 0] = 0.4 + 0.3 * swing, 0.4 - 0.3 * swing
    joints[16, 2], joints[17, 2] = -0.9 + 0.4 * np.sin(1.7 * t), 0.9 - 0.4 * np.sin(1.3 * t)
    return joints


def receive(options: argparse.Namespace) -> dict[str, Any]:
    """The subscriber: raw bytes of markers, or typed messages of points, read as arrays."""
    import rclpy
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import PointCloud2
    from visualization_msgs.msg import MarkerArray

    from msg_adapters import decode_marker_array, points_of

    node = start_ros("receiver")
    got: dict[str, dict[int, float]] = {person: {} for person in names(options.persons)}
    bad, read_ms = 0, []

    def take_points(person: str, message: PointCloud2) -> None:
        nonlocal bad
        now, start = time.time_ns(), time.perf_counter()
        points = points_of(message)
        where = np.stack([points["x"], points["y"], points["z"]], axis=1)
        read_ms.append(1e3 * (time.perf_counter() - start))
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        got[person][stamp] = 1e-6 * (now - stamp)
        bad += not np.isfinite(where.sum())

    def take(data: bytes) -> None:
        nonlocal bad
        now = time.time_ns()
        for marker in decode_marker_array(data):
            if marker.action == 0:
                person = marker.ns.rpartition("/")[0]
                got[person][marker.stamp_ns] = 1e-6 * (now - marker.stamp_ns)
                bad += not np.isfinite(marker.points.sum())

    if options.points:
        for person in got:
            topic = f"{person}/points" if person else "points"
            node.create_subscription(PointCloud2, topic, functools.partial(take_points, person), QoSProfile(depth=10))
    else:
        node.create_subscription(MarkerArray, "garments", take, QoSProfile(depth=10), raw=True)
    end = time.monotonic() + options.seconds + 30.0
    last = 0.0
    while time.monotonic() < end:
        before = sum(map(len, got.values()))
        rclpy.spin_once(node, timeout_sec=0.1)
        if sum(map(len, got.values())) > before:
            last = time.monotonic()
        if last and time.monotonic() - last > 4.0:
            break
    return {"got": got, "not_finite": bad, "read_ms": percentiles(read_ms)}


def processor_seconds(process: subprocess.Popen[bytes]) -> dict[str, float]:
    """What the threads of a process have used of a core so far [s], by name (Linux)."""
    seconds: dict[str, float] = {}
    for task in Path(f"/proc/{process.pid}/task").iterdir():
        with contextlib.suppress(FileNotFoundError):  # a thread that has just ended
            name = "main" if task.name == str(process.pid) else (task / "comm").read_text(encoding="utf-8").strip()
            used = 1e-9 * int((task / "schedstat").read_text(encoding="ascii").split()[0])
            seconds[name] = seconds.get(name, 0.0) + used
    return seconds


def share_of_core(before: dict[str, float], after: dict[str, float], seconds: float) -> dict[str, float]:
    """Share of a core that all threads used together, and that each busy thread used [%]."""
    used = {name: 100 * (value - before.get(name, 0.0)) / seconds for name, value in after.items()}
    each = {name: round(value, 2) for name, value in sorted(used.items(), key=lambda item: -item[1]) if value > 0.005}
    return {"all": round(sum(used.values()), 2), **each}


def wait(options: argparse.Namespace, node: subprocess.Popen[bytes]) -> dict[str, Any]:
    """The node's share of a core while frames are sent and nobody listens; then, how long late viewers wait."""
    time.sleep(25.0)  # until the processes have started and found each other, and the node is idle
    used, start = processor_seconds(node), time.monotonic()
    time.sleep(options.seconds)
    share = share_of_core(used, processor_seconds(node), time.monotonic() - start)
    return {"core_percent": share, "first_garment_ms": late_viewers()}


def late_viewers() -> list[int]:
    """How long a viewer that already runs waits for a first garment after subscribing, `LATE_VIEWERS` times [ms]."""
    import rclpy
    from rclpy.qos import QoSProfile
    from visualization_msgs.msg import MarkerArray

    node = start_ros("viewer")
    waited = []
    for _ in range(LATE_VIEWERS):
        time.sleep(REST_S)
        came: list[bytes] = []
        start = time.monotonic()
        subscription = node.create_subscription(MarkerArray, "garments", came.append, QoSProfile(depth=10), raw=True)
        while not came and time.monotonic() < start + 60.0:
            rclpy.spin_once(node, timeout_sec=0.1)
        waited.append(round(1e3 * (time.monotonic() - start)))
        node.destroy_subscription(subscription)
    return waited


def operate(sender: subprocess.Popen[bytes], of_node: subprocess.Popen[bytes]) -> dict[str, Any]:
    """Changes parameters while frames flow, and keeps the node's latest diagnostics."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter

    node = start_ros("operator")
    statuses: dict[str, Any] = {}

    def note(array: DiagnosticArray) -> None:
        for status in array.status:
            values = {item.key: item.value for item in status.values}
            if float(values.get("rate [Hz]", "1")) > 0:
                statuses[status.name] = {"message": status.message, **values}

    node.create_subscription(DiagnosticArray, "/diagnostics", note, 10)
    client = node.create_client(SetParameters, "garment_node/set_parameters")
    client.wait_for_service(timeout_sec=60.0)
    answers, i = [], 0
    used, began = processor_seconds(of_node), time.monotonic()
    while sender.poll() is None:
        end = time.monotonic() + 1.0
        while time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.1)
        i += 1
        change = Parameter("max_distance", value=float(i)).to_parameter_msg()
        request = SetParameters.Request(parameters=[change])
        start = time.perf_counter()
        rclpy.spin_until_future_complete(node, client.call_async(request), timeout_sec=5.0)
        answers.append(1e3 * (time.perf_counter() - start))
    share = share_of_core(used, processor_seconds(of_node), time.monotonic() - began)
    return {
        "parameter_ms": percentiles(answers),
        "parameter_max_ms": max(answers),
        "core_percent": share,
        "diagnostics": statuses,
    }


def percentiles(values: list[float]) -> dict[str, float]:
    return {f"p{q}": round(float(np.percentile(values, q)), 1) for q in (50, 95, 99)} if values else {}


def summary(sent: dict[str, list[int]], got: dict[str, dict[str, float]]) -> dict[str, Any]:
    n_sent = sum(map(len, sent.values()))
    ms = [(int(stamp), value) for person in got.values() for stamp, value in person.items()]
    n_got = sum(len(set(map(int, got[person])) & set(stamps)) for person, stamps in sent.items())
    ms.sort()
    third = max(len(ms) // 3, 1)
    return {
        "sent": n_sent,
        "received": n_got,
        "received_percent": round(100 * n_got / n_sent, 2),
        "unknown_stamps": len(ms) - n_got,
        "latency_ms": percentiles([value for _, value in ms]),
        "latency_p50_first_third_ms": percentiles([value for _, value in ms[:third]]).get("p50"),
        "latency_p50_last_third_ms": percentiles([value for _, value in ms[-third:]]).get("p50"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--persons", type=int, default=1)
    parser.add_argument("--rate", type=float, default=30.0, help="frames a second of each person")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--garments", default=",".join(GARMENTS))
    parser.add_argument("--points", action="store_true", help="subscribe to points, typed, in the place of markers")
    parser.add_argument("--nobody", action="store_true", help="leave out the subscriber, and changes of parameters")
    parser.add_argument("-p", "--parameter", action="append", default=[], help="name:=value of the node, besides those")
    parser.add_argument("--role", choices=("send", "receive"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role:
        role = send if options.role == "send" else receive
        print(json.dumps(role(options)))
        return
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(101 + os.getpid() % 50)
    os.environ["OMP_NUM_THREADS"] = "1"
    parameters = {"input_type": "joint_state", "garments": f"[{options.garments}]"}
    if options.persons > 1:
        parameters["persons"] = f"[{', '.join(names(options.persons))}]"
    given = [f"{name}:={value}" for name, value in parameters.items()] + options.parameter
    arguments = [item for parameter in given for item in ("-p", parameter)]
    node = subprocess.Popen([sys.executable, "-m", "refu_ros.garment_node", "--ros-args", *arguments])
    same = [sys.executable, __file__, *sys.argv[1:]]
    if options.nobody:
        same.append(f"--seconds={UNTIL_KILLED_S}")
    sender = subprocess.Popen([*same, "--role=send"], stdout=subprocess.PIPE)
    try:
        if options.nobody:
            print(json.dumps(wait(options, node), indent=2))
            return
        receiver = subprocess.Popen([*same, "--role=receive"], stdout=subprocess.PIPE)
        operated = operate(sender, node)
        sent = json.loads(sender.communicate()[0])["sent"]
        received = json.loads(receiver.communicate()[0])
    finally:
        sender.kill()
        sender.wait()
        node.terminate()
        node.wait()
    result = {
        **summary(sent, received["got"]),
        "not_finite": received["not_finite"],
        "read_ms": received["read_ms"],
        **operated,
    }
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
