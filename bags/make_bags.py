"""Write the two bags of this folder: `walk` and `reach_squat`, ten seconds of procedural motion each, at 30 Hz.

Joint angles come from curves (a gait cycle; eased key poses). The root's translation follows from ground contact: the
standing sole doesn't slide, and the lowest one touches the floor.

The shipped `reach_squat` predates the built-in body's shape directions. Because its betas aren't zero, its hips differ
by up to 0.0028 rad and its translation by 6 mm from what is written now; `walk`, whose betas are zero, by 2 µm.

    python bags/make_bags.py            # beside this script
    python bags/make_bags.py elsewhere
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from msg_adapters import INPUT_TYPES, BagWriter, encoder_for
from refu_core import SmplFrame, load_body
from refu_core.skeleton import JOINT_NAMES

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

FPS = 30
SECONDS = 10
START_NS = 1_700_000_000_000_000_000
TOPIC = "/smpl_params"
CHUNK_BYTES = 16 << 10  # small chunks: if a bag is cut short, the chunks before the cut can still be read
CONTACT_M = 0.004  # a sole this near the floor counts as standing on it
LEG_M = 0.85
Curve = NDArray[np.float64]

# Angles of a leg over one gait cycle from heel strike to heel strike [fraction, degrees]: ordinary level walking.
HIP_FLEXION = [(0, 26), (0.12, 23), (0.30, 6), (0.50, -10), (0.62, -2), (0.75, 20), (0.87, 30), (1, 26)]
KNEE_FLEXION = [
    (0, 5), (0.12, 16), (0.30, 7), (0.42, 5), (0.50, 11), (0.62, 38), (0.73, 60), (0.85, 36), (0.95, 7), (1, 5),
]  # fmt: skip
DORSIFLEXION = [(0, 0), (0.07, -5), (0.30, 7), (0.45, 10), (0.53, 4), (0.63, -17), (0.74, -3), (0.86, 2), (1, 0)]
TOE_EXTENSION = [(0, 4), (0.1, 0), (0.35, 0), (0.50, 18), (0.60, 24), (0.70, 2), (0.85, 4), (1, 4)]
CYCLE_S = 1.12

# Key poses of reach_squat: time [s] and the angles [degrees] that differ from standing.
KEY_POSES: list[tuple[float, dict[str, float]]] = [
    (0.0, {}),
    (0.6, {}),
    (2.0, {"raise_right": 128, "elbow_right": 12, "lean": -4, "bend_left": 4, "twist_left": 8, "look_up": 14}),
    (2.6, {"raise_right": 132, "elbow_right": 8, "lean": -4, "bend_left": 6, "twist_left": 10, "look_up": 16}),
    (3.9, {"raise_right": 62, "raise_left": 62, "elbow_right": 30, "elbow_left": 30, "twist_left": 36}),
    (5.3, {"raise_right": 62, "raise_left": 62, "elbow_right": 30, "elbow_left": 30, "twist_left": -36}),
    (6.2, {"raise_right": 40, "raise_left": 40, "elbow_right": 25, "elbow_left": 25}),
    (7.7, {"raise_right": 74, "raise_left": 74, "elbow_right": 18, "elbow_left": 18, "squat": 82, "lean": 20}),
    (8.1, {"raise_right": 75, "raise_left": 75, "elbow_right": 18, "elbow_left": 18, "squat": 84, "lean": 20}),
    (9.5, {}),
    (10.0, {}),
]
REACH_BETAS = (0.6, -0.8, 0.5, 0.0, -0.4, 0.3, 0.0, 0.0, 0.2, 0.0)


@dataclass(frozen=True)
class Angles:
    """Rotations of some joints over time, built from turns about SMPL's axes [degrees], each shape (T,)."""

    rotations: dict[str, Rotation]

    def turn(self, joint: str, axis: str, degrees: Curve) -> None:
        """Turn a joint about an axis of its parent, on top of the turns it already has."""
        turn = Rotation.from_rotvec(np.radians(degrees)[:, None] * np.eye(3)["xyz".index(axis)])
        self.rotations[joint] = turn * self.rotations[joint] if joint in self.rotations else turn

    def pose(self, count: int) -> NDArray[np.float64]:
        """Rotation vectors [rad], shape (T, 24, 3)."""
        pose = np.zeros((count, len(JOINT_NAMES), 3))
        for joint, rotation in self.rotations.items():
            pose[:, JOINT_NAMES.index(joint)] = rotation.as_rotvec()
        return pose


