"""Registration: the built-in mesh laid onto the surface of another body in its rest pose.

Three bodies are built in and share one mesh, so one registration tells of all three which place of theirs is which of
the other body.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from torch import Tensor

from refu_core.body._kinematics import JOINT_NAMES
from refu_core.body._model import SmplBody
from refu_core.body._parts import joints_of
from refu_core.body._surface import OnSurface, Surface
from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.mesh import Connectivity, vertex_normals

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class RegistrationSettings:
    """How a mesh is laid onto a surface; figures are of the bodies in tests/smpl_file.py."""

    rounds: int = 12
    """How often closest points are looked for while shape and pose are fitted: they no longer change by then."""
    steps: int = 12
    """Of the optimiser in each round."""
    normal_scale: float = 0.05
    """Of two normals that stand at right angles, as far as being 1.4 times so far apart counts [m]: flanks don't find
    the arm beside them."""
    reach: float = 0.04
    """What is farther from the surface than this counts less and less [m]."""
    joint_spread: float = 0.04
    """How far joints of two models are apart in one body [m]. Hips (by 10 cm), spine and collars aren't looked at."""
    angle_spread: float = 0.1
    """How far a joint is turned from one rest pose to the other [rad]."""
    noise: float = 0.01
    """Of the surface against joints, angles and betas [m]."""
    stiffness: tuple[float, ...] = (300.0, 100.0, 30.0, 10.0, 3.0, 1.0, 1.0, 0.3, 0.3, 0.3)
    """How much more it counts that neighbours move alike than that vertices are on the surface, from round to round."""
    stiff_ends: float = 30.0
    """How many times stiffer hands, feet and heads are: nothing is worn there, and fingers find the wrong finger."""


@dataclass(frozen=True, eq=False)
class Registration:
    """The built-in mesh (V vertices) on another body."""

    vertices: Array
    """On its rest surface, or near it [m], shape (V, 3)."""
    place: OnSurface
    """Which points of its surface these are."""
    mean_distance: float
    """Of the two surfaces, hands, feet and head left out [m]."""
    far_distance: float
    """The 99th percentile [m]."""


_LOOKED_AT = tuple(
    JOINT_NAMES.index(f"{side}_{name}")
    for side in ("left", "right")
    for name in ("knee", "ankle", "shoulder", "elbow", "wrist")
)
ENDS = (*joints_of("head"), 7, 8, 10, 11, 20, 21, 22, 23)


_ALONG = 0.05
"""How much a gap along the surface counts of one across it: closest points slide."""
_SEEN = 0.01
"""As if every hundredth vertex were looked at: neighbours are wrong by as much as each other."""


class _State(NamedTuple):
    """What is fitted first."""

    betas: Tensor
    pose: Tensor
    transl: Tensor


class _Pairs(NamedTuple):
    """Vertices of the source and of the target that belong together, and how much each pair counts."""

    mine: Tensor
    theirs: Tensor
    weight: Tensor

    @classmethod
    def of(cls, mine: NDArray[Any], theirs: NDArray[Any], at: Array, goal: Array, reach: float) -> _Pairs:
        """What is farther apart than `reach` [m] counts less and less."""
        weight = 1 / (1 + ((at[mine] - goal[theirs]) ** 2).sum(1) / reach**2) ** 2
        return cls(torch.as_tensor(mine), torch.as_tensor(theirs), torch.as_tensor(weight))


def register(source: SmplBody, target: SmplBody, settings: RegistrationSettings | None = None) -> Registration:
    """Lays the mesh of `source` onto the rest surface of `target`, in some seconds.

    First by shape, pose and place of the source; then each vertex to the closest point, less and less held back by its
    neighbours.
    """
    return _Registrar(source, target, settings or RegistrationSettings()).run()


