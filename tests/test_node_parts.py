"""The parts of the node that know nothing of ROS: settings, scene, recorder, inference thread, diagnostics."""

from __future__ import annotations

import contextlib
import os
import queue
import resource
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from msg_adapters import (
    BagError,
    BagReader,
    BagWriter,
    DecodeError,
    Doubts,
    InputStream,
    Marker,
    Placement,
    QosProfile,
    check_plausible,
    decode_marker_array,
)
from msg_adapters.axes import up_of_sender
from msg_adapters.bags import Recorder, RecorderState, RunningRecording, free_path, path_in
from msg_adapters.cdr import CdrReader, CdrWriter
from msg_adapters.outputs._topics import is_due
from msg_adapters.scene import Scene
from msg_adapters.statistics import Statistics
from refu_core import BodyError, FrameError, GarmentPipeline, MeshError, RefuError, SmplFrame, load_body
from refu_core.keypoints import Proportions, Skeleton, keypoint_layout
from refu_core.keypoints._pose import Pose
from refu_core.modes import FOREIGN_BETAS, ONE_STYLE
from refu_core.options import SettingsError, specs_of
from refu_core.outputs import Fittings
from refu_ros._beside import PipelineLoader, RequestDresser, load
from refu_ros._diagnostics import Situation, statuses
from refu_ros._program import PROFILES, SEGMENT_BYTES, make_room
from refu_ros._settings import NodeSettings, coerced
from refu_ros._worker import Worker
from tests.virtual_time import VirtualTime

TOPIC, TYPE = "/garments", "visualization_msgs/msg/MarkerArray"
KEYPOINT_POSES = "geometry_msgs/msg/PoseArray"
GARMENT = "short-pant-male"
Y = np.array([0.0, 1.0, 0.0])


def frame(angle: float = 0.0, *, stamp_ns: int = 1, transl: tuple[float, ...] = (0.0, 0.0, 0.0)) -> SmplFrame:
    pose = np.zeros((24, 3))
    pose[1, 0] = angle
    return SmplFrame(pose=pose, transl=np.array(transl), stamp_ns=stamp_ns)


# Settings -----------------------------------------------------------------------------------------


def test_every_parameter_is_described() -> None:
    specs = specs_of(NodeSettings)
    assert all(spec.description.endswith(".") for spec in specs.values())
    assert NodeSettings().changed({name: spec.default for name, spec in specs.items()}) == NodeSettings()


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"garments": []}, "at least one"),
        ({"garments": ["cape"]}, "no garment 'cape'"),
        ({"garments": ["tshirt-male", "skirt-female"]}, "one body"),
        ({"garments": "tshirt-male"}, "a list of strings"),
        ({"style": [0.0, float("nan"), 0.0, 0.0]}, "style: wanted"),
        ({"betas": [1.0]}, "a list of 10 numbers"),
        ({"max_rate": -1}, "max_rate: wanted 0 to"),
        ({"max_rate": True}, "a number"),
        ({"max_rate": 1e-300}, "max_rate: wanted 0, or 0.01"),
        ({"keypoint_rate": 1e-300}, "keypoint_rate: wanted 0, or 0.01"),
        ({"persons": ["a", "a"]}, "distinct"),
        ({"persons": ["a", ""]}, "without a name"),
        ({"persons": ["a/b"]}, "letters"),
        ({"follow_humans": True}, "joint_state"),
        ({"frame_id": ""}, "frame_id"),
        ({"input_axes": "ros"}, "smpl or frame"),
    ],
)
def test_settings_without_a_meaning(values: dict[str, Any], reason: str) -> None:
    with pytest.raises(SettingsError, match=reason):
        NodeSettings().changed(values)


def test_a_tilde_is_a_home_in_every_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Garments, `body` and `weights` weren't found below ~, and `bags` was."""
    monkeypatch.setenv("HOME", "/home/ann")
    paths = ("body", "betas_from", "weights", "record", "bags")
    assert coerced(NodeSettings, dict.fromkeys(paths, "~/x")) == dict.fromkeys(paths, "/home/ann/x")
    others = {"garments": ["tshirt-male", "~/x.npz"], "camera_info": "~/camera_info", "bags": "~no\0body/x"}
    wanted = {"garments": ("tshirt-male", "/home/ann/x.npz"), "camera_info": "~/camera_info", "bags": "~no\0body/x"}
    assert coerced(NodeSettings, others) == wanted


def test_whole_numbers_do_for_floats() -> None:
    settings = NodeSettings().changed({"max_rate": 30, "style": [1, 0, 0, 0], "use_sim_time": True})
    assert (settings.max_rate, settings.style) == (30.0, (1.0, 0.0, 0.0, 0.0))


# Scene --------------------------------------------------------------------------------------------


