"""What a camera sees of meshes: vertices are compared with a depth buffer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Real
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)
from refu_core.errors import MeshError, require_type
from refu_core.frames import checked_numbers
from refu_core.mesh import as_points, check_faces
from refu_core.outputs import _visible_kernels as kernels

NEAR = 0.05
"""Anything nearer to the camera than this isn't seen [m]."""
TOLERANCE = 0.002
"""A vertex this far behind a surface still counts as on it [m]: less than the margin that cloth keeps from the skin."""
BUFFER_WIDTH = 480
"""Width of the depth buffer [pixels], unless the camera has fewer: 5 mm each at 2 m, a third of a garment's edges."""
_TALLEST = 4
"""Most rows of the depth buffer, in its widths: drawing into 480 x 32,768 pixels took a hundred times as long."""

Mesh = tuple[ArrayLike, ArrayLike]
"""Vertices (V, 3) [m] and faces (F, 3)."""


@dataclass(frozen=True, eq=False)
class PinholeCamera:
    """A camera without distortion: x to the right, y down, z forward, as in the optical frames of ROS.

    Raises `MeshError` for numbers that can't be a camera's, and `FrameError` for what isn't numbers.
    """

    width: int
    """Pixels."""
    height: int
    """Pixels."""
    focal: tuple[float, float]
    """fx and fy [pixels]."""
    centre: tuple[float, float]
    """cx and cy [pixels], from the upper left corner of the picture; the first pixel's middle is at (0.5, 0.5)."""
    rotation: NDArray[np.float64]
    """Takes a direction in the meshes' axes to the camera's, shape (3, 3)."""
    translation: NDArray[np.float64]
    """The meshes' origin in the camera's axes [m], shape (3,)."""

    def __post_init__(self) -> None:
        rotation, translation, _, focal, size = (
            checked_numbers(f"a camera's {name}", value, shape, np.float64)
            for name, value, shape in (
                ("rotation", self.rotation, (3, 3)),
                ("translation", self.translation, (3,)),
                ("centre", self.centre, (2,)),
                ("focal", self.focal, (2,)),
                ("width and height", (self.width, self.height), (2,)),
            )
        )
        is_turn = np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3 and np.linalg.det(rotation) > 0
        if min(*focal, *size) <= 0 or (size % 1).any() or not is_turn:
            wanted = "a camera has a size in pixels, positive focal lengths and a rotation that isn't a mirror"
            raise MeshError(f"{wanted}, got {self.width} x {self.height}, {self.focal} and {rotation.tolist()}")
        width, height = map(int, size)
        vars(self).update(width=width, height=height, rotation=rotation, translation=translation)

    @classmethod
    def looking_at(
        cls, target: ArrayLike, eye: ArrayLike, *, width: int = 640, height: int = 480, fov: float = 1.0
    ) -> PinholeCamera:
        """A camera at `eye` [m], shape (3,), that has `target` [m] in the middle and the y axis up.

        `fov` is the angle from its left to its right border [rad]. Raises `FrameError` unless `target` and `eye` are
        three numbers; `MeshError` for a `fov` beyond 0 to π, no width, and a camera that looks straight up or down.
        """
        target, eye = (checked_numbers(name, at, (3,), np.float64) for name, at in (("target", target), ("eye", eye)))
        given: tuple[object, ...] = width, height, fov
        if not all(isinstance(number, Real) for number in given):
            raise MeshError(f"wanted width, height and fov as numbers, got {width!r}, {height!r} and {fov!r}")
        if not 0 < fov < math.pi or not width > 0:
            raise MeshError(f"wanted a positive width and an angle below 180 degrees, got {width} pixels and {fov} rad")
        away = target - eye
        right = np.cross(away, [0.0, 1.0, 0.0])
        if not np.linalg.norm(right) > 1e-6 * np.linalg.norm(away):
            msg = f"a camera at {eye!r} can't have {target!r} in the middle and the y axis up: give its rotation"
            raise MeshError(msg)
        forward, right = away / np.linalg.norm(away), right / np.linalg.norm(right)
        rotation = np.stack((right, np.cross(forward, right), forward))
        f = 0.5 * width / math.tan(0.5 * fov)
        return cls(width, height, (f, f), (0.5 * width, 0.5 * height), rotation, -rotation @ eye)

    @property
    def eye(self) -> NDArray[np.float64]:
        """Where the camera is in the meshes' axes [m], shape (3,)."""
        place: NDArray[np.float64] = -self.rotation.T @ self.translation
        return place

    def scaled(self, width: int) -> PinholeCamera:
        """The same view with another number of columns, and rows in proportion."""
        factor = width / self.width
        focal, centre = ((x * factor, y * factor) for x, y in (self.focal, self.centre))
        return replace(self, width=width, height=max(round(self.height * factor), 1), focal=focal, centre=centre)


