"""A dressed person in the axes that somebody wants, each part computed when it is asked for."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from refu_core.outputs._clearance import Clearance
from refu_core.outputs._limbs import LimbContact, LimbContacts
from refu_core.outputs._normals import VertexNormals
from refu_core.outputs._openings import Opening, Openings
from refu_core.outputs._planner import PlannerMesh
from refu_core.outputs._sigma import Sigma
from refu_core.outputs._visible import PinholeCamera, all_visible

if TYPE_CHECKING:
    import os

    from numpy.typing import NDArray

    from refu_core.frames import SmplFrame
    from refu_core.realtime import GarmentPipeline, PipelineOutput


class Fittings:
    """What is found once of a pipeline's garments and its body, when it is asked for first."""

    def __init__(self, pipeline: GarmentPipeline, *, weights: str | os.PathLike[str] | None = None) -> None:
        """For a pipeline, and the folder of weights that it was loaded with, if any."""
        self._pipeline, self._weights = pipeline, weights
        self.garments = pipeline.garments
        self.names = tuple(self.garments)
        self.faces = {name: garment.faces.cpu().numpy() for name, garment in self.garments.items()}
        """Of each garment, shape (F, 3)."""
        self.counts = {name: garment.n_vertices for name, garment in self.garments.items()}
        """Vertices of each garment."""
        self.colors = {name: (*garment.card.color, 1.0) for name, garment in self.garments.items()}
        self.body = pipeline.body.faces.cpu().numpy(), len(pipeline.body.v_template)
        """The body's faces, and how many vertices it has."""
        self._planners: dict[str, PlannerMesh] = {}
        self._preparing: dict[str, threading.Thread] = {}
        self.without_planner: dict[str, str] = {}
        """Garments that planners can't have, and why."""

    def prepare(self) -> Fittings:
        """Finds at once what it would be asked for with the first frame, but planners' meshes: they take too long."""
        _ = self.openings, self.normals, self.clearance, self.contacts, self.sigma
        return self

    @cached_property
    def openings(self) -> dict[str, Openings]:
        """Of each garment."""
        return {name: Openings(garment) for name, garment in self.garments.items()}

    @cached_property
    def normals(self) -> dict[str, VertexNormals]:
        """Of each garment."""
        return {name: VertexNormals(faces, self.counts[name]) for name, faces in self.faces.items()}

    def planner(self, name: str) -> PlannerMesh:
        """A garment's; takes ten seconds or so when it is made for the first time ever."""
        if name not in self._planners:
            self._planners[name] = PlannerMesh.of(self._pipeline, name)
        return self._planners[name]

    def has_planner(self, name: str) -> bool:
        """Whether `planner` would answer at once. Who asks first starts to make it, in a thread of its own."""
        if name not in self._preparing:
            self._preparing[name] = threading.Thread(target=self._prepare_planner, args=(name,), daemon=True)
            self._preparing[name].start()
        return name in self._planners

    def _prepare_planner(self, name: str) -> None:
        try:
            self.planner(name)
        except Exception as error:  # whatever it is: nobody else would say it, and others would wait for this garment
            self.without_planner[name] = str(error) or type(error).__name__

    @cached_property
    def clearance(self) -> Clearance:
        """Of all garments."""
        return Clearance.of(self._pipeline)

    @cached_property
    def contacts(self) -> LimbContacts:
        """Of the body's parts through all garments."""
        return LimbContacts.of(self._pipeline)

    @cached_property
    def sigma(self) -> Sigma:
        """Of all garments."""
        return Sigma(self._pipeline, folder=self._weights)


@dataclass(frozen=True, eq=False)
class DressedPerson:
    """One person in one frame; vertices are relative to `offset`, in the axes that `rotation` leads to.

    One thread at a time may ask those of one `fittings`.
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
    """Who looks, where somebody does; in the axes and from the origin that `offset` is in."""

    @property
    def stamp_ns(self) -> int:
        """Of the frame [ns]."""
        return self.frame.stamp_ns

    def turned(self, points: NDArray[Any]) -> NDArray[Any]:
        """Points relative to the body's own origin in SMPL's axes, (..., 3), in those that `rotation` leads to."""
        turned: NDArray[Any] = points @ self.rotation.T.astype(points.dtype)
        return turned

    @cached_property
    def vertices(self) -> dict[str, NDArray[np.float32]]:
        """Of each garment [m], shape (V, 3)."""
        return {name: self.turned(mesh.local) for name, mesh in self.output.items()}

    @cached_property
    def body(self) -> NDArray[np.float32]:
        """Vertices of the body [m], shape (V, 3)."""
        return self.turned(self.output.body)

    @cached_property
    def openings(self) -> dict[str, tuple[Opening, ...]]:
        """Of each garment."""
        return {name: self.fittings.openings[name].frames(points) for name, points in self.vertices.items()}

    def normals(self) -> list[NDArray[np.float32]]:
        """At the vertices of each garment, shape (V, 3)."""
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
        from_here = camera.rotation @ self.offset + camera.translation
        numbers = camera.width, camera.height, camera.focal, camera.centre, camera.rotation, from_here
        own = [(points, self.fittings.faces[name]) for name, points in self.vertices.items()]
        return all_visible([*own, (self.body, self.fittings.body[0])], PinholeCamera(*numbers))[: len(own)]

    def contacts(self) -> tuple[LimbContact, ...]:
        """Cloth between parts of the body; `centre` is in SMPL's axes."""
        return self.fittings.contacts(self.output)

    def solid(self, name: str) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """A garment as planners take it: vertices [m] and faces."""
        planner = self.fittings.planner(name)
        return planner.solid(self.vertices[name]), planner.faces
