"""Mesh convolutions whose coefficients vary from vertex to vertex (Zhou et al. 2020; paper, supplement, "GCNN")."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor, nn
from torch.nn import functional

from refu_core.backbones._features import N_STYLE_SHAPE, PoseFeatures, style_shape
from refu_core.backbones._perceptron import Perceptron
from refu_core.backbones._protocol import WithoutWearerCode
from refu_core.errors import WeightsError
from refu_core.garments import GarmentTemplate
from refu_core.mesh import Connectivity

_MOST_STRIDE, _MOST_LEVELS = 8, 8


@dataclass(frozen=True)
class GcnnConfig:
    """Sizes of the network; the defaults, the preset `realtime`, are what a CPU trains in minutes."""

    joints: tuple[int, ...]
    encoding: str = "matrix"
    hidden: tuple[int, ...] = (256, 256)
    """Hidden layers of the perceptron before the mesh."""
    channels: tuple[int, ...] = (9, 32, 16, 16)
    """Those of the coarsest graph first; every layer goes up a level, and the last one ends with three channels."""
    bases: int = 8
    """M, the number of shared weight matrices that a vertex' own coefficients mix."""
    residual: float = 0.5
    """r, the share of the residual path."""
    stride: int = 2
    activation: str = "silu"
    dropout: float = 0.1

    def __post_init__(self) -> None:
        """Raises `WeightsError` for graphs that would take for ever to make."""
        if not 1 <= self.stride <= _MOST_STRIDE or not 1 <= len(self.channels) <= _MOST_LEVELS:
            wanted = f"strides to {_MOST_STRIDE}, {_MOST_LEVELS} channels at most"
            raise WeightsError(f"wanted {wanted}, got {self.stride}, {self.channels}")

    @classmethod
    def paper(cls, joints: tuple[int, ...]) -> GcnnConfig:
        """The decoder half of the original's `10_conv_res`."""
        return cls(joints, "rotvec", (1024, 1024), (9, 128, 64, 32), bases=17, activation="relu", dropout=0.2)


@dataclass(frozen=True, eq=False)
class Neighbours:
    """For each vertex of one graph, some vertices of another one or of the same."""

    index: NDArray[np.int64]
    """Shape (V_out, n); where there are fewer than n, the last one is repeated, and not valid."""
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


def sampled(mesh: Connectivity, *, levels: int, stride: int = 2) -> tuple[list[int], list[Neighbours]]:
    """A mesh's vertex graph, sampled `levels` times, finest first.

    Returns how many vertices each of the levels + 1 graphs has, and from each graph to the next finer one the coarse
    vertices that each fine one depends on.
    """
    links = mesh.adjacency_matrix()
    sizes, ups = [mesh.n_vertices], []
    for _ in range(levels):
        kept = _sample(links, stride)
        # A fine vertex is within stride - 1 links of a kept one; one more link blends between several.
        ups.append(Neighbours.of(_within(links, stride)[:, kept]))
        # Kept vertices that cover neighbouring vertices are neighbours.
        links = _within(links, 2 * stride - 1)[kept][:, kept]
        sizes.append(len(kept))
    return sizes, ups


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


class UpConv(nn.Module):
    """vcConv from a coarse graph to a finer one: y_i = Σ_{j ∈ N(i)} (Σ_m α_ijm B_m) x_j + b, with a residual path.

    The residual is vdUnpool, Σ_j |ρ_ij| x_j / Σ_j |ρ_ij|, and the sum y = √(1 - r) conv + √r residual.
    """

    def __init__(self, up: Neighbours, inputs: int, outputs: int, *, bases: int, residual: float) -> None:
        super().__init__()
        self.residual = residual
        n_out, n = up.index.shape
        self.register_buffer("index", torch.as_tensor(up.index), persistent=False)
        self.register_buffer("valid", torch.as_tensor(up.valid, dtype=torch.float32), persistent=False)
        self.index: Tensor
        self.valid: Tensor
        self.coefficients = nn.Parameter(torch.randn(n_out, n, bases) / (up.mean_count * bases))
        self.basis = nn.Parameter(torch.empty(bases, inputs, outputs))
        nn.init.normal_(self.basis, std=math.sqrt(up.mean_count * bases / inputs))  # keeps the size of the signal
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.density = nn.Parameter(torch.ones(n_out, n))
        self.across = nn.Linear(inputs, outputs, bias=False) if inputs != outputs else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Shape (V_coarse, B, I) -> (V_fine, B, O): what a neighbour hands over is contiguous in memory."""
        n_out, n = self.index.shape
        bases, inputs, outputs = self.basis.shape
        batch = x.shape[1]
        alpha = self.coefficients * self.valid[..., None]  # (V_fine, n, M)
        if outputs < inputs:  # the smaller array is the one that is gathered
            mixed = torch.einsum("vbi,mio->vmbo", x, self.basis).flatten(2)[self.index]  # (V_fine, n, M, B O)
            conv = torch.bmm(alpha.view(n_out, 1, -1), mixed.view(n_out, n * bases, -1)).view(n_out, batch, outputs)
        else:
            gathered = torch.bmm(alpha.transpose(1, 2), x.flatten(1)[self.index])  # (V_fine, M, B I)
            conv = torch.einsum("vmbi,mio->vbo", gathered.view(n_out, bases, batch, inputs), self.basis)
        rho = self.density.abs() * self.valid
        rho = rho / rho.sum(1, keepdim=True).clamp_min(1e-6)
        passed = torch.bmm(rho[:, None], self.across(x).flatten(1)[self.index]).view(n_out, batch, outputs)
        return math.sqrt(1 - self.residual) * (conv + self.bias) + math.sqrt(self.residual) * passed


class Gcnn(WithoutWearerCode, nn.Module):
    """A mesh decoder conditioned on (θ, β, γ).

    The original is an autoencoder of meshes, but at run time there is no mesh to encode. How (θ, β, γ) enter is this
    project's choice: a perceptron fills the latent of the coarsest graph.
    """

    def __init__(self, config: GcnnConfig, garment: GarmentTemplate) -> None:
        super().__init__()
        self.config = config
        self.n_vertices = garment.n_vertices
        sizes, ups = sampled(garment.mesh, levels=len(config.channels), stride=config.stride)
        self.features = PoseFeatures(config.joints, config.encoding)
        n, m = self.features.size + N_STYLE_SHAPE, sizes[-1] * config.channels[0]
        self.head = Perceptron(n, config.hidden, m, activation=config.activation, dropout=config.dropout)
        ends = (*config.channels[1:], 3)
        self.layers = nn.ModuleList(
            UpConv(up, a, b, bases=config.bases, residual=config.residual)
            for up, a, b in zip(reversed(ups), config.channels, ends, strict=True)
        )
        self.register_buffer("mean", torch.zeros(garment.n_vertices, 3))
        self.register_buffer("scale", torch.tensor(0.02))
        self.mean: Tensor
        self.scale: Tensor

    def forward(
        self, betas: Tensor, pose: Tensor, style: Tensor | None, *, wearer_code: Tensor | None = None
    ) -> Tensor:
        """Predicts for betas (B, 10), pose (B, 24, 3) [rad] and style (B, 4)."""
        del wearer_code  # there is none
        z = self.head(torch.cat((self.features(pose), style_shape(betas, style)), 1))
        x = z.view(len(z), -1, self.config.channels[0]).transpose(0, 1)
        for layer in self.layers[:-1]:
            x = functional.elu(layer(x))
        displacement: Tensor = self.mean + self.scale * self.layers[-1](x).transpose(0, 1)
        return displacement
