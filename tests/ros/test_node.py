"""`garment_node` as a process, with real rclpy on both sides."""

from __future__ import annotations

import itertools
import signal
import struct
from typing import TYPE_CHECKING

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="rclpy isn't installed (extra ros): the node isn't tested")

from harness import CHEAP, GARMENTS, NodeProcess, Peer, frame

from msg_adapters import encoder_for, vertices_from_points, vertices_ros_from_smpl
from refu_core import GarmentPipeline, PoseHistory

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

pytestmark = pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")


@pytest.fixture(scope="module")
def scene(ros: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Peer]:  # noqa: ARG001
    """A node for two persons, and its peer."""
    log = tmp_path_factory.mktemp("node") / "log.txt"
    parameters = {
        "persons": ["ann", "bob"],
        "input_type": "joint_state",
        "person_timeout": 2.0,
        "max_distance": 50,  # whole numbers will do for floats
        "lazy": False,
    }
    with NodeProcess(log, **parameters) as node:
        peer = Peer("ann", "bob")
        peer.wait_for_node()
        yield peer
        peer.close()
        assert node.process.poll() is None, node.log
        assert "Traceback" not in node.log


def test_garments_are_those_of_the_pipeline(scene: Peer) -> None:
    wanted, history = GarmentPipeline.load(GARMENTS), PoseHistory()
    for i in range(5):
        sent = frame(i, transl=(1.0, 2.0, 3.0))
        marker = scene.dress(sent, "ann")
        assert (marker.stamp_ns, marker.frame_id, marker.type) == (sent.stamp_ns, "map", 11)
        mesh = wanted(history(sent))[GARMENTS[0]]
        got = vertices_from_points(marker.points, mesh.faces)
        np.testing.assert_allclose(got, vertices_ros_from_smpl(mesh.vertices), atol=1e-5)


def test_everybody_in_the_scene_is_dressed(scene: Peer) -> None:
    for person in ("ann", "bob"):
        scene.dress(frame(20), person)
        assert scene.seen(frame(20).stamp_ns, f"{person}/{GARMENTS[1]}") is not None


