"""What the exact and the approximate distance to a posed mesh share: the pose, the checks, the derivatives."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import torch
import warp as wp
from numpy.typing import NDArray
from torch import Tensor

from refu_core._device import checked_device
from refu_core._warp import Repeated, Unpicklable, as_warp, ints, memory
from refu_core.errors import MeshError
from refu_core.garments import GarmentTemplate
from refu_core.mesh import Connectivity
from refu_core.sdf._closest_kernels import EDGE, ON_SURFACE, VERTEX, PosedMesh, feature_kernel
from refu_core.sdf._protocol import GarmentSdf, SdfSample, plain_garment_sdf
from refu_core.sdf._query_kernels import Skin


class Found(NamedTuple):
    """What a kernel says of N points; the fields in the order of the kernels' outputs."""

    face: Tensor
    """Closest face, int32, shape (N,); -1 for none."""
    distance: Tensor
    """Signed distance [m], shape (N,); infinite for no face."""
    gradient: Tensor
    """Unit gradient, shape (N, 3)."""

    def sample(self) -> SdfSample:
        """The same as an `SdfSample`."""
        return SdfSample(self.distance, self.gradient, self.face)


FARTHEST = 1e7
"""Largest coordinate [m], so how far away a body may be. Its fourth power doesn't overflow yet."""
FOUND = (wp.int32, wp.float32, wp.vec3)
"""The fields' types, as `Repeated` takes them."""


def ask(kernel: Repeated, points: Tensor, *more: Tensor) -> Found:
    """What a kernel says of points (N, 3) [m]; it takes them, `more`, and the fields of `Found` to be filled."""
    n = len(points)
    face = torch.empty(n, dtype=torch.int32, device=points.device)
    found = Found(face, points.new_empty(n), points.new_empty(n, 3))
    kernel((n,), points, *more, *found)
    return found


