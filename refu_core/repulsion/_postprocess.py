"""The post-processes that the paper compares itself with: naive, and by optimisation. NumPy and SciPy, one garment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import block_diag, coo_array, csc_array, csr_array, diags_array, eye_array
from scipy.sparse.linalg import cg, splu
from torch import Tensor

from refu_core.errors import MeshError
from refu_core.repulsion._unit import repulse
from refu_core.sdf import BodySdf, SdfSample

DRAPE_ROUNDS: tuple[tuple[float, float], ...] = ((4.0, 0.8), (2.0, 0.6), (1.0, 0.4))
"""(λ_s, λ_d) of each round of Guan et al. 2012."""
_CLEARANCE = 0.001
_LAPLACIAN_WEIGHT = 2.0


@torch.no_grad()
def push_naively(points: Tensor, sdf: BodySdf, *, near: Tensor | None = None) -> Tensor:
    """The naive post-process (paper, Sec. Comparisons): x + |f(x)| ∇f/|∇f| for vertices inside, onto the skin exactly.

    Args:
        points: Garment vertices [m], shape (N, 3), in the frame of the body last given to `sdf`.
        sdf: The body's signed distance.
        near: A body face near each vertex, shape (N,), where `sdf` asks for such hints.
    """
    return repulse(points, _query(sdf, points, near))


@dataclass(frozen=True, eq=False)
class PostProcess:
    """Post-processes by least squares for garments of one mesh, whose Laplacian is built once."""

    laplacian: csr_array
    """Uniform: x_i minus the mean of its neighbours, shape (N, N)."""

    @classmethod
    def of_faces(cls, faces: Tensor | NDArray[np.int64], n_vertices: int) -> PostProcess:
        """For garments of these `faces`, shape (G, 3), and `n_vertices` N.

        Raises:
            MeshError: A face that names a vertex there isn't.
        """
        array = np.asarray(faces.cpu() if isinstance(faces, Tensor) else faces, dtype=np.int64)
        if array.ndim != 2 or array.shape[1] != 3 or array.min(initial=0) < 0 or array.max(initial=0) >= n_vertices:
            msg = f"faces must be triangles of {n_vertices} vertices, got {array.shape} up to {array.max(initial=-1)}"
            raise MeshError(msg)
        here = array[:, [0, 1, 2, 1, 2, 0]].ravel()
        there = array[:, [1, 2, 0, 0, 1, 2]].ravel()
        adjacent = coo_array((np.ones(len(here)), (here, there)), shape=(n_vertices, n_vertices)).tocsr()
        adjacent.data[:] = 1.0  # edges inside the garment were entered from two faces
        degree = np.maximum(adjacent.sum(axis=1), 1.0)
        return cls(csr_array(eye_array(n_vertices) - diags_array(1.0 / degree) @ adjacent))

    @torch.no_grad()
    def optimise(
        self,
        points: Tensor,
        sdf: BodySdf,
        *,
        clearance: float = _CLEARANCE,
        reach: float = 0.0,
        near: Tensor | None = None,
    ) -> Tensor:
        """The optimisation of DRAPE (Guan et al. 2012), the paper's "Opt. Post-Process": garment vertices [m], (N, 3).

        Each round minimises p + λ_s s + λ_d d over the garment y, with ỹ what the round before has left:
        p = Σ (nᵢᵀ(yᵢ - bᵢ) - ε)² over the vertices inside, bᵢ the closest point of the skin and nᵢ its normal;
        s = Σ |(yᵢ - ỹᵢ) - mean over neighbours of (y - ỹ)|²; d = Σ |yᵢ - ỹᵢ|². Pairs (i, bᵢ) are found anew each round.
        DRAPE leaves ε open, and takes the closest vertex for bᵢ; the closest point is its better.

        Args:
            points: Garment vertices [m], shape (N, 3).
            sdf: The body's signed distance.
            clearance: ε, how far outside the vertices are to end [m].
            reach: Vertices that are nearer to the skin than this are brought to `clearance`, too [m]. DRAPE's is 0:
                only those inside are, and edges between others may still cut through the body.
            near: As `push_naively`.
        """
        for smoothness, damping in DRAPE_ROUNDS:
            sample = _query(sdf, points, near)
            inside, normal, deficit = _penetrating(sample, clearance, reach)
            if not len(inside):
                break
            points = points + self._drape_round(inside, normal, deficit, smoothness, damping).to(points)
        return points

    def _drape_round(
        self,
        inside: NDArray[np.int64],
        normal: NDArray[np.float64],
        deficit: NDArray[np.float64],
        smoothness: float,
        damping: float,
    ) -> Tensor:
        """Displacement y - ỹ that solves one round, shape (N, 3)."""
        n = self.laplacian.shape[0]
        # nᵀ(y - b) - ε = nᵀu - (ε - f) for the displacement u: one row for each vertex inside, three columns each.
        columns = 3 * inside[:, None] + np.arange(3)
        rows = np.repeat(np.arange(len(inside)), 3)
        push = coo_array((normal.ravel(), (rows, columns.ravel())), shape=(len(inside), 3 * n)).tocsr()
        smooth = self.laplacian.T @ self.laplacian * smoothness + damping * eye_array(n)
        spread = _on_each_axis(csr_array(smooth))
        # Damping bounds the condition number by about 40: conjugate gradients need no factorisation.
        solution, failed = cg(push.T @ push + spread, push.T @ deficit, rtol=1e-8, maxiter=1000)
        assert not failed
        return torch.from_numpy(solution.reshape(n, 3))

    @torch.no_grad()
    def keep_laplacian(
        self, points: Tensor, sdf: BodySdf, *, clearance: float = _CLEARANCE, near: Tensor | None = None
    ) -> Tensor:
        """The post-process of TailorNet (Patel et al. 2020): least squares of [L; W] x = [L v; W t], shape (N, 3).

        W weighs the vertices inside with 2 and their targets t lie `clearance` [m] outside; the Laplacian carries the
        rest along. Arguments as `optimise`.
        """
        sample = _query(sdf, points, near)
        inside, normal, deficit = _penetrating(sample, clearance)
        if not len(inside):
            return points
        n = self.laplacian.shape[0]
        weight = np.zeros(n)
        weight[inside] = _LAPLACIAN_WEIGHT**2
        wanted = np.zeros((n, 3))
        wanted[inside] = deficit[:, None] * normal
        # Pieces without a vertex inside stay where they are; the tiny weight makes that a solution, too.
        system = csc_array(self.laplacian.T @ self.laplacian + diags_array(weight + 1e-9))
        shift: NDArray[np.float64] = splu(system).solve(weight[:, None] * wanted)
        return points + torch.from_numpy(shift).to(points)


def _query(sdf: BodySdf, points: Tensor, near: Tensor | None) -> SdfSample:
    return sdf.query(points) if near is None else sdf.query(points, near=near)


def _penetrating(
    sample: SdfSample, clearance: float, reach: float = 0.0
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Vertices inside or nearer than `reach` (R,), the way out (R, 3), and how far it is to `clearance` outside [m]."""
    rows = torch.nonzero(sample.distance < reach)[:, 0]
    found = sample.rows(rows)
    return (
        rows.cpu().numpy(),
        found.gradient.double().cpu().numpy(),
        clearance - found.distance.double().cpu().numpy(),
    )


def _on_each_axis(matrix: csr_array) -> csr_array:
    """The matrix (N, N) applied to each of x, y, z of interleaved coordinates, shape (3 N, 3 N)."""
    n = matrix.shape[0]
    interleaved = np.arange(3 * n).reshape(n, 3).T.ravel()
    stacked = coo_array(block_diag((matrix, matrix, matrix)))
    return coo_array((stacked.data, (interleaved[stacked.row], interleaved[stacked.col])), shape=stacked.shape).tocsr()
