"""The SMPL body model (Loper et al. 2015): from shape, pose and joints to a posed mesh."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from refu_core._device import checked_device, without_autocast
from refu_core._numbers import NOT_NUMBERS, as_numbers
from refu_core.body._fingers import without_fingers
from refu_core.body._kinematics import RigidTransforms, forward_kinematics, require_batch
from refu_core.body._skinning import Skinning
from refu_core.errors import BodyError, FrameError
from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.skeleton import PARENTS

N_POSE_FEATURES = 9 * (N_JOINTS - 1)
_LARGEST = 1e6
"""No model has larger numbers, and products of much larger ones are infinite in float32."""
_OTHERS = {5: "FLAME's, a head", 16: "MANO's, a hand", 33: "SMAL's, an animal", 35: "SMAL's, an animal", 75: "SUPR's"}
"""Models of the same keys, by their number of joints."""


class BodyOutput(NamedTuple):
    """A batch of posed bodies in SMPL axes."""

    vertices: Tensor
    """[m], shape (B, V, 3)."""
    joints: Tensor
    """[m], shape (B, 24, 3)."""
    transforms: RigidTransforms
    """Rest pose to posed, per joint and without `transl`; what garments are posed with."""
    rotations: Tensor
    """Of the joints relative to their parents, shape (B, 24, 3, 3)."""


class Shape(NamedTuple):
    """Bodies of given β before they are posed, in SMPL axes."""

    vertices: Tensor
    """Without pose blend shapes [m], shape (B, V, 3)."""
    joints: Tensor
    """[m], shape (B, 24, 3)."""


@dataclass(frozen=True, eq=False)
class BodyArrays:
    """The arrays of an SMPL-layout model file, checked; V vertices, F faces."""

    v_template: NDArray[np.float64]
    """Mean shape in the T-pose [m], shape (V, 3)."""
    faces: NDArray[np.int64]
    """Counter-clockwise from outside, shape (F, 3)."""
    weights: NDArray[np.float64]
    """Skinning weights, rows sum to one, shape (V, 24)."""
    joint_regressor: NDArray[np.float64]
    """Joints from the vertices of a shape, rows sum to one, shape (24, V)."""
    shapedirs: NDArray[np.float64]
    """Displacement per unit of each beta [m], shape (V, 3, 10)."""
    posedirs: NDArray[np.float64] | None
    """Displacement per unit of a pose feature (entries of R_j - I, j = 1…23) [m], shape (V, 3, 207); None for none."""

    @classmethod
    def from_mapping(cls, data: Mapping[str, Any], *, source: str) -> BodyArrays:
        """Reads the keys of SMPL files (`f`, `J_regressor`, `kintree_table`, …); raises `BodyError`."""
        missing = sorted({"v_template", "f", "weights", "J_regressor", "kintree_table", "shapedirs"} - set(data))
        if missing:
            msg = f"{source}: not an SMPL-layout model, it lacks {', '.join(missing)}{_keys_hint(data, missing)}"
            raise BodyError(msg)

        def numbers(key: str) -> NDArray[np.float64]:
            try:
                array = np.asarray(data[key], dtype=np.float64, order="C")
            except (TypeError, ValueError, OverflowError) as error:
                raise BodyError(f"{source}: {key} is not an array of numbers: {error}") from error
            # The parent of the root is 2**32 - 1 in official files; all else is metres, shares and indices.
            largest = max(-array.min(initial=0), array.max(initial=0))  # NaN if any value is
            if not np.isfinite(largest) or (key != "kintree_table" and largest > _LARGEST):
                raise BodyError(f"{source}: {key} has values that are NaN or infinite, or beyond {_LARGEST:g}")
            return array

        read = {key: numbers(key) for key in ("weights", "J_regressor", "kintree_table", "posedirs") if key in data}
        read = without_fingers(read)
        v_template = numbers("v_template")
        n = _n_rows(v_template.shape) if v_template.ndim == 2 else 0
        parents = read["kintree_table"]
        # The root's parent is stored as 2**32 - 1 or -1.
        if parents.shape != (2, N_JOINTS) or tuple(parents[0, 1:].tolist()) != PARENTS[1:]:
            msg = f"{source}: kintree_table must be the tree of SMPL's {N_JOINTS} joints, or of SMPL-H's or SMPL-X's, "
            msg += f"got the shape {parents.shape}{_tree_hint(parents.shape)}"
            raise BodyError(msg)

        def require(name: str, array: NDArray[Any], shape: tuple[int, ...]) -> None:
            if array.shape != shape or not n:
                hint = _shape_hint(array.shape, shape)
                raise BodyError(f"{source}: {name} must have the shape {shape}, got {array.shape}{hint}")

        require("v_template", v_template, (n, 3))
        shapedirs, faces = numbers("shapedirs"), np.atleast_1d(numbers("f"))
        n_shapes = shapedirs.shape[0 if shapedirs.shape[-1] in (n, 3 * n) else -1] if shapedirs.ndim else 0
        if n_shapes < N_BETAS:
            raise BodyError(f"{source}: shapedirs must be (V, 3, {N_BETAS} or more), got {shapedirs.shape}")
        require("shapedirs", shapedirs, (n, 3, n_shapes))
        require("f", faces, (_n_rows(faces.shape), 3))
        if (faces % 1).any():
            raise BodyError(f"{source}: f must hold whole numbers, those of vertices")
        require("weights", read["weights"], (n, N_JOINTS))
        require("J_regressor", read["J_regressor"], (N_JOINTS, n))
        posedirs = read["posedirs"] if "posedirs" in read and read["posedirs"].any() else None
        if posedirs is not None:
            require("posedirs", posedirs, (n, 3, N_POSE_FEATURES))
        arrays = cls(
            v_template=v_template,
            faces=faces.astype(np.int64),
            weights=read["weights"],
            joint_regressor=read["J_regressor"],
            shapedirs=shapedirs[:, :, :N_BETAS],
            posedirs=posedirs,
        )
        if arrays.faces.min(initial=0) < 0 or arrays.faces.max(initial=0) >= n:
            msg = f"{source}: faces must index {n} vertices, got {arrays.faces.min()} to {arrays.faces.max()}"
            if arrays.faces.min() == 1 and arrays.faces.max() == n:
                msg += ": they count from 1, wanted from 0; subtract 1"
            raise BodyError(msg)
        sums, least = arrays.weights.sum(1), arrays.weights.min()
        if np.abs(sums - 1).max() > 1e-3 or least < -1e-3:
            msg = f"{source}: the skinning weights of a vertex must sum to one, and none be negative, got sums from "
            msg += f"{sums.min():.4g} to {sums.max():.4g} and a least weight of {least:.4g}: "
            raise BodyError(msg + "make negative ones 0, then divide each vertex's weights by their sum")
        return arrays


def _keys_hint(there: Collection[str], missing: list[str]) -> str:
    """The hint for a file that has the keys `there` and lacks `missing`; empty if there is none."""
    if "skin_template_v" in there:
        return ": it is SKEL's, whose bones aren't SMPL's joints; give SMPL's own file"
    if missing == ["f"] and "faces" in there:
        return ": SMPL's files call their faces f"
    if "weights" in missing and "shapedirs" in missing:
        return ": a mesh or a scan has no joints and no shapes; fit SMPL to it and give SMPL's own file"
    return ""


def _tree_hint(shape: tuple[int, ...]) -> str:
    """The hint for a `kintree_table` of a wrong shape; empty if there is none."""
    if len(shape) == 2 and shape[1] == 2:
        return ": transpose it"
    other = _OTHERS.get(shape[1], "") if len(shape) == 2 else ""
    return f": the file is {other}; give SMPL's own file" if other else ""


def _n_rows(shape: tuple[int, ...]) -> int:
    """How many triples an array (N, 3) holds, or one that was transposed by mistake."""
    return shape[1] if len(shape) == 2 and shape[0] == 3 != shape[1] else shape[0]


def _shape_hint(shape: tuple[int, ...], wanted: tuple[int, ...]) -> str:
    """The hint for an array of another shape than `wanted`; empty if there is none."""
    flat = (wanted[0] * wanted[1], *wanted[2:])
    if shape == wanted[::-1]:
        return ": transpose it"
    if shape[:1] + shape[2:] == (wanted[0], 93):
        return ": they are STAR's, of other features of the pose; leave them out, or give SMPL's own file"
    if shape == flat:
        return f": reshape it to {wanted}"
    return f": transpose it, and reshape it to {wanted}" if shape == flat[::-1] else ""


class SmplBody:
    """An SMPL-layout body: batched, differentiable, float32 or float64, on any device.

    V = mean + shape blend shapes(β) + pose blend shapes(θ), skinned by the transforms of the regressed joints.
    """

    def __init__(
        self, arrays: BodyArrays, *, name: str, device: str | torch.device = "cpu", dtype: torch.dtype = torch.float32
    ) -> None:
        if dtype not in (torch.float32, torch.float64):
            raise BodyError(f"wanted a body in torch.float32 or torch.float64, got {dtype}")
        self.name = name
        """What the body was loaded as: a built-in name or a file's stem."""
        self.arrays = arrays
        """As in its file, in float64; those of built-in bodies are shared and read-only."""
        self.device = checked_device(device)
        self.dtype = dtype

        def tensor(array: NDArray[Any]) -> Tensor:
            return torch.tensor(array, device=self.device, dtype=dtype)

        self.faces = torch.tensor(arrays.faces, device=self.device)
        """Shape (F, 3), int64."""
        self.v_template = tensor(arrays.v_template)
        self.weights = tensor(arrays.weights)
        self._skinning = Skinning(self.weights)
        n = len(arrays.v_template)
        # Rows are summed faster than columns.
        self._shapedirs = tensor(arrays.shapedirs.reshape(n * 3, N_BETAS).T.copy())
        self._posedirs = tensor(arrays.posedirs.reshape(n * 3, -1)) if arrays.posedirs is not None else None
        # Joints are linear in β, so the regressor is applied once to the basis and not to each body.
        self.joint_template = tensor(arrays.joint_regressor @ arrays.v_template)
        """Joints of the mean shape [m], shape (24, 3)."""
        self._joint_shapedirs = tensor(np.einsum("jv,vcb->jcb", arrays.joint_regressor, arrays.shapedirs))

    def __eq__(self, other: object) -> bool:
        """Whether it is the same body, in the same precision and on the same device."""
        return isinstance(other, SmplBody) and self._identity == other._identity

    def __hash__(self) -> int:
        """The hash of what makes bodies equal."""
        return hash(self._identity)

    @property
    def _identity(self) -> tuple[str, torch.device, torch.dtype]:
        return self.fingerprint, self.device, self.dtype

    def __repr__(self) -> str:
        return f"SmplBody({self.name!r}, {self.n_vertices} vertices, {self.dtype}, {self.device})"

    @property
    def n_vertices(self) -> int:
        """Number of vertices V."""
        return len(self.v_template)

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the model's arrays (16 hexadecimal digits), by which weights name the body they were trained on."""
        digest = hashlib.sha256()
        for entry in fields(self.arrays):
            array = getattr(self.arrays, entry.name)
            if array is not None:
                digest.update(np.ascontiguousarray(array, dtype="<i4" if entry.name == "faces" else "<f4").tobytes())
        return digest.hexdigest()[:16]

    def to(self, *, device: str | torch.device | None = None, dtype: torch.dtype | None = None) -> SmplBody:
        """The same body on another device or in another precision. Raises `RefuError` where there is no such one."""
        return SmplBody(self.arrays, name=self.name, device=device or self.device, dtype=dtype or self.dtype)

    def _batch(self, name: str, value: ArrayLike | Tensor, width: tuple[int, ...]) -> Tensor:
        tensor = _tensor(name, value, self.device).to(self.dtype)
        if tensor.shape[1:] not in (width, (math.prod(width),)) or tensor.ndim < 2:
            raise FrameError(f"{name} must have the shape (B, {', '.join(map(str, width))}), got {tuple(tensor.shape)}")
        return tensor.reshape(-1, *width)

    def rest_joints(self, betas: Tensor) -> Tensor:
        """Joints of the unposed shapes [m], (B, 24, 3), of betas (B, 10). Raises `FrameError` for another tensor."""
        require_batch("betas", betas, (N_BETAS,))
        return self.joint_template + torch.einsum("jck,bk->bjc", self._joint_shapedirs, betas)

    def rest_vertices(self, betas: Tensor) -> Tensor:
        """Unposed bodies without pose blend shapes [m], (B, V, 3), of betas (B, 10). Raises as `rest_joints`."""
        require_batch("betas", betas, (N_BETAS,))
        return torch.addmm(self.v_template.view(1, -1), betas, self._shapedirs).view(-1, self.n_vertices, 3)

    def __call__(
        self,
        pose: ArrayLike | Tensor,
        betas: ArrayLike | Tensor | None = None,
        transl: ArrayLike | Tensor | None = None,
    ) -> BodyOutput:
        """Poses a batch of bodies. Raises `FrameError` for a wrong shape.

        Args:
            pose: rotation vectors relative to the parent joint [rad], shape (B, 24, 3) or (B, 72).
            betas: shape coefficients, (B, 10) or (1, 10); zeros if not given.
            transl: added to vertices and joints, in its own precision [m], (B, 3) or (1, 3).
        """
        theta = self._batch("pose", pose, (N_JOINTS, 3))
        batch = len(theta)
        beta = self._batch("betas", betas, (N_BETAS,)) if betas is not None else theta.new_zeros(1, N_BETAS)
        if len(beta) not in (1, batch):
            msg = f"betas must have the shape ({batch}, {N_BETAS}) or (1, {N_BETAS}), got {tuple(beta.shape)}"
            raise FrameError(msg)
        with without_autocast(self.device.type):  # in bfloat16 skin was 15 mm off
            posed = self.posed(theta, self.shape(beta))
        if transl is None:
            return posed
        shift = _tensor("transl", transl, self.device)
        if shift.ndim != 2 or shift.shape[1] != 3 or len(shift) not in (1, batch):
            raise FrameError(f"transl must have the shape ({batch}, 3) or (1, 3), got {tuple(shift.shape)}")
        return posed._replace(vertices=posed.vertices + shift[:, None], joints=posed.joints + shift[:, None])

    def shape(self, betas: Tensor) -> Shape:
        """The unposed bodies of betas (B, 10), as `posed` takes them."""
        return Shape(self.rest_vertices(betas), self.rest_joints(betas))

    def posed(self, pose: Tensor, shape: Shape, *, in_root: bool = False) -> BodyOutput:
        """Poses bodies by rotation vectors (B, 24, 3) [rad]; `shape` has as many bodies, or one for all.

        With `in_root` all but the rotations are in the root's axes. Raises `FrameError` for anything but such a tensor.
        """
        require_batch("the pose's rotation vectors", pose, (N_JOINTS, 3))
        rotations, joints, transforms = forward_kinematics(pose, shape.joints, in_root=in_root)
        vertices = shape.vertices
        if self._posedirs is not None:
            feature = (rotations[:, 1:] - torch.eye(3, dtype=self.dtype, device=self.device)).flatten(1)
            vertices = vertices + (feature @ self._posedirs.T).view(len(pose), vertices.shape[1], 3)
        return BodyOutput(self._skinning(vertices, transforms), joints, transforms, rotations)


def _tensor(name: str, value: ArrayLike | Tensor, device: torch.device) -> Tensor:
    """A tensor of real numbers on `device`; arrays are copied, since a frame's are read-only."""
    if not isinstance(value, Tensor):
        try:
            array = as_numbers(value, also="c")  # torch knows no foreign byte order, and no negative strides
            if np.ma.is_masked(value):
                raise ValueError("with masked values")
            value = torch.from_numpy(array.astype(array.dtype.newbyteorder("="), order="C"))
        except NOT_NUMBERS as error:
            got = f"{type(value).__name__}: {error}"
            raise FrameError(f"{name} must be an array or tensor of numbers, got {got}") from error
    if value.is_complex():
        raise FrameError(f"{name} must be real numbers, got {value.dtype}")
    return value.to(device)