class Clock:
    """Time that the test moves."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@given(st.lists(st.sampled_from(["put a", "put b", "take"])))
def test_one_frame_may_wait_behind_another_and_who_is_later_starts_anew(events: list[str]) -> None:
    statistics = Statistics()
    scene = Scene(statistics, clock=Clock())
    waiting: dict[str, list[int]] = {}
    stale = 0
    for i, event in enumerate(events):
        if event == "take":
            taken = scene.take(timeout=0.0)
            assert {person: arrival.frame.stamp_ns for person, arrival in taken.items()} == {
                person: stamps[0] for person, stamps in waiting.items()
            }
            waiting = {person: stamps[1:] for person, stamps in waiting.items() if stamps[1:]}
        else:
            person = event[-1]
            known = waiting.get(person, [])
            stale += 2 * (len(known) == 2)
            waiting[person] = [i] if len(known) == 2 else [*known, i]
            scene.put(person, frame(stamp_ns=i))
    assert statistics.report().total["drop.stale"] == stale


def test_the_rate_limit_holds_frames_back_and_counts_them_apart() -> None:
    clock, statistics = Clock(), Statistics()
    scene = Scene(statistics, clock=clock)
    scene.put("", frame(stamp_ns=1))
    scene.put("", frame(stamp_ns=2))
    assert scene.take(not_before=5.0, timeout=0.0) == {}
    scene.put("", frame(stamp_ns=3))
    clock.now = 5.0
    assert scene.take(not_before=5.0, timeout=0.0)[""].frame.stamp_ns == 3
    assert scene.take(not_before=5.0, timeout=0.0) == {}
    assert statistics.report().group("skip") == {"max_rate": 2}
    assert not statistics.report().group("drop")


def test_who_is_silent_leaves_once() -> None:
    clock = Clock()
    scene = Scene(Statistics(), clock=clock)
    scene.put("a", frame())
    scene.take(timeout=0.0)
    clock.now = 1.0
    scene.put("b", frame())
    clock.now = 1.5
    assert scene.leave(1.0) == ["a"]
    assert scene.leave(1.0) == []
    assert scene.persons == ("b",)


@given(st.floats(0.3, 1.8), st.lists(st.floats(-0.1, 0.1), min_size=6, max_size=30))
def test_who_sends_seldom_stays_until_three_of_their_pauses_are_over(period: float, jitter: list[float]) -> None:
    clock = Clock()
    scene = Scene(Statistics(), clock=clock)
    gone = []
    for i, late in enumerate(jitter):
        before, clock.now = clock.now, 10 + (i + late) * period
        for now in np.linspace(before, clock.now, 8):
            clock.now = now
            gone += [i] * len(scene.leave(1.0))
        scene.put("ann", frame())
        scene.take(timeout=0.0)
    assert {*gone} <= {1}, "before the second frame nobody knows how seldom they come"
    clock.now += max(1.0, 2 * period)
    assert scene.leave(1.0) == []
    clock.now += max(0.1, 2 * period)
    assert scene.leave(1.0) == ["ann"]


def test_who_comes_again_after_a_while_is_soon_as_little_waited_for_as_before() -> None:
    clock = Clock()
    scene = Scene(Statistics(), clock=clock)
    for now in (0.0, 0.1, 1.9, 2.0, 2.1, 2.2, 50.0, 50.1):
        clock.now = now
        scene.put("ann", frame())
        scene.take(timeout=0.0)
        assert scene.leave(1.0) == []
    clock.now = 51.2
    assert scene.leave(1.0) == ["ann"]
    for i in range(1000):
        clock.now += 1.5
        scene.put(f"passer-by {i}", frame())
        scene.take(timeout=0.0)
        scene.leave(1.0)
    assert len(scene._came) <= 3


def test_more_people_than_there_is_room_for_are_left_out_and_counted() -> None:
    clock, statistics = Clock(), Statistics()
    scene = Scene(statistics, most=3, clock=clock)
    for round_ in range(3):  # whoever is here already stays
        for person in "abcde":
            scene.put(person, frame(stamp_ns=round_))
        assert [*scene.take(timeout=0.0)] == ["a", "b", "c"]
    clock.now = 2.0
    scene.leave(1.0)
    scene.put("e", frame())
    assert scene.persons == ("e",)
    assert "3 people are here already" in report_of(statistics)["input"].message


def test_a_frame_wakes_the_thread_that_waits() -> None:
    scene = Scene(Statistics())
    taken: list[Any] = []
    thread = threading.Thread(target=lambda: taken.append(scene.take(timeout=3600.0)), daemon=True)
    thread.start()
    scene.put("", frame(stamp_ns=7))
    thread.join(timeout=60.0)
    assert not thread.is_alive()
    assert taken[0][""].frame.stamp_ns == 7


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (SmplFrame(pose=np.full((24, 3), 5e3)), "pose"),
        (SmplFrame(pose=np.zeros((24, 3)), betas=np.full(10, 50.0)), "betas"),
        (SmplFrame(pose=np.zeros((24, 3)), style=np.full(4, 50.0)), "style"),
        (SmplFrame(pose=np.zeros((24, 3)), transl=np.full(3, 1e300)), "transl"),
        (SmplFrame(pose=np.zeros((24, 3)), stamp_ns=-1), "stamp"),
        (SmplFrame(pose=np.zeros((24, 3)), stamp_ns=2**63), "stamp"),
    ],
)
def test_numbers_no_body_has(bad: SmplFrame, reason: str) -> None:
    check_plausible(frame(3.0))
    with pytest.raises(FrameError, match=reason):
        check_plausible(bad)


# Recorder -----------------------------------------------------------------------------------------


def put(recorder: Recorder, i: int, data: bytes = b"\0\1\0\0data") -> None:
    recorder.put(TOPIC, TYPE, data, time_ns=i, qos=QosProfile())


def test_everything_queued_is_in_the_file(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "bag")
    for i in range(500):
        put(recorder, i)
    recorder.close()
    put(recorder, 500)  # too late, and no error
    with BagReader(tmp_path / "bag") as bag:
        assert [message.log_time_ns for message in bag.messages()] == list(range(500))
        assert not bag.truncated
    assert recorder.state().written == 500
    assert (tmp_path / "bag" / "metadata.yaml").is_file()


def test_a_recording_never_replaces_another(tmp_path: Path) -> None:
    paths = []
    for _ in range(3):
        recorder = Recorder(tmp_path / "bag")
        recorder.close()
        paths.append(recorder.path.name)
    assert paths == ["bag", "bag-1", "bag-2"]
    (tmp_path / "empty").mkdir()
    assert free_path(tmp_path / "empty") == tmp_path / "empty"


def test_recordings_that_begin_at_once_each_get_a_bag(tmp_path: Path) -> None:
    def record(turn: int) -> str:
        recorder = Recorder(tmp_path / f"{turn}" / "bag")
        recorder.close()
        return recorder.path.name

    for turn in range(20):
        with ThreadPoolExecutor(5) as pool:
            assert {*pool.map(record, [turn] * 5)} == {"bag", *(f"bag-{i}" for i in range(1, 5))}


def test_a_slow_disk_drops_and_never_blocks(tmp_path: Path) -> None:
    gate = threading.Event()

    class SlowBag(BagWriter):
        def write(self, *args: Any, **kwargs: Any) -> None:
            gate.wait()
            super().write(*args, **kwargs)

    recorder = Recorder(tmp_path / "bag", max_queued_bytes=1000, open_bag=SlowBag)
    for i in range(100):
        put(recorder, i, bytes(100))
    state = recorder.state()
    gate.set()
    recorder.close()
    assert 89 <= state.dropped <= 90  # ten fit, and one more if the writer had already taken one
    assert recorder.state().written == 100 - state.dropped


def test_a_full_disk_ends_the_recording_and_nothing_else(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    recorder = Recorder(tmp_path / "bag")
    noise = np.random.default_rng(0).bytes(300_000)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, hard))
        for i in range(100):
            put(recorder, i, noise)
            while recorder.state().queued > 3:
                time.sleep(0.001)
        recorder.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not recorder.running
    state = recorder.state()
    assert "can't be written" in state.error
    with BagReader(recorder.path / "bag_0.mcap") as bag:
        count = sum(1 for _ in bag.messages())
    assert 4 <= count == state.written
    assert state.dropped >= 1, "those of the chunk that did not fit, too"


@pytest.mark.parametrize("replaced", [False, True])
@pytest.mark.parametrize("sync_period", [0.02, 0.0])
def test_a_bag_that_is_taken_away_is_an_error(tmp_path: Path, sync_period: float, *, replaced: bool) -> None:
    """While it is written, or where the disk isn't waited for, as it is closed; nobody else's file is touched."""
    said: list[str] = []
    logger = SimpleNamespace(info=said.append, error=lambda text: said.append(f"ERROR {text}"))
    recording = RunningRecording(logger, sync_period=sync_period)
    recording.start(str(tmp_path / "bag"))
    recording.put("/t", "std_msgs/msg/Float32MultiArray", b"\0\1\0\0", QosProfile())
    file = tmp_path / "bag" / "bag_0.mcap"
    file.unlink()
    if replaced:
        file.write_bytes(b"another's")
    while sync_period and not recording.state()[1]:
        time.sleep(0.01)
    recording.close()
    words = "another file has taken its place" if replaced else "No such file"
    assert said[-1].startswith("ERROR ")
    assert words in said[-1]
    assert words in recording.state()[1]
    assert not replaced or file.read_bytes() == b"another's"
    recording.start(str(tmp_path / "next"))
    assert recording.state()[1] == ""
    recording.close()
    assert said[-1] == f"recorded 0 messages to {tmp_path / 'next'}"


def test_a_path_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(BagError, match="file"):
        Recorder(tmp_path / "file" / "bag")


# Inference thread ---------------------------------------------------------------------------------


class Viewer:
    """An outlet that keeps what it gets."""

    def __init__(self) -> None:
        self.watching = True
        self.body_watching = False
        self.others: set[str] = set()
        self.sent: list[tuple[str, bytes]] = []
        self.messages: list[list[Marker]] = []
        self.bodies: list[list[Marker]] = []

    def is_watched(self) -> bool:
        return bool(self.wanted())

    def wanted(self) -> set[str]:
        return {*["garments"] * self.watching, *["body"] * self.body_watching, *self.others}

    def watchers(self, topic: str) -> int:
        return int(topic in self.wanted())

    def now_ns(self) -> int:
        return 99

    def send(self, topic: str, data: bytes) -> None:
        if topic == "garments":
            self.messages.append(decode_marker_array(data))
        elif topic == "body":
            self.bodies.append(decode_marker_array(data))
        else:
            self.sent.append((topic, data))


class Setup:
    """A worker that the test ticks by hand."""

    def __init__(self, pipeline: Any, **settings: Any) -> None:
        self.clock = Clock()
        self.statistics = Statistics()
        self.scene = Scene(self.statistics, clock=self.clock)
        self.viewer = Viewer()
        settings = {"garments": [GARMENT], **settings}
        self.worker = Worker(
            self.scene,
            self.statistics,
            self.viewer,
            settings=NodeSettings().changed(settings),
            fittings=Fittings(pipeline),
        )

    def tick(self, **frames: SmplFrame) -> None:
        for person, sent in frames.items():
            self.scene.put(person, sent)
        self.worker.tick(lambda: self.scene.take(timeout=0.0))

    def total(self, key: str) -> int:
        return self.statistics.report().total[key]


@pytest.fixture(scope="module")
def pipeline() -> GarmentPipeline:
    return GarmentPipeline.load([GARMENT])


def test_a_tick_is_one_message_with_each_persons_stamp(pipeline: GarmentPipeline) -> None:
    setup = Setup(pipeline)
    setup.tick(ann=frame(stamp_ns=5), bob=frame(0.3, stamp_ns=6, transl=(0.0, 0.0, 2.0)))
    (markers,) = setup.viewer.messages
    assert [(marker.ns, marker.stamp_ns) for marker in markers] == [(f"ann/{GARMENT}", 5), (f"bob/{GARMENT}", 6)]
    assert markers[1].points[:, 0].mean() == pytest.approx(2.0, abs=0.3)  # SMPL's z is ROS's x


def test_a_message_is_laid_out_once_whoever_comes_first(pipeline: GarmentPipeline) -> None:
    setup = Setup(pipeline)
    setup.tick(ann=frame(), bob=frame())
    setup.tick(bob=frame(), ann=frame())
    assert [[m.ns.split("/")[0] for m in markers] for markers in setup.viewer.messages] == [["ann", "bob"]] * 2


def test_unchanged_frames_cost_no_inference_but_move(pipeline: GarmentPipeline) -> None:
    setup = Setup(pipeline)
    setup.tick(ann=frame(stamp_ns=1))
    setup.tick(ann=frame(stamp_ns=2, transl=(1.0, 0.0, 0.0)))
    (first,), (second,) = setup.viewer.messages
    assert (second.stamp_ns, setup.total("skip.unchanged")) == (2, 1)
    np.testing.assert_allclose(second.points, first.points + np.array([0.0, 1.0, 0.0]), atol=1e-12)


def test_a_camera_that_turns_swings_no_skirt() -> None:
    setup = Setup(GarmentPipeline.load(["skirt-female"]), garments=["skirt-female"], input_axes="frame")
    stands, found = frame().pose, []
    for step in range(20):
        camera = Placement(
            Rotation.from_rotvec([0.02 * step, 0.05 * step, 0]).as_matrix(), np.array([0.1 * step, 0, 1])
        )
        seen = camera.inverse()
        pose = stands.copy()
        pose[0] = Rotation.from_matrix(seen.rotation @ Rotation.from_rotvec(stands[0]).as_matrix()).as_rotvec()
        pelvis = setup.worker.fittings.pipeline.body.rest_joints(torch.zeros(1, 10))[0, 0].double().numpy()
        transl = seen.rotation @ (pelvis + 3 * np.eye(3)[2]) + seen.translation - pelvis
        there = SmplFrame(pose=pose, transl=transl, stamp_ns=1 + step * 33_000_000, up=seen.rotation[:, 1])
        setup.scene.put("ann", there, camera)
        setup.worker.tick(lambda: setup.scene.take(timeout=0.0))
        found.append(setup.viewer.messages[-1][0].points)
    assert np.abs(np.array(found) - found[0]).max() < 1e-5


def test_cloth_comes_to_rest_after_the_pose_has() -> None:
    skirt, still = (GarmentPipeline.load(["skirt-female"], backbone=name) for name in ("auto", "tailornet"))
    setup, at_rest = (Setup(one, garments=["skirt-female"]) for one in (skirt, still))
    angles = [*np.linspace(0, 0.6, 8), *[0.6] * 20]  # a leg is lifted in a quarter of a second, and held
    for i, angle in enumerate(angles):
        setup.tick(ann=frame(angle, stamp_ns=1 + i * 10**9 // 30))
    points = [markers[0].points for markers in setup.viewer.messages]
    assert len(points) == len(angles)
    assert 1 <= setup.total("skip.unchanged") <= 3  # after 16 frames nothing of the past is left
    moved = [np.linalg.norm(after - before, axis=1).max() for before, after in pairwise(points)]
    assert moved[8] > 1e-3  # the pose was the same
    at_rest.tick(ann=frame(0.6))
    np.testing.assert_allclose(points[-1], at_rest.viewer.messages[0][0].points, atol=1e-5)


def test_a_frame_that_comes_after_a_newer_one_stops_no_skirt() -> None:
    """A frame that came 0.1 s late took the motion from the next: vertices jumped by up to 74 mm."""
    skirt = GarmentPipeline.load(["skirt-female"], sdf="none", collider=False)
    found = []
    for order in (range(10), (0, 1, 2, 3, 4, 5, 7, 8, 6, 9)):
        setup = Setup(skirt, garments=["skirt-female"])
        for i in order:
            setup.tick(ann=frame(0.1 * i, stamp_ns=10**9 + i * 10**9 // 15))
        found.append(setup.viewer.messages[-1][0].points)
        stamps = [markers[0].stamp_ns for markers in setup.viewer.messages]
        assert stamps == sorted(stamps)
    assert setup.total("skip.late") == setup.total("back_in_time") == 1
    assert np.linalg.norm(found[1] - found[0], axis=1).max() < 0.01


@pytest.mark.parametrize("changed", [{"input_axes": "frame"}, {"frame_id": "odom"}])
def test_who_is_described_anew_has_not_moved(changed: dict[str, Any]) -> None:
    """Somebody who stands still while a parameter of frames is set, at a rate at which people turn as far."""
    setup = Setup(GarmentPipeline.load(["skirt-female"], sdf="none", collider=False), garments=["skirt-female"])
    placement = Placement()
    for i in range(8):
        if i == 4:
            setup.worker.settings = setup.worker.settings.changed(changed)
            if "frame_id" in changed:
                placement = Placement(Rotation.from_euler("z", 90, degrees=True).as_matrix(), np.ones(3))
        setup.scene.put("ann", frame(1e-6 * i, stamp_ns=(1 + i) * 10**9 // 4), placement)
        setup.tick()
    points = [markers[0].points for markers in setup.viewer.messages]
    for before, now in pairwise(points[4:]):
        np.testing.assert_allclose(now, before, atol=1e-4)


@pytest.mark.parametrize(("x", "level"), [(8000.0, 0), (5.4e6, 1), (-9000.0, 1)])
def test_coordinates_too_large_for_points_are_warned_of(pipeline: GarmentPipeline, x: float, level: int) -> None:
    setup = Setup(pipeline)
    setup.tick(ann=frame(transl=(x, 1.0, 0.0)))
    status = report_of(setup.statistics)["garments"]
    assert (status.level, "use a local frame_id" in status.message) == (level, bool(level))


def test_nothing_is_done_for_nobody(pipeline: GarmentPipeline) -> None:
    setup = Setup(pipeline)
    setup.viewer.watching = False
    setup.tick(ann=frame())
    assert not setup.viewer.messages
    assert setup.total("skip.unwatched") == 1
    setup.viewer.body_watching = True
    setup.tick(ann=frame())
    assert [marker.ns for marker in setup.viewer.bodies[0]] == ["ann/body"]


def test_who_goes_away_is_deleted(pipeline: GarmentPipeline) -> None:
    setup = Setup(pipeline, max_distance=10.0, person_timeout=1.0)
    setup.tick(ann=frame(), bob=frame())
    setup.tick(ann=frame(transl=(0.0, 0.0, 11.0)))
    assert [(m.ns, m.action) for m in setup.viewer.messages[-1]] == [(f"ann/{GARMENT}", 2)]
    setup.clock.now = 2.0
    setup.tick()
    assert [(m.ns, m.action, m.stamp_ns) for m in setup.viewer.messages[-1]] == [(f"bob/{GARMENT}", 2, 99)]
    count = len(setup.viewer.messages)
    setup.worker.stop()
    assert len(setup.viewer.messages) == count  # nobody is left to delete


@pytest.mark.parametrize("y", [-3.0, 3.0])
def test_who_is_near_is_so_in_the_frame_of_the_messages(pipeline: GarmentPipeline, y: float) -> None:
    setup = Setup(pipeline, max_distance=4.3)
    mocap = Placement(translation=np.array([3.0, 0.0, 0.0]))
    setup.scene.put("ann", frame(transl=(y, 0.0, 0.0)), mocap)  # SMPL's x is ROS's y: 4.2 m away on either side
    setup.scene.put("bob", frame(transl=(0.0, 0.0, 1.5 * y / 3.0)), mocap)
    setup.tick()
    near = {f"ann/{GARMENT}", *[f"bob/{GARMENT}"] * (y < 0)}
    assert {marker.ns for marker in setup.viewer.messages[0]} == near


def test_a_pipeline_is_swapped_between_ticks(pipeline: GarmentPipeline) -> None:
    setup = Setup(pipeline)
    setup.tick(ann=frame(stamp_ns=1))
    setup.worker.fittings = Fittings(GarmentPipeline.load(["tshirt-male"]))
    setup.tick(ann=frame(stamp_ns=2))
    added, deleted = setup.viewer.messages[1:]
    assert [(m.ns, m.action) for m in added] == [("ann/tshirt-male", 0)]
    assert [(m.ns, m.action) for m in deleted] == [(f"ann/{GARMENT}", 2)]


def test_parameters_replace_shape_and_style(pipeline: GarmentPipeline) -> None:
    setup = Setup(pipeline, betas_source="fixed", betas=[2.0] + [0.0] * 9, style=[1.0, 0.0, 0.0, 0.0])
    setup.tick(ann=frame())
    wanted = SmplFrame(np.zeros((24, 3)), betas=np.eye(10)[0] * 2, style=np.eye(4)[0])
    mesh = pipeline(wanted)[GARMENT]
    np.testing.assert_allclose(setup.viewer.messages[0][0].points, mesh.vertices[mesh.faces.ravel()][:, [2, 0, 1]])


def test_the_margin_needs_no_other_pipeline() -> None:
    setup = Setup(GarmentPipeline.load([GARMENT]), margin=0.02)
    setup.tick(ann=frame())
    mesh = GarmentPipeline.load([GARMENT], margin=0.02)(frame())[GARMENT]
    np.testing.assert_allclose(setup.viewer.messages[0][0].points, mesh.vertices[mesh.faces.ravel()][:, [2, 0, 1]])
    setup.worker.settings = setup.worker.settings.changed({"margin": 0.0})
    setup.tick(ann=frame())
    assert not np.allclose(setup.viewer.messages[1][0].points, setup.viewer.messages[0][0].points)


class Choosy:
    """A pipeline that fails for some poses."""

    def __init__(self, pipeline: GarmentPipeline) -> None:
        self._pipeline = pipeline
        self.body, self.garments = pipeline.body, pipeline.garments
        self.untrained = pipeline.untrained
        self.threads = pipeline.threads
        self.heeds_past = pipeline.heeds_past

    def __call__(self, frames: list[SmplFrame], *, margin: float | None) -> list[Any]:
        if any(frame.pose[1, 0] > 1 for frame in frames):
            msg = "not this pose"
            raise ValueError(msg)
        return self._pipeline(frames, margin=margin)


def test_one_persons_failure_is_nobody_elses(pipeline: GarmentPipeline) -> None:
    setup = Setup(Choosy(pipeline))
    setup.tick(ann=frame(2.0), bob=frame(0.5), eve=frame(0.2))
    assert [marker.ns for marker in setup.viewer.messages[0]] == [f"bob/{GARMENT}", f"eve/{GARMENT}"]
    assert setup.total("drop.failed") == 1
    setup.tick(ann=frame(0.1))
    assert [marker.ns for marker in setup.viewer.messages[1]] == [f"ann/{GARMENT}"]


def test_the_rate_limit(pipeline: GarmentPipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    """A message each 50 ms, with the newest frame of those that come each 4.9 ms."""
    time = VirtualTime()
    time.rules("msg_adapters.scene", monkeypatch)
    monkeypatch.setattr("refu_ros._worker.time", time)
    began: list[tuple[float, int]] = []

    class Slow(Choosy):
        def __call__(self, frames: list[SmplFrame], *, margin: float | None) -> list[Any]:
            began.append((time.now, frames[0].stamp_ns))
            time.sleep(0.002)
            return super().__call__(frames, margin=margin)

    statistics, viewer = Statistics(), Viewer()
    scene = Scene(statistics, clock=time.monotonic)
    settings = NodeSettings().changed({"garments": [GARMENT], "max_rate": 20})
    worker = Worker(scene, statistics, viewer, settings=settings, fittings=Fittings(Slow(pipeline)))  # type: ignore[arg-type]
    for i in range(100):
        time.at(0.0049 * i, lambda i=i: scene.put("", frame(0.001 * i, stamp_ns=i)))
    time.at(0.49, worker._stopping.set)
    time.at(0.49, scene.wake)
    worker._run()
    moments, stamps = zip(*began, strict=True)
    np.testing.assert_allclose(moments, 0.05 * np.arange(10), atol=1e-9)
    assert stamps == tuple(int(moment / 0.0049) for moment in 0.05 * np.arange(10))
    assert len([markers for markers in viewer.messages if markers[0].action == 0]) == 10
    total = statistics.report().total
    assert (total["skip.max_rate"], total["drop.stale"]) == (100 - 10 - 1, 0)  # the last one waits


class Uneven(Choosy):
    """A pipeline of two threads whose first call ends after its second one."""

    def __init__(self, pipeline: GarmentPipeline, *, fails: bool) -> None:
        super().__init__(pipeline)
        self.threads, self.fails = 2, fails
        self.began: list[int] = []
        self.first_began, self.second_ended = threading.Event(), threading.Event()

    def __call__(self, frames: list[SmplFrame], *, margin: float | None) -> list[Any]:
        self.began.append(frames[0].stamp_ns)
        if frames[0].stamp_ns == 1:
            self.first_began.set()
            assert self.second_ended.wait(60)
            if self.fails:
                raise MemoryError
        outputs = super().__call__(frames, margin=margin)
        if frames[0].stamp_ns == 2:
            self.second_ended.set()
        return outputs


@pytest.mark.parametrize("fails", [False, True])
def test_threads_send_in_the_order_in_which_frames_came(pipeline: GarmentPipeline, *, fails: bool) -> None:
    uneven, statistics, viewer = Uneven(pipeline, fails=fails), Statistics(), Viewer()
    scene = Scene(statistics)
    settings = NodeSettings(garments=(GARMENT,), threads=3)
    worker = Worker(scene, statistics, viewer, settings=settings, fittings=Fittings(uneven))  # type: ignore[arg-type]
    worker.start()
    scene.put("", frame(0.1, stamp_ns=1))
    assert uneven.first_began.wait(60)
    scene.put("", frame(0.2, stamp_ns=2))
    assert uneven.second_ended.wait(60), "it was worked on beside the first"
    worker.stop()
    sent = [markers[0].stamp_ns for markers in viewer.messages if markers[0].action == 0]
    assert sent == ([2] if fails else [1, 2])
    assert uneven.began == [1, 2]
    assert statistics.report().total["drop.failed"] == int(fails)


def test_no_more_is_taken_than_the_pipeline_has_threads(pipeline: GarmentPipeline) -> None:
    """What waits to be computed is replaced by what is newer, as long as nobody has taken it."""
    began, may_end = threading.Event(), threading.Event()

    class Waiting(Choosy):
        def __call__(self, frames: list[SmplFrame], *, margin: float | None) -> list[Any]:
            began.set()
            assert may_end.wait(60)
            return super().__call__(frames, margin=margin)

    statistics, viewer = Statistics(), Viewer()
    scene = Scene(statistics)
    settings = NodeSettings(garments=(GARMENT,), threads=3)
    worker = Worker(scene, statistics, viewer, settings=settings, fittings=Fittings(Waiting(pipeline)))  # type: ignore[arg-type]
    worker.start()
    scene.put("", frame(0.1, stamp_ns=1))
    assert began.wait(60)
    for i in range(2, 5):
        scene.put("", frame(0.1 * i, stamp_ns=i))
    assert statistics.report().total["drop.stale"] == 2
    may_end.set()
    for _ in range(600):
        if sum(markers[0].action == 0 for markers in viewer.messages) == 2:
            break
        time.sleep(0.1)
    worker.stop()
    assert [markers[0].stamp_ns for markers in viewer.messages if markers[0].action == 0] == [1, 4]


# Loader -------------------------------------------------------------------------------------------


def test_what_cannot_be_loaded_is_reported() -> None:
    came: list[Any] = []
    loader = PipelineLoader(lambda _, key: came.append(key), lambda error, _: came.append(error), threads=1)
    missing = NodeSettings(garments=(GARMENT,), device="nonsense").pipeline
    good = NodeSettings(garments=(GARMENT,)).pipeline
    for i, key in enumerate((missing, good)):
        loader.request(key)
        end = time.monotonic() + 120
        while len(came) <= i and time.monotonic() < end:
            time.sleep(0.01)
    loader.close()
    assert "nonsense" in str(came[0])
    assert came[1] == good


def test_what_cannot_be_taken_over_is_reported() -> None:
    def use(_fittings: object, _key: object) -> None:
        msg = "no room for it"
        raise RuntimeError(msg)

    said = queue.SimpleQueue[Exception]()
    loader = PipelineLoader(use, lambda error, _: said.put(error), threads=1)
    loader.request(NodeSettings(garments=(GARMENT,), backbone="skinned", sdf="none").pipeline)
    assert "no room for it" in str(said.get(timeout=120))
    loader.close()


# Diagnostics --------------------------------------------------------------------------------------


def report_of(
    statistics: Statistics,
    recording: RecorderState | None = None,
    *,
    persons: tuple[str, ...] = ("",),
    given: Sequence[str] = ("",),
    has_foreign_betas: bool = False,
    input_frame: str = "",
    is_untransformed: bool = False,
    **settings: Any,
) -> dict[str, Any]:
    now = Situation(
        node="n",
        state="active",
        persons=persons,
        recording=recording,
        recording_error=recording.error if recording else "",
        has_foreign_betas=has_foreign_betas,
        input_frame=input_frame,
        is_untransformed=is_untransformed,
    )
    found = statuses(statistics.report(), NodeSettings().changed({"persons": [*given], **settings}), now)
    return {status.name.removeprefix("n: "): status for status in found}


def test_messages_with_nobody_in_them_are_no_silence() -> None:
    statistics = Statistics()
    statistics.receive()
    assert report_of(statistics, persons=())["input"].message == "nobody is here, though 1 messages came"
    assert report_of(statistics, persons=())["input"].message.startswith("no input for")


def test_people_whom_nobody_watches_are_not_missed() -> None:
    statistics = Statistics()
    statistics.receive()
    statistics.count("skip.unwatched")
    assert report_of(statistics, persons=())["input"].level == 0


@pytest.mark.parametrize(
    ("given", "persons", "message"),
    [
        ([""], ("ann", "bob"), "0.0 Hz"),
        ([""], (), "no input for"),
        (["left", "right"], ("left_ann", "right_ann"), "0.0 Hz"),
        (["left", "right"], ("left_ann", "bright_ann"), "no input from right"),
    ],
)
def test_people_in_markers_have_names_of_their_own(given: list[str], persons: tuple[str, ...], message: str) -> None:
    statistics = Statistics()
    statistics.receive()
    report_of(statistics)
    status = report_of(statistics, persons=persons, given=given, input_type="keypoint_markers")["input"]
    assert (status.level, status.message[: len(message)]) == (int(message != "0.0 Hz"), message)


def test_levels_mean_something(tmp_path: Path) -> None:
    statistics = Statistics()
    assert (report_of(statistics)["input"].level, report_of(statistics)["input"].message) == (1, "no input yet")
    statistics.receive()
    statistics.publish([10.0], found=5, unresolved=2)
    fine = report_of(statistics)
    assert [fine[part].level for part in ("input", "garments", "recording")] == [0, 0, 0]
    assert fine["garments"].values["penetrating vertices resolved"] == "3"
    for largest in (0.001, 0.0123, 0.002):
        statistics.shift(largest)
    shift = "skin moved by the collider, at most [mm]"
    assert report_of(statistics)["garments"].values[shift] == "12.3"
    assert report_of(statistics)["garments"].values[shift] == "0.0", "since the last report"
    statistics.receive()
    statistics.drop("invalid", "no pose in it")
    only_bad = report_of(statistics)["input"]
    assert only_bad.level == 2
    assert "no pose in it" in only_bad.message
    for i in range(10):
        statistics.receive()
        statistics.drop("invalid" if i % 2 else "stale", "no pose in it")
    mixed = report_of(statistics)
    assert (mixed["input"].level, mixed["garments"].level) == (1, 1)
    assert "over budget" in mixed["garments"].message
    statistics.set_error("no weights")
    assert (report_of(statistics)["garments"].level, report_of(statistics)["garments"].message) == (2, "no weights")
    for level, state in (
        (0, RecorderState(tmp_path, 1, 0, 0, 10, 10**12, "")),
        (1, RecorderState(tmp_path, 1, 0, 3, 10, 10**12, "")),
        (1, RecorderState(tmp_path, 1, 0, 0, 10, 10**6, "")),
        (2, RecorderState(tmp_path, 1, 0, 0, 10, 10**12, "no space left")),
    ):
        assert report_of(statistics, recording=state)["recording"].level == level


# Transport ----------------------------------------------------------------------------------------

_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS")


@pytest.fixture
def unconfigured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Fast DDS as installed, and room in shared memory; returns the working folder."""
    for name in _VARIABLES:
        monkeypatch.setenv(name, "")  # what `make_room` sets goes with the test
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=SEGMENT_BYTES + 1))  # noqa: ARG005
    return tmp_path


