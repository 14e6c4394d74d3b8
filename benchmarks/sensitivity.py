"""What halving and doubling each number of the collider, of contact and of keypoints do on recorded motion.

    python benchmarks/sensitivity.py collider MOTIONS    # collider.md and collider.json, with the collider's cost
    python benchmarks/sensitivity.py contact MOTIONS     # contact.md
    python benchmarks/sensitivity.py keypoints MOTIONS   # keypoints.md

MOTIONS is a folder of AMASS-style npz files at 60 Hz; one in `--every` frames is judged, and none of these is left out.
Figures of contact are those of `refu evaluate --table motion`, in mode `hybrid` with β = 0. Keypoints are followed for
the first seconds of each clip.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from msg_adapters import Motion, read_motion
from refu_core import GarmentPipeline, SmplFrame, load_body, load_garment
from refu_core.body import Collider, ColliderSettings, SmplBody
from refu_core.contact import DEFAULT_CONTACT
from refu_core.keypoints import (
    KeypointTracker,
    Proportions,
    Skeleton,
    TrackerSettings,
    _solver,
    _tracker,
    keypoint_layout,
)
from refu_core.keypoints._pose import Pose, exp_so3
from refu_core.metrics import SelfContactDetector
from refu_core.skeleton import JOINT_NAMES
from refu_lab.benchmark import SdfFrame, measure, one_core, sdf_methods
from refu_lab.reproduction import OutfitJudge, figures_of, frame_pair
from refu_lab.tables import TextTable, write_json, write_page


def changes(settings: Any) -> Iterator[tuple[str, str, Any]]:
    """The default, then each number halved and doubled; integers stay integers, even ones even, and none becomes 0."""
    yield "default", "", settings
    for field in fields(settings):
        value = getattr(settings, field.name)
        for factor in (0.5, 2.0):
            if isinstance(value, tuple):
                other: object = tuple(factor * part for part in value)
            elif isinstance(value, int):
                least = 2 - value % 2
                other = max(least, int(factor * value) // least * least)
            else:
                other = factor * value
            if other != value:
                yield f"`{field.name}`", f"{value} → {other}", replace(settings, **{field.name: other})


# ---- the collider ----------------------------------------------------------------------------------------------------

REACH = 0.02
"""Skin at most this far from a built-in garment at rest counts as within its reach [m]."""
NOISE = np.radians(8)
"""Standard deviation of the noise on each coordinate of each joint, as of a pose estimator that sees limbs badly."""
OF_COLLIDER = {
    "free_percent": "free %",
    "free_with_noise_percent": "free with noise %",
    "median_shift_mm": "median of largest shifts [mm]",
    "largest_shift_mm": "largest shift [mm]",
    "moved_percent": "skin moved %",
    "largest_leap_mm": "largest leap [mm]",
}
ABOUT_COLLIDER = """# The collider: cost, and what its numbers do

`python benchmarks/sensitivity.py collider`, {frames} frames of recorded motion, male body. *Free*: no
intersection within 2 cm of a garment that the rest pose lacks. *With noise*: every joint but the root is
off by 8° in each coordinate, as from a poor pose estimate: arms are deep in the trunk. *Leap*: the
farthest that skin moves from a frame at 60 Hz to the next, beyond 1.5 times what it moves without the
collider.

