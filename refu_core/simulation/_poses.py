"""Where poses come from: recorded motions, everyday postures that these lack, and samples within joints' limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refu_core.body import MIRRORED_JOINTS
from refu_core.errors import SimulationError
from refu_core.frames import N_JOINTS
from refu_core.recordings import SUFFIXES, Axes, interpolated, is_named_as_motion, n_resampled, read_recording
from refu_core.skeleton import JOINT_NAMES, posed

_SHOWN = 3
"""How many files an error lists beside the first one."""
# Range of each joint's rotation vector [degrees] about x, y, z, for the left side where there are two; the right side
# is its mirror image. x points to the subject's left, y up, z forward, so a thigh is raised by a negative turn about x,
# an arm lowered by a negative turn about z, an elbow bent by a negative turn about y.
_LIMITS: dict[int, tuple[tuple[float, float], tuple[float, float], tuple[float, float]]] = {
    0: ((-15, 25), (0, 0), (-10, 10)),
    1: ((-85, 20), (-20, 20), (-5, 25)),
    3: ((-8, 18), (-12, 12), (-10, 10)),
    4: ((0, 100), (-5, 5), (0, 0)),
    6: ((-5, 15), (-12, 12), (-10, 10)),
    7: ((-20, 15), (-5, 5), (-5, 5)),
    9: ((-5, 12), (-10, 10), (-8, 8)),
    12: ((-20, 25), (-25, 25), (-12, 12)),
    13: ((-5, 5), (-12, 8), (-6, 14)),
    15: ((-15, 20), (-25, 25), (-12, 12)),
    16: ((-35, 45), (-75, 20), (-75, 65)),
    18: ((-20, 20), (-120, 0), (-10, 10)),
    20: ((-20, 20), (-15, 15), (-30, 30)),
}
_ACROBATS = _LIMITS | {
    0: ((0, 0), (0, 0), (0, 0)),
    1: ((-125, 40), (-25, 60), (-15, 65)),
    3: ((-20, 35), (-20, 20), (-20, 20)),
    4: ((0, 135), (-5, 5), (0, 0)),
}
"""Those of people who kick, roll, climb or turn cartwheels: legs and back go farther."""
_MOST_TILT = 120.0
"""How far acrobats are tilted from upright at most [degrees]: farther, loose cloth falls over the rest of the body."""


@dataclass(frozen=True, eq=False)
class Clip:
    """A recorded motion."""

    name: str
    """The file's stem."""
    poses: NDArray[np.float32]
    """Rotation vectors [rad], shape (T, 24, 3)."""
    transl: NDArray[np.float64]
    """Translations [m], shape (T, 3)."""
    fps: float
    """Frames a second."""
    notes: tuple[str, ...] = ()
    """What the reader assumed or converted, to be shown to the person who gave the file."""

    def resampled(self, fps: float) -> Clip:
        """The motion at another frame rate, rotations on the shorter arc; `SimulationError` above a million frames."""
        n = len(self.poses)
        try:
            wanted = np.minimum(np.arange(n_resampled(n, self.fps, fps)) * (self.fps / fps), n - 1)
        except ValueError as error:
            raise SimulationError(f"{self.name}: {error}") from error
        poses, transl = interpolated(self.poses, self.transl, np.arange(n), wanted)
        return Clip(self.name, poses.astype(np.float32), transl, fps, self.notes)


def load_clips(path: str | Path, *, axes: Axes = "auto", fps: float | None = None) -> list[Clip]:
    """The motions of a file or a folder, by name, with y up; `docs/guide/inputs.md` lists the recognised files.

    Args:
        path: a file, or a folder of files and subfolders, as in AMASS.
        axes: axes of the files' roots; `auto` infers them from how people stand, and says so in `Clip.notes`.
        fps: frames a second, instead of what the files say.

    Raises `SimulationError` for nothing there, or for files of another layout, all of which it names.
    """
    path = Path(path)
    files = [path]
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if is_named_as_motion(file.name))
    if not files or not files[0].exists():
        raise SimulationError(f"{path}: wanted motions ({', '.join(SUFFIXES)}), found none; give a folder or a file")
    clips, unfit, folder = [], {}, path if path.is_dir() else path.parent
    for file in files:
        name = file.relative_to(folder)
        try:
            found = read_recording(file, error=SimulationError, axes="z-up" if axes == "frame" else axes, fps=fps)
            if not (np.isfinite(found.poses).all() and np.isfinite(found.transl).all()):
                raise SimulationError(f"{file}: wanted finite poses and trans; cut out the frames that aren't")
        except SimulationError as error:
            unfit[name.as_posix()] = error
        else:
            clips.append(Clip(name.with_suffix("").as_posix(), found.poses, found.transl, found.fps, found.notes))
    if unfit:
        first, others = next(iter(unfit.values())), [*unfit][1:]
        if not others:
            raise first
        listing = ", ".join(others[:_SHOWN]) + (", …" if len(others) > _SHOWN else "")
        raise SimulationError(f"{first}; nor can these be used: {listing}") from first
    return clips


