"""`refu replay`, whole: bags and motion files in; bags, figures and reports out; and what it refuses."""

from __future__ import annotations

import itertools
import json
import os
import pickle
import re
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import igl
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

import msg_adapters as adapters
from msg_adapters.markers import encode_delete
from refu_core import GarmentPipeline, SmplFrame, load_body, load_garment
from refu_core.garments import BUILTIN_GARMENTS, PAPER_GARMENTS
from refu_core.modes import ONE_STYLE
from refu_core.simulation import posture
from refu_lab.cli import main
from refu_lab.commands.replay import ReplayOptions
from refu_lab.dressed_bag import DressedBag
from refu_lab.replay import replay

BAGS = Path(__file__).parents[2] / "bags"
SHIPPED = [BAGS / "walk", BAGS / "reach_squat"]


def motion(n: int = 6) -> list[SmplFrame]:
    """A short motion with the arms down, so that something is in the way."""
    frames = []
    for i in range(n):
        pose = np.zeros((24, 3), np.float32)
        pose[16, 2], pose[17, 2] = -1.1, 1.1
        pose[1, 0] = 0.1 * i
        frames.append(
            SmplFrame(pose, np.full(10, 0.3, np.float32), np.array([0.1 * i, 0.9, 0]), stamp_ns=10**18 + i * 33_333_333)
        )
    return frames


def write_bag(
    path: Path, frames: list[SmplFrame], kind: str = "joint_state", extra: dict[int, bytes] | None = None
) -> Path:
    """A bag of `frames`, with other bytes in the place of some of them."""
    encode = adapters.encoder_for(kind)
    with adapters.BagWriter(path) as writer:
        writer.add_topic("/smpl_params", adapters.INPUT_TYPES[kind])
        for i, frame in enumerate(frames):
            data = (extra or {}).get(i, encode(frame))
            writer.write("/smpl_params", data, log_time_ns=frame.stamp_ns + 5)
    return path


@pytest.fixture(scope="module")
def small_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_bag(tmp_path_factory.mktemp("bag") / "small.mcap", motion())


def run(*arguments: object) -> int:
    return main([str(argument) for argument in ("replay", *arguments, "--quiet")])


# ---- what comes out --------------------------------------------------------------------------------------------------


def decoded(path: Path, *topics: str) -> list[tuple[str, int, Any]]:
    """Topic, log time and message of everything in an .mcap (of some topics), read by another decoder than ours."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [(channel.topic, m.log_time, ros) for _, channel, m, ros in reader.iter_decoded_messages(topics or None)]


@pytest.mark.parametrize(
    ("late_s", "said"),
    [
        ([0, 0, -3600, -3600, 0, 0], "leap in 2 of 6 frames, at first by -3600.0 s"),
        ([0, 0, 0, 60, 60, 60], "leap in 1 of 6 frames, at first by +60.0 s"),
        ([0, 1, 2, 1.95, 1.93, 3], None),
    ],
)
def test_times_of_receipt_that_leap_are_said(late_s: list[float], said: str | None, tmp_path: Path) -> None:
    """A bag whose stamps are fine replayed without a word, and so did what was made of it, an hour off."""
    encode = adapters.encoder_for("joint_state")
    with adapters.BagWriter(tmp_path / "leaps.mcap") as writer:
        writer.add_topic("/smpl_params", adapters.INPUT_TYPES["joint_state"])
        for frame, late in zip(motion(), late_s, strict=True):
            writer.write("/smpl_params", encode(frame), log_time_ns=frame.stamp_ns + round(1e9 * late))
    options = ReplayOptions(input=tmp_path / "leaps.mcap", garments=["short-pant-male"], evaluate=False)
    warnings = [text for text in replay(options).warnings if "receipt" in text]
    assert len(warnings) == (said is not None)
    assert said is None or said in warnings[0]


def test_stamps_that_go_back_now_and_then_are_said(tmp_path: Path) -> None:
    """Of parts out of order nothing was said as long as most frames were newer than the ones before."""
    frames = motion(8)
    bag = write_bag(tmp_path / "parts.mcap", [*frames[4:], *frames[:4]])
    warnings = replay(ReplayOptions(input=bag, garments=["short-pant-male"], evaluate=False)).warnings
    assert any("stamps go back in 1 of 8 frames" in text for text in warnings)


def test_nothing_that_a_bag_holds_controls_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A topic could colour the terminal, and write lines of its own."""
    path, topic, kind = tmp_path / "bag\x1b[31m.mcap", "/\x1b]0;owned\x07\nskipped 7 x", "sensor_msgs/msg/JointState"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        number = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", b""))
        writer.add_message(number, 1, adapters.encoder_for("joint_state")(motion(1)[0]), 1)
        writer.finish()
    assert run(path, "--garments", "short-pant-male", "--no-evaluate") == 0
    printed = capsys.readouterr().out
    assert all(line.isprintable() for line in printed.splitlines())
    assert not any(line.startswith("skipped") for line in printed.splitlines())