Cost by the plain query of a T-shirt: {motion:.3f} in motion, {nothing_near:.3f} where nothing is near."""


class ColliderBench:
    """Poses sampled from clips, and what the collider does to the skin in them."""

    def __init__(self, clips: list[Motion], every: int) -> None:
        self.body: SmplBody = load_body("male")
        poses = [clip.poses for clip in clips]
        self.poses = np.concatenate([one[::every] for one in poses])
        noise = np.random.default_rng(0).normal(0, NOISE, self.poses.shape).astype(np.float32)
        noise[:, 0] = 0
        self.noisy = self.poses + noise
        self.pairs = [(one[i], one[i + 1]) for one in poses for i in range(0, len(one) - 1, 4 * every)]
        self.detector = SelfContactDetector(self.body.faces, self.body.v_template.numpy())
        garments = ("tshirt-male", "short-pant-male", "shirt-male")
        worn = torch.cat([load_garment(name).v_template for name in garments])
        is_near = torch.cdist(self.body.v_template, worn).amin(dim=1) < REACH
        self.near = is_near[self.body.faces].any(dim=1).numpy()

    def measure(self, settings: ColliderSettings) -> dict[str, float]:
        """How many frames are free of intersections near a garment, how far skin is shifted, and how it leaps."""
        collider = Collider(self.body, settings=settings)
        free, shift, moved = [], [], []
        for pose in self.poses:
            skin, apart = self._apart(collider, pose)
            free.append(self._is_free(apart))
            away = np.linalg.norm(apart - skin, axis=1)
            shift.append(away.max())
            moved.append((away > 1e-4).mean())
        leaps = []
        for first, second in self.pairs:
            (skin, apart), (skin_, apart_) = (self._apart(collider, pose) for pose in (first, second))
            went = np.linalg.norm(apart_ - apart, axis=1) - 1.5 * np.linalg.norm(skin_ - skin, axis=1)
            leaps.append(went.max())
        free_with_noise = [self._is_free(self._apart(collider, pose)[1]) for pose in self.noisy]
        return {
            "free_percent": 100 * float(np.mean(free)),
            "free_with_noise_percent": 100 * float(np.mean(free_with_noise)),
            "median_shift_mm": 1e3 * float(np.median(shift)),
            "largest_shift_mm": 1e3 * float(np.max(shift)),
            "moved_percent": 100 * float(np.mean(moved)),
            "largest_leap_mm": 1e3 * float(np.max(leaps)),
        }

    def _is_free(self, apart: NDArray[np.float32]) -> bool:
        return not self.near[self.detector.detect(apart).pairs].any()

    def _apart(self, collider: Collider, pose: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        skin = self.body(pose=pose[None])
        return skin.vertices[0].numpy(), collider(skin.vertices, skin.transforms)[0].numpy()

    def cost(self) -> dict[str, float]:
        """Median time of the collider over that of a T-shirt's plain query (BVH refitted, every vertex queried)."""
        collider, garment = Collider(self.body), load_garment("tshirt-male")
        plain = sdf_methods(self.body, garment, network=False)[0][0].ask
        rest, betas = self.body(pose=np.zeros((1, 24, 3))), torch.zeros(10)
        given = []
        for pose in self.poses:
            skin = self.body(pose=pose[None])
            worn = garment.pose(garment.v_template[None], skin.transforms)[0].numpy()
            frame = SdfFrame(skin.vertices[0].numpy(), worn, garment.v_template, torch.from_numpy(pose), betas)
            given.append((frame, skin))
        contenders = {
            "plain": lambda both: plain(both[0]),
            "motion": lambda both: collider(both[1].vertices, both[1].transforms),
            "rest": lambda _: collider(rest.vertices, rest.transforms),
        }
        with one_core():
            times = measure(contenders, [given], rounds=2)
        median = {name: timing.median for name, timing in times.items()}
        shares = {"motion": median["motion"] / median["plain"], "nothing_near": median["rest"] / median["plain"]}
        return {"plain_query_ms": median["plain"], **shares}


def write_collider(clips: list[Motion], every: int, folder: Path) -> None:
    bench = ColliderBench(clips, every)
    cost, shipped = bench.cost(), ColliderSettings()
    rows = {f"{name} {value}".strip(): bench.measure(one) for name, value, one in tqdm(list(changes(shipped)))}
    cells = [[name, *(f"{values[key]:.1f}" for key in OF_COLLIDER)] for name, values in rows.items()]
    about = ABOUT_COLLIDER.format(frames=len(bench.poses), **cost)
    write_page(folder / "collider.md", [about, TextTable("", ["", *OF_COLLIDER.values()], cells).markdown()])
    report = {"cost": cost, "frames": len(bench.poses), "settings": asdict(shipped), "rows": rows}
    write_json(folder / "collider.json", report)


# ---- contact ---------------------------------------------------------------------------------------------------------

