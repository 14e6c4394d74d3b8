"""Registration: the built-in mesh laid onto the surface of another body in its rest pose.

The three built-in bodies share one mesh, so one registration tells for all three which of their points is which point
of the other body.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from refu_core.body._io import load_body
from refu_core.body._model import SmplBody
from refu_core.body._parts import joints_of
from refu_core.body._surface import OnSurface, Surface
from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.mesh import Connectivity, symmetric_solver, vertex_normals
from refu_core.skeleton import JOINT_NAMES

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class RegistrationSettings:
    """How a mesh is laid onto a surface; figures are for the bodies in tests/smpl_file.py. Lengths are an adult's."""

    heights: tuple[float, float] = (1.5, 2.0)
    """Shorter and taller bodies are registered at these heights [m]. So points are found within 2 to 4 mm on average,
    and within 10 mm on an infant 1.5 m tall; at 1.2 m within 8 to 25 mm, at 0.6 m more than 100 mm off."""
    rounds: int = 10
    """Newton steps for shape and pose, each with the points that are closest at that moment."""
    normal_scale: float = 0.05
    """Normals at right angles count as much as points 1.4 times this far apart [m]: flanks aren't matched with the arm
    beside them."""
    reach: float = 0.04
    """Points farther from the surface than this count less and less [m]."""
    joint_spread: float = 0.04
    """How far apart two models put the same joint of a body [m]. Hips (10 cm apart), spine and collars aren't used."""
    angle_spread: float = 0.1
    """How far a joint turns from one rest pose to the other [rad]."""
    noise: float = 0.005
    """Noise of the surface, which weighs it against joints, angles and betas [m]."""
    stiffness: tuple[float, ...] = (300.0, 30.0, 10.0, 3.0, 1.0, 0.3)
    """Weight of neighbours moving alike, relative to that of vertices lying on the surface, for each round."""
    stiff_ends: float = 30.0
    """How many times stiffer hands, feet and heads are: nothing is worn there, and fingers may match the wrong ones."""


@dataclass(frozen=True, eq=False)
class Registration:
    """The built-in mesh (V vertices) on another body."""

    vertices: Array
    """The mesh's vertices on that body's rest surface, or near it [m], shape (V, 3)."""
    place: OnSurface
    """The points of the surface closest to these vertices."""
    mean_distance: float
    """Mean distance between the two surfaces, without hands, feet and head [m]."""
    far_distance: float
    """The 99th percentile of that distance [m]."""


_LOOKED_AT = tuple(
    JOINT_NAMES.index(f"{side}_{name}")
    for side in ("left", "right")
    for name in ("knee", "ankle", "shoulder", "elbow", "wrist")
)
ENDS = (*joints_of("head"), 7, 8, 10, 11, 20, 21, 22, 23)

_ALONG = 0.05
"""How much a gap along the surface counts, relative to one across it: closest points slide along the surface."""
_SEEN = 0.01
"""Weight of a vertex, as if only one in a hundred were used: neighbours have similar errors."""


class Derivatives(NamedTuple):
    """What a unit of each beta, a radian about each axis of each joint, and a metre along each axis do at rest."""

    vertices: Array
    """[m], shape (V, 3, 85)."""
    joints: Array
    """[m], shape (24, 3, 85)."""


@cache
def derivatives(name: str) -> Derivatives:
    """The derivatives of a built-in body."""
    source, step = load_body(name, dtype=torch.float64), 1e-4
    rest = source(torch.zeros(1, N_JOINTS, 3, dtype=torch.float64))
    turns = [source(pose[None]) for pose in step * torch.eye(3 * N_JOINTS, dtype=torch.float64)]
    betas = torch.eye(N_BETAS, dtype=torch.float64)
    place = torch.eye(3, dtype=torch.float64)
    found = []
    for part, shaped in (("vertices", source.rest_vertices(betas)), ("joints", source.rest_joints(betas))):
        zero = getattr(rest, part)[0]
        bent = torch.stack([getattr(turn, part)[0] - zero for turn in turns]) / step
        columns = torch.cat((shaped - zero, bent, place[:, None].expand(-1, len(zero), -1)))
        found.append(columns.permute(1, 2, 0).contiguous().numpy())
    return Derivatives(*found)


def size_of(body: SmplBody) -> float:
    """How many times as large as an adult a body is, by its height; 1 within `RegistrationSettings.heights`."""
    tall = np.ptp(body.arrays.v_template[:, 1])
    return float(tall / np.clip(tall, *RegistrationSettings.heights))


