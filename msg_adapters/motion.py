"""Recorded motion: what archives, pose estimators and motion capture write, as frames in SMPL's axes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from msg_adapters.bags import iter_smpl_frames
from msg_adapters.cdr import NS_PER_S
from msg_adapters.errors import BagError, MotionFileError
from msg_adapters.people import Track, check_plausible
from refu_core.frames import SmplFrame
from refu_core.keypoints import Proportions
from refu_core.recordings import SUFFIXES, Axes, Recording, interpolated, n_resampled, not_finite, read_recording
from refu_core.skeleton import JOINT_NAMES

_PAUSE_NS = NS_PER_S
"""A longer step between a bag's frames is a pause, unless such steps are usual in that bag."""


@dataclass(frozen=True, eq=False)
class Motion(Recording):
    """A recording as frames."""

    source: str = "motion"
    """What it was read from: errors begin with it."""

    def __repr__(self) -> str:
        return f"Motion({self.source}: {len(self)} frames at {self.fps:g} Hz, {self.gender})"

    def __len__(self) -> int:
        return len(self.poses)

    def frame(self, index: int) -> SmplFrame:
        """Frame `index`, stamped from 0 on.

        Raises `FrameError` (of `refu_core`) for numbers that aren't finite, or that no body has: recordings have them.
        """
        stamp_ns = round(index * NS_PER_S / self.fps)
        frame = SmplFrame(self.poses[index], betas=self.betas, transl=self.transl[index], stamp_ns=stamp_ns)
        check_plausible(frame)  # messages may be of float32, in which the largest would be infinite
        return frame

    def frames(self) -> Iterator[SmplFrame]:
        """All frames in order; raises as `frame` does."""
        return map(self.frame, range(len(self)))

    def resampled(self, fps: float) -> Motion:
        """The motion at another frame rate: rotations on the shorter arc, translations along straight lines.

        Raises `MotionFileError` for a rate outside [0.001, 10000], more than a million frames, and where a frame isn't
        finite.
        """
        try:
            count = n_resampled(len(self), self.fps, fps)
        except ValueError as error:
            raise MotionFileError(f"{self.source}: {error}") from error
        bad = not_finite(self.poses, self.transl)
        if bad.size:
            what = f"{bad.size} of {len(self)} frames aren't finite (the first: {bad[0]})"
            raise MotionFileError(f"{self.source}: {what}; cut them out, or leave the rate at its own {self.fps:g} Hz")
        at = np.minimum(np.arange(count) * (self.fps / fps), len(self) - 1)
        poses, transl = interpolated(self.poses, self.transl, np.arange(len(self)), at)
        return replace(self, poses=poses.astype(np.float32), transl=transl, fps=float(fps))

    def in_place(self, *, up: int) -> Motion:
        """The motion with its translations held at the first frame's, except along the axis `up`."""
        held = np.repeat(self.transl[:1], len(self), axis=0)
        held[:, up] = self.transl[:, up]
        return replace(self, transl=held)


def read_motion(
    path: str | Path,
    *,
    fps: float | None = None,
    axes: Axes = "auto",
    person: str | None = None,
    worn: Proportions | None = None,
) -> Motion:
    """Reads a file of motion: `docs/guide/inputs.md` lists what is recognised.

    Arguments are as in `refu_core.recordings.read_recording`. The axes `auto` are inferred from how people stand, which
    the motion's `notes` say; `worn` is made by `Proportions.of_body`. The motion is in SMPL's axes, except for `frame`,
    which leaves it as it is.

    Raises `MotionFileError` for a file that can't be read or isn't recognised, or whose arrays have other shapes.
    """
    recording = read_recording(path, error=MotionFileError, fps=fps, axes=axes, person=person, worn=worn)
    return Motion(**{item.name: getattr(recording, item.name) for item in fields(recording)}, source=str(path))


def load_motion(path: str, *, axes: Axes = "auto", fps: float = 0.0) -> Motion:
    """The motion of a file, of a bag, or `march` for an empty path.

    A bag's frames are spaced evenly, without its pauses, and have the betas of the first.
    A file's axes and rate (0 for its own) are as in `read_motion`. Raises `MotionFileError` and `BagError`.
    """
    if not path:
        return march()
    if Path(path).suffix.lower() in SUFFIXES:
        return read_motion(path, axes=axes, fps=fps or None)
    if fps:
        msg = f"{path}: a frame rate is for files of motion ({', '.join(SUFFIXES)}); a bag's frames have stamps"
        raise BagError(msg)
    frames = [record.frame for record in iter_smpl_frames(path) if record.frame is not None]
    if not frames:
        raise BagError(f"{path}: no frame of its SMPL topic can be decoded; `refu replay {path}` says why")
    steps = np.diff([frame.stamp_ns for frame in frames])
    longest = max(_PAUSE_NS, 3 * float(np.median(np.abs(steps)))) if len(steps) else 0.0
    kept = steps[np.abs(steps) <= longest]  # small steps back are kept, too: they are no pause
    seconds = int(kept.sum()) / NS_PER_S
    fps = len(kept) / seconds if seconds > 0 else MARCH_FPS
    notes = []
    if n_pauses := len(steps) - len(kept):
        notes.append(f"pauses are left out ({n_pauses}): stamps jump by more than {longest / NS_PER_S:g} s")
    track = Track()
    for frame in frames:
        track.add(frame)
    notes += track.doubts(up=None if axes == "frame" else np.array([0.0, 1.0, 0.0])).values()
    if any((frame.betas != frames[0].betas).any() for frame in frames):
        notes.append("betas differ between frames: a person has one shape, the first frame's")
    poses, transl = (np.stack(arrays) for arrays in zip(*((f.pose, f.transl) for f in frames), strict=True))
    return Motion(poses, transl, frames[0].betas, fps, notes=tuple(notes), source=path)


MARCH_FPS = 30.0
_STEPS_S = 1.2  # of one step
_ROOT_HEIGHT_M = 1.156  # of the built-in male body's root above its soles


def march() -> Motion:
    """Steps on the spot with swinging arms, in SMPL axes; the end joins the beginning."""
    t = np.arange(round(2 * _STEPS_S * MARCH_FPS)) / (2 * _STEPS_S * MARCH_FPS) * 2 * np.pi
    pose = np.zeros((len(t), len(JOINT_NAMES), 3))
    x, z = np.eye(3)[[0, 2]]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        lift = np.maximum(sign * np.sin(t), 0) ** 2  # one leg always stands, straight
        pose[:, JOINT_NAMES.index(f"{side}_hip"), 0] = -0.9 * lift
        pose[:, JOINT_NAMES.index(f"{side}_knee"), 0] = 1.3 * lift
        pose[:, JOINT_NAMES.index(f"{side}_ankle"), 0] = -0.4 * lift  # the sole stays level
        down = Rotation.from_rotvec(-sign * 1.15 * z)
        swing = Rotation.from_rotvec((0.5 * sign * np.sin(t))[:, None] * x)
        pose[:, JOINT_NAMES.index(f"{side}_shoulder")] = (swing * down).as_rotvec()
        pose[:, JOINT_NAMES.index(f"{side}_elbow"), 1] = -sign * 0.4
    pose[:, JOINT_NAMES.index("spine2"), 1] = 0.12 * np.sin(t)
    transl = np.tile([0.0, _ROOT_HEIGHT_M, 0.0], (len(t), 1))
    return Motion(pose.astype(np.float32), transl, np.zeros(10, np.float32), MARCH_FPS)
