"""What the commands do with files and bags that aren't in SMPL's axes, of another gender, or of keypoints."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import msg_adapters as adapters
from msg_adapters.cdr import CdrWriter
from msg_adapters.inputs._joint_state import AXES
from msg_adapters.markers import encode_lists
from refu_core import SmplFrame
from refu_core.keypoints import Proportions, Skeleton, keypoint_layout
from refu_core.keypoints._pose import Pose, exp_so3
from refu_lab.cli import main
from refu_lab.commands.replay import ReplayOptions
from refu_lab.replay import ReplayResult, replay
from refu_lab.report import write_report

ROOT = Path(__file__).parents[2]
FAST = ["--garments", "short-pant-male", "--backbone", "skinned", "--sdf", "none", "--no-collider", "--quiet"]
Z_UP = Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
PLAIN: dict[str, Any] = {"garments": ("short-pant-male",), "backbone": "skinned", "sdf": "none", "collider": False}
FRAMES = [*islice((one.frame for one in adapters.iter_smpl_frames(ROOT / "bags" / "walk") if one.frame), 8)]


def z_up(path: Path, **changes: Any) -> Path:
    """A clip as AMASS has it."""
    poses = np.array([frame.pose for frame in FRAMES], np.float64)
    poses[:, 0] = (Z_UP * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    wide = np.pad(poses[:, :22].reshape(len(poses), 66), ((0, 0), (0, 90)))
    trans = Z_UP.apply([frame.transl for frame in FRAMES])
    arrays = {"poses": wide, "trans": trans, "betas": np.zeros(16), "mocap_framerate": 30.0, "gender": "male"}
    np.savez(path, **arrays | changes)
    return path


def run(path: Path, **options: Any) -> ReplayResult:
    return replay(ReplayOptions(input=path, **{"max_frames": 3} | PLAIN | options))


def heights(result: ReplayResult) -> tuple[float, float]:
    """Along y and along z, of the first frame's pelvis to head [m]."""
    pose, bones = result.frames[0].frame, Skeleton(keypoint_layout("smpl24"), Proportions.builtin("male"))
    joints = bones.posed(Pose(np.zeros(3), exp_so3(pose.pose.astype(float)), np.zeros(10))).joints
    return float(joints[15, 1]), float(joints[15, 2])


@pytest.mark.parametrize("number", [np.nan, 1e300])  # float32, in which poses are, ends at 3e38
def test_frames_that_are_not_finite_are_told(tmp_path: Path, number: float) -> None:
    poses = np.zeros((10, 72))
    poses[3] = number
    np.savez(tmp_path / "a.npz", poses=poses, trans=np.zeros((10, 3)), betas=np.zeros(10), mocap_framerate=30)
    motion = adapters.read_motion(tmp_path / "a.npz", axes="smpl")
    assert "NaN or infinite in 1 of 10, first in number 3: nobody is dressed there" in motion.notes


def test_names_of_people_are_no_commands_to_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    people = {name: {"poses": np.zeros((n, 72)), "fps": 30} for name, n in (("\x1b[2Jann", 3), ("bob", 2))}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(people))
    assert main(["replay", str(tmp_path / "a.pkl"), *FAST]) == 0
    printed = capsys.readouterr().out
    assert "\\x1b[2Jann (3 frames)" in printed
    assert printed.replace("\n", "").isprintable()


def test_numbers_beyond_those_of_messages_are_refused_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savez(tmp_path / "a.npz", poses=np.zeros((3, 72)), trans=np.full((3, 3), 1e300), fps=30)
    assert main(["replay", str(tmp_path / "a.npz"), *FAST]) == 2
    assert "3 x transl: wanted magnitudes up to 1e+09, got 1e+300" in capsys.readouterr().err


@pytest.mark.usefixtures("little_light")
def test_z_up_is_seen_and_pictures_stand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Any] = []

    def draw(meshes: Any, **_: Any) -> Any:  # what is drawn matters here, and to draw it takes seconds
        drawn.extend(meshes)
        return np.zeros((4, 4, 3), np.uint8)

    monkeypatch.setattr("refu_lab.report.render", draw)
    monkeypatch.setattr("refu_lab.report._plot", lambda *_: None)  # nor do the curves
    path = z_up(tmp_path / "a.npz")
    seen, left = run(path, max_frames=1), run(path, max_frames=1, input_axes="frame")
    assert heights(seen)[0] > 0.6
    assert heights(left)[1] > 0.6
    assert any("+z: taken as z up" in warning for warning in seen.warnings)
    assert (seen.options.axes, left.options.axes) == ("smpl", "frame")
    monkeypatch.setattr(ReplayOptions, "load_pipeline", None)  # the result has the pipeline
    for result in (seen, left):
        write_report(result, tmp_path / "report")
    for body, garment in zip(drawn[::2], drawn[1::2], strict=True):
        extent = np.ptp(body.vertices, axis=0)
        assert extent[1] > 1.6 > 1.3 > extent[2]  # stands
        assert abs(garment.vertices[:, 1].mean() - body.vertices[:, 1].mean()) < 0.3


