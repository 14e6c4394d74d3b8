"""AMASS-style files: their three layouts, what they leave out, resampling, and what is refused."""

from __future__ import annotations

import pickle
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from msg_adapters import (
    INPUT_TYPES,
    BagError,
    BagWriter,
    Motion,
    MotionFileError,
    encoder_for,
    load_motion,
    read_motion,
)
from refu_core import FrameError, SmplFrame

if TYPE_CHECKING:
    from pathlib import Path

RNG = np.random.default_rng(0)
T = 12


def save(path: Path, **changes: Any) -> Path:
    arrays: dict[str, Any] = {
        "poses": RNG.normal(size=(T, 72)),
        "trans": RNG.normal(size=(T, 3)),
        "betas": RNG.normal(size=16),
        "mocap_framerate": 120.0,
        "gender": "female",
    }
    arrays |= changes
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


@pytest.mark.parametrize("columns", [72, 156, 165])
def test_layouts(tmp_path: Path, columns: int) -> None:
    poses, trans = RNG.normal(size=(T, columns)), RNG.normal(size=(T, 3))
    motion = read_motion(save(tmp_path / "a.npz", poses=poses, trans=trans, gender=b"male"), axes="smpl")
    shared = 24 if columns == 72 else 22
    assert len(motion) == T
    np.testing.assert_array_equal(motion.poses[:, :shared].reshape(T, -1), poses[:, : shared * 3].astype(np.float32))
    assert not motion.poses[:, shared:].any()
    lower = [0.003, -0.131, -0.008] if columns == 165 else [0.0, 0.0, 0.0]  # SMPL-X's pelvis, in its mesh
    np.testing.assert_allclose(motion.transl, trans + lower, rtol=0, atol=1e-12)
    assert (motion.fps, motion.gender) == (120.0, "male")
    assert repr(motion).endswith(f"a.npz: {T} frames at 120 Hz, male)")
    frames = list(motion.frames())
    assert [f.stamp_ns for f in frames[:4]] == [0, 8333333, 16666667, 25000000]
    np.testing.assert_array_equal(frames[3].pose, motion.poses[3])
    np.testing.assert_array_equal(frames[3].transl, motion.transl[3])


def test_what_may_be_left_out(tmp_path: Path) -> None:
    changes = {
        "trans": None,
        "betas": np.ones(4),
        "gender": None,
        "mocap_framerate": None,
        "mocap_frame_rate": np.array([60]),
    }
    motion = read_motion(save(tmp_path / "a.npz", **changes))
    np.testing.assert_array_equal(motion.betas, [1] * 4 + [0] * 6)
    assert not motion.transl.any()
    assert (motion.fps, motion.gender) == (60.0, "neutral")
    assert not read_motion(save(tmp_path / "b.npz", betas=None)).betas.any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"poses": None}, "no poses; wanted pose_world, "),
        ({"poses": np.zeros((T, 70))}, r"poses must be \(T, n, 3\) or .* got \(12, 70\)"),
        ({"poses": np.zeros((0, 72))}, r"got \(0, 72\)"),
        ({"poses": np.zeros((T, 24, 2))}, r"got \(12, 24, 2\)"),
        ({"poses": np.full((T, 72), "x")}, "poses must be numbers"),
        ({"poses": np.full((T, 72), None)}, "can't be read as .npz: .*an array of objects"),
        (
            {"trans": np.zeros((T - 1, 3))},
            r"trans or transl or translation must be \(12, 3\) like the pose, got \(11, 3\)",
        ),
        ({"betas": np.full(10, np.nan)}, "betas has values that are NaN"),
        ({"betas": np.zeros((T - 2, 10))}, "betas must be one row"),
        ({"mocap_framerate": None}, "no frame rate"),
        ({"mocap_framerate": 0.0}, r"frame rate in \[0.001, 10000\], got 0"),
        ({"mocap_framerate": 1e-300}, r"frame rate in \[0.001, 10000\], got 1e-300"),
        ({"mocap_framerate": 30j}, "wanted plain numbers"),
        ({"mocap_framerate": np.zeros(2, [("a", "f8")])[0]}, "wanted plain numbers"),
        ({"poses": np.full((T, 72), complex("nan"))}, "wanted plain numbers"),
        ({"poses": np.zeros((T, 72), np.int8)}, "poses must be numbers with a fraction"),
        ({"betas": np.full(10, 1e300)}, "too large for float32"),
        ({"gender": "x" * 10_000}, "at most 32768 bytes of text"),
        ({"mocap_framerate": np.nan}, "frame rate"),
        ({"mocap_framerate": "fast"}, "mocap_framerate must be one number, got .*; say it, as in --fps 30"),
    ],
)
def test_files_that_are_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    path = save(tmp_path / "a.npz", **changes)
    with pytest.raises(MotionFileError, match=message) as caught:
        read_motion(path)
    assert str(path) in str(caught.value)


def test_other_files(tmp_path: Path) -> None:
    text = tmp_path / "a.npz"
    text.write_text("not a zip archive")
    for path in (tmp_path / "none.npz", tmp_path, text):
        with pytest.raises(MotionFileError, match="can't be read"):
            read_motion(path)