def test_fast_dds_gets_room_for_meshes(unconfigured: Path) -> None:  # noqa: ARG001
    assert make_room()
    assert Path(os.environ["FASTRTPS_DEFAULT_PROFILES_FILE"]) == PROFILES
    name = "{http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles}segment_size"
    assert [int(size.text or 0) for size in ET.parse(PROFILES).iter(name)] == [SEGMENT_BYTES]


@pytest.mark.parametrize("variable", _VARIABLES)
def test_who_configured_fast_dds_keeps_that(
    unconfigured: Path,  # noqa: ARG001
    monkeypatch: pytest.MonkeyPatch,
    variable: str,
) -> None:
    monkeypatch.setenv(variable, "mine")
    assert not make_room()
    assert os.environ[variable] == "mine"


def test_a_profile_in_the_folder_counts_too(unconfigured: Path) -> None:
    (unconfigured / "DEFAULT_FASTRTPS_PROFILES.xml").write_text("<profiles/>")
    assert not make_room()


@pytest.mark.parametrize("free", [0, SEGMENT_BYTES, None])
def test_without_room_everything_stays_as_it_is(
    unconfigured: Path,  # noqa: ARG001
    monkeypatch: pytest.MonkeyPatch,
    free: int | None,
) -> None:
    def usage(path: str) -> SimpleNamespace:
        if free is None:
            raise FileNotFoundError(path)
        return SimpleNamespace(free=free)

    monkeypatch.setattr("shutil.disk_usage", usage)
    assert not make_room()