def split_clips(motions: str | Path | Sequence[Clip]) -> tuple[list[Clip], list[Clip]]:
    """Train and test clips: in order of name, every fifth from the second on is kept whole for the test.

    Instead of clips, a file or folder of them may be given. Raises `SimulationError` as `load_clips`, and for fewer
    than two clips, which can't be split.
    """
    clips = load_clips(motions) if isinstance(motions, (str, Path)) else motions
    if len(clips) < 2:
        raise SimulationError(f"wanted two motions or more, to keep whole ones for the test; got {len(clips)}")
    ordered = sorted(clips, key=lambda clip: clip.name)
    test = [clip for i, clip in enumerate(ordered) if i % 5 == 1]
    return [clip for clip in ordered if clip not in test], test


def without_heading(pose: NDArray[np.floating]) -> NDArray[np.float32]:
    """The pose (24, 3) turned about the vertical so that the root faces +z; its tilt stays [rad]."""
    root = Rotation.from_rotvec(np.asarray(pose[0], np.float64))
    forward = root.apply([0.0, 0.0, 1.0])
    if np.hypot(forward[0], forward[2]) < 0.1:  # lying: the head gives the heading, the feet if the face is up
        forward = root.apply([0.0, 1.0, 0.0]) * -np.sign(forward[1])
    out = np.array(pose, np.float32)
    out[0] = (Rotation.from_euler("y", -np.arctan2(forward[0], forward[2])) * root).as_rotvec()
    return out


def mirrored(poses: NDArray[np.floating]) -> NDArray[np.float32]:
    """The poses (…, 24, 3) of the mirror image, left and right exchanged [rad]."""
    return poses[..., MIRRORED_JOINTS, :] * np.array([1, -1, -1], np.float32)


def random_pose(rng: np.random.Generator) -> NDArray[np.float32]:
    """A pose (24, 3) within the limits of human joints [rad]; the middle of each range is likelier than its ends."""
    return _pose_within(_LIMITS, rng)


def _pose_within(limits: Mapping[int, Sequence[tuple[float, float]]], rng: np.random.Generator) -> NDArray[np.float32]:
    pose = np.zeros((N_JOINTS, 3))
    for joint, ranges in limits.items():
        low, high = np.radians(ranges).T
        pose[joint] = low + (high - low) * rng.beta(1.6, 1.6, 3)
        other = MIRRORED_JOINTS[joint]
        if other != joint:
            pose[other] = (low + (high - low) * rng.beta(1.6, 1.6, 3)) * (1, -1, -1)
    return pose.astype(np.float32)


def acrobatic_pose(rng: np.random.Generator) -> NDArray[np.float32]:
    """A pose (24, 3) of somebody tilted in any direction, with legs as far up and apart as acrobats' go [rad]."""
    pose = _pose_within(_ACROBATS, rng)
    way, tilt = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(0, _MOST_TILT))
    pose[0] = tilt * np.array([np.cos(way), 0, np.sin(way)])
    return without_heading(pose)


def clip_pose(clips: Sequence[Clip], rng: np.random.Generator) -> tuple[NDArray[np.float32], int, int]:
    """A frame of a clip, mirrored or not, without its heading; the clip's number; the frame's number."""
    lengths = np.array([len(clip.poses) for clip in clips], np.float64)
    which = int(rng.choice(len(clips), p=np.sqrt(lengths) / np.sqrt(lengths).sum()))  # short clips count, too
    frame = int(rng.integers(len(clips[which].poses)))
    pose = clips[which].poses[frame]
    if rng.random() < 0.5:
        pose = mirrored(pose)
    return without_heading(pose), which, frame


