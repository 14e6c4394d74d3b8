"""The optimisation post-process that the paper compares with, in NumPy and SciPy, for one garment."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array, eye_array, kron
from scipy.sparse.linalg import cg
from torch import Tensor

from refu_core.mesh import Connectivity
from refu_core.sdf import SdfSample

DRAPE_ROUNDS: tuple[tuple[float, float], ...] = ((4.0, 0.8), (2.0, 0.6), (1.0, 0.4))
"""(λ_s, λ_d) of each round of Guan et al. 2012."""
_CLEARANCE = 0.001  # [m]


class PostProcess:
    """Post-processes garments of one mesh by least squares; the mesh's Laplacian is built once."""

    def __init__(self, faces: Tensor | NDArray[np.int64], n_vertices: int) -> None:
        """For garments with these `faces`, shape (G, 3); raises `MeshError` for a face of a vertex that isn't there."""
        self._laplacian = Connectivity.of(faces, n_vertices).uniform_laplacian()  # x minus its neighbours' mean, (N, N)

    @torch.no_grad()
    def optimise(
        self, points: Tensor, ask: Callable[[Tensor], SdfSample], *, clearance: float = _CLEARANCE, reach: float = 0.0
    ) -> Tensor:
        """The optimisation of DRAPE (Guan et al. 2012), the paper's "Opt. Post-Process": garment vertices [m], (N, 3).

        Each round minimises p + λ_s s + λ_d d over the garment y, where ỹ is the result of the round before:
        p = Σ (nᵢᵀ(yᵢ - bᵢ) - ε)² over the vertices inside, bᵢ the closest point of the skin and nᵢ its normal;
        s = Σ |(yᵢ - ỹᵢ) - mean over neighbours of (y - ỹ)|²; d = Σ |yᵢ - ỹᵢ|². Pairs (i, bᵢ) are found anew each round.
        DRAPE doesn't specify ε, and takes the closest vertex for bᵢ; the closest point is better.

        Args:
            points: Garment vertices [m], shape (N, 3).
            ask: Gives the signed distance of such vertices to the body.
            clearance: ε, how far outside the body the vertices should end up [m].
            reach: Vertices nearer to the skin than this are also brought to `clearance` [m]. DRAPE's is 0: it moves
                only those inside, and edges between others may still cut through the body.
        """
        n = self._laplacian.shape[0]
        for smoothness, damping in DRAPE_ROUNDS:
            sample = ask(points)
            inside = torch.nonzero(sample.distance < reach)[:, 0]
            if not len(inside):
                break
            found = sample.rows(inside)
            normal, distance = (x.double().cpu().numpy() for x in (found.gradient, found.distance))
            # nᵀ(y - b) - ε = nᵀu - (ε - f) for the displacement u: one row for each vertex inside, three columns each.
            columns = 3 * inside.cpu().numpy()[:, None] + np.arange(3)
            rows = np.repeat(np.arange(len(inside)), 3)
            push = coo_array((normal.ravel(), (rows, columns.ravel())), shape=(len(inside), 3 * n)).tocsr()
            smooth = self._laplacian.T @ self._laplacian * smoothness + damping * eye_array(n)
            # Damping bounds the condition number by about 40: conjugate gradients converge without a factorisation.
            matrix, wanted = push.T @ push + kron(smooth, eye_array(3)), push.T @ (clearance - distance)
            solution, failed = cg(matrix, wanted, rtol=1e-8, maxiter=1000)
            assert not failed
            points = points + torch.from_numpy(solution.reshape(n, 3)).to(points)
        return points
