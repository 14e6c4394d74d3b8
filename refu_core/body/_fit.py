"""Fits the built-in mesh to other bodies, and finds how they differ from the built-in ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from os import PathLike
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from refu_core._cache import keep, recall
from refu_core.body._io import load_body
from refu_core.body._model import BodyArrays, SmplBody
from refu_core.body._register import ENDS, Array, Registrar, Registration, derivatives, size_of
from refu_core.body._rest_pose import require_rest_pose
from refu_core.body._surface import OnSurface
from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.modes import BUILTIN_BODIES

REGISTERED = "neutral"
"""The built-in body that is laid onto others: it is half way between the other two."""
POOR_FIT = 3e-3
"""Surfaces farther apart than this on average [m], at an adult's height, don't belong to two bodies in the T-pose.
(Those in tests/smpl_file.py are .3 to .5 mm apart.)"""
_POOR_FAR = 10e-3
"""The same at the 99th percentile [m]. (Those are 1.6 to 2.3 mm apart, an infant with its large head 4 mm; where limbs
aren't found, it is 15 mm and more.)"""
_ANGLE_SPREAD = 0.1
"""How much a joint's angle differs between two rest poses [rad]."""
_TRUST = 1e-3
"""A beta that moves skin by no more than this per unit [m] is hardly used: it would fit noise."""
_END_SHARE = 0.1
"""How much hands, feet and heads count when shapes are compared."""
_REGRESSED = 400
"""Number of vertices that a joint is regressed from."""
_VERSION = 2
"""Version of what `Registrar` computes: results that another version has cached aren't used."""


@dataclass(frozen=True, eq=False)
class ShapeMap:
    """Maps betas of one body to those of another: β' = offset + matrix β."""

    matrix: Tensor
    """Shape (10, 10)."""
    offset: Tensor
    """Shape (10,)."""
    limit: float = 3.0
    """Largest magnitude of a component of β': nothing was trained beyond it."""

    def __call__(self, betas: Tensor) -> Tensor:
        """The mapped betas, shape (B, 10), of betas (B, 10). Differentiable."""
        return (self.offset.to(betas) + betas @ self.matrix.to(betas).T).clamp(-self.limit, self.limit)


@dataclass(frozen=True, eq=False)
class Difference:
    """What a built-in body's shape space can't express of another body, at the V vertices of the built-in mesh.

    Lengths are those of the other body at an adult's height (`BodyFit.size`).
    """

    source: SmplBody
    """The built-in body, float64, on the CPU."""
    betas: ShapeMap
    """Maps the body's betas to those of the built-in one."""
    template: Array
    """Difference of the mean shape at rest [m], shape (V, 3)."""
    directions: Array
    """Difference of the displacement per unit of each beta [m], shape (V, 3, 10)."""
    weights: Array
    """Difference of the skinning weights, shape (V, 24)."""


class BodyFit:
    """A body and the built-in mesh laid onto it."""

    def __init__(self, body: SmplBody, registration: Registration, *, fingerprints: tuple[str, ...] = ()) -> None:
        self.body = body
        self.registration = registration
        self.fingerprints = fingerprints or (body.fingerprint,)
        """Fingerprints of bodies: weights trained on any of them are this body's own."""
        self._of: dict[str, Difference] = {}

    @cached_property
    def size(self) -> float:
        """How many times as large as an adult the body is; 1 from 1.5 to 2 m."""
        return size_of(self.body)

    @property
    def is_poor(self) -> bool:
        """Whether the surfaces are too far apart, for the body's size, to trust what is transferred."""
        found = self.registration
        return found.mean_distance > POOR_FIT * self.size or found.far_distance > _POOR_FAR * self.size

    @property
    def text(self) -> str:
        """The quality of the fit, in words."""
        found = self.registration
        mean, far = 1e3 * found.mean_distance, 1e3 * found.far_distance
        return f"{mean:.1f} mm on average, {far:.1f} mm at the 99th percentile"

    @property
    def warnings(self) -> list[str]:
        """Warnings about the fit, in words."""
        if not self.is_poor:
            return []
        wanted = f"wanted {1e3 * POOR_FIT * self.size:.2g} mm at most, and {1e3 * _POOR_FAR * self.size:.2g} mm"
        return [f"the built-in mesh lies on {self.body.name} {self.text}, {wanted}: garments may fit it badly"]

    def carried(self, values: NDArray[np.floating]) -> Array:
        """`values` of the body's vertices (N, …), interpolated at the vertices of the built-in mesh (V, …)."""
        return self.registration.place.of(values.astype(np.float64), self.body.arrays.faces)

    def directions(self) -> Array:
        """What a unit of each beta does to the built-in mesh on this body [m], shape (V, 3, 10)."""
        return self.carried(self.body.arrays.shapedirs)

    def difference(self, name: str) -> Difference:
        """How the body differs from the built-in body `name`."""
        if name not in self._of:
            self._of[name] = self._differ(load_body(name, dtype=torch.float64))
        return self._of[name]

    def _differ(self, source: SmplBody) -> Difference:
        rest, own = source.v_template.numpy(), source.arrays.shapedirs
        columns = derivatives(source.name).vertices
        off = self.registration.vertices / self.size - rest
        goal = np.concatenate((off[:, :, None], self.directions() / self.size), axis=2)
        columns = columns.reshape(-1, columns.shape[2])
        share = np.where(source.weights[:, list(ENDS)].sum(1).numpy() > 0.5, _END_SHARE, 1.0)
        weight = np.repeat(share / share.sum(), 3)[:, None]
        prior = _TRUST**2 * np.repeat([1.0, _ANGLE_SPREAD**-2, 1e-6], [N_BETAS, 3 * N_JOINTS, 3])
        found = np.linalg.solve(
            columns.T @ (weight * columns) + np.diag(prior), columns.T @ (weight * goal.reshape(len(columns), -1))
        )[:N_BETAS]
        left = goal - np.einsum("vck,kr->vcr", own, found)
        shape_map = ShapeMap(torch.as_tensor(found[:, 1:]), torch.as_tensor(found[:, 0]))
        weights = self.carried(self.body.arrays.weights) - source.arrays.weights
        return Difference(source, shape_map, left[:, :, 0], left[:, :, 1:], weights)

    def resampled(self) -> BodyFit:
        """The same body on the built-in mesh: its shape space, joints and skin, whatever its own mesh is like."""
        arrays, source = self.body.arrays, load_body(REGISTERED)
        vertices, directions = self.registration.vertices, self.directions()
        weights = self.carried(arrays.weights).clip(0)
        made = BodyArrays(
            v_template=vertices,
            faces=source.arrays.faces,
            weights=weights / weights.sum(1, keepdims=True),
            joint_regressor=_regressor(self.body, vertices, directions),
            shapedirs=directions,
            posedirs=None if arrays.posedirs is None else self.carried(arrays.posedirs),
        )
        body = SmplBody(made, name=self.body.name, device=self.body.device, dtype=self.body.dtype)
        known = self.registration
        laid = replace(known, vertices=vertices, place=_corners(made.faces, len(vertices)))
        return BodyFit(body, laid, fingerprints=(body.fingerprint, self.body.fingerprint))


def _regressor(body: SmplBody, vertices: Array, directions: Array) -> Array:
    """Regresses the body's joints, for every β, from vertices (V, 3) near them that move by `directions` (V, 3, 10)."""
    exact = body.to(device="cpu", dtype=torch.float64)
    joints = exact.joint_template.numpy()
    moved = exact.rest_joints(torch.eye(N_BETAS, dtype=torch.float64)).numpy() - joints  # (10, 24, 3)
    tree, rows = cKDTree(vertices), np.zeros((N_JOINTS, len(vertices)))
    for j, joint in enumerate(joints):
        near = np.asarray(tree.query(joint, _REGRESSED)[1])
        # The displacements (millimetres per unit of β) must be matched as well as the place (metres).
        known = [np.ones((1, len(near))), vertices[near].T, directions[near].reshape(len(near), -1).T]
        goal = [np.ones(1), joint, moved[:, j].T.ravel()]
        uniform = np.full(len(near), 1 / len(near))
        lacks = np.concatenate(goal) - np.concatenate(known) @ uniform
        rows[j, near] = uniform + np.linalg.lstsq(np.concatenate(known), lacks, rcond=1e-6)[0]
        rows[j] /= rows[j].sum()
    return rows


def load_fit(
    body: str | PathLike[str] | SmplBody, *, betas_from: bool = False, device: str | torch.device = "cpu"
) -> BodyFit:
    """Loads a body, in float32, and lays the built-in mesh onto it: some seconds for a body not seen before.

    With `betas_from` it is the same body on the built-in mesh, whatever its own mesh is like (`BodyFit.resampled`).

    Raises `BodyError`: no such body, or one that isn't in metres, upright, in the T-pose, closed (`require_rest_pose`).
    """
    if isinstance(body, SmplBody):
        loaded = body.to(device=device, dtype=torch.float32)
    else:
        loaded = load_body(body, device=device)
    source = load_body(REGISTERED)
    # The built-in bodies share one mesh.
    is_built_in = np.array_equal(loaded.arrays.faces, source.arrays.faces)
    if is_built_in and any(loaded.fingerprint == load_body(name).fingerprint for name in BUILTIN_BODIES):
        place = _corners(source.arrays.faces, source.n_vertices)
        return BodyFit(loaded, Registration(loaded.arrays.v_template, place, 0.0, 0.0))
    require_rest_pose(loaded, closed=not betas_from)
    found = BodyFit(loaded, _registered(source, loaded))
    return found.resampled() if betas_from else found


def _corners(faces: NDArray[np.int64], n_vertices: int) -> OnSurface:
    """Each vertex of a mesh as a point of the mesh's own surface."""
    face, corner = np.zeros(n_vertices, np.int64), np.zeros(n_vertices, np.int64)
    for k in range(3):
        face[faces[:, k]], corner[faces[:, k]] = np.arange(len(faces)), k
    return OnSurface(face, np.eye(3)[corner])


def _registered(source: SmplBody, body: SmplBody) -> Registration:
    """As `Registrar` lays it, cached from one process to the next."""
    name = f"fit-{_VERSION}-{source.fingerprint}-{body.fingerprint}"
    known = recall(name, keys=("vertices", "face", "weight", "distances"))
    if known is None or not _makes_sense(known, source, body):
        made = Registrar(source, body).run()
        distances = np.array([made.mean_distance, made.far_distance], np.float32)
        known = {"vertices": made.vertices.astype(np.float32), "face": made.place.face.astype(np.int32)}
        known |= {"weight": made.place.weight.astype(np.float32), "distances": distances}
        keep(name, known)
    # What is cached is rounded, so a new result is rounded, too: both give the same body.
    place = OnSurface(known["face"].astype(np.int64), known["weight"].astype(np.float64))
    mean, far = known["distances"].tolist()
    return Registration(known["vertices"].astype(np.float64), place, mean, far)


def _makes_sense(known: Mapping[str, NDArray[Any]], source: SmplBody, body: SmplBody) -> bool:
    n = source.n_vertices
    shapes = {"vertices": (n, 3), "face": (n,), "weight": (n, 3), "distances": (2,)}
    return all(known[key].shape == shape and np.isfinite(known[key]).all() for key, shape in shapes.items()) and bool(
        (known["face"] >= 0).all() and (known["face"] < len(body.faces)).all()
    )
