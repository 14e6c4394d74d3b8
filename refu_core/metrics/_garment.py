"""The paper's metrics ("Datasets, Metrics, and Settings" and the supplement), over the frames of one garment."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from refu_core.errors import MeshError
from refu_core.mesh import Connectivity, check_faces
from refu_core.metrics._collisions import Collisions
from refu_core.metrics._intersect import as_vertices

ON_SKIN = 1e-6
"""Vertices no deeper than this [m] lie on the skin and not inside: positions of a metre are stored to a tenth of it."""


@dataclass(frozen=True)
class FrameMetrics:
    """Figures of one garment in one frame, over all of its vertices or those that were kept."""

    n_vertices: int
    """Vertices the figures are over."""
    n_inside: int
    """Of these, inside the body (deeper than `ON_SKIN`); as a percentage of all, VFCP."""
    is_free: bool
    """No vertex inside and no pair of triangles intersects; as a percentage of frames, CFMP."""
    n_vf: int
    """Garment triangles with a vertex-face contact; its mean over frames is Avg. VF."""
    n_ee: int
    """Garment triangles with an edge-edge contact; its mean over frames is Avg. EE."""
    max_depth_mm: float
    """Depth of the deepest vertex [mm]."""
    energy: float
    """Penetration energy, sum of max(0, -f)^2 over the vertices [m^2]. The paper takes its energy from another work
    without giving the formula: this one is ours."""
    collision_error_mm: float
    """The paper's collision loss with the exact distance, sum of max(0, -f) over the vertices [mm]."""
    mpve_mm: float | None
    """Mean distance of the vertices to the true ones [mm]; None without a truth."""
    laplacian_mm: float | None
    """Mean length of the difference between Laplacian and true Laplacian [mm], over the vertices in question; None
    without a truth or without such a vertex. See `GarmentMetrics.add`."""


@dataclass(frozen=True)
class Figures:
    """Metrics over frames; None where no frame has what it takes."""

    n_frames: int
    """Frames the figures are over."""
    mpve_mm: float | None
    """Mean per-vertex error [mm]: mean over frames of the mean over vertices."""
    vfcp_percent: float | None
    """Vertex-face collision percentage: vertices inside the body."""
    cfmp_percent: float | None
    """Collision-free models percentage: frames without a contact or a vertex inside."""
    avg_vf: float | None
    """Mean number of garment triangles with a vertex-face contact."""
    avg_ee: float | None
    """Mean number of garment triangles with an edge-edge contact."""
    max_depth_mm: float | None
    """Depth of the deepest vertex of all frames [mm]."""
    mean_energy: float | None
    """Mean penetration energy [m^2], by our own definition (see `FrameMetrics.energy`)."""
    mean_collision_error_mm: float | None
    """Mean collision error [mm] (see `FrameMetrics.collision_error_mm`)."""
    laplacian_mm: float | None
    """Local Laplacian error [mm], mean over the frames that have one."""

    @staticmethod
    def over(frames: list[FrameMetrics]) -> Figures:
        """The figures of some frames; frames of no vertices count as no frames."""
        kept = [frame for frame in frames if frame.n_vertices]

        def mean(values: list[float]) -> float | None:
            return float(np.mean(values)) if values else None

        return Figures(
            n_frames=len(kept),
            mpve_mm=mean([frame.mpve_mm for frame in kept if frame.mpve_mm is not None]),
            vfcp_percent=mean([100.0 * frame.n_inside / frame.n_vertices for frame in kept]),
            cfmp_percent=mean([100.0 * frame.is_free for frame in kept]),
            avg_vf=mean([frame.n_vf for frame in kept]),
            avg_ee=mean([frame.n_ee for frame in kept]),
            max_depth_mm=max((frame.max_depth_mm for frame in kept), default=None),
            mean_energy=mean([frame.energy for frame in kept]),
            mean_collision_error_mm=mean([frame.collision_error_mm for frame in kept]),
            laplacian_mm=mean([frame.laplacian_mm for frame in kept if frame.laplacian_mm is not None]),
        )

    def as_dict(self) -> dict[str, Any]:
        """The figures by name, ready for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class MetricsSummary:
    """Figures with and without the places where the body touches itself."""

    all: Figures
    """Every frame, every vertex."""
    contact_free_frames: Figures
    """Only the frames of which no garment vertex is near a self-contact."""
    contact_free_vertices: Figures
    """Every frame, but only the vertices (and triangles of such) that aren't near a self-contact."""

    @property
    def n_frames(self) -> int:
        """Frames in all."""
        return self.all.n_frames

    @property
    def n_contact_frames(self) -> int:
        """Frames with a self-contact near the garment."""
        return self.all.n_frames - self.contact_free_frames.n_frames


