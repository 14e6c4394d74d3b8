"""The scene in the browser: light, ground, a camera on the person, and meshes that change from frame to frame."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from msg_adapters import vertices_ros_from_smpl, vertices_smpl_from_ros
from refu_lab.render import Viewpoint
from refu_lab.view._film import SceneMesh
from refu_lab.view._marks import Band

if TYPE_CHECKING:
    import viser

_FOV = 30.0
"""Vertical field of view [degrees]: a long lens, so that proportions look natural."""
_SIDE = 0.45
"""Angle between the first view and the person's front [rad]: a little from the side."""
_NOBODY = np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 1.8]])
"""What is looked at if nothing is there: whoever was seen may leave before the viewer begins [m]."""
_SKY, _EARTH, _SUN = (236, 242, 255), (176, 166, 156), (255, 244, 228)
_GROUND, _LINES, _SECTIONS = (238, 239, 241), (214, 217, 222), (190, 195, 203)

Key = tuple[str, str, int]
"""Names of person and shape, and number of the band among all of these names."""


@dataclass(eq=False)
class _Shown:
    mesh: viser.MeshHandle
    faces: NDArray[np.int64]
    n_vertices: int
    color: tuple[float, float, float]


class Stage:
    """Draws frames; a client that connects later sees the last one."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._drawn: dict[Key, _Shown] = {}
        scene = server.scene
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(None)
        scene.add_light_hemisphere("/light/sky", sky_color=_SKY, ground_color=_EARTH, intensity=1.9)
        self._world = scene.add_frame("/world", show_axes=False)

    def set(self, shapes: Sequence[SceneMesh], *, ground: float, front: float) -> None:
        """Puts the ground under the first frame, and the camera in front of it.

        `ground` is its height [m]; `front` is where the person faces, from x towards y [rad].
        """
        points = np.concatenate([shape.vertices for shape in shapes] or [_NOBODY]).astype(np.float64)
        centre = (points.min(0) + points.max(0)) / 2
        self._server.scene.add_grid(
            "/world/ground",
            infinite_grid=True,
            cell_size=0.25,
            section_size=1.0,
            cell_color=_LINES,
            section_color=_SECTIONS,
            cell_thickness=1.0,
            section_thickness=1.0,
            fade_distance=14.0,
            fade_strength=1.5,
            shadow_opacity=0.3,
            plane_color=_GROUND,
            plane_opacity=1.0,
            position=(0.0, 0.0, ground - 0.002),
        )
        # A key light from one side of the camera, a paler fill light from the other, as in photography.
        for name, angle, color, intensity, height in (
            ("key", front - 0.45, _SUN, 1.9, 4.5),
            ("fill", front + 1.5, _SKY, 0.7, 2.0),
        ):
            self._server.scene.add_light_directional(
                f"/light/{name}",
                color=color,
                intensity=intensity,
                cast_shadow=name == "key",
                position=(3.0 * math.cos(angle), 3.0 * math.sin(angle), height),
            )
        yaw = math.degrees(front + _SIDE)
        framed = Viewpoint.framing(
            vertices_smpl_from_ros(points), size=(640, 760), yaw=yaw, pitch=9.0, margin=1.25, vertical_fov=_FOV
        )
        shift = np.array([centre[0], centre[1], 0.0])
        camera = self._server.initial_camera
        camera.fov = math.radians(_FOV)
        camera.position = vertices_ros_from_smpl(framed.eye) - shift
        camera.look_at = vertices_ros_from_smpl(framed.target) - shift
        camera.near = 0.02

    def follow(self, shapes: Sequence[SceneMesh]) -> None:
        """Moves the world so that the middle of a person is over the origin, where the camera looks."""
        if shapes:
            low, high = (np.stack([at(shape.vertices, 0) for shape in shapes]) for at in (np.min, np.max))
            middle = (low.min(0) + high.max(0)) / 2
            self._world.position = (-float(middle[0]), -float(middle[1]), 0.0)

    def draw(self, bands: Iterable[tuple[SceneMesh, Sequence[Band]]], *, wireframe: bool) -> None:
        """Shows these bands, and nothing else."""
        with self._server.atomic():
            left = set(self._drawn)
            counts: Counter[tuple[str, str]] = Counter()  # markers may differ by their topics or ids alone
            for shape, parts in bands:
                names = shape.person, shape.name
                for band in parts:
                    key = (*names, counts[names])
                    counts[names] += 1
                    if len(band.faces):
                        left.discard(key)
                        self._put(key, shape, band, wireframe=wireframe)
            for key in left:
                self._drawn.pop(key).mesh.remove()

    def _put(self, key: Key, shape: SceneMesh, band: Band, *, wireframe: bool) -> None:
        drawn = self._drawn.get(key)
        if drawn is not None and drawn.n_vertices == len(shape.vertices):
            drawn.mesh.vertices = shape.vertices
            if drawn.faces is not band.faces:
                drawn.mesh.faces = band.faces.astype(np.uint32)
                drawn.faces = band.faces
            if drawn.color != band.color:
                drawn.mesh.color = drawn.color = band.color
            if drawn.mesh.wireframe != wireframe:
                drawn.mesh.wireframe = wireframe
            return
        if drawn is not None:
            drawn.mesh.remove()
        name = "/".join(part for part in ("/world", _node(shape.person), _node(shape.name), str(key[2])) if part)
        mesh = self._server.scene.add_mesh_simple(
            name,
            shape.vertices,
            band.faces.astype(np.uint32),
            color=band.color,
            side="double" if shape.is_garment else "front",
            wireframe=wireframe,
            receive_shadow=False,  # shadow maps of a few thousand texels draw stripes on cloth seen close up
        )
        self._drawn[key] = _Shown(mesh, band.faces, len(shape.vertices), band.color)


def _node(name: str) -> str:
    return name.replace("/", "_")