POSTURES = {
    "hanging arms": "both_shoulder 18 -16 -83, both_elbow 0 -9 0",
    "crossed arms": "left_shoulder 38 -67 -54, left_elbow 0 -95 0, right_shoulder 28 68 52, right_elbow 0 87 0",
    "hands on hips": "both_shoulder 72 -19 -52, both_elbow 0 -85 0",
    "hands in the lap": "both_shoulder 17 -35 -76, both_elbow 0 -61 0, both_hip -88 0 5, both_knee 85 0 0",
    "squat": "pelvis 30 0 0, spine1 10 0 0, spine2 10 0 0, neck -15 0 0, both_shoulder -36 -56 -64, "
    "both_elbow 0 -28 0, both_hip -118 0 14, both_knee 125 0 0, both_ankle -30 0 0",
    "sitting": "both_shoulder -4 -13 -80, both_elbow 0 -59 0, both_hip -85 0 8, both_knee 82 0 0",
    "prayer": "both_shoulder 18 -37 -66, both_elbow 0 -117 0",
    "lying curled up": "pelvis 0 0 90, spine1 18 0 0, spine2 18 0 0, spine3 12 0 0, neck 22 0 0, head 12 0 0, "
    "both_shoulder -25 -55 -73, both_elbow 0 -91 0, both_hip -115 0 -10, both_knee 122 0 0, both_ankle 15 0 0",
    "arms overhead": "both_collar 0 0 22, both_shoulder 8 -14 62, both_elbow 0 -15 0",
    "one arm overhead": "left_collar 0 0 22, left_shoulder 8 -14 62, left_elbow 0 -20 0, "
    "right_shoulder 18 16 83, right_elbow 0 9 0",
    "hands behind the head": "both_collar 0 0 12, both_shoulder -90 -32 22, both_elbow 0 -125 0",
    "hands behind the back": "both_shoulder 67 14 -72, both_elbow 0 -70 0",
    "hand at the ear": "left_shoulder -67 12 -68, left_elbow 0 -135 0, right_shoulder 18 16 83, right_elbow 0 9 0",
    "reaching forward": "both_collar 0 -10 0, both_shoulder 3 -75 -4, both_elbow 0 -15 0",
    "bent to the floor": "pelvis 45 0 0, spine1 25 0 0, spine2 15 0 0, spine3 10 0 0, both_shoulder 7 -75 -9, "
    "both_elbow 0 -10 0, both_hip -60 0 3, both_knee 20 0 0",
    "kneeling": "both_shoulder 18 -30 -76, both_elbow 0 -35 0, both_hip -10 0 6, both_knee 95 0 0, both_ankle 20 0 0",
    "crawling": "pelvis 80 0 0, neck -20 0 0, head -15 0 0, both_shoulder 0 -80 0, both_elbow 0 -10 0, "
    "both_hip -75 0 4, both_knee 85 0 0, both_ankle 25 0 0",
    "lunge": "left_hip -75 0 4, left_knee 80 0 0, right_hip 20 0 -4, right_knee 55 0 0, both_shoulder 10 -25 -70, "
    "both_elbow 0 -40 0",
    "cross-legged": "both_shoulder 14 -30 -72, both_elbow 0 -45 0, both_hip -89 80 -10, both_knee 122 0 0",
    "straddle": "both_shoulder 12 -50 -40, both_elbow 0 -15 0, both_hip -78 22 40, both_knee 8 0 0",
    "deep lunge": "left_hip -98 0 6, left_knee 98 0 0, right_hip 35 0 -5, right_knee 25 0 0, "
    "both_shoulder 10 -30 -60, both_elbow 0 -50 0",
    "side lunge": "pelvis 15 0 0, left_hip -55 15 42, left_knee 92 0 0, right_hip -12 0 -40, both_shoulder 0 -55 -45, "
    "both_elbow 0 -55 0",
    "high kick": "spine1 8 0 0, left_hip -98 0 5, left_knee 18 0 0, right_hip 6 0 0, both_shoulder 18 -16 -83, "
    "both_elbow 0 -9 0",
    "side kick": "pelvis 0 0 -20, left_hip -18 0 45, left_knee 12 0 0, right_hip 0 0 18, both_shoulder 0 -50 -40, "
    "both_elbow 0 -80 0",
    "hugging oneself": "left_collar 0 -12 0, right_collar 0 12 0, left_shoulder 28 -78 -38, left_elbow 0 -105 0, "
    "right_shoulder 14 80 28, right_elbow 0 98 0",
    "lying on the back": "pelvis -90 0 0, both_shoulder 8 -10 -62, both_hip -8 0 8, both_knee 12 0 0",
    "lying on the belly": "pelvis 90 0 0, neck -25 0 0, both_shoulder -18 8 38, both_elbow 0 -75 0, both_hip 0 0 8",
    "lying on the side": "pelvis 0 0 90, left_shoulder 0 0 55, right_shoulder 18 28 68, right_elbow 0 42 0, "
    "both_hip -28 0 0, both_knee 42 0 0",
    "running": "pelvis 8 0 0, spine1 4 0 0, left_hip -22 0 4, left_knee 108 0 0, right_hip -32 0 -4, "
    "right_knee 48 0 0, both_shoulder 10 -25 -70, both_elbow 0 -80 0",
    "pushing off": "pelvis 10 0 0, spine1 4 0 0, left_hip 18 0 4, left_knee 78 0 0, right_hip -58 0 -4, "
    "right_knee 72 0 0, both_shoulder 10 -25 -70, both_elbow 0 -80 0",
    "sprinting": "pelvis 15 0 0, spine1 6 0 0, left_hip -48 0 4, left_knee 130 0 0, right_hip 8 0 -4, "
    "right_knee 22 0 0, both_shoulder 10 -25 -70, both_elbow 0 -80 0",
    "heel at the seat": "left_hip 4 0 2, left_knee 124 0 0, both_shoulder 18 -16 -83, both_elbow 0 -9 0",
    "sitting on the heels": "both_hip -78 0 6, both_knee 142 0 0, both_ankle 30 0 0, both_shoulder 17 -35 -76, "
    "both_elbow 0 -50 0",
    "leg behind": "pelvis 40 0 0, spine1 -14 0 0, spine2 -14 0 0, spine3 -10 0 0, left_hip 42 15 12, left_knee 12 0 0, "
    "right_hip -40 0 0, both_shoulder 0 -40 -20, both_elbow 0 -15 0",
    "leg to the side": "pelvis 0 0 -8, left_hip -22 35 72, left_knee 8 0 0, right_hip 0 0 8, both_shoulder 0 -20 -25, "
    "both_elbow 0 -20 0",
    "foot at the knee": "left_hip -62 48 48, left_knee 118 0 0, both_shoulder 0 -35 -40, both_elbow 0 -35 0",
    "bent knees turned out": "both_hip -55 48 42, both_knee 98 0 0, both_ankle -22 0 0, both_shoulder 0 -25 -40, "
    "both_elbow 0 -25 0",
}
"""By name: rotation vectors [degrees] in SMPL's axes, x to the left, as `refu_core.skeleton.posed` reads them."""
SELF_TOUCHING = tuple(POSTURES)[:8]
"""The postures in which the skin intersects itself."""
FIRST_POSTURES = tuple(POSTURES)[:18]
"""The postures of plans that don't say which."""
_SPREAD = 8.0
"""Standard deviation of a drawn posture's joints about the named one, in each coordinate [degrees]."""
_STIFF = tuple(JOINT_NAMES.index(f"{side}_{name}") for side in ("left", "right") for name in ("foot", "wrist", "hand"))
"""Joints that affect no garment; they aren't varied."""