def test_as_many_garments_as_frames_and_stamps_kept(small_bag: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    assert run(small_bag, "--output", out, "--garments", "tshirt-male,short-pant-male") == 0
    arrays, inputs = ([ros for _, _, ros in decoded(out, name)] for name in ("/garments", "/smpl_params"))
    assert len(arrays) == len(inputs) == len(motion())
    for array, frame in zip(arrays, motion(), strict=True):
        assert [m.ns for m in array.markers] == ["tshirt-male", "short-pant-male"]
        for marker in array.markers:
            stamp = marker.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == frame.stamp_ns
            assert marker.header.frame_id == "map"
            assert (marker.type, marker.action, marker.id) == (11, 0, 0)
            assert len(marker.points) == 3 * len(load_garment(marker.ns).faces)
            assert all(np.isfinite((p.x, p.y, p.z)).all() for p in marker.points[::97])


def test_the_output_is_what_the_pipeline_says_in_ros_axes(small_bag: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    assert run(small_bag, "--output", out, "--garments", "short-pant-male") == 0
    pipeline = GarmentPipeline.load(["short-pant-male"])
    with adapters.BagReader(out) as reader:
        arrays = list(reader.messages(["/garments"]))
    for message, frame in zip(arrays, motion(), strict=True):
        (marker,) = adapters.decode_marker_array(message.data)
        mesh = pipeline(frame)["short-pant-male"]
        wanted = mesh.vertices[:, [2, 0, 1]]  # REP 103: x forward, y left, z up
        found = adapters.vertices_from_points(marker.points, mesh.faces, n_vertices=len(wanted))
        np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_the_output_shows_who_wears_it_and_says_how_it_fits(small_bag: Path, tmp_path: Path) -> None:
    out, bare = tmp_path / "out.mcap", tmp_path / "bare.mcap"
    assert run(small_bag, "--output", out, "--garments", "short-pant-male") == 0
    pipeline = GarmentPipeline.load(["short-pant-male"])
    bodies, reports = ([ros for _, _, ros in decoded(out, name)] for name in ("/body", "/diagnostics"))
    n_inside = 0
    for array, report, frame in zip(bodies, reports, motion(), strict=True):
        (marker,) = array.markers
        wanted = pipeline(frame)
        corners = np.array([(p.x, p.y, p.z) for p in marker.points[:3000]])
        at = (wanted.body + wanted.transl)[pipeline.body.faces.numpy().reshape(-1)[:3000]]
        np.testing.assert_allclose(corners, at[:, [2, 0, 1]], atol=1e-6)
        assert str(marker.header.stamp) == str(report.header.stamp)
        received, shorts = report.status
        assert (received.name, received.message) == ("refu replay: input", "/smpl_params")
        assert shorts.name == "refu replay: short-pant-male"
        said = {pair.key: pair.value for pair in shorts.values}
        assert int(said["vertices inside before"]) == wanted.stats.garments["short-pant-male"].n_inside
        n_inside += int(said["vertices inside before"])
        assert said["vertices inside"] == "0"
        is_free = said["intersecting pairs of triangles"] == "0"
        assert (shorts.level, shorts.message == "free of collisions") == (0 if is_free else 1, is_free)
    assert n_inside > 0
    assert run(small_bag, "--output", bare, "--garments", "short-pant-male", "--no-body", "--no-evaluate") == 0
    kept = [message for message in raw_messages(out) if message[0] in ("/garments", "/smpl_params")]
    assert [message for message in raw_messages(bare) if message[0] != "/diagnostics"] == kept
    said = {ros.status[1].message for _, _, ros in decoded(bare, "/diagnostics")}
    assert said == {"no vertex inside the body"}


def test_input_of_a_bag_without_definitions_can_be_decoded_in_the_output(small_bag: Path, tmp_path: Path) -> None:
    """ROS 2 wrote none into `.db3` before Iron."""
    old = tmp_path / "old.db3"
    with sqlite3.connect(old) as database:
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format)")
        database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data)")
        topic = (1, "/smpl_params", adapters.INPUT_TYPES["joint_state"], "cdr")
        database.execute("INSERT INTO topics VALUES (?, ?, ?, ?)", topic)
        rows = [(1, one.log_time_ns, one.data) for one in adapters.BagReader(small_bag).messages()]
        database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    database.close()
    assert run(old, "--output", tmp_path / "out.mcap", "--no-evaluate") == 0
    messages = decoded(tmp_path / "out.mcap", "/smpl_params")
    assert [len(message.name) for _, _, message in messages] == [85] * len(rows)