def test_every_truncation(tmp_path: Path) -> None:
    data = save(tmp_path / "a.npz").read_bytes()
    for cut in range(0, len(data), 97):
        (tmp_path / "cut.npz").write_bytes(data[:cut])
        with pytest.raises(MotionFileError):
            read_motion(tmp_path / "cut.npz")


def test_frames_that_are_not_finite_are_known_by_their_error(tmp_path: Path) -> None:
    poses = np.zeros((T, 72))
    poses[3, 5] = np.nan
    poses[4, 5] = 1e300
    motion = read_motion(save(tmp_path / "a.npz", poses=poses))
    for index in (3, 4):
        with pytest.raises(FrameError, match="NaN or infinite"):
            motion.frame(index)
    with pytest.raises(MotionFileError, match=r"a\.npz: 2 of 12 frames aren't finite \(the first: 3\)"):
        motion.resampled(30)
    with pytest.raises(MotionFileError, match=r"a\.npz: wanted a frame rate"):
        motion.in_place(up=1).resampled(0)


def test_a_rate_is_not_left_out_of_account_where_a_bag_has_stamps(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", [0, 10, 20])
    with pytest.raises(BagError, match="a frame rate is for files of motion"):
        load_motion(path, fps=30.0)


def test_damaged_files_say_what_was_wanted(tmp_path: Path) -> None:
    whole = pickle.dumps({"poses": np.zeros((T, 72))})
    for name, data in (("a.npz", b"PK no archive"), ("a.pkl", whole[:40]), ("b.pkl", b"\x80"), ("c.npz", b"text")):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(MotionFileError, match=r"wanted a motion: \.npz") as told:
            read_motion(tmp_path / name)
        assert "Error" not in str(told.value)


def test_resampling_ignores_jumps_of_full_turns() -> None:
    angle = np.linspace(0, 1.5, 31)
    axis = np.array([0.6, 0, 0.8])
    poses = np.zeros((31, 24, 3), np.float32)
    poses[:, 4] = (angle + 2 * np.pi * (np.arange(31) % 2))[:, None] * axis
    transl = np.stack([angle, angle**2, np.ones(31)], -1)
    motion = Motion(poses, transl, np.zeros(10, np.float32), fps=60.0)
    half, double = motion.resampled(30), motion.resampled(120)
    assert (len(half), len(double), half.fps) == (16, 61, 30)
    for other, at in ((half, angle[::2]), (double, np.linspace(0, 1.5, 61))):
        np.testing.assert_allclose(other.poses[:, 4], at[:, None] * axis, atol=1e-5)
        np.testing.assert_allclose(other.transl[:, 0], at, atol=1e-9)
    same = motion.resampled(60)
    turns = [Rotation.from_rotvec(one.poses.reshape(-1, 3)) for one in (same, motion)]
    assert (turns[0] * turns[1].inv()).magnitude().max() < 1e-6
    np.testing.assert_array_equal(same.transl, transl)
    assert len(Motion(poses[:1], transl[:1], motion.betas, 60.0).resampled(30)) == 1
    with pytest.raises(MotionFileError, match="frame rate"):
        motion.resampled(0)


def write_bag(path: Path, stamps: Any, *, thinner: int | None = None) -> str:
    encode = encoder_for("joint_state")
    with BagWriter(path) as writer:
        writer.add_topic("/smpl_params", INPUT_TYPES["joint_state"])
        for i, stamp in enumerate(stamps):
            frame = SmplFrame(np.zeros((24, 3)), np.full(10, float(i == thinner)), np.zeros(3), stamp_ns=int(stamp))
            writer.write("/smpl_params", encode(frame), log_time_ns=10**18 + i)
    return str(path)


def test_pauses_of_a_bag_slow_nobody_down(tmp_path: Path) -> None:
    even = 10**18 + np.arange(40) * 40_000_000
    slow, left, anew, jittered = 10**18 + np.arange(5) * 2 * 10**9, even.copy(), even.copy(), even.copy()
    left[15:] += 60 * 10**9
    anew[15:] -= 10**17
    jittered[1:-1] += RNG.integers(-60_000_000, 60_000_000, 38)
    for name, stamps, fps, n_pauses in (
        ("even", even, 25, 0), ("slow", slow, 0.5, 0), ("left", left, 25, 1), ("anew", anew, 25, 1),
        ("jittered", jittered, 25, 0), ("one", even[:1], 30, 0), ("still", np.full(5, 10**18), 30, 0),
    ):  # fmt: skip
        motion = load_motion(write_bag(tmp_path / name, stamps))
        assert (motion.fps, len(motion)) == (pytest.approx(fps), len(stamps)), name
        notes = ["pauses are left out (1): stamps jump by more than 1 s"] if n_pauses else []
        notes += ["stamps don't advance in 4 of 5 frames: does the sender's clock run?"] if name == "still" else []
        assert motion.notes == tuple(notes), name
    (note,) = load_motion(write_bag(tmp_path / "betas", even, thinner=3)).notes
    assert note.startswith("betas differ between frames")


def test_recorded_motion(motions: list[Path]) -> None:
    for path in motions:
        motion = read_motion(path)
        resampled = motion.resampled(30)
        assert abs(len(resampled) / 30 - len(motion) / motion.fps) < 0.1
        assert sum(1 for _ in resampled.frames()) == len(resampled)