def posture(name: str) -> NDArray[np.float32]:
    """One of `POSTURES`, rotation vectors [rad], shape (24, 3). Raises `KeyError` for another name."""
    return np.radians(posed(POSTURES[name])).astype(np.float32)


def drawn_posture(rng: np.random.Generator, names: Sequence[str]) -> tuple[NDArray[np.float32], int]:
    """One of the postures `names`, varied at random, mirrored or not, without heading; and its number in `POSTURES`.

    Rotation vectors [rad], shape (24, 3).
    """
    name = names[int(rng.integers(len(names)))]
    noise = np.radians(rng.normal(0.0, _SPREAD, (len(JOINT_NAMES), 3)))
    noise[_STIFF, :] = 0.0
    named = Rotation.from_rotvec(posture(name).astype(np.float64))
    pose = (Rotation.from_rotvec(noise) * named).as_rotvec().astype(np.float32)
    if rng.random() < 0.5:
        pose = mirrored(pose)
    return without_heading(pose), tuple(POSTURES).index(name)


def drawn_pose(
    clips: Sequence[Clip],
    rng: np.random.Generator,
    *,
    recorded_share: float,
    posture_share: float,
    acrobatic_share: float = 0.0,
    postures: Sequence[str] = FIRST_POSTURES,
) -> tuple[NDArray[np.float32], int, int]:
    """A clip's frame, a varied posture, an acrobat's pose or one within joints' limits, (24, 3) [rad]; clip and frame.

    Without a clip its number is -1 and the frame is the posture's number, or -1 for an acrobat's or a random pose.
    """
    kind = rng.random()
    if kind < recorded_share and clips:
        return clip_pose(clips, rng)
    if recorded_share <= kind < recorded_share + posture_share:
        pose, which = drawn_posture(rng, postures)
        return pose, -1, which
    is_acrobatic = recorded_share + posture_share <= kind < recorded_share + posture_share + acrobatic_share
    return acrobatic_pose(rng) if is_acrobatic else random_pose(rng), -1, -1
