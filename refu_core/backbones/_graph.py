"""Coarser and coarser vertex graphs of a mesh, for convolutions on it (Zhou et al. 2020)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from refu_core.mesh import Connectivity


@dataclass(frozen=True, eq=False)
class Neighbours:
    """For each vertex of one graph, some vertices of another one or of the same."""

    index: NDArray[np.int64]
    """Shape (V_out, n); where there are fewer than n, the last ones are repeated and not valid."""
    valid: NDArray[np.bool_]
    """Shape (V_out, n)."""

    @property
    def mean_count(self) -> float:
        """Mean number of neighbours."""
        return float(self.valid.sum(1).mean())

    @staticmethod
    def of(links: sparse.csr_array) -> Neighbours:
        """The non-zero columns of each row of `links`, (V_out, V_in); every row needs one."""
        count = np.diff(links.indptr)
        slots = np.minimum(np.arange(count.max())[None], count[:, None] - 1)
        index = links.indices[links.indptr[:-1, None] + slots].astype(np.int64)
        return Neighbours(index, np.arange(count.max())[None] < count[:, None])


@dataclass(frozen=True, eq=False)
class MeshGraph:
    """A mesh's vertices and what is left of them after each sampling, finest first."""

    sizes: tuple[int, ...]
    """Vertices of each of the L + 1 levels."""
    ups: tuple[Neighbours, ...]
    """From level l + 1 to level l: the coarse vertices that a fine one hears, shape (V_l, n)."""

    @staticmethod
    def of(mesh: Connectivity, *, levels: int, stride: int = 2) -> MeshGraph:
        """Samples the vertex graph of a mesh `levels` times."""
        links = mesh.adjacency_matrix()
        sizes, ups = [mesh.n_vertices], []
        for _ in range(levels):
            kept = _sample(links, stride)
            # A fine vertex is within stride - 1 links of a kept one; one more link blends between several.
            ups.append(Neighbours.of(_within(links, stride)[:, kept]))
            # Kept vertices that cover neighbouring vertices are neighbours.
            links = _within(links, 2 * stride - 1)[kept][:, kept]
            sizes.append(len(kept))
        return MeshGraph(tuple(sizes), tuple(ups))


def _sample(links: sparse.csr_array, stride: int) -> NDArray[np.int64]:
    """Greedily kept vertices: every vertex is fewer than `stride` links from one of them, and no two are that close."""
    near = _within(links, stride - 1)
    covered = np.zeros(links.shape[0], bool)
    kept = []
    for vertex in range(len(covered)):
        if not covered[vertex]:
            kept.append(vertex)
            covered[near.indices[near.indptr[vertex] : near.indptr[vertex + 1]]] = True
    return np.array(kept, np.int64)


def _within(links: sparse.csr_array, hops: int) -> sparse.csr_array:
    """Pairs of vertices at most `hops` links apart, each with itself."""
    step = _binary(links + sparse.eye_array(links.shape[0], format="csr"))
    reach = step
    for _ in range(hops - 1):
        reach = _binary(reach @ step)
    return reach


def _binary(links: sparse.csr_array) -> sparse.csr_array:
    links = sparse.csr_array(links)
    links.sum_duplicates()
    links.sort_indices()
    links.data = np.ones_like(links.data)
    return links
