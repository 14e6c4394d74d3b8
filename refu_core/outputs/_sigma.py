"""How far a prediction may be off, vertex by vertex: from the network's errors on samples that it wasn't trained on."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from refu_core._numbers import NOT_NUMBERS, as_numbers
from refu_core.backbones import SEEN_TILT
from refu_core.body import SmplBody
from refu_core.errors import FrameError, MeshError, WeightsError, require_pipeline, require_type
from refu_core.frames import LAGS, N_JOINTS, SmplFrame
from refu_core.garments import GarmentTemplate
from refu_core.keypoints._pose import skew
from refu_core.outputs._worn import require_garment, require_worn
from refu_core.realtime import GarmentPipeline, PipelineOutput
from refu_core.skeleton import CARRIED
from refu_core.weights import load_weights, save_weights, weights_folder

UNKNOWN_SIGMA = 0.03
"""σ of every vertex of a garment whose network has no `sigma` file, or that has no network and follows the skin [m].
Following the skin alone, the T-shirt, the shirt, and the shorts have a σ of 24 to 27 mm, the skirt of 43."""
RADIUS_90 = 2.5003
"""A ball of this many σ around a vertex holds the true one in 90 % of cases: χ's quantile, three degrees of freedom."""
REGIONS = 3
"""Number of pose regions: equal shares of the samples, from hardly bent to most bent."""
GROWTH, MOST_GROWTH = 3.0, 0.8
"""How much σ grows by for each radian that joints have turned [1/rad], and at most. In 514 frames of moving T-shirts,
and 181 of shirts, σ would have to be 1.5 to 1.7 times as large from 0.1 rad on. With these numbers the 90 % interval
holds 91 and 94 % there, and 78 and 86 % in the faster sequences of a T-shirt and a skirt in bags/."""
LEAST_SIGMA = 0.0011
"""Less is never claimed [m]: the truth is simulated, and a skirt whose joints are turned by 0.02° is that far off."""
_SWEEPS = 10
"""How often errors are averaged with those of neighbours: some fifty samples say too little about a single vertex."""


@dataclass(frozen=True, eq=False)
class SigmaMap:
    """What is known of one garment's errors."""

    sigma: NDArray[np.float32]
    """Standard deviation of each vertex per coordinate, over all poses [m], shape (V,)."""
    bend: NDArray[np.float32]
    """How much the garment's joints are bent in the middle of each pose region [rad], ascending, shape (R,)."""
    factor: NDArray[np.float32]
    """The factor by which σ is larger there, shape (R,)."""
    is_measured: bool = True
    """False for `UNKNOWN_SIGMA`."""

    def at(self, bend: float) -> NDArray[np.float32]:
        """σ in a pose bent this much [m], shape (V,), interpolated between the regions' middles to avoid jumps."""
        found: NDArray[np.float32] = self.sigma * np.float32(np.interp(bend, self.bend, self.factor))
        return found

    @classmethod
    def unknown(cls, n_vertices: int) -> SigmaMap:
        """For a garment about which nothing is known: a number that a filter can work with."""
        one = np.ones(1, np.float32)
        return cls(np.full(n_vertices, UNKNOWN_SIGMA, np.float32), 0 * one, one, is_measured=False)


def bend_of(garment: GarmentTemplate, pose: NDArray[Any]) -> NDArray[np.float64]:
    """How much the joints that affect a garment, except the root, bend [rad] in poses (…, 24, 3) [rad]; shape (…,)."""
    require_garment(garment)
    joints = [joint for joint in garment.card.joints if joint != 0]
    angle = np.linalg.norm(np.asarray(pose, np.float64)[..., joints, :], axis=-1)
    wrapped = np.remainder(angle + np.pi, 2 * np.pi) - np.pi  # a rotation of 350° is one of 10°
    found: NDArray[np.float64] = np.sqrt((wrapped**2).sum(-1))
    return found


