"""Pictures of bodies and garments without a display: a small ray caster for reports and documentation.

```python
from refu_lab.render import Viewpoint, RenderMesh, render, save_png
body = RenderMesh(vertices, faces)                               # SMPL axes: y up, z forward, metres
image = render([body], camera=Viewpoint.framing(vertices, yaw=25.0))  # uint8, (640, 480, 3)
```

Soft daylight comes from a warm sun disc and a cool sky. How much of each a vertex sees is computed once per vertex and
interpolated, so a picture has no grain and every ray through a pixel is cheap. One thread draws 480 x 640 pixels of
a body and a garment in about two seconds. The same input gives the same picture.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from refu_core._files import replacing
from refu_core.mesh import face_normals, vertex_normals
from refu_core.metrics import Collisions
from refu_lab import _ray_kernels as shading

SKIN = (0.86, 0.70, 0.61)
"""sRGB colour that suits a body."""
COLLIDING = (0.90, 0.10, 0.10)
"""sRGB colour of what collides."""

_SUN_RAYS, _SKY_RAYS = 40, 96
_SUN_SPREAD = 0.012  # 1 - cos of the disc's half angle: 9 degrees, an overcast sun
_SKY_REACH = 0.8  # [m] anything farther off doesn't dim the sky
_COVERED = 0.3  # a vertex that sees less of the sky than this share counts as covered
_GROUND_STEP, _GROUND_CELLS = 0.022, 400
"""Grid of light on the ground: its step [m], so fine that a foot's shadow ends at its sole, and most steps a side."""
_CREASE = math.cos(math.radians(55.0))


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """An upright pinhole camera in the world of the meshes."""

    eye: NDArray[np.float64]
    """Position [m], shape (3,)."""
    target: NDArray[np.float64]
    """Point in the middle of the picture [m], shape (3,)."""
    vertical_fov: float = 26.0
    """Angle from the bottom to the top of the picture [degrees]."""

    @classmethod
    def looking_at(
        cls, target: ArrayLike, *, distance: float, yaw: float = 20.0, pitch: float = 8.0, vertical_fov: float = 26.0
    ) -> Viewpoint:
        """A camera `distance` metres from `target` [m], shape (3,), in front (+z) of it.

        It is turned around the subject towards its left (+x) by `yaw`, and looks down by `pitch` [degrees].
        """
        a, b = math.radians(yaw), math.radians(pitch)
        away = np.array([math.sin(a) * math.cos(b), math.sin(b), math.cos(a) * math.cos(b)])
        centre = np.asarray(target, dtype=np.float64)
        return cls(eye=centre + distance * away, target=centre, vertical_fov=vertical_fov)

    @classmethod
    def framing(
        cls,
        vertices: ArrayLike,
        *,
        size: tuple[int, int] = (480, 640),
        yaw: float = 20.0,
        pitch: float = 8.0,
        margin: float = 1.12,
        vertical_fov: float = 26.0,
    ) -> Viewpoint:
        """A camera that shows all `vertices` [m], shape (V, 3), as large as a picture of `size` (width, height) allows.

        `margin` leaves free room around them (1 is none); `yaw` and `pitch` are those of `looking_at`.
        """
        points = np.asarray(vertices, dtype=np.float64).reshape(-1, 3)
        camera = cls.looking_at((points.min(0) + points.max(0)) / 2, distance=1.0, yaw=yaw, pitch=pitch)
        right, up, forward = camera.axes()
        half = math.tan(math.radians(vertical_fov) / 2)
        centre = camera.target
        for _ in range(3):  # because of perspective, centring changes the limits a little
            x, y, depth = ((points - centre) @ axis for axis in (right, up, forward))
            reach = np.maximum(np.abs(y), np.abs(x) * size[1] / size[0]) * margin / half - depth
            distance = float(reach.max())
            x, y = (one * distance / (distance + depth) for one in (x, y))
            centre = centre + right * (x.min() + x.max()) / 2 + up * (y.min() + y.max()) / 2
        return cls.looking_at(centre, distance=distance, yaw=yaw, pitch=pitch, vertical_fov=vertical_fov)

    def axes(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Unit vectors to the right and up in the picture and forward into it, each of shape (3,)."""
        forward = _unit(self.target - self.eye)
        right = _unit(np.cross(forward, (0.0, 1.0, 0.0)))
        return right, np.cross(right, forward), forward


@dataclass(frozen=True, eq=False)
class RenderMesh:
    """A triangle mesh to draw, closed or open; its inside is drawn too, darker."""

    vertices: ArrayLike
    """[m], shape (V, 3)."""
    faces: ArrayLike
    """Counter-clockwise from outside, shape (F, 3)."""
    colour: ArrayLike = SKIN
    """sRGB in [0, 1], of the whole mesh, shape (3,), or of each vertex, (V, 3)."""


def collision_mesh(
    vertices: NDArray[np.float32], faces: NDArray[np.int64], found: Collisions, *, colour: ArrayLike
) -> RenderMesh:
    """A garment of one sRGB `colour` whose colliding triangles and vertices inside the body are red."""
    colours = np.tile(np.array(colour), (len(vertices), 1))
    colours[found.inside] = COLLIDING
    colours[faces[np.unique(found.pairs[:, 0])].reshape(-1)] = COLLIDING
    return RenderMesh(vertices, faces, colours)


@dataclass(frozen=True)
class Backdrop:
    """What the meshes stand on and in front of, and where the sun is."""

    background: tuple[float, float, float] = (0.93, 0.935, 0.94)
    """sRGB."""
    ground: tuple[float, float, float] = (0.90, 0.90, 0.90)
    """sRGB of the ground in full light; it fades into the background with distance."""
    sun: float = 0.95
    """Brightness of the sun, up to 1; less sky and more sun make harder light."""
    sky: float = 1.0
    """Brightness of the sky, up to 1."""
    ground_height: float | None = None
    """Height y of the ground [m]; None puts it right under the lowest vertex."""
    show_ground: bool = True
    to_sun: tuple[float, float, float] = (-0.45, 0.85, 0.65)
    """Direction to the sun, of any length."""


def render(
    meshes: Sequence[RenderMesh],
    *,
    camera: Viewpoint,
    size: tuple[int, int] = (480, 640),
    samples: int = 9,
    backdrop: Backdrop | None = None,
) -> NDArray[np.uint8]:
    """Draws at least one mesh and returns sRGB, uint8, shape (height, width, 3).

    `size` is width and height [pixels]. `samples` is the rays a pixel, rounded down to a square number: more make
    smoother outlines.
    """
    (width, height), backdrop = size, backdrop or Backdrop()
    vertices, faces = _joined(meshes)
    colours = [np.broadcast_to(_to_linear(one.colour), np.shape(one.vertices)) for one in meshes]
    corner_normals, smooth = _normals(vertices, faces)
    right, up, forward = camera.axes()
    to_sun = _unit(np.asarray(backdrop.to_sun, dtype=np.float64))
    faces_wp = _array(faces.ravel(), wp.int32)
    mesh = wp.Mesh(_array(vertices, wp.vec3), faces_wp)
    sun, sky = _light(mesh, vertices, smooth, to_sun, sun_rays=_SUN_RAYS)
    on_vertices = [_array(_uncovered(x, sky < _COVERED, faces), wp.float32) for x in (sun, sky)]
    low, high = vertices.min(0), vertices.max(0)
    ground_y = float(low[1]) if backdrop.ground_height is None else backdrop.ground_height
    # The grid reaches as far as the shadow does; beyond it the ground is in full light.
    shadow = np.abs(to_sun[[0, 2]] / max(to_sun[1], 0.2)) * max(float(high[1]) - ground_y, 0.0)
    grid_low = low[[0, 2]] - shadow - _SKY_REACH / 2
    extent = float((high[[0, 2]] + shadow + _SKY_REACH / 2 - grid_low).max())
    cells = int(np.clip(np.ceil(extent / _GROUND_STEP) + 1, 2, _GROUND_CELLS)) if backdrop.show_ground else 2
    step = extent / (cells - 1)
    centre = (low[[0, 2]] + high[[0, 2]]) / 2
    radius = 3.0 * float(np.linalg.norm(high - low)) if backdrop.show_ground else 0.0
    grid = np.stack(np.meshgrid(*[np.arange(cells)] * 2, indexing="ij"), -1).reshape(-1, 2) * step + grid_low
    ground = np.stack([grid[:, 0], np.full(len(grid), ground_y), grid[:, 1]], 1).astype(np.float32)
    upward = np.broadcast_to(np.array([0, 1, 0], np.float32), ground.shape)
    shares = _light(mesh, ground, upward, to_sun, sun_rays=_SUN_RAYS)
    ground_light = [wp.array(x.reshape(cells, cells), device="cpu") for x in shares]

    image = wp.zeros((height, width), dtype=wp.vec3, device="cpu")
    wp.launch(
        shading.pixel_kernel,
        dim=(height, width),
        inputs=[
            mesh.id,
            faces_wp,
            _array(np.concatenate(colours), wp.vec3),
            _array(corner_normals.reshape(-1, 3), wp.vec3),
            *on_vertices,
            *ground_light,
            wp.vec2(float(grid_low[0]), float(grid_low[1])),
            step,
            ground_y,
            wp.vec2(float(centre[0]), float(centre[1])),
            radius,
            _vec3(_to_linear(backdrop.ground)),
            _vec3(_to_linear(backdrop.background)),
            _vec3(to_sun),
            backdrop.sun,
            backdrop.sky,
            _vec3(camera.eye),
            _vec3(right),
            _vec3(up),
            _vec3(forward),
            math.tan(math.radians(camera.vertical_fov) / 2),
            width,
            height,
            math.isqrt(samples),
        ],
        outputs=[image],
        device="cpu",
    )
    linear = np.clip(image.numpy().astype(np.float64), 0.0, 1.0)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(srgb * 255), dtype=np.uint8)


def sky_light(meshes: Sequence[RenderMesh]) -> list[NDArray[np.float32]]:
    """The share of the sky that the vertices of each mesh see past all meshes, (V,) a mesh.

    Covered vertices take the share of their uncovered neighbours, as in a picture.
    """
    vertices, faces = _joined(meshes)
    mesh = wp.Mesh(_array(vertices, wp.vec3), _array(faces.ravel(), wp.int32))
    _, sky = _light(mesh, vertices, _normals(vertices, faces)[1], np.array([0.0, 1.0, 0.0]), sun_rays=1)
    found = _uncovered(sky, sky < _COVERED, faces)
    return np.split(found, np.cumsum([len(np.asarray(one.vertices)) for one in meshes])[:-1])


def save_png(image: NDArray[np.uint8], path: str | os.PathLike[str]) -> None:
    """Writes a picture, shape (height, width, 3), as PNG, in full or not at all; `OSError` when it can't be written."""
    from PIL import Image

    with replacing(Path(path)) as file:
        Image.fromarray(image).save(file, format="PNG")


def _joined(meshes: Sequence[RenderMesh]) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Vertices (V, 3) and faces (F, 3) of all meshes as one."""
    starts = np.cumsum([0, *(len(np.asarray(mesh.vertices)) for mesh in meshes)])
    faces = [np.asarray(mesh.faces, np.int64) + start for mesh, start in zip(meshes, starts, strict=False)]
    return np.concatenate([np.asarray(mesh.vertices, np.float32) for mesh in meshes]), np.concatenate(faces)


def _array(value: ArrayLike, dtype: Any) -> Any:
    return wp.array(np.ascontiguousarray(value), dtype=dtype, device="cpu")


def _vec3(value: ArrayLike) -> Any:
    return wp.vec3(*(float(x) for x in np.asarray(value)))


def _light(
    mesh: Any,
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    to_sun: NDArray[np.float64],
    *,
    sun_rays: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Shares of the sun and the sky that N points (N, 3) of these normals see past a Warp mesh, each of shape (N,)."""
    sun, sky = (wp.zeros(len(points), dtype=wp.float32, device="cpu") for _ in range(2))
    rays = [_vec3(to_sun), _SUN_SPREAD, sun_rays, _SKY_RAYS, _SKY_REACH]
    inputs = [mesh.id, _array(points, wp.vec3), _array(normals, wp.vec3), *rays]
    wp.launch(shading.light_kernel, dim=len(points), inputs=inputs, outputs=[sun, sky], device="cpu")
    return sun.numpy(), sky.numpy()


def _normals(
    vertices: NDArray[np.float32], faces: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Unit normals of face corners, (F, 3, 3), smooth except across creases, and of vertices, (V, 3)."""
    exact = vertices.astype(np.float64)
    flat, smooth = _unit(face_normals(exact, faces)), vertex_normals(exact, faces)
    corners = smooth[faces]
    sharp = np.einsum("fck,fk->fc", corners, flat) < _CREASE
    corners[sharp] = np.broadcast_to(flat[:, None], corners.shape)[sharp]
    return corners.astype(np.float32), smooth.astype(np.float32)


def _uncovered(light: NDArray[np.float32], covered: NDArray[np.bool_], faces: NDArray[np.int64]) -> NDArray[np.float32]:
    """Light of the vertices, shape (V,), where `covered` ones take the mean of their uncovered neighbours.

    Otherwise the darkness under a hem would spread beyond it, into every face that the hem crosses.
    """
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    result = light.astype(np.float64)
    for _ in range(2):
        known = ~covered[edges[:, 1]]
        count = np.bincount(edges[known, 0], minlength=len(light))
        total = np.bincount(edges[known, 0], result[edges[known, 1]], len(light))
        filled = covered & (count > 0)
        result[filled] = total[filled] / count[filled]
        covered = covered & ~filled
    return result.astype(np.float32)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    result: NDArray[np.float64] = vectors / np.maximum(length, 1e-30)
    return result


def _to_linear(srgb: ArrayLike) -> NDArray[np.float64]:
    value = np.asarray(srgb, dtype=np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
