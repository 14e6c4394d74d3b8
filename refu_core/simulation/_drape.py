"""From (β, θ, γ) to a draped garment: the settled canonical drape, the move to the pose, the settling.

Simulated cloth depends on how it got where it is: two paths to the same pose leave a T-shirt 10 to 16 mm apart and a
skirt 13 to 51 mm. So every sample starts from the settled drape of its own shape and style in one canonical pose and
takes a fixed path to its own pose: the result is a function of (β, θ, γ) alone, and samples don't depend on each other.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial.transform import Rotation

from refu_core.body import DEFAULT_GAP, Collider, ColliderSettings, SmplBody
from refu_core.errors import MeshError
from refu_core.frames import N_JOINTS
from refu_core.garments import GarmentTemplate
from refu_core.mesh import Connectivity
from refu_core.metrics import SheetChecker
from refu_core.realtime import RootTurn
from refu_core.sdf import ExactSdf
from refu_core.simulation._cloth import F32, ClothCut, ClothSettings, ClothTopology, CourseStep, SimulatedCloth
from refu_core.simulation._joined import JoinedGarments
from refu_core.skeleton import posed

_ROUNDS = 8
"""Most rounds. Nearly all that can be resolved takes one to three, each over a wider part of the cloth."""
_RINGS = 2
"""Rings of neighbours around intersecting faces that a round smooths with them."""
_SWEEPS = (4, 5)
"""Per round: pushes off the skin, and smoothing sweeps before each push."""


class Untangle:
    """Smooths a settled garment where its own faces intersect, as in the crook of an elbow bent by 2 rad.

    There is no room there for two layers and their folds, and as only vertices are kept off faces, edges slip through
    each other. Vertices around move towards the mean of their neighbours and are then pushed off the skin, as in ReFU.
    """

    def __init__(self, mesh: Connectivity, sdf: ExactSdf, *, margin: float) -> None:
        """For a garment that is kept `margin` above the body behind `sdf` [m]."""
        self._faces, self._sdf, self._margin = np.asarray(mesh.faces), sdf, margin
        around = mesh.adjacency_matrix()
        share = around.multiply(1 / np.maximum(around.sum(1), 1)[:, None])
        self._mean = sparse.csr_array(share.astype(np.float32))
        self._sheet = SheetChecker(self._faces)

    def __call__(self, vertices: F32, body: F32) -> F32:
        """Smoothed vertices (N, 3) of the garment on a body (V, 3) [m]: the very same array if no faces intersect.

        Some faces may still intersect after the last round.
        """
        points, is_loose = vertices, np.zeros(len(vertices), np.bool_)
        for round_ in range(_ROUNDS):
            self._sheet.update(points)
            pairs = self._sheet.with_itself()
            if not len(pairs):
                break
            if not round_:
                points = vertices.copy()
                self._sdf.update(torch.from_numpy(np.ascontiguousarray(body)))
            is_loose[self._faces[pairs]] = True
            for _ in range(_RINGS):
                is_loose |= self._mean @ is_loose.astype(np.float32) > 0
            loose = np.flatnonzero(is_loose)
            self._level(points, loose)
        return points

    def _level(self, points: F32, loose: NDArray[np.intp]) -> None:
        mean = self._mean[loose]
        for _ in range(_SWEEPS[0]):
            for _ in range(_SWEEPS[1]):
                points[loose] = (points[loose] + mean @ points) / 2
            found = self._sdf.query(torch.from_numpy(points[loose]))
            lack = (self._margin - found.distance).clamp_min(0)
            points[loose] += (lack[:, None] * found.gradient).numpy()


GRAVITY = 9.81
"""[m/s²], along -y of the world."""


@dataclass(frozen=True)
class DrapeSettings:
    """How long a sample is simulated."""

    cloth: ClothSettings = field(default_factory=ClothSettings)
    dress_frames: int = 6
    """Frames in the T-pose, with strong damping, in which the template turns into cloth."""
    lower_frames: int = 16
    """Frames in which the arms go down from the T-pose to the canonical one."""
    canonical_frames: int = 60
    """Most frames in which the canonical drape settles."""
    speed: float = 0.035
    """Average distance that the fastest part of the body goes in a frame of the move [m]."""
    move_frames: tuple[int, int] = (12, 40)
    """Fewest and most frames of the move."""
    settle_frames: tuple[int, int] = (14, 45)
    """Fewest and most frames of settling; it ends early when the cloth rests."""
    careful_frames: int = 5
    """Number of last frames, in which contacts of edge midpoints are solved, too."""
    rest_speed: float = 0.012
    """Root mean square speed below which cloth counts as at rest [m/s]."""
    drag: tuple[float, float, float] = (130.0, 6.0, 30.0)
    """Rates at which velocity fades [1/s]: as the template becomes cloth, as the body moves, as the cloth settles."""
    waistband: float = 0.012
    """Width of the band that is held at the skin [m]."""
    gap: float = DEFAULT_GAP
    """Gap that is kept between two parts of the body [m]."""


CANONICAL_POSE = posed("both_shoulder 0 0 -0.87, both_hip 0 0 0.08").astype(np.float32)
"""The pose of the canonical drape: arms lowered by 50°, legs slightly apart [rad], shape (24, 3)."""
COMFORT_POSES = np.stack(
    [
        posed("both_shoulder 0 0 -0.87"),
        posed("both_shoulder 0 -0.7 0, both_elbow 0 -2 0"),
        posed("both_hip -0.8 0 0, both_knee 1.2 0 0"),
        posed("both_hip 0 0 0.4"),
    ]
).astype(np.float32)
"""Poses that a garment is cut to be comfortable in [rad], shape (P, 24, 3); the T-pose isn't among them.