TOGETHER, SKIRT = ("shirt-male", "short-pant-male"), ("skirt-female",)
OF_TOGETHER = ("`layer_", "`alike", "`levellings")
"""Prefixes of the settings that matter only to garments worn together."""
OF_CONTACT = {
    "cfmp_percent": ("free %", "{:.1f}"),
    "max_depth_mm": ("deepest mm", "{:.1f}"),
    "layers_cut_percent": ("cut %", "{:.1f}"),
    "jump_20_percent": ("jumps %", "{:.1f}"),
    "jump_max_mm": ("largest mm", "{:.0f}"),
    "stretched_percent": ("torn %", "{:.4f}"),
    "self_crossings": ("own crossings", "{:.0f}"),
}
GARMENTS = {"shirt-male": "shirt", "short-pant-male": "shorts", "skirt-female": "skirt"}
ABOUT_CONTACT = """# Collision handling: what half and twice of each setting do

Shirt over shorts, and a skirt, mode `hybrid`, β = 0: {count} frames of recorded motion each, none left out. By
`benchmarks/sensitivity.py contact`. One frame more or less is {one:.1f} %.

Free: of collisions with the body. Cut: through the shorts. Jumps: frames in which a vertex moves more than 20 mm
farther in 1/60 s than the skinned garment. Torn: edges twice as long as at rest. Own crossings: pairs of the garment's
faces, a frame."""


def write_contact(clips: list[Motion], every: int, folder: Path) -> None:
    pairs = [frame_pair(clip, index) for clip in clips for index in range(0, len(clip) - 1, every)]
    rows: dict[str, list[list[str]]] = {garment: [] for garment in GARMENTS}
    for name, value, settings in tqdm(list(changes(DEFAULT_CONTACT))):
        for outfit in (TOGETHER,) if name.startswith(OF_TOGETHER) else (TOGETHER, SKIRT):
            judge = OutfitJudge(outfit, {"hybrid": GarmentPipeline.load(outfit, contact=settings)})
            judged = [judge.judge(pair)[0] for pair in pairs]
            for garment in outfit:
                found = figures_of([one[garment, "hybrid"] for one in judged])
                shown = (
                    ("" if found[key] is None else form.format(found[key])) for key, (_, form) in OF_CONTACT.items()
                )
                rows[garment].append([name, value, *shown])
    parts = [ABOUT_CONTACT.format(count=len(pairs), one=100 / len(pairs))]
    header = ["setting", "value", *(title for title, _ in OF_CONTACT.values())]
    for garment, made in rows.items():
        parts += [f"## {GARMENTS[garment]}", TextTable("", header, made).markdown()]
    write_page(folder / "contact.md", parts)


# ---- keypoints -------------------------------------------------------------------------------------------------------

SECONDS = 6.0
"""How long each clip's keypoints are followed."""
RATE = 30.0  # Hz
PLACED = [i for i, name in enumerate(JOINT_NAMES) if "hand" not in name and "foot" not in name]
"""Joints that the layouts show, or that lie between what they show."""
MODULES = {
    _solver: ("_FLAT", "_LOOSE", "_CLOSE", "_BOLDEST", "_LEAST", "_BENT", "_FAR_LIKELIER"),
    _tracker: ("_WOUND", "_FASTEST", "_FITS", "_NEAR", "_FAR"),
}
"""Numbers that aren't settings."""
CASES = {"usual": "zed38", "hard": "coco17"}
"""Layouts of the keypoints, by case."""
ABOUT_KEYPOINTS = """# Keypoints: what half and twice of each number do

{count} frames at 30 Hz of {clips} clips of recorded motion, of a person who isn't of mean shape. By
`benchmarks/sensitivity.py keypoints`. Error: mean distance of joints from where they are [mm], hands and toes left out;
beside it what 95 % are below. Jitter: median of the joints' second differences [mm].

Usual: `zed38` with 10 mm of noise, a tenth lost. Hard: `coco17` with 20 mm, 30 % lost; for 0.3 s in every 2 s left and
right are exchanged, for 0.3 s in every 3 s nothing is seen, and 2 % of the keypoints are up to half a metre off."""


class Followed(NamedTuple):
    """Somebody's motion, and what a tracker sees of it."""

    frames: list[SmplFrame]
    points: list[NDArray[np.float64]]