def test_garments_are_in_the_same_place_either_way(tmp_path: Path) -> None:
    """z up in ROS is z up in the file: turned to SMPL's axes and back again, or left as it is."""
    path, places = z_up(tmp_path / "a.npz"), []
    for axes in ("auto", "frame", "z-up"):
        out = tmp_path / f"{axes}.mcap"
        run(path, input_axes=axes, output=out, backbone="tailornet")  # cloth hangs the same way, too
        with adapters.BagReader(out) as reader:
            (message, *_) = reader.messages(["/garments"])
        places.append(adapters.decode_marker_array(message.data)[0].points)
    np.testing.assert_allclose(places[0], places[1], atol=6e-3)
    np.testing.assert_array_equal(places[0], places[2])


def test_garments_are_in_the_frame_that_their_people_are_in(tmp_path: Path) -> None:
    encode, path, out = adapters.encoder_for("pose_array"), tmp_path / "seen.mcap", tmp_path / "out.mcap"
    with adapters.BagWriter(path) as writer:
        writer.add_topic("/smpl_params", adapters.INPUT_TYPES["pose_array"])
        writer.write("/smpl_params", encode(FRAMES[0], frame_id="head_optical"), log_time_ns=10**9)
    for axes, given, frame_id in (
        ("frame", {}, "head_optical"),
        ("smpl", {}, "map"),
        ("frame", {"frame_id": "world"}, "world"),
    ):
        run(path, input_axes=axes, output=out, overwrite=True, **given)
        with adapters.BagReader(out) as reader:
            (message,) = reader.messages(["/garments"])
        assert adapters.decode_marker_array(message.data)[0].frame_id == frame_id


@pytest.mark.parametrize("input_type", ["multiarray", "joint_state"])
def test_the_frame_that_is_asked_for_says_which_way_is_up(tmp_path: Path, input_type: str) -> None:
    """A camera's message without a frame, or of one that isn't called optical."""
    pose = np.zeros((24, 3), np.float32)
    pose[0, 0] = np.pi  # y is down
    with adapters.BagWriter(tmp_path / "seen.mcap") as writer:
        writer.add_topic("/smpl_params", adapters.INPUT_TYPES[input_type])
        raw = adapters.encoder_for(input_type)(SmplFrame(pose, stamp_ns=10**9), frame_id="camera")
        writer.write("/smpl_params", raw, log_time_ns=10**9)
    for frame_id, up, said in (("", [0, 0, 1], "frame_id has z up"), ("camera_optical", [0, -1, 0], "")):
        result = run(tmp_path / "seen.mcap", input_axes="frame", frame_id=frame_id)
        np.testing.assert_array_equal(result.frames[0].frame.up, up)
        assert bool(result.warnings) == bool(said)
        assert said in "".join(result.warnings)


def test_another_gender_is_said(tmp_path: Path) -> None:
    result = run(z_up(tmp_path / "a.npz", gender="female"))
    assert any("of a female body and is dressed as male" in text for text in result.warnings)
    assert not any("person, the garments" in warning for warning in run(z_up(tmp_path / "b.npz")).warnings)


def test_a_bag_of_people_who_lie_is_said(tmp_path: Path) -> None:
    encode = adapters.encoder_for("multiarray")
    with adapters.BagWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/smpl_params", adapters.INPUT_TYPES["multiarray"])
        for i, frame in enumerate(FRAMES[:3]):
            pose = frame.pose.copy()
            pose[0] = (Z_UP * Rotation.from_rotvec(pose[0])).as_rotvec()
            lying = type(frame)(pose, frame.betas, frame.transl)
            writer.write("/smpl_params", encode(lying), log_time_ns=(10 + i) * 10**8)
    said = "; ".join(run(tmp_path / "a.mcap").warnings)
    assert "people are upright in 0 % of 3 frames, heads are towards +z: input_axes is smpl (y up)" in said
    assert run(tmp_path / "a.mcap", input_axes="frame").warnings == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda f: replace(f, pose=np.degrees(f.pose)), "wanted radians: degrees?"),
        (lambda f: replace(f, transl=1000 * f.transl), "translations in cm or mm?"),
    ],
)
def test_a_bag_in_other_units_is_said(tmp_path: Path, change: Callable[[SmplFrame], SmplFrame], said: str) -> None:
    encode = adapters.encoder_for("joint_state")
    with adapters.BagWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/smpl_params", adapters.INPUT_TYPES["joint_state"])
        for frame in FRAMES:
            writer.write("/smpl_params", encode(change(frame)), log_time_ns=10**9 + frame.stamp_ns)
    assert said in "; ".join(run(tmp_path / "a.mcap", max_frames=None).warnings)