class MeshSdf(Unpicklable, ABC):
    """A signed distance to faces of the posed body: subclasses find faces, exact first derivatives come from here."""

    is_exact = True
    """Whether the face found is always the closest one."""

    def __init__(self, faces: Tensor | NDArray[Any], *, device: str | torch.device = "cpu") -> None:
        mesh = Connectivity.of(faces)
        self.device = checked_device(device)
        self.n_vertices = mesh.n_vertices
        self.faces = torch.as_tensor(mesh.faces, device=self.device)
        self._posed = PosedMesh()
        self._posed.faces = as_warp(self.faces, wp.int32)
        fan_start, fan_face = mesh.fan
        for name, array in (("across", mesh.across), ("fan_start", fan_start), ("fan_face", fan_face)):
            setattr(self._posed, name, ints(array, self.device))
        self._none = torch.empty(0, dtype=torch.int32, device=self.device)
        self._vertices: Tensor | None = None  # as given, with its graph
        self._points: Tensor | None = None  # float32 copy that the kernels read
        self._skin: Any = None

    def update(self, vertices: Tensor, *, pose: Tensor | None = None, betas: Tensor | None = None) -> None:
        """Takes over a new pose: `vertices` [m], shape (V, 3). `pose` and `betas` aren't needed here.

        Raises `MeshError` for a wrong shape, values that aren't finite, or a body that is inside out the first time.
        """
        del pose, betas
        require_tensor("the body's vertices", vertices)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) < self.n_vertices:
            msg = f"the body's vertices must have the shape ({self.n_vertices}, 3), got {tuple(vertices.shape)}"
            raise MeshError(msg)
        require_finite("the body's vertices", vertices)
        is_new = self._points is None or len(vertices) != len(self._points)
        if self._points is None or is_new:
            require_outward(vertices.detach().to(self.device).double()[None], self.faces)
            self._points = memory(len(vertices), 3, device=self.device)
            self._posed.points = as_warp(self._points, wp.vec3)
            kinds = (wp.vec3, wp.int32, wp.int32, wp.vec3, wp.vec3)
            self._find_features = Repeated(feature_kernel, kinds, [self._posed])
            self._skin = None
        self._vertices = vertices
        self._points.copy_(vertices.detach())
        self._take_pose(is_new=is_new)

    def query(self, points: Tensor, *, near: Tensor | None = None) -> SdfSample:
        """Signed distance and gradient at `points` [m], shape (N, 3), differentiable as the class says.

        `near`, integers of shape (N,), may name a body face near each point: the `face` of an earlier sample, or what
        `RestFaces` says of a garment.

        Raises `MeshError` for a wrong shape, values that aren't finite, or when no body was set with `update`.
        """
        self._require_update()
        where = self._checked(points)
        found = self._find(where, None if near is None else self._checked_faces(near, len(where)))
        assert self._vertices is not None  # _require_update has seen to it
        tracked = torch.is_grad_enabled() and (points.requires_grad or self._vertices.requires_grad)
        if not tracked and points.dtype == torch.float32:
            return found.sample()
        corners = self._vertices.to(points)[self.faces.long()[found.face.long()]]
        kind, _, normal = self._features(where, found.face)
        sample = signed_distance(points, corners, kind, normal.to(points), found.distance.sign().to(points))
        return sample._replace(face=found.face)

    def of_garment(self, garment: GarmentTemplate) -> GarmentSdf:  # noqa: ARG002
        """As `BodySdf.of_garment`."""
        return plain_garment_sdf(self)

    def _features(self, points: Tensor, face: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """`signed_distance`'s `kind`, int32 (N,), barycentrics and unit pseudo-normals, (N, 3), of closest faces."""
        kind = torch.empty_like(face)
        barycentrics, normal = points.new_empty(2, len(face), 3)
        self._find_features((len(face),), points, face, kind, barycentrics, normal)
        return kind, barycentrics, normal

    def skin(self) -> Any:
        """The posed body for custom kernels, as `refu_core.sdf.Skin`. Raises `MeshError` before `update`.

        It is the same one for all poses, until the memory that it refers to is replaced.
        """
        self._require_update()
        if self._skin is None:
            self._skin = self._bind_skin()
        return self._skin

    def _bind_skin(self) -> Any:
        skin = Skin()
        skin.mesh = self._posed
        return skin

    @abstractmethod
    def _take_pose(self, *, is_new: bool) -> None:
        """Prepares for the pose in `_points`; `is_new` says that these are other tensors than last time."""

    @abstractmethod
    def _find(self, points: Tensor, near: Tensor | None) -> Found:
        """The closest face to each of the checked `points`, shape (N, 3), whose `near` faces may be known, (N,)."""

    def _checked(self, points: Tensor) -> Tensor:
        require_points(points)
        return points.detach().to(device=self.device, dtype=torch.float32).contiguous()

    def _checked_faces(self, near: Tensor, n: int, *, least: int = 0) -> Tensor:
        if not isinstance(near, Tensor) or near.shape != (n,) or near.is_floating_point():
            got = f"{near.dtype} of shape {tuple(near.shape)}" if isinstance(near, Tensor) else type(near).__name__
            raise MeshError(f"near must be integers of the shape ({n},), got {got}")
        near = near.to(device=self.device, dtype=torch.int32).contiguous()
        # Clamped, as a check would wait for the device, and no kernel may read beyond the faces.
        return near.clamp(least, len(self.faces) - 1)

    def _require_update(self) -> Tensor:
        if self._points is None:
            raise MeshError("no body yet: call update(vertices) before asking for distances")
        return self._points


def signed_distance(points: Tensor, corners: Tensor, kind: Tensor, normal: Tensor, sign: Tensor) -> SdfSample:
    """Distances and gradients of points (N, 3) from corners (N, 3, 3) of known faces, with exact first derivatives.

    `kind` (N,) is the part of the face that is closest: 0 the interior, 1 to 3 its vertices, 4 to 6 its edges (0, 1),
    (1, 2), (2, 0); `normal` (N, 3) the unit pseudo-normal there; `sign` (N,) the side of the body, +1 outside, -1
    inside, 0 on its surface. To first order all three are constant around the point.
    """
    kind, each = kind.long(), torch.arange(len(points), device=points.device)
    is_face, is_edge = (kind == 0)[:, None], (kind >= int(EDGE))[:, None]
    first = torch.where(is_edge[:, 0], kind - int(EDGE), kind - int(VERTEX)).clamp_min(0)
    start, along = corners[each, first], corners[each, (first + 1) % 3] - corners[each, first]
    offset = points - start
    t = (offset * along).sum(-1, keepdim=True) / (along * along).sum(-1, keepdim=True).clamp_min(1e-30)
    offset = torch.where(is_edge, offset - t * along, offset)
    a, b, c = corners.unbind(1)
    up = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    above = ((points - a) * up).sum(-1)
    # Within intersecting limbs the winding number's side may not be the normal's. On the surface rounding decides.
    off_surface = above.detach().abs() > float(ON_SURFACE)
    flip = torch.where(off_surface & (sign * above.detach() < 0), -1.0, 1.0).to(points)
    # On an edge or vertex itself a distance has no derivative; the height over it along the pseudo-normal stands in.
    height = (offset * normal).sum(-1)
    touching = (torch.linalg.vector_norm(offset.detach(), dim=-1) < float(ON_SURFACE))[:, None]
    length = torch.linalg.vector_norm(torch.where(touching, normal, offset), dim=-1)
    distance = torch.where(touching[:, 0], height, sign * length)
    gradient = torch.where(touching, normal, offset * (sign / length)[:, None])
    return SdfSample(
        torch.where(is_face[:, 0], flip * above, distance), torch.where(is_face, flip[:, None] * up, gradient)
    )


def require_outward(vertices: Tensor, faces: Tensor) -> None:
    """Raises `MeshError` where one of B bodies (B, V, 3) [m] with these `faces`, shape (F, 3), is turned inside out."""
    centred = vertices - vertices[:, :1]  # far from the origin, rounding would decide
    a, b, c = centred[:, faces.long()].unbind(2)
    if not bool(((a * torch.linalg.cross(b, c)).sum((1, 2)) > 0).all()):
        raise MeshError("the body's faces must be counter-clockwise seen from outside: this body has a negative volume")


def require_tensor(name: str, value: object) -> None:
    """Raises `MeshError` for what isn't a tensor of floating-point numbers."""
    if not isinstance(value, Tensor) or not value.is_floating_point():
        got = value.dtype if isinstance(value, Tensor) else type(value).__name__
        msg = f"{name} must be a floating-point torch.Tensor, got {got}: torch.as_tensor(..., dtype=torch.float32)"
        raise MeshError(msg)


def require_points(points: Tensor) -> None:
    """Raises `MeshError` for what isn't a tensor of finite points, shape (N, 3)."""
    require_tensor("points", points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshError(f"points must have the shape (N, 3), got {tuple(points.shape)}")
    require_finite("points", points)


def require_finite(name: str, values: Tensor) -> None:
    """Raises `MeshError` where `values`, shape (N, 3) [m], aren't all finite, or are so large that squares overflow."""
    if values.is_cuda and torch.cuda.is_current_stream_capturing():
        return  # a CUDA graph can't wait for the answer; what it replays was checked where it came in
    values = values.detach()
    if float(torch.linalg.vector_norm(values)) <= FARTHEST:  # no value is larger than the norm, which is quick to know
        return
    largest = float(values.abs().max())  # NaN if any value is
    if not math.isfinite(largest):
        bad = int((~torch.isfinite(values)).any(dim=-1).sum())
        raise MeshError(f"{name} must be finite, got {bad} of {len(values)} with NaN or infinite coordinates")
    if largest > FARTHEST:
        msg = f"{name} must be within {FARTHEST:.0e} m of the origin, got {largest:.3g} m; is the unit metres?"
        raise MeshError(msg)