def visible(
    vertices: ArrayLike,
    faces: ArrayLike,
    camera: PinholeCamera,
    occluders: Sequence[Mesh] = (),
    *,
    buffer_width: int = BUFFER_WIDTH,
) -> NDArray[np.bool_]:
    """Which of a mesh's vertices (V, 3) [m] a camera in their axes sees, from either side, shape (V,).

    `occluders` are other meshes in the same axes: the body, other garments. Anything narrower than a pixel of the depth
    buffer, which has `buffer_width` columns, may be missed. Raises `MeshError` for vertices that aren't finite, and for
    faces that don't fit them.
    """
    require_type(occluders, Sequence, "occluders as a list of meshes", error=MeshError)
    return all_visible([(vertices, faces), *occluders], camera, buffer_width=buffer_width)[0]


def all_visible(
    meshes: Sequence[Mesh], camera: PinholeCamera, *, buffer_width: int = BUFFER_WIDTH
) -> list[NDArray[np.bool_]]:
    """`visible` for several meshes that hide each other, at the cost of one. Raises `MeshError` as `visible` does."""
    _check(meshes, camera)
    if not meshes:
        return []
    points, faces, buffer, ends = _draw(meshes, _buffered(camera, buffer_width))
    seen = np.zeros(len(points), np.bool_)
    output = wp.array(seen, dtype=wp.bool, device="cpu", copy=False)
    inputs = [points, faces, NEAR, TOLERANCE, buffer]
    wp.launch(kernels.visible_kernel, len(seen), inputs, [output], device="cpu")
    return np.split(seen, ends[:-1])


def _buffered(camera: PinholeCamera, width: int) -> PinholeCamera:
    """The camera at the resolution of the depth buffer, however tall its picture is."""
    require_type(width, Real, "the buffer's width as a number of pixels", error=MeshError)
    if not 1 <= width < math.inf:
        raise MeshError(f"the buffer's width must be a number of pixels, 1 at least, got {width}")
    return camera.scaled(min(camera.width, width, max(_TALLEST * width * camera.width // camera.height, 1)))


def depth_image(meshes: Sequence[Mesh], camera: PinholeCamera) -> NDArray[np.float32]:
    """What a depth camera would measure without noise at its own resolution: depth along its z [m], shape (H, W).

    Infinite where there is nothing. Raises `MeshError` as `visible` does.
    """
    _check(meshes, camera)
    if not meshes:
        return np.full((camera.height, camera.width), np.inf, np.float32)
    found = _draw(meshes, camera)[2].numpy()
    return np.where(found == np.iinfo(np.int64).max, np.inf, (found >> 32) * 1e-6).astype(np.float32)


def _check(meshes: object, camera: object) -> None:
    require_type(camera, PinholeCamera, "a PinholeCamera", error=MeshError)
    require_type(meshes, Sequence, "a list of meshes", error=MeshError)
    assert isinstance(meshes, Sequence)
    if not all(isinstance(mesh, (tuple, list)) and len(mesh) == 2 for mesh in meshes):
        raise MeshError("wanted meshes as pairs of vertices (V, 3) and faces (F, 3)")


def _draw(meshes: Sequence[Mesh], camera: PinholeCamera) -> tuple[Any, Any, Any, NDArray[np.int64]]:
    """What kernels take: vertices as the camera sees them, faces, depth buffer; and where each mesh's vertices end."""
    points = [as_points("vertices", vertices) for vertices, _ in meshes]
    checked = [check_faces(faces, n_vertices=len(own)) for own, (_, faces) in zip(points, meshes, strict=True)]
    ends = np.cumsum([len(own) for own in points])
    starts = [0, *ends[:-1].tolist()]
    # Relative to the camera, in float64: a person may be far from the origin.
    there = (np.concatenate(points) - camera.eye) @ camera.rotation.T
    depth = there[:, 2]
    there[:, :2] *= np.array(camera.focal) / np.maximum(depth, 1e-6)[:, None]
    there[:, :2] += camera.centre
    corners = np.concatenate([own + np.int32(start) for own, start in zip(checked, starts, strict=True)])
    faces = wp.array(corners, dtype=wp.int32, device="cpu", copy=False)
    seen = wp.array(there.astype(np.float32), dtype=wp.vec3, device="cpu", copy=False)
    buffer = wp.full((camera.height, camera.width), np.iinfo(np.int64).max, dtype=wp.int64, device="cpu")
    wp.launch(kernels.raster_kernel, len(corners), [seen, faces, NEAR], [buffer], device="cpu")
    return seen, faces, buffer, ends