@dataclass(eq=False)
class GarmentMetrics:
    """Gathers the metrics of one garment over frames.

    `faces` are the garment's, shape (G, 3). Raises `MeshError` when they aren't triangles.
    """

    faces: NDArray[np.int32]
    _all: list[FrameMetrics] = field(default_factory=list, init=False, repr=False)
    _away: list[FrameMetrics] = field(default_factory=list, init=False, repr=False)
    _has_contact: list[bool] = field(default_factory=list, init=False, repr=False)
    _laplacian: csr_array | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        self.faces = check_faces(self.faces)

    def add(
        self,
        vertices: Any,
        collisions: Collisions,
        *,
        truth: Any = None,
        near_contact: Any = None,
        resolved: Any = None,
    ) -> FrameMetrics:
        """Takes in a frame and returns its figures over all vertices.

        Args:
            vertices: The garment [m], shape (N, 3).
            collisions: Its exact collisions.
            truth: The true garment [m], shape (N, 3), where there is one.
            near_contact: Vertices near a self-contact of the body, bool, shape (N,); none by default.
            resolved: Vertices that collided before collisions were handled, bool, shape (N,): the local Laplacian error
                is over these (the supplement's "initial collided vertex"); over all vertices by default.

        Raises:
            MeshError: Arrays whose shapes don't belong together.
        """
        garment = as_vertices("the garment's vertices", vertices)
        n = len(garment)
        target = None if truth is None else as_vertices("truth", truth)
        near = np.zeros(n, np.bool_) if near_contact is None else np.asarray(near_contact, dtype=np.bool_)
        region = np.ones(n, np.bool_) if resolved is None else np.asarray(resolved, dtype=np.bool_)
        shapes = {near.shape, region.shape, collisions.inside.shape}
        if shapes != {(n,)} or (target is not None and target.shape != garment.shape) or self.faces.max() >= n:
            msg = (
                f"truth, near_contact, resolved and collisions must belong to the garment's {n} vertices, got shapes "
                f"{None if target is None else target.shape}, {near.shape}, {region.shape}, {collisions.inside.shape}"
            )
            raise MeshError(msg)
        errors = laplacians = None
        if target is not None:
            errors = np.linalg.norm(garment.astype(np.float64) - target, axis=1)
            laplacians = np.linalg.norm(self._laplacian_of(garment) - self._laplacian_of(target), axis=1)
        everything = np.ones(n, np.bool_)
        frame = self._figures(everything, collisions, errors, laplacians, region)
        self._all.append(frame)
        self._away.append(self._figures(~near, collisions, errors, laplacians, region))
        self._has_contact.append(bool(near.any()))
        return frame

    def summary(self) -> MetricsSummary:
        """The figures over the frames added so far."""
        untouched = [frame for frame, contact in zip(self._all, self._has_contact, strict=True) if not contact]
        return MetricsSummary(Figures.over(self._all), Figures.over(untouched), Figures.over(self._away))

    def _figures(
        self,
        kept: NDArray[np.bool_],
        collisions: Collisions,
        errors: NDArray[np.float64] | None,
        laplacians: NDArray[np.float64] | None,
        region: NDArray[np.bool_],
    ) -> FrameMetrics:
        of_kept = kept[self.faces[collisions.pairs[:, 0]]].all(axis=1)
        pairs, is_vf = collisions.pairs[of_kept, 0], collisions.pair_is_vf[of_kept]
        depth = collisions.depth[kept].astype(np.float64)
        region = region & kept
        return FrameMetrics(
            n_vertices=int(kept.sum()),
            n_inside=int((depth > ON_SKIN).sum()),
            is_free=not len(pairs) and not collisions.inside[kept].any(),
            n_vf=len(np.unique(pairs[is_vf])),
            n_ee=len(np.unique(pairs[~is_vf])),
            max_depth_mm=1e3 * float(depth.max(initial=0.0)),
            energy=float((depth**2).sum()),
            collision_error_mm=1e3 * float(depth.sum()),
            mpve_mm=None if errors is None or not kept.any() else 1e3 * float(errors[kept].mean()),
            laplacian_mm=None if laplacians is None or not region.any() else 1e3 * float(laplacians[region].mean()),
        )

    def _laplacian_of(self, vertices: NDArray[np.float32]) -> NDArray[np.float64]:
        """Each vertex minus the mean of its neighbours along edges (the uniform Laplacian) [m], shape (N, 3)."""
        if self._laplacian is None or self._laplacian.shape[0] != len(vertices):
            self._laplacian = Connectivity.of(self.faces, len(vertices)).uniform_laplacian()
        product: NDArray[np.float64] = self._laplacian @ vertices.astype(np.float64)
        return product
