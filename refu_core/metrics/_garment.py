"""The paper's metrics ("Datasets, Metrics, and Settings" and the supplement), over the frames of one garment."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from refu_core._numbers import NOT_NUMBERS, as_numbers
from refu_core.errors import MeshError
from refu_core.mesh import Connectivity, check_faces
from refu_core.metrics._collisions import Collisions, as_vertices

ON_SKIN = 1e-6
"""Vertices no deeper than this [m] lie on the skin, not inside: positions of a metre are stored to a tenth of this."""
SWEEPS = (1, 4, 16, 64)
"""Number of sweeps that take each band away, finest first. A sweep goes half way to the mean of the neighbours."""


@dataclass(frozen=True)
class FrameMetrics:
    """Figures of one garment in one frame, over all of its vertices."""

    n_vertices: int
    """Vertices of the garment."""
    n_inside: int
    """Vertices inside the body (deeper than `ON_SKIN`); as a percentage of all, VFCP."""
    is_free: bool
    """Whether no vertex is inside and no pair of triangles intersects; as a percentage of frames, CFMP."""
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
    """Mean length of the difference between Laplacian and true Laplacian [mm], over the resolved vertices; None without
    a truth or without such a vertex. See `GarmentMetrics.add`."""
    folds: list[list[float]] | None
    """Energy of the garment's folds and of the true ones, four bands each (`FoldBands`) [m^2]; None without a truth."""


@dataclass(frozen=True)
class Figures:
    """Metrics over frames; None where no frame has the data for one."""

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
    """Energy of the garments' folds divided by that of the true ones, over all frames: for the finest folds, those that
    the first levelling sweep takes away (`FoldBands`). Below 1 garments are smoother than cloth."""
    folds_4: float | None
    """The same for what four more sweeps take away."""
    folds_16: float | None
    """The same for sixteen more."""
    folds_64: float | None
    """The same for 64 more: the widest folds."""

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
            **{f"folds_{n}": ratios.get(n) for n in SWEEPS},
        )

    def as_dict(self) -> dict[str, Any]:
        """The figures by name, ready for JSON."""
        return asdict(self)


class FoldBands:
    """Splits a garment into bands: folds of a few edges' length, then wider ones, and the shape that is left.

    Networks that are trained for a small error predict the mean of what cloth may do, which is smoother than cloth. The
    mean error hardly shows this. The energy of the bands does.
    """

    def __init__(self, mesh: Connectivity) -> None:
        self._sweep = sparse.csr_array(sparse.eye_array(mesh.n_vertices) - 0.5 * mesh.uniform_laplacian())

    def split(self, vertices: Any) -> NDArray[np.float64]:
        """The bands of arrays (V, ...) over the vertices, finest first, and what is left: (5, V, ...). They add up.

        Raises `MeshError` for anything but finite numbers of that shape.
        """
        n = self._sweep.shape[0]
        try:
            array = np.asarray(as_numbers(vertices), np.float64)
        except NOT_NUMBERS as error:
            wanted = f"wanted numbers of the shape ({n}, ...), got {type(vertices).__name__}"
            raise MeshError(f"{wanted}: {error}") from error
        if array.shape[:1] != (n,) or not np.isfinite(array).all():
            raise MeshError(f"wanted finite numbers of the shape ({n}, ...), got {array.shape}")
        rest = array.reshape(len(array), -1)
        bands = []
        for n_sweeps in SWEEPS:
            level = rest
            for _ in range(n_sweeps):
                level = self._sweep @ level
            bands.append(rest - level)
            rest = level
        return np.stack([*bands, rest]).reshape(len(SWEEPS) + 1, *array.shape)

    def energies(self, vertices: Any) -> NDArray[np.float64]:
        """The energy of each band of vertices (V, ..., 3) [m], finest first [m^2], shape (4, ...)."""
        energies: NDArray[np.float64] = (self.split(vertices)[:-1] ** 2).sum(axis=(1, -1))
        return energies


class GarmentMetrics:
    """Gathers the metrics of one garment over frames."""

    def __init__(self, faces: Any) -> None:
        """For a garment of these faces, shape (G, 3). Raises `MeshError` when they aren't triangles."""
        self.faces = check_faces(faces)
        self._frames: list[FrameMetrics] = []
        self._known: tuple[sparse.csr_array, FoldBands] | None = None

    def add(self, vertices: Any, collisions: Collisions, *, truth: Any = None, resolved: Any = None) -> FrameMetrics:
        """Takes in a garment's vertices (N, 3) [m] with their exact collisions; returns figures over all vertices.

        `truth` are the true vertices, if there are any. The local Laplacian error is over the vertices that `resolved`,
        bool, (N,), marks: those that collided before collisions were handled (the supplement's "initial collided
        vertex"); over all by default. Raises `MeshError` for arrays whose shapes don't belong together, and for another
        number of vertices than in the frames before.
        """
        known = self._frames[0].n_vertices if self._frames else None
        garment = as_vertices("the garment's vertices", vertices, known)
        n = len(garment)
        target = None if truth is None else as_vertices("truth", truth)
        region = np.ones(n, np.bool_) if resolved is None else np.asarray(resolved, dtype=np.bool_)
        shapes = {region.shape, collisions.inside.shape}
        if shapes != {(n,)} or (target is not None and target.shape != garment.shape) or self.faces.max() >= n:
            got = f"{None if target is None else target.shape}, {region.shape}, {collisions.inside.shape}"
            raise MeshError(f"truth, resolved and collisions must belong to the garment's {n} vertices, got {got}")
        errors = laplacians = folds = None
        if target is not None:
            errors = np.linalg.norm(garment.astype(np.float64) - target, axis=1)
            if self._known is None:
                mesh = Connectivity.of(self.faces, n)
                self._known = mesh.uniform_laplacian(), FoldBands(mesh)
            laplacian, bands = self._known
            laplacians = np.linalg.norm(
                laplacian @ garment.astype(np.float64) - laplacian @ target.astype(np.float64), axis=1
            )
            folds = bands.energies(np.stack((garment, target), axis=1)).T.tolist()
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
            folds=folds,
        )
        self._frames.append(frame)
        return frame

    def summary(self) -> Figures:
        """The figures over the frames added so far."""
        return Figures.over(self._frames)