Cloth cut to the T-pose alone is too short over the shoulders when arms hang, at the elbows when they bend, at the seat,
the knees and the crotch when legs are raised or spread; a tailor leaves room there.
"""
CROOK_POSE = posed("both_elbow 0 -2 0").astype(np.float32)
"""Elbows bent by 2 rad [rad], shape (24, 3): where a sleeve gets shorter, its wrinkles are finer than its mesh."""


def pose_path(start: NDArray[np.floating], end: NDArray[np.floating], n: int) -> NDArray[np.float32]:
    """`n` poses after `start`, the last one `end`: each joint turns about one axis, slowly at both ends.

    Poses are rotation vectors [rad], shape (24, 3); the result has the shape (n, 24, 3).
    """
    first = Rotation.from_rotvec(np.asarray(start, np.float64))
    turn = (first.inv() * Rotation.from_rotvec(np.asarray(end, np.float64))).as_rotvec()
    t = np.arange(1, n + 1) / n
    t = t * t * (3 - 2 * t)
    path = np.stack([(first * Rotation.from_rotvec(turn * u)).as_rotvec() for u in t]).astype(np.float32)
    path[-1] = end
    return path


def _alone(values: NDArray[np.floating]) -> torch.Tensor:
    """Coefficients (K,) as a batch of one body, (1, K)."""
    return torch.as_tensor(values, dtype=torch.float32)[None]


@torch.no_grad()
def colliders(body: SmplBody, collider: Collider, poses: NDArray[np.floating], betas: NDArray[np.floating]) -> F32:
    """The colliders of a body in poses (P, 24, 3) [rad] and a shape (10,), root rotation included [m], (P, V, 3).

    As in `refu_core.realtime.dress`, overlaps are pulled apart in the root's frame, before the root's rotation.
    """
    posed = body.posed(torch.as_tensor(poses, dtype=torch.float32), body.shape(_alone(betas)), in_root=True)
    found = collider(posed.vertices, posed.transforms)
    return np.stack([turn.to_host(one) for turn, one in zip(RootTurn.taken_off(posed), found, strict=True)])


@dataclass(frozen=True, eq=False)
class SettledDrape:
    """A settled garment."""

    vertices: F32
    """In the body's frame with the root's rotation, without translation [m], shape (N, 3)."""
    speed: float
    """Root mean square speed that is left [m/s]."""
    stretch: float
    """99.9th percentile of edge length over the length that the edge reaches freely."""
    cut: ClothCut
    """Its cloth."""


_DOWN = np.array([0, -GRAVITY, 0])
_FEWEST = 10
"""Fewest frames in which the canonical drape settles."""


@dataclass(frozen=True, eq=False)
class Course:
    """What happens to a body and the cloth on it, frame by frame, until the cloth rests."""

    bodies: F32
    """The body from frame to frame of its move, its start first [m], shape (T + 1, V, 3)."""
    gravity: NDArray[np.floating]
    """Acceleration at each of them [m/s²], shape (T + 1, 3)."""
    drag: tuple[float, float, float]
    """As in `DrapeSettings`."""
    settle: tuple[int, int]
    """Fewest and most frames of settling."""
    rest_speed: float
    """It ends early below this root mean square speed [m/s]."""
    careful: int
    """Careful frames after that."""
    dress: int = 0
    """Frames before the move in which the template becomes cloth."""

    def steps(self) -> Generator[CourseStep, float, None]:
        """The frames, one by one; the speed that the cloth has after each is to be sent [m/s]."""
        gravity, last = self.gravity.astype(np.float32), len(self.bodies) - 1
        dressing, moving, settling = self.drag
        for _ in range(self.dress):
            yield CourseStep(0, 0, gravity[0], dressing)
        for k in range(last):
            yield CourseStep(k, k + 1, gravity[k + 1], moving)
        fewest, most = self.settle
        for settled in range(1, most + 1):
            speed = yield CourseStep(last, last, gravity[-1], settling)
            if speed < self.rest_speed and settled >= fewest:
                break
        for _ in range(self.careful):
            yield CourseStep(last, last, gravity[-1], settling, is_careful=True)


def follow(cloth: SimulatedCloth, course: Course) -> float:
    """Takes the cloth along a course, and returns the speed at its end [m/s]."""
    steps, bodies, speed = course.steps(), list(course.bodies), math.inf
    step = next(steps, None)
    while step is not None:
        before, after = bodies[step.before], bodies[step.after]
        speed = cloth.frame(before, after, gravity=step.gravity, drag=step.drag, careful=step.is_careful)
        step = sent(steps, speed)
    return speed


def sent(steps: Generator[CourseStep, float, None], speed: float) -> CourseStep | None:
    """The step after the one at whose end the cloth had this speed [m/s]; None at a course's end."""
    try:
        return steps.send(speed)
    except StopIteration:
        return None