class Registrar:
    """Lays the mesh of `source` onto the rest surface of `target`, in some seconds.

    First the source's shape, pose and place are fitted; then each vertex moves to the closest point, held back less
    and less by its neighbours. Children and giants are registered at an adult's height.
    """

    def __init__(self, source: SmplBody, target: SmplBody) -> None:
        self.how = RegistrationSettings()
        self.source = source.to(device="cpu", dtype=torch.float64)
        self.target = target.to(device="cpu", dtype=torch.float64)
        self.mesh = Connectivity.of(source.faces.cpu().numpy(), source.n_vertices)
        self.size = size_of(target)
        self.surface = Surface(self.target.v_template.numpy() / self.size, target.faces.cpu().numpy().astype(np.int32))
        self.joints = self.target.joint_template.numpy() / self.size
        self.is_end = self.source.weights[:, list(ENDS)].sum(1).numpy() > 0.5

    def run(self) -> Registration:
        """Both steps, and how far apart the surfaces are afterwards."""
        vertices = self._draped(self._articulated())
        place = self.surface.closest(vertices)
        there = np.linalg.norm(self.surface.at(place) - vertices, axis=1)[~self.is_end]
        own = Surface(vertices, self.mesh.faces)
        points = self.surface.vertices[self.target.weights[:, list(ENDS)].sum(1).numpy() <= 0.5]
        back = np.linalg.norm(own.at(own.closest(points)) - points, axis=1)
        both = self.size * np.concatenate((there, back))
        return Registration(self.size * vertices, place, float(both.mean()), float(np.percentile(both, 99)))

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self._features(self.surface.vertices, self.surface.normals))

    def _features(self, vertices: Array, normals: Array) -> Array:
        return np.concatenate((vertices, self.how.normal_scale * normals), axis=1)

    def _articulated(self) -> Array:
        """The source in the shape, pose and place that are nearest to the target [m], shape (V, 3)."""
        how, linear = self.how, derivatives(self.source.name)
        own = self.source.joint_template.numpy()
        state = np.zeros(linear.vertices.shape[2])
        state[-3:] = (self.joints - own)[list(_LOOKED_AT)].mean(0)
        at, joints = self._at(state)
        for k in range(how.rounds):
            features = self._features(at, vertex_normals(at, self.mesh.faces))
            theirs = np.asarray(self._tree.query(features)[1])
            mine = np.asarray(cKDTree(features).query(self._tree.data)[1])
            mine, theirs = (
                np.concatenate(both) for both in ((np.arange(len(at)), mine), (theirs, np.arange(len(mine))))
            )
            reach = how.reach if k < how.rounds // 2 else how.reach / 2
            gap = at[mine] - self.surface.vertices[theirs]
            weight = _SEEN / how.noise**2 / (1 + (gap**2).sum(1) / reach**2) ** 2
            prior = np.repeat([1.0, how.angle_spread**-2, 0.0], [N_BETAS, 3 * N_JOINTS, 3])
            out = self.surface.normals[theirs]
            metric = weight[:, None, None] * (out[:, :, None] * out[:, None, :] + _ALONG * np.eye(3))
            # A vertex has its own pair, and those of the target's points that are nearest to it.
            pairs = sparse.csr_array((np.ones(len(mine)), (mine, np.arange(len(mine)))), shape=(len(at), len(mine)))
            metrics = (pairs @ metric.reshape(-1, 9)).reshape(-1, 3, 3)
            pull = pairs @ (metric @ gap[:, :, None])[:, :, 0]
            moves, looked_at = (one.reshape(-1, len(state)) for one in (linear.vertices, linear.joints[_LOOKED_AT, :]))
            off = (joints - self.joints)[list(_LOOKED_AT)].ravel() / how.joint_spread**2
            normal = np.diag(prior) + moves.T @ (metrics @ linear.vertices).reshape(moves.shape)
            normal += looked_at.T @ looked_at / how.joint_spread**2
            slope = prior * state + moves.T @ pull.ravel() + looked_at.T @ off
            state = state - np.linalg.solve(normal, slope)
            at, joints = self._at(state)
        return at

    def _at(self, state: Array) -> tuple[Array, Array]:
        """Vertices (V, 3) and joints (24, 3) [m] of a state (85,): betas, pose [rad] and place [m], side by side."""
        with torch.no_grad():
            numbers = torch.as_tensor(state)
            posed = self.source(numbers[None, N_BETAS:-3], numbers[None, :N_BETAS])
        return posed.vertices[0].numpy() + state[-3:], posed.joints[0].numpy() + state[-3:]

    def _draped(self, start: Array) -> Array:
        """Vertices (V, 3) [m] brought to the target's surface."""
        stiff = np.where(self.is_end, self.how.stiff_ends, 1.0)
        laplacian = self.mesh.uniform_laplacian()
        bending = sparse.csr_array(laplacian.T @ sparse.diags_array(stiff) @ laplacian)
        at = start
        for stiffness in self.how.stiffness:
            place = self.surface.closest(at)
            goal = self.surface.at(place)
            normal = self.surface.at(place, self.surface.normals)
            own = vertex_normals(at, self.mesh.faces)
            agree = np.clip(((normal * own).sum(1) - 0.5) / 0.4, 0, 1)
            distance2 = ((goal - at) ** 2).sum(1)
            weight = agree / (1 + distance2 / self.how.reach**2) + 1e-4
            solve = symmetric_solver(sparse.diags_array(weight) + stiffness * bending)
            at = start + solve(weight[:, None] * (goal - start))
        return at