@pytest.mark.parametrize("how", ["body", "betas_from"])
def test_who_wears_the_garments_is_a_parameter_that_needs_another_pipeline(how: str) -> None:
    two = {"garments": ["short-pant-male", "skirt-female"], "backbone": "skinned", "sdf": "none", "collider": False}
    with pytest.raises(SettingsError, match="garments of one body"):
        NodeSettings().changed(two)
    asked = NodeSettings().changed({**two, how: "neutral"})
    assert " on neutral " in str(asked.pipeline)
    assert load(asked.pipeline).pipeline.body.name == "neutral"
    assert asked.betas_are_told
    missing = asked.changed({"body": "", "betas_from": "", "garments": ["short-pant-male"], how: "/none/SMPL.pkl"})
    with pytest.raises(BodyError, match=r"/none/SMPL\.pkl: can't be read"):
        load(missing.pipeline)


def test_a_clock_that_never_came_and_doubted_input_are_warned_of() -> None:
    statistics = Statistics()
    statistics.receive()
    doubts: dict[str, Any] = {"has_no_clock": True, "doubted": "degrees?"}
    now = Situation(node="n", state="active", persons=("",), recording=None, recording_error="", **doubts)
    found = {one.name: one for one in statuses(statistics.report(), NodeSettings(), now)}
    assert (found["n: node"].level, found["n: input"].level) == (1, 1)
    assert "no /clock has come" in found["n: node"].message
    assert found["n: input"].message == "degrees?"