class Draper:
    """Drapes one garment on one body; keeps the canonical drape of the last shape and style."""

    def __init__(
        self, garment: GarmentTemplate | JoinedGarments, body: SmplBody, *, settings: DrapeSettings | None = None
    ) -> None:
        """Prepares for `garment`, or several that are worn together, on `body`, all on the CPU.

        Raises `MeshError` when the body isn't watertight, a garment has edges of more than two faces or vertices of
        none, or one that is held at the waist is closed.
        """
        self.outfit = garment if isinstance(garment, JoinedGarments) else JoinedGarments([garment])
        self.garment = garment = self.outfit.joined
        self.body = body
        self.settings = settings or DrapeSettings()
        self.topology = ClothTopology.of(garment.mesh)
        # The BVH decides which of two equally close faces is found, and so a result's last bit. It is built anew for
        # each drape, on a mesh that depends on the drape alone, and never in between.
        self._sdf = sdf = ExactSdf(body.faces, rebuild_distance=math.inf)
        self._collider = Collider(body, settings=ColliderSettings(gap=self.settings.gap))
        counts = [garment.n_vertices for garment in self.outfit.garments]
        piece = np.repeat(np.arange(len(counts)), counts)
        self.cloth = SimulatedCloth(self.topology, sdf, piece=piece, settings=self.settings.cloth)
        self.waist = self._waists()
        self.untangled = Untangle(garment.mesh, sdf, margin=self.settings.cloth.margin)
        self._comfort = np.concatenate((COMFORT_POSES, CROOK_POSE[None]))
        self._canonical: tuple[bytes, F32, F32] | None = None

    def _waists(self) -> NDArray[np.intp]:
        """Vertices of the bands that hold garments at the waist; none where all hang from the shoulders."""
        vertices, loops = self.garment.v_template.numpy(), self.topology.boundary_loops()
        found = [np.zeros(0, np.intp)]
        for garment in self.outfit.garments:
            if garment.card.held_at_waist:
                part = self.outfit.parts[garment.name]
                rims = [rim for rim in loops if part.start <= rim[0] < part.stop]
                if not rims:
                    raise MeshError(f"{garment.name} is held at the waist, and its mesh is closed: open it there")
                loop = max(rims, key=lambda rim: float(vertices[rim, 1].mean()))
                found.append(np.flatnonzero(self.topology.distance_from(vertices, loop) < self.settings.waistband))
        return np.concatenate(found)

    def rest(self, betas: NDArray[np.floating], style: NDArray[np.floating]) -> F32:
        """The garment cut for this shape and style [m], shape (N, 3): its edges are the cloth's rest lengths."""
        return self.garment.rest(_alone(betas), self.garment.own(_alone(style)))[0].numpy()

    def bodies(self, poses: NDArray[np.floating], betas: NDArray[np.floating]) -> F32:
        """What cloth lies on: the colliders of poses (P, 24, 3) [rad] and a shape (10,) [m], shape (P, V, 3)."""
        return colliders(self.body, self._collider, poses, betas)

    def canonical(self, betas: NDArray[np.floating], style: NDArray[np.floating]) -> tuple[F32, F32]:
        """The settled canonical drape of a shape and style and its collider, (N, 3) and (V, 3) [m]."""
        key = np.concatenate((betas, style)).astype(np.float32).tobytes()
        if self._canonical is None or self._canonical[0] != key:
            course = self.canonical_course(betas)
            cut = self.cut(betas, style)
            start = self.dressed(betas, style, course)
            self.begin(cut, start, course.bodies[0])
            follow(self.cloth, course)
            self._canonical = (key, self.cloth.positions.copy(), course.bodies[-1])
        return self._canonical[1:]

    def dressed(self, betas: NDArray[np.floating], style: NDArray[np.floating], course: Course) -> F32:
        """The garment as it is put on, at the start of a canonical course [m], shape (N, 3)."""
        self.rebuild(course.bodies[0])
        return self.outfit.layered(self.rest(betas, style), course.bodies[0], self._sdf)

    def cut(self, betas: NDArray[np.floating], style: NDArray[np.floating]) -> ClothCut:
        """The cloth of a shape and style."""
        rest, shape = self.rest(betas, style), _alone(betas)
        transforms = self.body(self._comfort, shape).transforms
        *eased, crook = self.garment.pose(torch.from_numpy(rest).expand(len(self._comfort), -1, -1), transforms).numpy()
        body_rest = self.body.rest_vertices(shape)[0].numpy()
        self.rebuild(body_rest)
        return self.cloth.tailored(rest, eased=eased, crooks=[crook], waist=self.waist, body_rest=body_rest)

    def begin(self, cut: ClothCut, positions: F32, body: F32) -> None:
        """Puts cloth of this cut at `positions` (N, 3), at rest, for the body's vertices (V, 3) [m]."""
        self.cloth.start(cut, positions)
        self.rebuild(body)

    def rebuild(self, body: F32) -> None:
        """Builds the tree of triangles anew on this body (V, 3) [m]; it is only refitted from then on."""
        self._sdf.update(torch.from_numpy(np.ascontiguousarray(body)))
        self._sdf.rebuild()

    def canonical_course(self, betas: NDArray[np.floating]) -> Course:
        """From the T-pose to the canonical drape.

        The garment is put on in the T-pose that it was cut in: if skinning lowered its arms, the armpits would start
        out folded into themselves.
        """
        s, start = self.settings, np.zeros((1, N_JOINTS, 3), np.float32)
        poses = np.concatenate((start, pose_path(start[0], CANONICAL_POSE, s.lower_frames)))
        # The T-pose is computed alone: in a batch, the last bits of a product depend on the number of rows.
        bodies = np.concatenate([self.bodies(some, betas) for some in (poses[:1], poses[1:])])
        gravity = np.broadcast_to(_DOWN, (len(poses), 3))
        settle, rest = (_FEWEST, s.canonical_frames), s.rest_speed / 2
        return Course(bodies, gravity, s.drag, dress=s.dress_frames, settle=settle, rest_speed=rest, careful=0)

    def course(self, pose: NDArray[np.floating], betas: NDArray[np.floating], start: F32) -> Course:
        """From the canonical drape, on the body `start` (V, 3) [m], to the drape in `pose` (24, 3) [rad].

        The root's rotation tilts gravity and not the body: a person who bends forward doesn't swing the cloth about.
        """
        s, target = self.settings, np.array(pose, np.float32)
        root = Rotation.from_rotvec(target[0].astype(np.float64))
        target[0] = 0
        way = np.linalg.norm(self.bodies(target[None], betas)[0] - start, axis=1).max()
        n = int(np.clip(np.ceil(way / s.speed), *s.move_frames))
        bodies = np.concatenate((start[None], self.bodies(pose_path(CANONICAL_POSE, target, n), betas)))
        tilts = Rotation.from_rotvec(pose_path(np.zeros((1, 3)), root.as_rotvec()[None], n)[:, 0]).inv()
        gravity = np.concatenate((_DOWN[None], tilts.apply(_DOWN)))
        settle = s.settle_frames[0] - s.careful_frames, s.settle_frames[1] - s.careful_frames
        return Course(bodies, gravity, s.drag, settle=settle, rest_speed=s.rest_speed, careful=s.careful_frames)

    def drape(
        self, pose: NDArray[np.floating], betas: NDArray[np.floating], style: NDArray[np.floating]
    ) -> SettledDrape:
        """The garment of `style` (4,) at rest on the body of `betas` (10,) in `pose` (24, 3) [rad]."""
        start, body = self.canonical(betas, style)
        course, cut = self.course(pose, betas, body), self.cut(betas, style)
        self.begin(cut, start, course.bodies[-1])
        speed = follow(self.cloth, course)
        return self.settled(self.cloth.positions, course.bodies[-1], cut, pose, betas, speed=speed)

    def settled(
        self,
        positions: F32,
        body: F32,
        cut: ClothCut,
        pose: NDArray[np.floating],
        betas: NDArray[np.floating],
        *,
        speed: float,
    ) -> SettledDrape:
        """The drape of cloth that has come to rest at `positions` (N, 3) on `body` (V, 3), at the end of a course."""
        level = self.untangled(positions, body)
        pelvis = self.body.rest_joints(_alone(betas))[0, 0].numpy()
        root = Rotation.from_rotvec(np.asarray(pose, np.float32)[0].astype(np.float64))
        turned = np.ascontiguousarray(root.apply(level.astype(np.float64) - pelvis) + pelvis, dtype=np.float32)
        return SettledDrape(turned, speed, cut.stretch(self.topology, level), cut)