def turned_of(garment: GarmentTemplate, past: NDArray[Any]) -> float:
    """How far the joints that affect a garment, and the root, have turned in 4/15 s [rad], root of the sum of squares.

    `past` is `SmplFrame.past`, (4, 219).
    """
    joints = [0, *(joint for joint in garment.card.joints if joint != 0)]
    of_joints = past[LAGS.index(4 / 15), : 9 * N_JOINTS].reshape(N_JOINTS, 9)[joints]
    return float(np.linalg.norm(of_joints) / np.sqrt(2))  # |R - R'| of small turns is √2 times their angle


def fit_sigma(garment: GarmentTemplate, errors: NDArray[Any], poses: NDArray[Any]) -> SigmaMap:
    """σ of a garment from N predictions whose truth is known, for samples that its network hasn't seen.

    `errors` are distances of predicted vertices to the true ones [m], (N, V); `poses` are those of the samples [rad],
    (N, 24, 3). In each pose region σ is scaled so that nine in ten of the true vertices are within `RADIUS_90` σ.
    Raises `MeshError` for arrays of other shapes, and for fewer than 10 samples a region.
    """
    require_garment(garment)
    try:
        length, where = (np.asarray(as_numbers(one), np.float64) for one in (errors, poses))
    except NOT_NUMBERS as error:
        raise MeshError(f"errors and poses must be arrays of numbers: {error}") from error
    n = len(length)
    is_shaped = length.shape == (n, garment.n_vertices) and where.shape == (n, N_JOINTS, 3)
    if not is_shaped or not (np.isfinite(length).all() and np.isfinite(where).all()):
        wanted = f"finite errors (N, {garment.n_vertices}) and poses (N, {N_JOINTS}, 3)"
        raise MeshError(f"wanted {wanted}, got {length.shape} and {where.shape}")
    if n < 10 * REGIONS:
        raise MeshError(f"σ needs {10 * REGIONS} samples or more, got {n}")
    around = garment.mesh.adjacency_matrix()
    degree = np.maximum(around.sum(axis=1), 1.0)
    variance = (length**2).mean(0) / 3
    for _ in range(_SWEEPS):
        variance = 0.5 * variance + 0.5 * (around @ variance) / degree
    sigma = np.sqrt(variance)
    bend = bend_of(garment, where)
    regions = np.array_split(np.argsort(bend, kind="stable"), REGIONS)
    middle = [np.median(bend[rows]) for rows in regions]
    factor = [np.quantile(length[rows] / sigma, 0.9) / RADIUS_90 for rows in regions]
    sigma = np.maximum(sigma, LEAST_SIGMA / max(min(factor), 1e-3))
    return SigmaMap(sigma.astype(np.float32), np.array(middle, np.float32), np.array(factor, np.float32))


def save_sigma(
    garment: GarmentTemplate, found: SigmaMap, card: Mapping[str, Any], *, folder: str | os.PathLike[str] | None = None
) -> Path:
    """Writes `sigma` beside a garment's weights, in its folder below `folder`, by default below the shipped weights.

    Raises `WeightsError` where it can't be written.
    """
    require_garment(garment)
    require_type(found, SigmaMap, "a SigmaMap", error=WeightsError)
    tensors = {name: torch.from_numpy(getattr(found, name)) for name in ("sigma", "bend", "factor")}
    tensors["sigma"] = tensors["sigma"].half()
    about = {"garment": garment.name, "n_vertices": garment.n_vertices, **card}
    return save_weights(weights_folder(garment.name, folder) / "sigma", tensors, about)


