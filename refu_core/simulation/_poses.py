"""Where poses come from: frames of recorded motions, and samples within the limits of human joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from refu_core.body import MIRRORED_JOINTS
from refu_core.errors import SimulationError
from refu_core.frames import N_JOINTS
from refu_core.recordings import SUFFIXES, Axes, interpolated, n_resampled, read_recording

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
            msg = f"{self.name}: {error}"
            raise SimulationError(msg) from error
        poses, transl = interpolated(self.poses, self.transl, np.arange(n), wanted)
        return Clip(self.name, poses.astype(np.float32), transl, fps, self.notes)


def load_clips(path: str | Path, *, axes: Axes = "auto", fps: float | None = None) -> list[Clip]:
    """The motions of a file or a folder, by name, with y up; `docs/guide/inputs.md` lists the recognised files.

    Args:
        path: a file, or a folder of files and subfolders, as in AMASS.
        axes: axes of the files' roots; `auto` infers them from how people stand, and says so in `Clip.notes`.
        fps: frames a second, instead of what the files say.

    Raises:
        SimulationError: nothing there, or a file of another layout.
    """
    path = Path(path)
    files = [path]
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.suffix.lower() in SUFFIXES and not _is_shape(file))
    if not files or not files[0].exists():
        msg = f"{path}: wanted motions ({', '.join(SUFFIXES)}), found none; give a folder of them or a file"
        raise SimulationError(msg)
    clips, folder = [], path if path.is_dir() else path.parent
    for file in files:
        found = read_recording(file, error=SimulationError, axes="z-up" if axes == "frame" else axes, fps=fps)
        if not (np.isfinite(found.poses).all() and np.isfinite(found.transl).all()):
            msg = f"{file}: wanted finite poses and trans; cut out the frames that aren't"
            raise SimulationError(msg)
        name = file.relative_to(folder).with_suffix("").as_posix()
        clips.append(Clip(name, found.poses, found.transl, found.fps, found.notes))
    return clips


def as_clips(motions: str | Path | Sequence[Clip]) -> list[Clip]:
    """The given clips, or those loaded from a file or folder. Raises as `load_clips`."""
    return load_clips(motions) if isinstance(motions, (str, Path)) else list(motions)


def _is_shape(path: Path) -> bool:
    """Whether a file holds a shape without motion; AMASS keeps such files among its motions."""
    return path.name == "shape.npz" or path.stem.endswith("_stagei")


def split_clips(clips: Sequence[Clip]) -> tuple[list[Clip], list[Clip]]:
    """Train and test clips: in order of name, every fifth from the second on is kept whole for the test.

    Raises `SimulationError` for fewer than two clips, which can't be split.
    """
    if len(clips) < 2:
        msg = f"wanted two motions or more, so that whole ones can be kept for the test; got {len(clips)}"
        raise SimulationError(msg)
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


def mirrored(pose: NDArray[np.floating]) -> NDArray[np.float32]:
    """The pose (24, 3) of the mirror image, left and right exchanged [rad]."""
    image: NDArray[np.float32] = np.asarray(pose, np.float32)[MIRRORED_JOINTS,] * np.array([1, -1, -1], np.float32)
    return image


def random_pose(rng: np.random.Generator) -> NDArray[np.float32]:
    """A pose (24, 3) within the limits of human joints [rad]; the middle of each range is likelier than its ends."""
    pose = np.zeros((N_JOINTS, 3))
    for joint, ranges in _LIMITS.items():
        low, high = np.radians(ranges).T
        pose[joint] = low + (high - low) * rng.beta(1.6, 1.6, 3)
        other = MIRRORED_JOINTS[joint]
        if other != joint:
            pose[other] = (low + (high - low) * rng.beta(1.6, 1.6, 3)) * (1, -1, -1)
    return pose.astype(np.float32)


def clip_pose(clips: Sequence[Clip], rng: np.random.Generator) -> tuple[NDArray[np.float32], int, int]:
    """A frame of a clip, mirrored or not, without its heading; the clip's number; the frame's number."""
    lengths = np.array([len(clip.poses) for clip in clips], np.float64)
    which = int(rng.choice(len(clips), p=np.sqrt(lengths) / np.sqrt(lengths).sum()))  # short clips count, too
    frame = int(rng.integers(len(clips[which].poses)))
    pose = clips[which].poses[frame]
    if rng.random() < 0.5:
        pose = mirrored(pose)
    return without_heading(pose), which, frame