def arm(angles: Angles, side: str, *, down: Curve, forward: Curve, elbow: Curve) -> None:
    """Lower an arm from the T-pose, swing it forward, bend the elbow."""
    sign = 1.0 if side == "left" else -1.0
    angles.turn(f"{side}_elbow", "y", -sign * elbow)
    angles.turn(f"{side}_shoulder", "x", np.full_like(down, 8.0))  # the palm faces the thigh, slightly
    angles.turn(f"{side}_shoulder", "z", -sign * (down - 5))
    angles.turn(f"{side}_shoulder", "x", -forward)
    angles.turn(f"{side}_collar", "z", -sign * np.full_like(down, 5.0))


def walk_pose(t: Curve) -> NDArray[np.float64]:
    """A steady walk, pose (T, 24, 3) [rad] at times [s]."""
    angles = Angles({})
    phase = t / CYCLE_S
    turn = 2 * np.pi * phase
    yaw, roll = -5 * np.cos(turn), 2.5 * np.sin(turn)
    angles.turn("pelvis", "z", roll)
    angles.turn("pelvis", "y", yaw)
    angles.turn("pelvis", "x", np.full_like(t, 2.0))
    for side, shift in (("left", 0.0), ("right", 0.5)):
        sign = 1.0 if side == "left" else -1.0
        cycle = (phase + shift) % 1.0
        angles.turn(f"{side}_hip", "x", -gait(HIP_FLEXION, cycle))
        angles.turn(f"{side}_hip", "z", sign * 2.0 - roll)  # feet a little apart, and level whatever the pelvis does
        angles.turn(f"{side}_hip", "y", sign * 4.0 - yaw)
        angles.turn(f"{side}_knee", "x", gait(KNEE_FLEXION, cycle))
        angles.turn(f"{side}_ankle", "x", -gait(DORSIFLEXION, cycle))
        angles.turn(f"{side}_foot", "x", -gait(TOE_EXTENSION, cycle))
        swing = -np.cos(2 * np.pi * cycle)  # opposite to the leg of the same side
        arm(angles, side, down=np.full_like(t, 66.0), forward=4 + 17 * swing, elbow=24 + 9 * swing)
    for joint, share in (("spine1", 0.3), ("spine2", 0.4), ("spine3", 0.7)):
        angles.turn(joint, "y", -share * 1.8 * yaw)
        angles.turn(joint, "z", -0.4 * roll)
    angles.turn("head", "y", 0.9 * yaw)
    return angles.pose(len(t))


def reach_squat_pose(t: Curve) -> NDArray[np.float64]:
    """Reach up with one arm, twist to both sides, squat; pose (T, 24, 3) [rad] at times [s]."""
    body = load_body("male")
    ankles = [JOINT_NAMES.index(f"{side}_ankle") for side in ("left", "right")]
    abduction = np.full_like(t, 5.0)
    for _ in range(8):  # open the legs just far enough that the feet stay where they are
        pose = reach_squat_angles(t, abduction).pose(len(t))
        left, right = body(pose, betas=np.array([REACH_BETAS])).joints[:, ankles].double().numpy().transpose(1, 0, 2)
        width = left[:, 0] - right[:, 0]
        abduction += np.degrees(width[0] - width) / (2 * LEG_M)
    return pose


def reach_squat_angles(t: Curve, abduction: Curve) -> Angles:
    """The joint angles of `reach_squat_pose`, with the legs opened by `abduction` [degrees], shape (T,)."""
    key = {name: ease(name, t) for name in {name for _, pose in KEY_POSES for name in pose}}
    sway = np.sin(2 * np.pi * t / 3.3)  # nobody stands like a statue
    angles = Angles({})
    angles.turn("pelvis", "x", 0.55 * key["lean"] + 0.3 * sway)
    for side in ("left", "right"):
        sign = 1.0 if side == "left" else -1.0
        squat = key["squat"]
        angles.turn(f"{side}_hip", "x", -(0.92 * squat + 0.55 * key["lean"] + 0.3 * sway) - 2)
        angles.turn(f"{side}_hip", "z", sign * abduction)
        angles.turn(f"{side}_hip", "y", sign * (9 + 0.15 * squat))
        angles.turn(f"{side}_knee", "x", 1.18 * squat + 4)
        angles.turn(f"{side}_ankle", "x", -(0.26 * squat + 2))
        angles.turn(f"{side}_ankle", "z", -sign * abduction)
        lift = key[f"raise_{side}"]
        down = 66 - 0.12 * np.minimum(lift, 80)
        arm(angles, side, down=down, forward=3 + lift + sway, elbow=12 + key[f"elbow_{side}"])
    for joint, share in (("spine1", 0.25), ("spine2", 0.35), ("spine3", 0.4)):
        angles.turn(joint, "x", share * 0.9 * key["lean"])
        angles.turn(joint, "z", share * key["bend_left"] + 0.2 * sway)
        angles.turn(joint, "y", share * key["twist_left"])
    angles.turn("neck", "y", 0.25 * key["twist_left"])
    angles.turn("head", "y", 0.20 * key["twist_left"])
    angles.turn("head", "x", -key["look_up"] - 0.5 * key["lean"])
    return angles