@pytest.mark.parametrize("bag", SHIPPED, ids=lambda path: path.name)
def test_shipped_bags_replay_and_open_as_rosbag2(bag: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(bag, "--output", out, "--json", tmp_path / "r.json", "--max-frames", 4) == 0
    assert (out / "metadata.yaml").exists()
    with AnyReader([out]) as reader:
        assert {c.topic: c.msgcount for c in reader.connections}["/garments"] == 4
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["frames"] == 4
    for figures in result["garments"].values():
        assert set(figures["latency_ms"]) == {"p50", "p95", "p99"}
        assert figures["mpve_mm"] is None
        assert {"vfcp_percent", "cfmp_percent", "max_depth_mm"} <= set(figures)


def test_motion_files_replay(motions: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    assert run(motions[0], "--output", out, "--max-frames", 3, "--garments", "skirt-female") == 0
    assert [topic for topic, _, _ in raw_messages(out)] == ["/smpl_params", "/garments", "/body", "/diagnostics"] * 3


@pytest.mark.parametrize("backbone", ["skinned", "tailornet"])
@pytest.mark.parametrize("body", ["male", "female"])
def test_nothing_is_inside_the_body(body: str, backbone: str, sampled: list[SmplFrame]) -> None:
    """Judged by libigl's winding number, on frames of every motion and shipped bag: none within the promised range, and
    beyond it as many as the frame itself says. Every other frame is worn by skinning, the rest as a network drapes it.
    """
    garments = [name for name in PAPER_GARMENTS if load_garment(name).body == body]
    pipelines = [GarmentPipeline.load([name], sdf="accurate", backbone=backbone) for name in garments]
    faces = pipelines[0].body.faces.numpy().astype(np.int64)
    n_promised = 0
    for frame in sampled[backbone == "tailornet" :: 2]:
        outs = [pipeline(frame) for pipeline in pipelines]
        assert all(np.array_equal(out.body, outs[0].body) for out in outs)
        meshes = [out[name].local.astype(np.float64) for out, name in zip(outs, garments, strict=True)]
        # At once, as most of its time goes into preparing for a body.
        winding = igl.fast_winding_number(
            outs[0].body.astype(np.float64), faces, np.concatenate(meshes, dtype=np.float64)
        )
        ends = np.cumsum([len(mesh) for mesh in meshes])[:-1]
        for name, out, of_one in zip(garments, outs, np.split(winding, ends), strict=True):
            n_inside = int((np.abs(of_one) >= 0.5).sum())
            assert n_inside == out.stats.garments[name].n_unresolved, name
            assert n_inside <= (0 if out.stats.within_promise else 1), name
        n_promised += outs[0].stats.within_promise
    assert n_promised > 10


def test_figures_are_against_the_collider_and_beside_it_against_the_skin(tmp_path: Path) -> None:
    """Hanging arms: a T-shirt that is free of the collider is between an arm and a flank that overlap."""
    bag = write_bag(tmp_path / "hanging.mcap", [SmplFrame(pose=posture("hanging arms"))])
    results = {}
    for name, options in (("with", ()), ("without", ("--no-collider",))):
        file = tmp_path / f"{name}.json"
        assert run(bag, "--json", file, "--garments", "tshirt-male", *options) == 0
        results[name] = json.loads(file.read_text(encoding="utf-8"))
    figures = {name: result["garments"]["tshirt-male"] for name, result in results.items()}
    assert figures["with"]["vfcp_percent"] == 0
    assert figures["with"]["skin_cfmp_percent"] == 0
    assert 5 < results["with"]["skin_shift_mm"]["largest"] < 40
    assert results["without"]["skin_shift_mm"] == {"mean": 0, "largest": 0}
    assert figures["without"]["skin_cfmp_percent"] == figures["without"]["cfmp_percent"]
    assert (figures["with"]["cfmp_percent"], figures["without"]["cfmp_percent"]) == (100, 0)


@pytest.fixture(scope="module")
def sampled(motions: list[Path]) -> list[SmplFrame]:
    """Some frames of every motion and shipped bag."""
    frames = []
    for path in motions:
        clip = adapters.read_motion(path)
        frames += [clip.frame(i) for i in np.linspace(0, len(clip) - 1, 4).astype(int)]
    for bag in SHIPPED:
        records = list(adapters.iter_smpl_frames(bag))
        frames += [f for r in records[:: len(records) // 4] if (f := r.frame) is not None]
    return frames


@pytest.mark.usefixtures("little_light")
def test_report_is_complete_in_its_folder(small_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(small_bag, "--report", tmp_path / "report", "--garments", "short-pant-male") == 0
    told = capsys.readouterr().out
    assert "CFMP: frames free of collisions" in " ".join(told.split())
    assert "MPVE" not in told, "there is no true garment"
    page = (tmp_path / "report" / "index.html").read_text(encoding="utf-8")
    files = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert len(files) == 8, "two plots, three frames before and after"
    for file in files:
        assert (tmp_path / "report" / file).stat().st_size > 1000
    assert "short-pant-male" in page
    assert "p50: median" in page
    assert "MPVE" not in page


def test_betas_can_be_given(small_bag: Path, tmp_path: Path) -> None:
    depths = []
    for betas in ("0", "0,2"):
        out = tmp_path / f"{betas}.mcap"
        assert run(small_bag, "--betas", betas, "--output", out, "--garments", "short-pant-male") == 0
        (marker,) = adapters.decode_marker_array(raw_messages(out)[1][2])
        depths.append(np.ptp(marker.points[:, 0]))
    assert depths[1] > depths[0] + 0.02, "the second component is girth"


def test_a_style_that_a_garment_has_no_ear_for_is_told(tmp_path: Path) -> None:
    styled = [replace(frame, style=np.ones(4)) for frame in motion(2)]
    bag = write_bag(tmp_path / "styled.mcap", styled, "multiarray")
    for garment, said in (("tshirt-female", [ONE_STYLE.format("tshirt-female")]), ("skirt-female", [])):
        path = tmp_path / f"{garment}.json"
        assert run(bag, "--garments", garment, "--sdf", "none", "--json", path) == 0
        assert [one for one in json.loads(path.read_text())["warnings"] if "style" in one] == said


def test_real_speed_keeps_the_pace(small_bag: Path) -> None:
    start = time.monotonic()
    assert run(small_bag, "--speed", "real", "--garments", "short-pant-male") == 0
    assert time.monotonic() - start > 5 * 0.0333


# ---- what goes wrong -------------------------------------------------------------------------------------------------


def nan_frame() -> bytes:
    data = bytearray(adapters.encoder_for("multiarray")(motion(1)[0]))
    data[-40:-36] = np.float32(np.nan).tobytes()
    return bytes(data)


def test_bad_messages_are_counted_and_skipped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = {1: b"", 2: b"\x00\x01\x00\x00" + b"\xff" * 64, 4: nan_frame()}
    bag = write_bag(tmp_path / "mixed.mcap", motion(), "multiarray", bad)
    out, report = tmp_path / "out.mcap", tmp_path / "r.json"
    assert run(bag, "--output", out, "--json", report, "--garments", "short-pant-male") == 0
    result = json.loads(report.read_text())
    assert result["frames"] == 3
    assert sum(result["skipped"].values()) == 3
    assert any("NaN" in reason for reason in result["skipped"])
    assert "skipped 1 x" in capsys.readouterr().out
    topics = [topic for topic, _, _ in raw_messages(out)]
    assert topics.count("/smpl_params") == 6
    assert topics.count("/garments") == 3
    said = [ros.status[0] for _, _, ros in decoded(out, "/diagnostics")]
    assert [status.level for status in said] == [0, 2, 2, 0, 2, 0]
    assert "NaN" in said[4].message


def test_a_body_that_nobody_has_and_a_time_that_no_message_holds_are_skipped(tmp_path: Path) -> None:
    frames = motion(5)
    frames[1] = replace(frames[1], betas=np.full(10, -99.0))  # inside out
    frames[3] = replace(frames[3], stamp_ns=2**31 * 10**9 - 1)
    late = adapters.encoder_for("joint_state")(replace(frames[3], stamp_ns=0))  # received later than that
    bag = write_bag(tmp_path / "odd.mcap", frames, extra={3: late})
    out, told = tmp_path / "out.mcap", tmp_path / "r.json"
    assert run(bag, "--output", out, "--json", told, "--garments", "short-pant-male", "--backbone", "skinned") == 0
    result = json.loads(told.read_text())
    assert result["frames"] == 3
    assert sum(result["skipped"].values()) == 2
    assert all("magnitudes up to 20" in reason or "impossible time" in reason for reason in result["skipped"])
    assert [topic for topic, _, _ in raw_messages(out)].count("/garments") == 3
    glb, options = tmp_path / "odd.glb", ("--garments", "short-pant-male", "--backbone", "skinned", "--count", "5")
    assert main(["export", str(bag), "--output", str(glb), *options, "--json", str(told)]) == 0
    said = json.loads(told.read_text())
    assert len(said["files"]) == 3
    assert sum("is left out" in warning for warning in said["warnings"]) == 2


def raw_messages(path: Path) -> list[tuple[str, int, bytes]]:
    with adapters.BagReader(path) as reader:
        return [(m.topic, m.log_time_ns, m.data) for m in reader.messages()]


def test_a_truncated_bag_is_replayed_up_to_the_damage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_bag(tmp_path / "whole.mcap", motion(60))
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(bag.read_bytes()[:-3000])
    report = tmp_path / "r.json"
    code = run(cut, "--json", report, "--garments", "short-pant-male", "--sdf", "none", "--no-evaluate")
    printed = capsys.readouterr()
    if code == 0:
        result = json.loads(report.read_text())
        assert 0 < result["frames"] <= 60
        assert result["warnings"], printed.out
    else:
        assert_one_line(code, printed.err, "cut.mcap")


def assert_one_line(code: int, err: str, *wanted: str) -> None:
    lines = [line for line in err.splitlines() if line.strip()]
    assert code == 2
    assert len(lines) == 1, err
    assert lines[0].startswith("refu")
    for text in wanted:
        assert text in lines[0]


def empty_bag(path: Path) -> Path:
    with adapters.BagWriter(path):
        pass
    return path


def bag_of_something_else(path: Path) -> Path:
    with adapters.BagWriter(path) as writer:
        writer.add_topic("/markers", adapters.MARKER_ARRAY)
        writer.write("/markers", encode_delete(["a"], stamp_ns=0), log_time_ns=0)
    return path


def file_of(content: bytes) -> Callable[[Path], Path]:
    def make(path: Path) -> Path:
        path.write_bytes(content)
        return path

    return make


def npz_of(**arrays: Any) -> Callable[[Path], Path]:
    def make(path: Path) -> Path:
        np.savez(path, **arrays)
        return path

    return make


def all_bad_bag(path: Path) -> Path:
    return write_bag(path, motion(2), "multiarray", {0: b"", 1: nan_frame()})


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_replay_without_a_frame_leaves_what_was_there(tmp_path: Path, *, overwrite: bool) -> None:
    bad, out = all_bad_bag(tmp_path / "bad.mcap"), tmp_path / "out.mcap"
    if overwrite:
        write_bag(out, motion(2), "multiarray")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    options = ["--garments", "short-pant-male", "--backbone", "skinned", "--sdf", "none", "--quiet", "--no-evaluate"]
    given = ["replay", str(bad), "--output", str(out), *options, *(["--overwrite"] if overwrite else [])]
    assert main(given) == 2
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_two_outputs_of_one_place_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag, out = write_bag(tmp_path / "in.mcap", motion(2), "multiarray"), str(tmp_path / "out.mcap")
    assert main(["replay", str(bag), "--output", out, "--json", out]) == 2
    assert "both --json and --output would be written there" in capsys.readouterr().err
    assert main(["replay", str(bag), str(bag), "--output", out]) == 2
    assert "of several inputs that is a folder" in capsys.readouterr().err
    assert main(["replay", str(bag), "--person", "ann"]) == 2
    assert "--person is for keypoints and files of motion" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        (["--keypoints", "coco17"], "--keypoints goes with --input-type keypoint_poses or keypoint_markers"),
        (["--jobs", "1000000"], "wanted at most 1024 processes of this machine (--jobs), got 1000000"),
    ],
)
def test_options_that_do_nothing_or_too_much_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], wanted: str
) -> None:
    bags = [str(write_bag(tmp_path / f"{name}.mcap", motion(2), "multiarray")) for name in "ab"]
    assert main(["replay", *(bags if "--jobs" in options else bags[:1]), *options]) == 2
    assert wanted in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["replay", *bags, "--frame-id", ""])
    assert "wanted text without control characters, got ''" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "make", "options", "wanted"),
    [
        ("missing.mcap", lambda path: path, (), ("missing.mcap",)),
        ("noise.mcap", file_of(os.urandom(4096)), (), ("noise.mcap",)),
        ("nothing.mcap", file_of(b""), (), ("nothing.mcap",)),
        ("empty.mcap", empty_bag, (), ("empty.mcap", "empty")),
        ("other.mcap", bag_of_something_else, (), ("other.mcap", "/markers", "Float32MultiArray")),
        ("bad.mcap", all_bad_bag, (), ("bad.mcap", "no frame could be replayed")),
        ("good.mcap", lambda path: write_bag(path, motion(1)), ("--garments", "kilt"), ("kilt", "tshirt-male")),
        ("good.mcap", lambda path: write_bag(path, motion(1)), ("--garments", ","), ("--garments",)),
        ("good.mcap", lambda path: write_bag(path, motion(1)), ("--topic", "/nope"), ("/nope", "/smpl_params")),
        ("good.mcap", lambda path: write_bag(path, motion(1)), ("--output", "/proc/nope/out.mcap"), ("/proc/nope",)),
        ("good.mcap", lambda path: write_bag(path, motion(1)), ("--json", "/proc/nope/r.json"), ("/proc/nope",)),
        ("good.mcap", lambda path: write_bag(path, motion(1)), ("--betas", "1,nan"), ("--betas",)),
        ("good.mcap", lambda path: write_bag(path, motion(1)), ("--style", "1,2,3,4,5"), ("--style",)),
        ("good.mcap", lambda path: write_bag(path, motion(1)), ("--margin", "7"), ("margin",)),
        ("good.mcap", lambda path: write_bag(path, motion(1)), ("--backbone", "resnet"), ("resnet", "skinned")),
        ("good.mcap", lambda path: write_bag(path, motion(1)), ("--nonsense",), ("--nonsense",)),
        ("short.npz", npz_of(poses=np.zeros((3, 71)), trans=np.zeros((3, 3))), (), ("short.npz", "71")),
        (
            "nan.npz",
            npz_of(poses=np.full((3, 72), np.nan), trans=np.zeros((3, 3)), mocap_framerate=30),
            (),
            ("nan.npz",),
        ),
        ("none.npz", npz_of(poses=np.zeros((0, 72)), trans=np.zeros((0, 3)), mocap_framerate=30), (), ("none.npz",)),
        ("keys.npz", npz_of(angles=np.zeros((3, 72))), (), ("keys.npz", "poses")),
        ("objects.npz", npz_of(poses=np.array([{}], object)), (), ("objects.npz",)),
        ("evil.npz", file_of(pickle.dumps(print)), (), ("evil.npz",)),
    ],
)
def test_bad_input_is_one_clear_line(
    name: str,
    make: Callable[[Path], Path],
    options: tuple[str, ...],
    wanted: tuple[str, ...],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = make(tmp_path / name)
    try:
        code = run(path, "--sdf", "none", *options)
    except SystemExit as stop:
        code = int(stop.code or 0)
    assert_one_line(code, capsys.readouterr().err, *wanted)


@pytest.mark.parametrize("option", ["--output", "--json"])
def test_a_recording_is_never_written_over(option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = write_bag(tmp_path / "in.mcap", motion(2))
    before = given.read_bytes()
    (tmp_path / "link.mcap").symlink_to(given)
    for written in ("in.mcap", "link.mcap", "../" + tmp_path.name + "/in.mcap"):
        code = run(given, "--garments", "short-pant-male", "--overwrite", option, tmp_path / written)
        assert_one_line(code, capsys.readouterr().err, "written over the input")
        assert given.read_bytes() == before


def test_a_link_to_itself_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    link = tmp_path / "link.mcap"
    link.symlink_to(link)
    code = run(link, "--garments", "short-pant-male", "--output", tmp_path / "out.mcap")
    assert_one_line(code, capsys.readouterr().err, "link.mcap")


@pytest.mark.parametrize("option", ["--output", "--report", "--json"])
def test_a_link_to_a_disk_that_is_not_there_is_said_at_once(
    option: str, small_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was said to exist, and of a report only once all frames had been evaluated."""
    (tmp_path / "usb").symlink_to(tmp_path / "unmounted")
    code = run(small_bag, "--garments", "short-pant-male", option, tmp_path / "usb" / "out")
    output = capsys.readouterr()
    assert_one_line(code, output.err, f"a link to {tmp_path / 'unmounted'}, which isn't there")
    assert output.out == ""


def test_a_bag_directory_is_not_written_into(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = write_bag(tmp_path / "given", motion(2))
    (file,) = given.glob("*.mcap")
    before = file.read_bytes()
    for written in (given, file, given / "out.mcap"):
        code = run(given, "--garments", "short-pant-male", "--overwrite", "--output", written)
        assert_one_line(code, capsys.readouterr().err, "written over the input")
    assert file.read_bytes() == before
    assert not (given / "out.mcap").exists()


def test_a_damaged_bag_is_not_called_empty(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_bag(tmp_path / "flip.mcap", motion(20))
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 255
    path.write_bytes(data)
    code = run(path, "--garments", "short-pant-male")
    assert_one_line(code, capsys.readouterr().err, "damaged")


def test_an_output_that_is_there_is_not_overwritten_unasked(
    small_bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.mcap"
    out.write_bytes(b"precious")
    assert_one_line(run(small_bag, "--output", out), capsys.readouterr().err, "out.mcap")
    assert out.read_bytes() == b"precious"
    assert run(small_bag, "--output", out, "--overwrite", "--garments", "short-pant-male") == 0
    assert len(raw_messages(out)) == 4 * len(motion())


def assert_closed(bag: Path, most: int) -> None:
    """It has its closing records, and some garments, but not all of `most`."""
    with bag.open("rb") as stream:
        assert make_reader(stream).get_summary() is not None
    assert 0 < [topic for topic, _, _ in raw_messages(bag)].count("/garments") < most


def test_a_replay_that_is_terminated_leaves_a_readable_bag(tmp_path: Path) -> None:
    bag, out = write_bag(tmp_path / "long.mcap", motion(1800)), tmp_path / "out.mcap"  # a minute
    command = [sys.executable, "-m", "refu_lab", "replay", bag, "--output", out, "--speed", "real", "--quiet"]
    options = ["--garments", "short-pant-male", "--backbone", "skinned", "--sdf", "none", "--no-collider"]
    process = subprocess.Popen([*map(str, command), *options], stdout=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 300
    while (not out.exists() or out.stat().st_size < 20_000) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    process.terminate()
    printed, _ = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "interrupted" in printed
    assert_closed(out, 1800)


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM])
def test_either_signal_ends_a_replay_after_a_whole_frame(
    kind: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    add_frame, n_added = DressedBag.add_frame, itertools.count(1)

    def signalled(*frame: Any) -> None:
        add_frame(*frame)
        if next(n_added) == 3:
            signal.raise_signal(kind)

    monkeypatch.setattr(DressedBag, "add_frame", signalled)
    bag, out = write_bag(tmp_path / "long.mcap", motion(20)), tmp_path / "out.mcap"
    options = ("--garments", "short-pant-male", "--backbone", "skinned", "--sdf", "none", "--no-collider")
    assert run(bag, "--output", out, *options) == 130
    assert "interrupted" in capsys.readouterr().out
    assert_closed(out, 20)


def test_info_names_what_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "--json", str(tmp_path / "info.json")]) == 0
    facts = json.loads((tmp_path / "info.json").read_text())
    assert set(facts["garments"]) == set(BUILTIN_GARMENTS)
    assert "tshirt-male" in capsys.readouterr().out


def test_info_describes_a_body(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "--body", "female", "--json", str(tmp_path / "body.json")]) == 0
    facts = json.loads((tmp_path / "body.json").read_text())
    assert facts["watertight"] == "yes"
    assert facts["fingerprint"] == load_body("female").fingerprint
    assert "6909" in capsys.readouterr().out


class Evil:
    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        return os.system, ("echo owned",)


@pytest.mark.parametrize(
    ("name", "content", "wanted"),
    [
        ("evil.pkl", pickle.dumps({"v_template": Evil()}), "nothing was executed"),
        ("noise.pkl", os.urandom(200), "can't be read"),
        ("noise.npz", os.urandom(200), "can't be read"),
        ("model.fbx", b"", "must be an .npz or an official .pkl"),
    ],
    ids=["evil.pkl", "noise.pkl", "noise.npz", "model.fbx"],
)
def test_an_unreadable_body_is_one_clear_line(
    name: str, content: bytes, wanted: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).write_bytes(content)
    code = main(["info", "--body", str(tmp_path / name)])
    printed = capfd.readouterr()
    assert_one_line(code, printed.err, name, wanted)
    assert "owned" not in printed.out


def test_ground_truth_in_the_bag_gives_mpve(tmp_path: Path) -> None:
    """A bag whose truth is what comes out, 3 mm to the side: MPVE after is 3 mm."""
    pipeline = GarmentPipeline.load(["short-pant-male"])
    mesh = adapters.MarkerMesh(
        ns="short-pant-male",
        faces=pipeline.garments["short-pant-male"].faces.numpy(),
        n_vertices=pipeline.garments["short-pant-male"].n_vertices,
    )
    encoder, encode = adapters.MarkerArrayEncoder([mesh]), adapters.encoder_for("multiarray")
    bag = tmp_path / "truth.mcap"
    with adapters.BagWriter(bag) as writer:
        writer.add_topic("/smpl_params", adapters.INPUT_TYPES["multiarray"])
        writer.add_topic("/ground_truth", adapters.MARKER_ARRAY)
        for frame in motion():
            true = pipeline(frame)["short-pant-male"].local + np.array([0.003, 0, 0], np.float32)
            data = encoder.encode([true], stamp_ns=frame.stamp_ns, transl=frame.transl)
            writer.write("/smpl_params", encode(frame), log_time_ns=frame.stamp_ns)
            writer.write("/ground_truth", data, log_time_ns=frame.stamp_ns)
    assert run(bag, "--garments", "short-pant-male", "--json", tmp_path / "r.json") == 0
    figures = json.loads((tmp_path / "r.json").read_text())["garments"]["short-pant-male"]
    assert figures["mpve_mm"] == pytest.approx(3.0, abs=1e-3)
