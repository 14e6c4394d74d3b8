"""Where poses come from: frames of recorded motions, samples within the limits of human joints, and room for cloth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from refu_core._amass import n_resampled, read_recording
from refu_core.body import ARMS, LEGS, MIRRORED_JOINTS, joints_of
from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.metrics._self_contact import SelfContactDetector
from refu_core.simulation._drape import canonical_pose
from refu_core.simulation._errors import SimulationError

if TYPE_CHECKING:
    from refu_core.body import SmplBody
    from refu_core.garments import GarmentTemplate

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
# With an arm goes its collar.
_LIMBS = ((13, *ARMS[0]), (14, *ARMS[1]), *LEGS)
_FREE_LIMBS = (*LEGS[0], *LEGS[1], *joints_of("left_forearm", "right_forearm"))


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

    def resampled(self, fps: float) -> Clip:
        """The motion at another frame rate, rotations on the shorter arc; `SimulationError` for a million frames."""
        n = len(self.poses)
        if n < 2:
            return self
        try:
            wanted = np.arange(n_resampled(n, self.fps, fps)) / fps
        except ValueError as error:
            msg = f"{self.name}: {error}"
            raise SimulationError(msg) from error
        times = np.arange(n) / self.fps
        poses = np.stack(
            [Slerp(times, Rotation.from_rotvec(self.poses[:, j]))(wanted).as_rotvec() for j in range(N_JOINTS)], 1
        )
        transl = np.stack([np.interp(wanted, times, self.transl[:, k]) for k in range(3)], 1)
        return Clip(self.name, poses.astype(np.float32), transl, fps)


def load_clips(path: str | Path) -> list[Clip]:
    """The AMASS-style motions (`.npz` with poses, trans, mocap_framerate) of a file or a folder, by name.

    Raises:
        SimulationError: nothing there, or a file of another layout.
    """
    path = Path(path)
    files = sorted(path.glob("*.npz")) if path.is_dir() else [path]
    if not files or not files[0].exists():
        msg = f"{path}: wanted AMASS-style .npz motions, found none; give a folder of them or a file"
        raise SimulationError(msg)
    return [_load_clip(file) for file in files]


def _load_clip(path: Path) -> Clip:
    recording = read_recording(path, error=SimulationError)
    if not (np.isfinite(recording.poses).all() and np.isfinite(recording.transl).all()):
        msg = f"{path}: wanted finite poses and trans; cut out the frames that aren't"
        raise SimulationError(msg)
    return Clip(path.stem, recording.poses, recording.transl, recording.fps)


def split_clips(clips: Sequence[Clip], *, test_every: int = 5) -> tuple[list[Clip], list[Clip]]:
    """Train and test clips: every `test_every`-th by name, from the second on, is kept for the test, whole.

    Raises `SimulationError` for fewer than two clips, which can't be split.
    """
    if len(clips) < 2:
        msg = f"wanted two motions or more, so that whole ones can be kept for the test; got {len(clips)}"
        raise SimulationError(msg)
    ordered = sorted(clips, key=lambda clip: clip.name)
    test = [clip for i, clip in enumerate(ordered) if i % test_every == 1]
    return [clip for clip in ordered if clip not in test], test


def without_heading(pose: NDArray[np.floating]) -> NDArray[np.float32]:
    """The pose (24, 3) turned about the vertical so that the root faces +z; its tilt stays [rad]."""
    root = Rotation.from_rotvec(np.asarray(pose[0], np.float64))
    forward = root.apply([0.0, 0.0, 1.0])
    if np.hypot(forward[0], forward[2]) < 0.1:  # lying: the heading is that of the head
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
    which = int(rng.choice(len(clips), p=np.sqrt(lengths) / np.sqrt(lengths).sum()))  # short clips have their say
    frame = int(rng.integers(len(clips[which].poses)))
    pose = clips[which].poses[frame]
    if rng.random() < 0.5:
        pose = mirrored(pose)
    return without_heading(pose), which, frame


@dataclass(frozen=True)
class RoomSettings:
    """How much room a garment needs between limbs."""

    near: float = 0.008
    """A vertex this close to skin that touches other skin has no room [m]."""
    padding: float = 0.002
    """Room that cloth takes on the skin of the trunk and the upper arms [m]."""
    limb_padding: float = 0.004
    """Room that it takes on the legs, which have two layers between them, and on forearms and hands [m]."""
    tolerated: int = 4
    """Vertices without room that don't count yet: creases of elbow and groin press skin on skin, too."""
    step: float = 0.15
    """Share of its way that a limb is moved back at once."""
    least: float = 0.0
    """Share of the way that a limb must go at least."""