def hostile() -> list[bytes]:
    good = encoder_for("joint_state")(frame(0))
    rng = np.random.default_rng(0)
    not_finite, labels = bytearray(good), good.replace(b"left_hip_x", b"left_hop_x")
    not_finite[-8 * 20 : -8 * 10] = struct.pack("<10d", *[np.nan] * 10)
    long = bytearray(good)
    long[12:16] = b"\xff\xff\xff\x7f"  # the length of a string
    return [
        *[rng.bytes(int(n)) for n in (5, 64, 5000)],
        b"\0\1\0\0" + rng.bytes(200),
        good[: len(good) // 2],
        bytes(not_finite),
        labels,
        bytes(long),
    ]


def test_bad_input_is_counted_and_harms_nobody(scene: Peer) -> None:
    before = scene.count("input", "dropped: invalid")
    sent = hostile()
    for i, data in enumerate(sent):
        scene.send_raw(data, "ann")
        scene.dress(frame(100 + i), "bob")
    scene.dress(frame(99), "ann")
    again = itertools.cycle(sent)

    def counted() -> bool:  # input is best effort: what was sent once may have been lost
        scene.send_raw(next(again), "ann")
        return scene.count("input", "dropped: invalid") > before + len(sent) // 2

    scene.spin_until(counted, "bad input is counted")
    assert all(np.isfinite(marker.points).all() for markers in scene.garments for marker in markers)


def test_ten_thousand_messages_at_once_leave_no_backlog(scene: Peer) -> None:
    """Half of them hostile: nothing is queued, what is bad is counted, and the next good frame is dressed."""
    received, invalid = scene.count("input", "received"), scene.count("input", "dropped: invalid")
    bad = hostile()
    encode = encoder_for("joint_state")
    burst = [encode(frame(i, stamp_ns=50 * 10**9 + i)) for i in range(50)]
    for i in range(10_000):
        scene.send_raw(bad[i // 2 % len(bad)] if i % 2 else burst[i // 2 % len(burst)], "ann")
    scene.garments.clear()
    marker = scene.dress(frame(3), "ann")
    assert marker.stamp_ns == frame(3).stamp_ns
    assert len(scene.garments) < 100
    assert all(np.isfinite(marker.points).all() for markers in scene.garments for marker in markers)

    def counted() -> bool:  # of a burst only the last message may have arrived, and it may have been a good one
        scene.send_raw(bad[0], "ann")
        return scene.count("input", "received") > received and scene.count("input", "dropped: invalid") > invalid

    scene.spin_until(counted, "what arrived and what was bad is counted")
    scene.dress(frame(4), "ann")


def test_parameters_change_while_frames_flow(scene: Peer) -> None:
    scene.dress(frame(30), "bob")
    both = {f"bob/{name}" for name in GARMENTS}
    assert both <= scene.shown()
    (result,) = scene.set(garments=[GARMENTS[0]])
    assert result.successful, result.reason

    def deleted() -> bool:
        scene.send(frame(31), "bob")
        return scene.shown() & both == {f"bob/{GARMENTS[0]}"}

    scene.spin_until(deleted, "the garment that isn't worn any more is taken out of the scene")
    (result,) = scene.set(frame_id="odom")
    assert result.successful
    assert scene.dress(frame(32), "bob").frame_id == "odom"
    results = scene.set(garments=list(GARMENTS), frame_id="map", max_rate=200, style=[1.0, 0.0, 0.0, 0.0])
    assert all(result.successful for result in results), results
    scene.set(style=[0.0] * 4)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("garments", ["cape"], "no garment 'cape'"),
        ("garments", ["tshirt-male", "skirt-female"], "garments of one body"),
        ("sdf", "magic", "wanted"),
        ("margin", 1.0, "range"),
        ("max_rate", "fast", "wanted a number"),
        ("betas", [1.0], "wanted a list of 10 numbers"),
        ("persons", ["eve"], "read-only"),
        ("record", "/proc/nowhere", "/proc/nowhere"),
    ],
)
def test_values_without_a_meaning_are_rejected_with_a_reason(
    scene: Peer, name: str, value: object, reason: str
) -> None:
    (result,) = scene.set(**{name: value})
    assert not result.successful
    assert reason in result.reason


def test_work_nobody_needs_is_skipped_and_counted(scene: Peer) -> None:
    def skipped(kind: str) -> int:
        return scene.count("garments", f"skipped: {kind}")

    unchanged, distance, unwatched = skipped("unchanged"), skipped("distance"), skipped("unwatched")
    stamps = itertools.count(90 * 10**9)

    def stands_still() -> bool:
        scene.dress(frame(7, stamp_ns=next(stamps)), "ann")  # the same pose at another time
        return skipped("unchanged") >= unchanged + 3

    scene.spin_until(stands_still, "unchanged frames are skipped")

    def is_far_away() -> bool:
        scene.send(frame(8, transl=(0.0, 0.0, 60.0)), "ann")
        return skipped("distance") > distance

    scene.spin_until(is_far_away, "who is too far away is skipped")
    scene.unwatch()

    def skips() -> bool:
        scene.send(frame(9), "ann")
        return skipped("unwatched") > unwatched

    scene.spin_until(skips, "what nobody watches is skipped")
    scene.watch()
    scene.dress(frame(9), "ann")


def test_who_leaves_is_taken_out_of_the_scene(scene: Peer) -> None:
    of_ann = {f"ann/{name}" for name in GARMENTS}

    def is_dressed() -> bool:
        scene.send(frame(40), "ann")
        return of_ann <= scene.shown()

    scene.spin_until(is_dressed, "she wears what she should")
    scene.spin_until(lambda: not of_ann & scene.shown(), "the garments of who has left are deleted")
    scene.spin_until(lambda: "ann" in scene.status("input")[1], "silence is reported")
    assert scene.status("input")[0] == 1


def test_a_bad_start_is_one_line(ros: None, tmp_path: Path) -> None:  # noqa: ARG001
    with NodeProcess(tmp_path / "log.txt", garments=["cape"]) as node:
        assert node.ends() == 2
        assert "no garment 'cape'" in node.log
        assert "Traceback" not in node.log


def test_a_quality_that_does_not_exist_is_one_line(ros: None, tmp_path: Path) -> None:  # noqa: ARG001
    with NodeProcess(
        tmp_path / "log.txt", **CHEAP, **{"qos_overrides./smpl_params.subscription.reliability": "magic"}
    ) as node:
        assert node.ends() == 2
        assert "can't be activated" in node.log
        assert "magic" in node.log
        assert "Traceback" not in node.log


def test_humans_come_and_go(ros: None, tmp_path: Path) -> None:  # noqa: ARG001
    peer = Peer("ann", "bob", topic="/humans/bodies/{}/joint_states")
    with NodeProcess(tmp_path / "log.txt", **CHEAP, follow_humans=True, person_timeout=0.5) as node:
        peer.wait_for_node()
        peer.dress(frame(1), "ann")
        peer.dress(frame(2), "bob")
        peer.fall_silent("ann")

        def left() -> bool:
            peer.send(frame(3), "bob")
            return peer.shown() == {f"bob/{GARMENTS[0]}"}

        peer.spin_until(left, "ann is taken out of the scene")
        peer.dress(frame(4), "bob")
        assert node.stop(signal.SIGINT) == 0, node.log
    peer.close()
