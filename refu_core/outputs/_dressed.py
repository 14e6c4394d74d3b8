"""A dressed person in any axes that are wanted, each part computed when it is asked for."""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from refu_core.errors import MeshError, require_pipeline
from refu_core.frames import SmplFrame
from refu_core.mesh import check_faces
from refu_core.outputs._clearance import Clearance
from refu_core.outputs._limbs import LimbContact, LimbContacts
from refu_core.outputs._openings import Opening, Openings
from refu_core.outputs._planner import PlannerMesh
from refu_core.outputs._sigma import Sigma
from refu_core.outputs._visible import PinholeCamera, all_visible
from refu_core.outputs._worn import require_known
from refu_core.realtime import GarmentPipeline, PipelineOutput


class VertexNormals:
    """As `refu_core.mesh.vertex_normals`, for one mesh again and again, in a tenth of the time."""

    def __init__(self, faces: Any, n_vertices: int) -> None:
        """For `faces`, integers of shape (F, 3), and `n_vertices` V. Raises `MeshError` for other faces."""
        checked = check_faces(faces, n_vertices=n_vertices)
        self._n_vertices = n_vertices
        self._corners = np.ascontiguousarray(checked.T, dtype=np.intp)
        ones, owner = np.ones(checked.size, np.float32), np.repeat(np.arange(len(checked)), 3)
        self._sum = sparse.csr_array((ones, (checked.ravel(), owner)), shape=(n_vertices, len(checked)))

    def __call__(self, vertices: ArrayLike) -> NDArray[np.float32]:
        """Unit normals (V, 3) at finite vertices (V, 3), in their axes; zero where no face has an area.

        The mean of the normals of the faces around, weighted by area. Raises `MeshError` for vertices of another shape.
        """
        columns = np.ascontiguousarray(np.asarray(vertices, np.float32).T)
        if columns.shape != (3, self._n_vertices):
            raise MeshError(f"vertices must have the shape ({self._n_vertices}, 3), got {columns.shape[::-1]}")
        # Coordinate by coordinate: `np.cross` takes three times as long.
        origin, first, second = (np.take(columns, corner, axis=1) for corner in self._corners)
        (a, b, c), (d, e, f) = first - origin, second - origin
        normals: NDArray[np.float32] = self._sum @ np.stack((b * f - c * e, c * d - a * f, a * e - b * d), axis=1)
        lengths = np.sqrt(np.einsum("ij,ij->i", normals, normals))
        normals /= np.maximum(lengths, np.float32(1e-20))[:, None]
        return normals


class Fittings:
    """What is computed once for a pipeline's garments and its body, when it is first asked for."""

    def __init__(self, pipeline: GarmentPipeline, *, weights: str | os.PathLike[str] | None = None) -> None:
        """For a pipeline and the `weights` that it was loaded with, if any. Raises `MeshError` for no pipeline."""
        require_pipeline(pipeline, "garments", "body", error=MeshError)
        self.pipeline, self._weights = pipeline, weights
        self.garments = pipeline.garments
        self.names = tuple(self.garments)
        self.faces = {name: garment.faces.cpu().numpy() for name, garment in self.garments.items()}
        """Faces of each garment, shape (F, 3)."""
        self.counts = {name: garment.n_vertices for name, garment in self.garments.items()}
        """Vertices of each garment."""
        self.colors = {name: (*garment.card.color, 1.0) for name, garment in self.garments.items()}
        self.body = pipeline.body.faces.cpu().numpy(), len(pipeline.body.v_template)
        """The body's faces, and how many vertices it has."""
        self._planners: dict[str, PlannerMesh] = {}
        self._preparing: dict[str, threading.Thread] = {}
        self.without_planner: dict[str, str] = {}
        """Garments for which no planner's mesh could be made, and why."""

    def prepare(self) -> Fittings:
        """Computes now what the first frame would need, except planners' meshes, which take too long."""
        _ = self.openings, self.normals, self.clearance, self.contacts, self.sigma
        return self

    @cached_property
    def openings(self) -> dict[str, Openings]:
        """The openings of each garment."""
        return {name: Openings(garment) for name, garment in self.garments.items()}

    @cached_property
    def normals(self) -> dict[str, VertexNormals]:
        """What computes the normals of each garment."""
        return {name: VertexNormals(faces, self.counts[name]) for name, faces in self.faces.items()}

    def planner(self, name: str) -> PlannerMesh:
        """A garment's mesh for planners; takes ten seconds or so when it is made for the first time ever."""
        require_known(name, self.garments)
        if name not in self._planners:
            self._planners[name] = PlannerMesh.of(self.pipeline, name)
        return self._planners[name]

    def has_planner(self, name: str) -> bool:
        """Whether `planner` would answer at once. The first call starts to make the mesh, in a thread of its own."""
        require_known(name, self.garments)
        if name not in self._preparing:
            self._preparing[name] = threading.Thread(target=self._prepare_planner, args=(name,), daemon=True)
            self._preparing[name].start()
        return name in self._planners

    def _prepare_planner(self, name: str) -> None:
        try:
            self.planner(name)
        except Exception as error:  # of any kind: nothing else would report it, and callers would wait for this garment
            self.without_planner[name] = str(error) or type(error).__name__

    @cached_property
    def clearance(self) -> Clearance:
        """What computes the clearance of all garments."""
        return Clearance.of(self.pipeline)

    @cached_property
    def contacts(self) -> LimbContacts:
        """What finds contacts of the body's parts through all garments."""
        return LimbContacts.of(self.pipeline)

    @cached_property
    def sigma(self) -> Sigma:
        """What computes σ of all garments."""
        return Sigma(self.pipeline, folder=self._weights)