class _Registrar:
    def __init__(self, source: SmplBody, target: SmplBody, settings: RegistrationSettings) -> None:
        self.how = settings
        self.source = source.to(device="cpu", dtype=torch.float64)
        self.target = target.to(device="cpu", dtype=torch.float64)
        self.mesh = Connectivity.of(source.faces.cpu().numpy(), source.n_vertices)
        self.surface = Surface(self.target.v_template.numpy(), target.faces.cpu().numpy().astype(np.int32))
        self.joints = self.target.rest_joints(torch.zeros(1, N_BETAS, dtype=torch.float64))[0]
        self.is_end = self.source.weights[:, list(ENDS)].sum(1).numpy() > 0.5

    def run(self) -> Registration:
        """All of it."""
        vertices = self._draped(self._articulated())
        place = self.surface.closest(vertices)
        there = np.linalg.norm(self.surface.at(place) - vertices, axis=1)[~self.is_end]
        own = Surface(vertices, self.mesh.faces)
        is_end = self.target.weights[:, list(ENDS)].sum(1).numpy() > 0.5
        points = self.surface.vertices[~is_end]
        back = np.linalg.norm(own.at(own.closest(points)) - points, axis=1)
        both = np.concatenate((there, back))
        return Registration(vertices, place, float(both.mean()), float(np.percentile(both, 99)))

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self._features(self.surface.vertices, self.surface.normals))

    def _features(self, vertices: Array, normals: Array) -> Array:
        return np.concatenate((vertices, self.how.normal_scale * normals), axis=1)

    def _articulated(self) -> Array:
        """The source in the shape, pose and place that are nearest to the target [m], shape (V, 3)."""
        how = self.how
        betas = torch.zeros(1, N_BETAS, dtype=torch.float64)
        pose = torch.zeros(1, N_JOINTS, 3, dtype=torch.float64)
        transl = (self.joints - self.source(pose).joints[0])[list(_LOOKED_AT)].mean(0)
        state = _State(betas.requires_grad_(), pose.requires_grad_(), transl.clone().requires_grad_())
        for k in range(how.rounds):
            at = self._at(state)
            features = self._features(at, vertex_normals(at, self.mesh.faces))
            theirs = np.asarray(self._tree.query(features)[1])
            mine = np.asarray(cKDTree(features).query(self._tree.data)[1])
            reach = how.reach if k < how.rounds // 2 else how.reach / 2
            pairs = [
                _Pairs.of(np.arange(len(at)), theirs, at, self.surface.vertices, reach),
                _Pairs.of(mine, np.arange(len(mine)), at, self.surface.vertices, reach),
            ]
            self._step(state, pairs)
        return self._at(state)

    def _at(self, state: _State) -> Array:
        with torch.no_grad():
            vertices: Array = (self.source(state.pose, state.betas).vertices[0] + state.transl).numpy()
        return vertices

    def _step(self, state: _State, pairs: list[_Pairs]) -> None:
        """Brings pairs of points together, as far as joints, angles and betas let them."""
        how, looked_at = self.how, list(_LOOKED_AT)
        goal, normals = torch.as_tensor(self.surface.vertices), torch.as_tensor(self.surface.normals)
        optimiser: Any = torch.optim.LBFGS(list(state), max_iter=how.steps, line_search_fn="strong_wolfe")

        def loss() -> Tensor:
            optimiser.zero_grad()
            posed = self.source(state.pose, state.betas)
            vertices, joints = posed.vertices[0] + state.transl, posed.joints[0] + state.transl
            total = ((joints - self.joints)[looked_at] / how.joint_spread).square().sum()
            total = total + (state.pose / how.angle_spread).square().sum() + state.betas.square().sum()
            for mine, theirs, weight in pairs:
                gap = vertices[mine] - goal[theirs]
                off = (gap * normals[theirs]).sum(1).square() + _ALONG * gap.square().sum(1)
                total = total + _SEEN * (weight * off).sum() / how.noise**2
            torch.autograd.backward(total)
            return total

        optimiser.step(loss)

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
            matrix = sparse.csc_array(sparse.diags_array(weight) + stiffness * bending)
            at = start + splu(matrix).solve(weight[:, None] * (goal - start))
        return at