def test_a_message_that_came_before_the_report_and_was_refused_after_it_makes_sense() -> None:
    statistics = Statistics()
    statistics.receive()
    report_of(statistics)
    statistics.drop("invalid", "it is damaged")
    status = report_of(statistics)["input"]
    assert (status.level, status.message) == (2, "every message is invalid: it is damaged")
    statistics.receive()
    statistics.receive()
    statistics.drop("invalid", "it is damaged")
    assert report_of(statistics)["input"].message == "1 of 2 messages are invalid: it is damaged"


def test_betas_of_unknown_meaning_are_warned_of() -> None:
    statistics = Statistics()
    statistics.receive()
    assert report_of(statistics, has_foreign_betas=False)["input"].level == 0
    status = report_of(statistics, has_foreign_betas=True)["input"]
    assert (status.level, status.message) == (1, FOREIGN_BETAS)
    for source in ("message", "builtin", "fixed"):
        assert NodeSettings().changed({"betas_source": source}).betas_are_told is (source != "message")


@pytest.mark.parametrize(("root", "words"), [((0.0, 1.0, 0.0), ""), ((np.pi / 2, 0.0, 0.0), "towards +z")])
def test_people_who_lie_are_warned_of_once(root: tuple[float, ...], words: str) -> None:
    """Of a sender whose z is up, everybody lies; who turns round stands."""
    settings, doubts = NodeSettings(), Doubts()
    pose = np.zeros((24, 3), np.float32)
    pose[0] = root
    said = [doubt for _ in range(300) for doubt in doubts.of("", SmplFrame(pose), settings, up=Y)]
    assert len(said) == bool(words) + 1  # who has no stamps is told, too
    assert words in "".join(said)
    frames = [SmplFrame(pose, stamp_ns=i * 10**8) for i in range(300)]
    of_frame = Doubts()  # which way is up isn't known
    assert not any(of_frame.of("", frame, settings, up=None) for frame in frames)