class KeypointBench:
    """The same keypoints for every setting."""

    def __init__(self, clips: list[Motion]) -> None:
        self.proportions = Proportions.builtin("male")
        self.joints = Skeleton(keypoint_layout("smpl24"), self.proportions)
        rng = np.random.default_rng(0)
        betas = 0.8 * rng.normal(size=10)
        self.skeletons = {case: Skeleton(keypoint_layout(name), self.proportions) for case, name in CASES.items()}
        self.seen = {
            case: [self._followed(skeleton, clip, betas, rng, is_hard=case == "hard") for clip in clips]
            for case, skeleton in self.skeletons.items()
        }

    def _followed(
        self,
        skeleton: Skeleton,
        clip: Motion,
        betas: NDArray[np.float64],
        rng: np.random.Generator,
        *,
        is_hard: bool,
    ) -> Followed:
        motion = clip.resampled(RATE)
        frames = [motion.frame(i) for i in range(min(len(motion), round(SECONDS * RATE)))]
        frames = [
            SmplFrame(frame.pose, betas, frame.transl, stamp_ns=10**9 + round(1e9 * i / RATE))
            for i, frame in enumerate(frames)
        ]
        points = [skeleton.posed(self._pose(frame)).points for frame in frames]
        for i, one in enumerate(points):
            one += rng.normal(0, 0.02 if is_hard else 0.01, one.shape)
            one[rng.random(len(one)) < (0.3 if is_hard else 0.1)] = np.nan
            if is_hard:
                off = rng.random(len(one)) < 0.02
                one[off] += rng.uniform(-0.3, 0.3, (int(off.sum()), 3))
                points[i] = one[skeleton.layout.mirrored] if i % 60 in range(20, 29) else one
                points[i] = points[i] * (np.nan if i % 90 in range(60, 69) else 1)
        return Followed(frames, points)

    def _pose(self, frame: SmplFrame) -> Pose:
        betas = frame.betas.astype(np.float64)
        turns = exp_so3(frame.pose.astype(np.float64))
        return Pose(frame.transl + self.proportions.of(betas)[0], turns, betas)

    def measure(self, settings: TrackerSettings) -> list[float]:
        """Of both cases: mean error, 95th percentile, and jitter [mm]."""
        found = []
        for case, persons in self.seen.items():
            errors, jitter = [], []
            for frames, points in persons:
                track = KeypointTracker(self.skeletons[case], settings=settings)
                got = [track.update(one, frame.stamp_ns) for one, frame in zip(points, frames, strict=True)]
                places = [self._joints(one) for one in (one or SmplFrame(np.zeros((24, 3))) for one in got)]
                truth = [self._joints(frame) for frame in frames]
                errors.append(np.linalg.norm(np.subtract(places, truth), axis=2)[:, PLACED])
                jitter.append(np.linalg.norm(np.diff(places, 2, axis=0), axis=2))
            off = np.concatenate(errors)
            found += [off.mean(), np.percentile(off, 95), np.median(np.concatenate(jitter))]
        return [1e3 * float(one) for one in found]

    def _joints(self, frame: SmplFrame) -> NDArray[np.float64]:
        return self.joints.posed(self._pose(frame)).joints


def write_keypoints(clips: list[Motion], folder: Path) -> None:
    bench = KeypointBench(clips)
    rows = [
        [name, value, *map("{:.1f}".format, bench.measure(one))]
        for name, value, one in tqdm([*changes(TrackerSettings())])
    ]
    for module, names in MODULES.items():
        for name in tqdm(names):
            shipped = getattr(module, name)
            for factor in (0.5, 2.0):
                setattr(module, name, factor * shipped)
                value = f"x {factor}" if isinstance(shipped, np.ndarray) else f"{shipped} → {factor * shipped}"
                rows.append([f"`{name}`", value, *map("{:.1f}".format, bench.measure(TrackerSettings()))])
            setattr(module, name, shipped)
    count = sum(len(person.frames) for person in bench.seen["usual"])
    about = ABOUT_KEYPOINTS.format(count=count, clips=len(clips))
    header = ["number", "value", *(f"{case}: {what}" for case in CASES for what in ("error", "95 %", "jitter"))]
    write_page(folder / "keypoints.md", [about, TextTable("", header, rows).markdown()])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("collider", "contact", "keypoints"))
    parser.add_argument("motions", type=Path)
    parser.add_argument("--every", type=int, default=60)
    parser.add_argument("--output", type=Path, default=Path("docs/results"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    clips = [read_motion(file) for file in sorted(args.motions.glob("*.npz"))]
    if args.what == "keypoints":
        write_keypoints(clips, args.output)
    else:
        write = write_collider if args.what == "collider" else write_contact
        write(clips, args.every, args.output)


if __name__ == "__main__":
    main()