def load_sigma(garment: GarmentTemplate, *, folder: str | os.PathLike[str] | None = None) -> SigmaMap:
    """What `save_sigma` wrote; `SigmaMap.unknown` where there is no such file.

    Raises `WeightsError` for a file that is damaged, or of another garment.
    """
    require_garment(garment)
    stem = weights_folder(garment.name, folder) / "sigma"
    if not stem.with_suffix(".json").exists():
        return SigmaMap.unknown(garment.n_vertices)
    stored = load_weights(stem, expect={"garment": garment.name, "n_vertices": garment.n_vertices})
    try:
        sigma, bend, factor = (stored.tensors[key].float().numpy() for key in ("sigma", "bend", "factor"))
    except KeyError as error:
        raise WeightsError(f"{stored.path}: wanted the tensors sigma, bend and factor, there is no {error}") from error
    is_right = sigma.shape == (garment.n_vertices,) and bend.ndim == 1 and bend.shape == factor.shape and len(bend)
    if not is_right or not ((sigma > 0).all() and (factor > 0).all() and (np.diff(bend) >= 0).all()):
        raise WeightsError(f"{stored.path}: not the σ of {garment.name}: make it anew with scripts/fit_sigma.py")
    return SigmaMap(sigma, bend, factor)


class Sigma:
    """Standard deviations of a pipeline's garments: from its networks and, if its covariance is known, the input."""

    def __init__(self, pipeline: GarmentPipeline, *, folder: str | os.PathLike[str] | None = None) -> None:
        """For a pipeline; `folder` is that of the user's own weights, if the pipeline was loaded with one.

        Raises `WeightsError` for a damaged file of σ, and `MeshError` for no pipeline.
        """
        require_pipeline(pipeline, "garments", "body", error=MeshError)
        self._body, self._garments = pipeline.body, pipeline.garments
        self.maps: dict[str, SigmaMap] = {}
        """By garment. One that no network drapes, or whose network wasn't measured, has `UNKNOWN_SIGMA`."""
        for name, garment in self._garments.items():
            known = name not in pipeline.untrained
            self.maps[name] = load_sigma(garment, folder=folder) if known else SigmaMap.unknown(garment.n_vertices)

    def __call__(
        self,
        frame: SmplFrame,
        output: PipelineOutput,
        *,
        pose_covariance: NDArray[Any] | None = None,
        transl_covariance: NDArray[Any] | None = None,
    ) -> dict[str, NDArray[np.float32]]:
        """σ per coordinate of each garment's vertices [m], by name, shape (V,), for a frame and what was made of it.

        A ball of `RADIUS_90` σ holds the true vertex in nine cases of ten, if the input is as stated and the person
        hardly moves; σ is never NaN. Moving cloth is harder to predict: σ grows by up to `MOST_GROWTH` of its own size
        as joints turn (`turned_of`), if the frame knows its past.
        Raises `FrameError` for anything but a frame, and for a covariance of another shape, not finite, too large, or
        with a negative variance; `MeshError` for anything but an output, and for an output with other garments.

        Args:
            frame: the one that was dressed.
            output: what the pipeline made of it.
            pose_covariance: of the rotation vectors [rad²], shape (72, 72), or (24, 3, 3) where joints are
                independent; it is pushed through the kinematics.
            transl_covariance: of the translation [m²], shape (3, 3).
        """
        require_type(frame, SmplFrame, "a SmplFrame", error=FrameError)
        require_worn(output, self._garments)
        pose = None
        if pose_covariance is not None:
            pose = _covariance("pose_covariance", pose_covariance, (3 * N_JOINTS, 3 * N_JOINTS), (N_JOINTS, 3, 3))
        transl = 0.0
        if transl_covariance is not None:
            transl = float(np.trace(_covariance("transl_covariance", transl_covariance, (3, 3)))) / 3
        found, unseen = {}, _unseen_tilt(frame)
        for name in output:
            garment = self._garments[name]
            sigma = self.maps[name].at(float(bend_of(garment, frame.pose)))
            if frame.past is not None:
                sigma = sigma * np.float32(1 + min(GROWTH * turned_of(garment, frame.past), MOST_GROWTH))
            sigma = sigma + np.float32(unseen) * np.maximum(UNKNOWN_SIGMA - sigma, 0).astype(np.float32)
            if pose is not None or transl > 0:
                variance = sigma.astype(np.float64) ** 2 + transl
                if pose is not None:
                    variance += _input_variance(self._body, garment, frame, output[name].local, pose)
                sigma = np.sqrt(variance).astype(np.float32)
            found[name] = sigma
        return found