@pytest.mark.parametrize(
    ("frame_id", "root", "words"),
    [
        ("map", [np.pi, 0, 0], "towards -y: input_axes is frame, and frame_id has z up"),
        ("camera", [np.pi, 0, 0], "towards -y: input_axes is frame, and frame_id has z up"),
        ("camera_optical", [0, 0, 0], "towards +y: input_axes is frame, and frame_id has -y up"),
        ("camera_optical", [np.pi, 0, 0], ""),
        ("map", [np.pi / 2, 0, 0], ""),
    ],
)
def test_people_whose_heads_arent_where_their_frame_has_up_are_warned_of(
    frame_id: str, root: list[float], words: str
) -> None:
    """Cloth would hang sideways."""
    doubts, pose = Doubts(), np.zeros((24, 3))
    pose[0] = root
    up = up_of_sender("frame", frame_id, np.eye(3))
    said = [
        doubt for i in range(200) for doubt in doubts.of("", SmplFrame(pose, stamp_ns=i * 10**8), NodeSettings(), up=up)
    ]
    assert len(said) == bool(words)
    assert words in "".join(said)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (lambda _: {"pose": np.full((24, 3), 40.0)}, "wanted radians: degrees?"),
        (lambda i: {"transl": [i * 5.0, 0, 0]}, "two senders on one topic?"),
        (lambda i: {"transl": [i % 2, 0, 0]}, "two senders on one topic?"),
        (lambda _: {"stamp_ns": 5}, "stamps don't advance in 99 of 100 frames"),
        (lambda i: {"stamp_ns": 10**18 - i * 10**8}, "stamps don't advance in 99 of 100 frames"),
        (lambda i: {"stamp_ns": i * 10**11}, "frames are 1e+02 s apart by their stamps"),
        (lambda i: {"stamp_ns": i * 10**5}, "frames are 0.0001 s apart by their stamps"),
    ],
)
def test_numbers_in_other_units_are_doubted(changed: Callable[[int], Any], words: str) -> None:
    doubts = Doubts()
    said = []
    for i in range(250):
        frame = SmplFrame(**{"pose": np.zeros((24, 3)), "stamp_ns": 10**18 + i * 10**8 // 3} | changed(i))
        said += doubts.of("ann", frame, NodeSettings(), up=Y)
    assert len(said) == 1
    assert words in said[0]
    assert doubts.of_senders["ann"] == said[0]
    doubts.forget("ann")
    assert not doubts.of_senders
    assert not doubts._tracks


def test_a_style_that_a_garment_has_no_ear_for_is_told_once() -> None:
    styled = SmplFrame(np.zeros((24, 3), np.float32), style=np.ones(4))
    doubts, settings = Doubts(), NodeSettings().changed({"garments": ["tshirt-female", "skirt-female"]})
    said = [doubts.of("", styled, settings, up=Y) for _ in range(2)]
    assert said == [[ONE_STYLE.format("tshirt-female")], []]
    assert Doubts().of("", styled, NodeSettings(), up=Y) == []


@pytest.mark.parametrize("collider", [True, False])
def test_the_collider_is_a_parameter_that_needs_another_pipeline(collider: bool) -> None:
    plain = NodeSettings().changed({"garments": ["short-pant-male"], "backbone": "skinned", "sdf": "none"})
    asked = plain.changed({"collider": collider})
    assert plain.collider
    assert (asked.pipeline == plain.pipeline) is collider
    assert ("no collider" in str(asked.pipeline)) is not collider
    assert (load(asked.pipeline).pipeline.outfit.collider is not None) is collider
    with pytest.raises(SettingsError, match="true or false"):
        plain.changed({"collider": "yes"})


# Keypoints ----------------------------------------------------------------------------------------


def test_keypoints_are_followed_from_message_to_frames() -> None:
    settings = NodeSettings(input_type="keypoint_poses", keypoints="coco17", keypoint_rate=30.0)
    assert (settings.axes, settings.known_betas) == ("frame", None)
    decoder, body = InputStream(settings.input_type), load_body("male")
    assert (decoder.message_type, decoder.is_of_keypoints, decoder.predicted(0)) == (KEYPOINT_POSES, True, {})
    decoder.follow(body, "coco17", betas=None, smoothing=1.0)
    bones = Skeleton(keypoint_layout("coco17"), Proportions.of_body(body))
    turns = np.tile(np.eye(3), (24, 1, 1))

    def message(stamp_ns: int, x: float) -> bytes:
        points = bones.posed(Pose(np.array([x, 1.0, 0.0]), turns, np.zeros(10))).points
        cdr = CdrWriter()
        cdr.fields("Ts", stamp_ns, "camera")
        cdr.fields("I", len(points))
        cdr.array("f8", np.pad(points, ((0, 0), (0, 4))))
        return cdr.to_bytes()

    for i in range(10):
        data, now_ns = message(10**9 + i * 33_333_333, 0.05 * i), 5 * 10**9 + i * 33_333_333
        frames, frame_ids = decoder.frames(data, now_ns, sender="ann")
    assert (list(frames), frame_ids) == (["ann"], {"ann": "camera"})
    now = 5 * 10**9 + 9 * 33_333_333
    held, ahead = decoder.predicted(now)["ann"], decoder.predicted(now + 66_666_666)["ann"]
    assert 0.05 < ahead.transl[0] - held.transl[0] < 0.11  # goes on at 1.5 m/s, and dies away
    assert ahead.stamp_ns - held.stamp_ns == 66_666_666
    assert decoder.predicted(now + 10**9) == {}
    with pytest.raises(DecodeError, match="wanted 17 poses"):
        decoder.frames(_of_ones(33), 0, sender="ann")
    decoder.follow(body, "coco17", betas=None, smoothing=1.0)  # the same settings
    assert decoder.predicted(now) != {}
    decoder.follow(body, "coco17", betas=(0.0,) * 10, smoothing=1.0)  # other settings: everybody begins anew
    assert decoder.predicted(now) == {}


def _of_ones(n: int) -> bytes:
    cdr = CdrWriter()
    cdr.fields("Ts", 1, "camera")
    cdr.fields("I", n)
    cdr.array("f8", np.ones((n, 7)))
    return cdr.to_bytes()


# Outputs ------------------------------------------------------------------------------------------


def test_each_output_comes_where_it_is_wanted_and_leaves_with_its_person(pipeline: GarmentPipeline) -> None:
    setup = Setup(pipeline, person_timeout=1.0)
    setup.viewer.watching = False
    setup.viewer.others = {"ann/points", "openings", "bob/openings/short_pant_male/waist"}
    setup.tick(ann=frame(stamp_ns=5), bob=frame(0.3, stamp_ns=6))
    sent = dict(setup.viewer.sent)
    assert len(sent) == len(setup.viewer.sent)
    assert set(sent) == setup.viewer.others
    stamp_ns, _, _, n_points = CdrReader(sent["ann/points"]).fields("TsII")
    assert (n_points, stamp_ns) == (pipeline.garments[GARMENT].n_vertices, 5)
    names = {f"{person}/{GARMENT}/{name}" for person in ("ann", "bob") for name in ("waist", "left_leg", "right_leg")}
    assert {marker.ns for marker in decode_marker_array(sent["openings"])} == names
    setup.viewer.sent.clear()
    setup.clock.now = 2.0
    setup.tick()
    ((topic, data),) = setup.viewer.sent
    assert topic == "openings"
    assert {(marker.ns, marker.action) for marker in decode_marker_array(data)} == {(name, 2) for name in names}


def test_one_outputs_failure_is_no_others(pipeline: GarmentPipeline, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: Any) -> None:
        msg = "no openings today"
        raise MeshError(msg)

    monkeypatch.setattr("refu_core.outputs.Openings.frames", fails)
    setup = Setup(pipeline)
    setup.viewer.others = {"openings", "points"}
    setup.tick(**{"": frame()})
    assert len(setup.viewer.messages) == 1
    assert [topic for topic, _ in setup.viewer.sent] == ["points"]
    assert "no openings today" in setup.statistics.report().reasons["not_finite"]


def test_obstacles_are_whole_whoever_hears_them(pipeline: GarmentPipeline) -> None:
    """Nobody has to have heard what came before: a planner may have been started anew between two messages."""
    setup = Setup(pipeline, planner_rate=0.0)
    fittings = setup.worker.fittings
    while not fittings.has_planner(GARMENT):
        time.sleep(0.01)
    setup.viewer.others = {"collision_object"}
    for persons in (("ann", "bob"), ("ann",), ("ann", "bob")):
        setup.viewer.sent.clear()
        setup.tick(**{person: frame() for person in persons})
        assert [data[-1] for _, data in setup.viewer.sent] == [0] * len(persons)  # ADD
        assert all(len(data) > 10_000 for _, data in setup.viewer.sent)


def test_no_obstacle_stands_still_while_another_is_made() -> None:
    """A planner kept what somebody had worn where they had been, and what they still wore, for seconds."""
    setup = Setup(GarmentPipeline.load(["tshirt-male", GARMENT], backbone="skinned", sdf="none"), planner_rate=0.0)
    setup.viewer.others = {"collision_object"}
    setup.worker.fittings.planner(GARMENT)
    while not setup.worker.fittings.has_planner(GARMENT):
        time.sleep(0.01)
    setup.tick(ann=frame())
    setup.worker.fittings = Fittings(GarmentPipeline.load(["tshirt-male"], backbone="skinned", sdf="none"))
    setup.tick(ann=frame(0.1))
    assert [data[-1] for _, data in setup.viewer.sent] == [0, 1]  # ADD, then REMOVE


def test_what_is_due_again_is_not_remembered() -> None:
    """People come and go for days, and each of their planners' meshes was."""
    due: dict[str, float] = {}
    often, seldom = (SimpleNamespace(planner_rate=rate) for rate in (0.0, 0.001))
    assert all(is_due(due, f"p{i}/mesh", often) for i in range(100))  # type: ignore[arg-type]
    assert len(due) < 2
    assert [is_due(due, "p/mesh", seldom) for _ in range(3)] == [True, False, False]  # type: ignore[arg-type]


def test_the_rate_of_now_says_when_a_planner_is_sent_its_next_mesh() -> None:
    """It was the rate at the last mesh: after one of 1e-300 Hz planners were never sent another."""
    seldom, often = (SimpleNamespace(planner_rate=rate) for rate in (1e-300, 1e3))
    sent: dict[str, float] = {}
    assert [is_due(sent, "p/mesh", seldom) for _ in range(2)] == [True, False]  # type: ignore[arg-type]
    time.sleep(0.002)
    assert is_due(sent, "p/mesh", often)  # type: ignore[arg-type]


@pytest.mark.parametrize("fields", [["colour"], ["normal", "x"]])
def test_points_have_fields_that_there_are(fields: list[str]) -> None:
    assert NodeSettings().changed({"points_fields": ["normal"]}).points_fields == ("normal",)
    with pytest.raises(SettingsError, match="points_fields: wanted names of normal, clearance"):
        NodeSettings().changed({"points_fields": fields})


def test_transforms_that_are_missing_are_reported() -> None:
    statistics = Statistics()
    statistics.receive()
    statistics.count("late_transform")
    assert report_of(statistics)["input"].values["late transforms"] == "1"
    statistics.receive()
    statistics.count("late_transform")
    status = report_of(statistics)["input"]
    assert (status.level, status.message[:39]) == (1, "1 frames are placed by older transforms")
    statistics.receive()
    taken = report_of(statistics, input_frame="camera", is_untransformed=True)["input"]
    assert (taken.level, taken.message[:23]) == (1, "camera is taken for map")
    assert report_of(statistics, input_frame="camera")["input"].level == 0
    statistics.receive()
    statistics.drop("transform", "no transform leads from camera to map")
    status = report_of(statistics)["input"]
    assert (status.level, status.message) == (1, "1 of 1 have no transform: no transform leads from camera to map")
    assert status.values["dropped: transform"] == "1"


# ---- requests --------------------------------------------------------------------------------------------------------


@given(
    st.text(max_size=30)
    | st.lists(st.sampled_from(["a", "..", ".", "", "b.mcap", "-x", "~", "link", "loop"])).map("/".join)
)
def test_no_name_leads_out_of_the_folder(name: str) -> None:
    with tempfile.TemporaryDirectory() as home:
        folder = Path(home, "bags")
        folder.mkdir()
        (folder / "link").symlink_to(home)
        (folder / "loop").symlink_to("loop")
        path = folder.resolve()
        with contextlib.suppress(RefuError):
            path = path_in(str(folder), name)
            assert path == folder.resolve() / name
        assert ".." not in path.parts
        assert not path.is_symlink()


def test_without_a_folder_no_file_may_be_named() -> None:
    with pytest.raises(RefuError, match="start the node with the parameter bags"):
        path_in("", "walk.mcap")


def test_who_asks_too_often_is_told_so() -> None:
    dresser, go = RequestDresser(), threading.Event()
    plain: dict[str, Any] = {"backbone": "skinned", "sdf": "none", "collider": False}
    settings = NodeSettings(garments=(GARMENT,), **plain)
    frame = SmplFrame(np.zeros((24, 3)))
    try:
        waiting = [dresser.ask(frame, settings, lambda *_: go.wait(60)) for _ in range(8)]
        with pytest.raises(RefuError, match="8 requests wait already"):
            dresser.ask(frame, settings, lambda *_: None)
        go.set()
        assert all(one.result(60) for one in waiting)
        seen = dresser.ask(frame, settings, lambda _, placed: placed[GARMENT]).result(60)
    finally:
        go.set()
        dresser.close()
    wanted = GarmentPipeline.load([GARMENT], **plain)(frame)[GARMENT].local
    np.testing.assert_array_equal(seen, wanted[:, [2, 0, 1]])


def test_work_on_request_gives_way_to_a_node_that_gives_way_itself() -> None:
    """Its niceness was 10 whatever the node's was; from a larger one only root may go back to that."""
    settings = NodeSettings(garments=(GARMENT,), backbone="skinned", sdf="none", collider=False)

    def ask() -> int:
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 5)
        dresser = RequestDresser()
        try:
            own = dresser.ask(SmplFrame(np.zeros((24, 3))), settings, lambda *_: os.getpriority(os.PRIO_PROCESS, 0))
            return cast("int", own.result(60))
        finally:
            dresser.close()

    with ThreadPoolExecutor(1) as node:
        assert node.submit(ask).result() == 15