class RoomMaker:
    """Keeps limbs from pressing into each other where the garment would lie between them.

    Recorded arms hang so close that the built-in bodies' upper arms sink into their flanks: no sleeve can be free of
    both. A limb that touches is moved back on its way from the canonical pose, a little at a time, until there is room.
    """

    def __init__(self, garment: GarmentTemplate, body: SmplBody, *, settings: RoomSettings | None = None) -> None:
        """For `garment` on `body`, both on the CPU."""
        self.settings = settings or RoomSettings()
        self._garment = garment
        self._body = body
        rest = body.rest_vertices(torch.zeros(1, N_BETAS))[0]
        free = body.weights.argmax(1)[:, None] == torch.tensor(_FREE_LIMBS)
        self._padding = torch.where(free.any(1), self.settings.limb_padding, self.settings.padding)[:, None]
        self._detector = SelfContactDetector(body.faces, self._padded(rest))
        main_joint = body.weights.argmax(1)[body.faces[:, 0]].numpy()
        self._limb = np.full(len(main_joint), -1)
        for k, joints in enumerate(_LIMBS):
            self._limb[np.isin(main_joint, joints)] = k

    def _padded(self, vertices: torch.Tensor) -> torch.Tensor:
        """Body vertices moved out by what cloth between two limbs takes from the gap on either side."""
        corners = vertices[self._body.faces]
        normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        summed = torch.zeros_like(vertices).index_add_(0, self._body.faces.reshape(-1), normals.repeat_interleave(3, 0))
        return vertices + self._padding * torch.nn.functional.normalize(summed, dim=1)

    def crowded(
        self, pose: NDArray[np.float32], betas: NDArray[np.floating], style: NDArray[np.floating]
    ) -> tuple[int, NDArray[np.intp]]:
        """How many vertices of the skinned garment have no room, and which limbs (0 to 3, see `_LIMBS`) take it."""
        shape = torch.as_tensor(betas, dtype=torch.float32).view(1, N_BETAS)
        posed = self._body(pose[None], shape)
        contact = self._detector.detect(self._padded(posed.vertices[0]))
        if contact.is_free:
            return 0, np.zeros(0, np.intp)
        gamma = None if self._garment.styledirs is None else torch.as_tensor(style, dtype=torch.float32).view(1, -1)
        skinned = self._garment.pose(self._garment.rest(shape, gamma), posed.transforms)[0]
        near = contact.near(skinned, distance=self.settings.near)
        centres = contact.vertices[self._body.faces.numpy()[contact.faces]].mean(1)
        if not near.any():
            return 0, np.zeros(0, np.intp)
        cloth = skinned.numpy()[near]
        close = np.array([((cloth - c) ** 2).sum(1).min() < 0.03**2 for c in centres])
        limbs = np.unique(self._limb[contact.faces[close]])
        return int(near.sum()), limbs[limbs >= 0]

    @property
    def n_limbs(self) -> int:
        """Limbs that can be held back."""
        return len(_LIMBS)

    def make_room(
        self, pose: NDArray[np.float32], betas: NDArray[np.floating], style: NDArray[np.floating]
    ) -> tuple[NDArray[np.float32], float] | None:
        """The pose with limbs moved back until the garment has room, and the share of the way that the most held-back
        limb goes; None where that isn't enough (the trunk folds, or a limb is back in the canonical pose)."""
        share = self.shares(pose, betas, style)
        return None if share is None else (self.held_back(pose, share), float(share.min()))

    def shares(
        self,
        pose: NDArray[np.float32],
        betas: NDArray[np.floating],
        style: NDArray[np.floating],
        *,
        start: NDArray[np.floating] | None = None,
    ) -> NDArray[np.float64] | None:
        """The share of its way that each limb may go, shape (4,), none of them above `start`; None as `make_room`."""
        share = np.ones(len(_LIMBS)) if start is None else np.array(start, np.float64)
        while True:
            count, limbs = self.crowded(self.held_back(pose, share), betas, style)
            if count <= self.settings.tolerated:
                return share
            share[limbs] -= self.settings.step
            if not len(limbs) or share.min() < self.settings.least - 1e-6:
                return None

    def held_back(self, pose: NDArray[np.float32], share: NDArray[np.floating]) -> NDArray[np.float32]:
        """The pose with each limb at its share, (4,), of its way from the canonical pose."""
        held = pose
        for k, joints in enumerate(_LIMBS):
            if share[k] < 1:
                j = list(joints)
                held = pose.copy() if held is pose else held
                first = Rotation.from_rotvec(canonical_pose()[j].astype(np.float64))
                turn = (first.inv() * Rotation.from_rotvec(pose[j].astype(np.float64))).as_rotvec()
                held[j] = (first * Rotation.from_rotvec(turn * share[k])).as_rotvec()
        return held