def gait(knots: Sequence[tuple[float, float]], cycle: Curve) -> Curve:
    """A periodic curve [degrees] through `knots`, at fractions of the cycle."""
    at, value = np.array(knots, dtype=np.float64).T
    curve: Curve = CubicSpline(at, value, bc_type="periodic")(cycle)
    return curve


def ease(name: str, t: Curve) -> Curve:
    """One angle of the key poses [degrees], from key to key with the smoothness of human reaching (minimum jerk)."""
    at = np.array([time for time, _ in KEY_POSES], dtype=np.float64)
    value = np.array([pose.get(name, 0.0) for _, pose in KEY_POSES])
    i = np.clip(np.searchsorted(at, t, side="right") - 1, 0, len(at) - 2)
    s = np.clip((t - at[i]) / (at[i + 1] - at[i]), 0, 1)
    eased: Curve = value[i] + (value[i + 1] - value[i]) * s**3 * (10 - 15 * s + 6 * s**2)
    return eased


def grounded_translation(pose: NDArray[np.float64], betas: NDArray[np.float64]) -> NDArray[np.float64]:
    """Translations [m], shape (T, 3), that keep the standing sole in place and the lowest one on the floor (y = 0)."""
    body = load_body("male")
    weights = body.weights[
        :, [JOINT_NAMES.index(f"{side}_{part}") for side in ("left", "right") for part in ("ankle", "foot")]
    ]
    feet = (weights.sum(1) > 0.6).numpy()
    soles = np.concatenate(
        [body(pose[i : i + 50], betas=betas[None]).vertices.numpy()[:, feet] for i in range(0, len(pose), 50)]
    )
    soles = soles.astype(np.float64)
    height = soles[:, :, 1] - soles[:, :, 1].min(axis=1, keepdims=True)
    contact = np.exp(-height / CONTACT_M)
    step = soles[1:] - soles[:-1]
    shared = contact[1:] * contact[:-1]
    slip = (shared[:, :, None] * step).sum(axis=1) / shared.sum(axis=1)[:, None]
    # Weight shifts from foot to foot in an instant; the heavy trunk can't follow that fast, so the motion is smoothed.
    transl = np.zeros((len(pose), 3))
    transl[1:] = -np.cumsum(gaussian_filter1d(slip, 0.8, axis=0, mode="nearest"), axis=0)
    transl[:, 1] = gaussian_filter1d(-soles[:, :, 1].min(axis=1), 0.8, mode="nearest")
    rounded: NDArray[np.float64] = transl.round(6)
    return rounded


def write_bag(path: Path, *, input_type: str, pose: NDArray[np.float64], betas: NDArray[np.float64]) -> None:
    """Write one motion as a bag, a rosbag2 directory."""
    encode = encoder_for(input_type)
    transl = grounded_translation(pose, betas)
    with BagWriter(path, chunk_bytes=CHUNK_BYTES, overwrite=True) as bag:
        bag.add_topic(TOPIC, INPUT_TYPES[input_type], betas_of="builtin")
        for i in range(len(pose)):
            stamp_ns = START_NS + round(i * 1e9 / FPS)
            frame = SmplFrame(pose[i].round(6), betas=betas.astype(np.float32), transl=transl[i], stamp_ns=stamp_ns)
            bag.write(TOPIC, encode(frame), log_time_ns=stamp_ns)


BAGS: Mapping[str, tuple[str, Callable[[Curve], NDArray[np.float64]], tuple[float, ...]]] = {
    "walk": ("multiarray", walk_pose, (0.0,) * 10),
    "reach_squat": ("joint_state", reach_squat_pose, REACH_BETAS),
}
"""Input type, motion and betas of each bag."""


def main() -> None:
    """Write all bags."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("directory", nargs="?", type=Path, default=Path(__file__).parent)
    directory = parser.parse_args().directory
    t = np.arange(FPS * SECONDS) / FPS
    for name, (input_type, motion, betas) in BAGS.items():
        write_bag(directory / name, input_type=input_type, pose=motion(t), betas=np.array(betas))


if __name__ == "__main__":
    main()
