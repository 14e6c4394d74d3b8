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
from refu_core.metrics._folds import SWEEPS, FoldBands
from refu_core.metrics._intersect import as_vertices

ON_SKIN = 1e-6
"""Vertices no deeper than this [m] lie on the skin and not inside: positions of a metre are stored to a tenth of it."""


@dataclass(frozen=True)
class FrameMetrics:
    """Figures of one garment in one frame, over all of its vertices."""

    n_vertices: int
    """Vertices of the garment."""
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
    folds: list[list[float]] | None
    """Energy of the garment's folds and of the true one's, four bands each (`FoldBands`) [m^2]; None without one."""


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
    folds_1: float | None
    """Energy of the garments' folds over that of the true ones', all frames together: of the finest folds, those that
    the first levelling sweep takes away (`FoldBands`). Below 1 garments are smoother than cloth."""
    folds_4: float | None
    """The same of what four more sweeps take away."""
    folds_16: float | None
    """And sixteen more."""
    folds_64: float | None
    """And 64 more: the widest folds."""

    @staticmethod
    def over(frames: list[FrameMetrics]) -> Figures:
        """The figures of some frames."""

        def mean(values: list[float]) -> float | None:
            return float(np.mean(values)) if values else None

        folds = np.sum([frame.folds for frame in frames if frame.folds is not None], axis=0)
        ratios = dict(zip(SWEEPS, (folds[0] / folds[1]).tolist(), strict=True)) if np.ndim(folds) else {}
        return Figures(
            n_frames=len(frames),
            mpve_mm=mean([frame.mpve_mm for frame in frames if frame.mpve_mm is not None]),
            vfcp_percent=mean([100.0 * frame.n_inside / frame.n_vertices for frame in frames]),
            cfmp_percent=mean([100.0 * frame.is_free for frame in frames]),
            avg_vf=mean([frame.n_vf for frame in frames]),
            avg_ee=mean([frame.n_ee for frame in frames]),
            max_depth_mm=max((frame.max_depth_mm for frame in frames), default=None),
            mean_energy=mean([frame.energy for frame in frames]),
            mean_collision_error_mm=mean([frame.collision_error_mm for frame in frames]),
            laplacian_mm=mean([frame.laplacian_mm for frame in frames if frame.laplacian_mm is not None]),
            folds_1=ratios.get(1),
            folds_4=ratios.get(4),
            folds_16=ratios.get(16),
            folds_64=ratios.get(64),
        )

    def as_dict(self) -> dict[str, Any]:
        """The figures by name, ready for JSON."""
        return asdict(self)


@dataclass(eq=False)
class GarmentMetrics:
    """Gathers the metrics of one garment over frames.

    `faces` are the garment's, shape (G, 3). Raises `MeshError` when they aren't triangles.
    """

    faces: NDArray[np.int32]
    _frames: list[FrameMetrics] = field(default_factory=list, init=False, repr=False)
    _laplacian: csr_array | None = field(default=None, init=False, repr=False)
    _bands: FoldBands | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        self.faces = check_faces(self.faces)

    def add(
        self,
        vertices: Any,
        collisions: Collisions,
        *,
        truth: Any = None,
        resolved: Any = None,
    ) -> FrameMetrics:
        """Takes in a frame and returns its figures over all vertices.

        Args:
            vertices: The garment [m], shape (N, 3).
            collisions: Its exact collisions.
            truth: The true garment [m], shape (N, 3), where there is one.
            resolved: Vertices that collided before collisions were handled, bool, shape (N,): the local Laplacian error
                is over these (the supplement's "initial collided vertex"); over all vertices by default.

        Raises:
            MeshError: Arrays whose shapes don't belong together.
        """
        garment = as_vertices("the garment's vertices", vertices)
        n = len(garment)
        target = None if truth is None else as_vertices("truth", truth)
        region = np.ones(n, np.bool_) if resolved is None else np.asarray(resolved, dtype=np.bool_)
        shapes = {region.shape, collisions.inside.shape}
        if shapes != {(n,)} or (target is not None and target.shape != garment.shape) or self.faces.max() >= n:
            msg = (
                f"truth, resolved and collisions must belong to the garment's {n} vertices, got shapes "
                f"{None if target is None else target.shape}, {region.shape}, {collisions.inside.shape}"
            )
            raise MeshError(msg)
        errors = laplacians = None
        if target is not None:
            errors = np.linalg.norm(garment.astype(np.float64) - target, axis=1)
            laplacians = np.linalg.norm(self._laplacian_of(garment) - self._laplacian_of(target), axis=1)
        depth = collisions.depth.astype(np.float64)
        frame = FrameMetrics(
            n_vertices=n,
            n_inside=int((depth > ON_SKIN).sum()),
            is_free=collisions.is_free,
            n_vf=collisions.n_vf,
            n_ee=collisions.n_ee,
            max_depth_mm=1e3 * collisions.max_depth,
            energy=float((depth**2).sum()),
            collision_error_mm=1e3 * float(depth.sum()),
            mpve_mm=None if errors is None else 1e3 * float(errors.mean()),
            laplacian_mm=None if laplacians is None or not region.any() else 1e3 * float(laplacians[region].mean()),
            folds=None if target is None else self._folds_of(garment, target),
        )
        self._frames.append(frame)
        return frame

    def summary(self) -> Figures:
        """The figures over the frames added so far."""
        return Figures.over(self._frames)

    def _folds_of(self, *garments: NDArray[np.float32]) -> list[list[float]]:
        """Of each the energies of its bands: one look at the mesh for all."""
        if self._bands is None:
            self._bands = FoldBands(Connectivity.of(self.faces, len(garments[0])))
        energies: list[list[float]] = self._bands.energies(np.stack(garments, axis=1)).T.tolist()
        return energies

    def _laplacian_of(self, vertices: NDArray[np.float32]) -> NDArray[np.float64]:
        """Each vertex minus the mean of its neighbours along edges (the uniform Laplacian) [m], shape (N, 3)."""
        if self._laplacian is None or self._laplacian.shape[0] != len(vertices):
            self._laplacian = Connectivity.of(self.faces, len(vertices)).uniform_laplacian()
        product: NDArray[np.float64] = self._laplacian @ vertices.astype(np.float64)
        return product