def _unseen_tilt(frame: SmplFrame) -> float:
    """How far a person leans beyond what networks have seen: from 0 to 1 between the tilts of `SEEN_TILT`."""
    tilt = np.arccos(np.clip((Rotation.from_rotvec(frame.pose[0]).as_matrix().T @ frame.up)[1], -1, 1))
    low, high = SEEN_TILT
    return float(np.clip((tilt - low) / (high - low), 0, 1))


_LARGEST = 1e12
"""Largest number in a covariance; joints turn by 1e4 rad at most, and people are no farther than 1e6 m off."""


def _covariance(name: str, value: Any, *shapes: tuple[int, ...]) -> NDArray[np.float64]:
    try:
        array = as_numbers(value).astype(np.float64)
    except NOT_NUMBERS:
        array = np.full(0, np.nan)
    if array.shape not in shapes or not np.isfinite(array).all():
        wanted, got = " or ".join(map(str, shapes)), array.shape if array.size else type(value).__name__
        raise FrameError(f"{name} must be finite numbers of the shape {wanted}, got {got}")
    if (np.diagonal(array, axis1=-2, axis2=-1) < 0).any():
        raise FrameError(f"{name} has a negative variance on its diagonal")
    if np.abs(array).max() > _LARGEST:
        msg = f"{name}: wanted numbers up to {_LARGEST:g}, got {np.abs(array).max():g}: leave out what isn't known"
        raise FrameError(msg)
    return array


def _input_variance(
    body: SmplBody,
    garment: GarmentTemplate,
    frame: SmplFrame,
    vertices: NDArray[np.float32],
    covariance: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Variance per coordinate of a garment's vertices due to the pose's covariance, to first order [m²], shape (V,).

    A joint turns what hangs on it about itself: dx = -w [x - p]× G J dθ. Here w is the vertex's total weight of this
    joint and all below it, p the posed joint, G its world rotation, and J the right Jacobian of its rotation vector θ.

    `vertices` are without the translation [m], (V, 3); `covariance` is of rotation vectors [rad²], (72, 72) or
    (24, 3, 3).
    """
    posed = body(frame.pose[None], frame.betas[None])
    joints = posed.joints[0].cpu().double().numpy()
    turn = posed.transforms.rotation[0].cpu().double().numpy() @ _right_jacobians(frame.pose.astype(np.float64))
    hangs = garment.weights.detach().cpu().double().numpy() @ CARRIED
    arm = hangs[:, :, None] * (vertices[:, None].astype(np.float64) - joints)
    n = len(joints)
    if covariance.ndim == 3:
        covariance = block_diag(*covariance)
    spread = np.einsum("aij,ajbk,blk->abil", turn, covariance.reshape(n, 3, n, 3), turn, optimize=True)
    trace = np.trace(spread, axis1=2, axis2=3)
    flat = arm.reshape(len(arm), -1)
    # tr([a]× S [b]×ᵀ) = (a·b) tr S - bᵀ S a
    form = np.einsum("ab,il->aibl", trace, np.eye(3)) - spread.transpose(0, 3, 1, 2)
    total = ((flat @ form.reshape(3 * n, 3 * n)) * flat).sum(1)
    return np.asarray(np.maximum(total, 0.0) / 3)


def _right_jacobians(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Right Jacobians J of rotation vectors (N, 3) [rad], shape (N, 3, 3): R(θ + dθ) = R(θ) exp([J dθ]×)."""
    angle = np.linalg.norm(pose, axis=1)[:, None, None]
    cross = skew(pose)
    square = np.maximum(angle, 1e-3) ** 2
    first = np.where(angle < 1e-3, 0.5, (1 - np.cos(angle)) / square)
    second = np.where(angle < 1e-3, 1 / 6, (angle - np.sin(angle)) / (square * np.maximum(angle, 1e-3)))
    return np.eye(3) - first * cross + second * (cross @ cross)