def test_a_body_of_ros4hri_is_shown_where_tf_has_it(tmp_path: Path) -> None:
    with adapters.BagWriter(tmp_path / "hri.mcap") as writer:
        writer.add_topic("/humans/bodies/bob/joint_states", adapters.INPUT_TYPES["joint_state"])
        message = CdrWriter()
        message.fields("Ts", 10**18, "camera")
        message.strings([f"{joint}_bob" for joint in AXES])
        message.sequence("f8", np.zeros(len(AXES)))
        message.fields("II", 0, 0)
        writer.write("/humans/bodies/bob/joint_states", message.to_bytes(), log_time_ns=10**18)
    result = run(tmp_path / "hri.mcap")
    assert result.options.frame_id == "body_bob"
    assert "the person stays at the origin of body_bob" in " ".join(result.warnings)
    assert run(ROOT / "bags" / "walk").options.frame_id == "map"


def keypoints() -> Iterator[tuple[int, Any]]:
    """A tracker's points of `FRAMES`, z up, and their stamps."""
    bones = Skeleton(keypoint_layout("zed38"), Proportions.builtin("male"))
    for i, frame in enumerate(FRAMES):
        pose = Pose(frame.transl + np.array([0, -0.22, 0.02]), exp_so3(frame.pose.astype(float)), np.zeros(10))
        yield 10**9 + round(i * 1e9 / 30), Z_UP.apply(bones.posed(pose).points)


def write_keypoints(path: Path, *, stamped: bool) -> None:
    with adapters.BagWriter(path) as writer:
        writer.add_topic("/skeleton", adapters.KEYPOINT_TYPES["keypoint_poses"])
        for stamp, points in keypoints():
            cdr = CdrWriter()
            cdr.fields("Ts", stamp if stamped else 0, "map")
            cdr.fields("I", len(points))
            cdr.array("f8", np.pad(points, ((0, 0), (0, 4))))
            writer.write("/skeleton", cdr.to_bytes(), log_time_ns=stamp)


def test_keypoints_of_a_bag(tmp_path: Path) -> None:
    write_keypoints(tmp_path / "a.mcap", stamped=True)
    result = run(tmp_path / "a.mcap", input_type="keypoint_poses", keypoints="zed38", max_frames=None)
    assert (len(result.frames), result.options.axes) == (len(FRAMES), "frame")
    for got, known in zip(result.frames, FRAMES, strict=True):
        root = Rotation.from_rotvec(known.pose[0]).inv() * Z_UP.inv() * Rotation.from_rotvec(got.frame.pose[0])
        assert root.magnitude() < 0.2
    write_keypoints(tmp_path / "b.mcap", stamped=False)
    unstamped = run(tmp_path / "b.mcap", input_type="keypoint_poses", keypoints="zed38", max_frames=None)
    for a, b in zip(result.frames, unstamped.frames, strict=True):  # they are of when they were received
        np.testing.assert_allclose(a.frame.transl, b.frame.transl, atol=1e-4)
    assert main(["replay", str(tmp_path / "a.mcap"), "--input-type", "keypoint_poses", "--keypoints", "coco17"]) == 2
    assert main(["replay", str(tmp_path / "a.mcap")]) == 2


def test_all_whose_keypoints_a_bag_has_are_named(tmp_path: Path) -> None:
    unturned = [0, 0, 0, 0, 0, 0, 1]
    with adapters.BagWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/skeletons", adapters.MARKER_ARRAY)
        for stamp, points in keypoints():
            people = [(name, stamp, unturned, points + at) for at, name in enumerate(("ann", "bob", "eve"))]
            data = encode_lists(8, people, frame_id="map", color=(1, 1, 1, 1), size=0.03)  # POINTS
            writer.write("/skeletons", data, log_time_ns=stamp)
    first = run(tmp_path / "a.mcap", input_type="keypoint_markers", max_frames=None)
    assert "3 persons: ann is taken; also bob, eve (--person chooses another)" in first.warnings
    bob = run(tmp_path / "a.mcap", input_type="keypoint_markers", person="bob", max_frames=None)
    np.testing.assert_allclose(bob.frames[-1].frame.transl - first.frames[-1].frame.transl, 1, atol=0.01)
    assert not [warning for warning in bob.warnings if "persons" in warning]


def test_simulate_says_how_motions_were_meant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def said(path: Path, *options: str) -> str:
        out = str(tmp_path / "set")
        assert (
            main(["simulate", "short-pant-male", "--count", "6", "--output", out, "--motions", str(path), *options])
            == 2
        )
        return capsys.readouterr().err

    # One clip can't be split: nothing is simulated, but how it was read is said before.
    assert "stands along +z: taken as z up" in said(z_up(tmp_path / "a.npz"))
    assert "z up" not in said(tmp_path / "a.npz", "--input-axes", "frame")
    assert "upright in 0 %" in said(tmp_path / "a.npz", "--input-axes", "smpl")
    np.savez(tmp_path / "b.npz", poses=np.zeros((5, 72)))
    assert "say it, as in --fps 30" in said(tmp_path / "b.npz")
    assert "two motions or more" in said(tmp_path / "b.npz", "--fps", "30")