@dataclass(frozen=True, eq=False)
class DressedPerson:
    """One person in one frame; vertices are relative to `offset`, in the axes that `rotation` leads to.

    Only one thread at a time may use the people who share one `fittings`.
    """

    person: str
    frame: SmplFrame
    output: PipelineOutput
    fittings: Fittings
    rotation: NDArray[np.float64]
    """From SMPL's axes, shape (3, 3)."""
    offset: NDArray[np.float64]
    """Where the body's own origin is [m], shape (3,); float64, so that a body far away loses no precision."""
    camera: PinholeCamera | None = None
    """The camera that sees the person, if any; its axes and origin are those of `offset`."""

    @property
    def stamp_ns(self) -> int:
        """The frame's time stamp [ns]."""
        return self.frame.stamp_ns

    def turned(self, points: NDArray[Any]) -> NDArray[Any]:
        """Turns points (..., 3) that are relative to the body's origin from SMPL's axes into those of `rotation`."""
        turned: NDArray[Any] = points @ self.rotation.T.astype(points.dtype)
        return turned

    @cached_property
    def vertices(self) -> dict[str, NDArray[np.float32]]:
        """Vertices of each garment [m], shape (V, 3)."""
        return {name: self.turned(mesh.local) for name, mesh in self.output.items()}

    @cached_property
    def body(self) -> NDArray[np.float32]:
        """Vertices of the body [m], shape (V, 3)."""
        return self.turned(self.output.body)

    @cached_property
    def openings(self) -> dict[str, tuple[Opening, ...]]:
        """The openings of each garment in this frame."""
        return {name: self.fittings.openings[name].frames(points) for name, points in self.vertices.items()}

    def normals(self) -> list[NDArray[np.float32]]:
        """Normals at the vertices of each garment, shape (V, 3)."""
        return [self.fittings.normals[name](points) for name, points in self.vertices.items()]

    def clearance(self) -> list[NDArray[np.float32]]:
        """How far each garment's vertices are from the body [m], shape (V,)."""
        return [*self.fittings.clearance(self.output).values()]

    def sigma(self) -> list[NDArray[np.float32]]:
        """Standard deviation of each garment's vertices [m], shape (V,)."""
        return [*self.fittings.sigma(self.frame, self.output).values()]

    def visible(self) -> list[NDArray[np.bool_]]:
        """Which of each garment's vertices the camera sees, shape (V,); none without a camera."""
        camera = self.camera
        if camera is None:
            return [np.zeros(len(points), np.bool_) for points in self.vertices.values()]
        from_here = replace(camera, translation=camera.rotation @ self.offset + camera.translation)
        own = [(points, self.fittings.faces[name]) for name, points in self.vertices.items()]
        return all_visible([*own, (self.body, self.fittings.body[0])], from_here)[: len(own)]

    def contacts(self) -> tuple[LimbContact, ...]:
        """Cloth between parts of the body; `centre` is in SMPL's axes."""
        return self.fittings.contacts(self.output)

    def solid(self, name: str) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """A garment as planners take it: vertices (N, 3) [m] and faces (T, 3)."""
        planner = self.fittings.planner(name)
        return planner.solid(self.vertices[name]), planner.faces
