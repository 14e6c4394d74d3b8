"""From a network's output, a code, to displacements of all vertices: densely as in the paper, or through a basis."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import warp as wp
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from torch import Tensor, nn
from torch.nn import functional

from refu_core._warp import Repeated, is_plain
from refu_core.backbones._decode_kernels import WIDTH, Steps, Strip, decode_kernel
from refu_core.errors import WeightsError
from refu_core.frames import N_STYLES
from refu_core.garments import GarmentTemplate
from refu_core.mesh import Connectivity, symmetric_solver
from refu_core.weights import in_steps

_HOLD = 100.0
"""How much more a control's own value weighs than the smoothness at a vertex."""
_NEVER_SINGULAR = 1e-9
"""Keeps the matrix from being singular: a piece of cloth without a control doesn't move."""


@dataclass(frozen=True, eq=False)
class Controls:
    """Vertices of a garment whose values determine those of all others, smoothly, as in a least-squares mesh.

    Sorkine and Cohen-Or (2004): each vertex is the mean of its neighbours, as far as the controls' values allow.
    """

    mesh: Connectivity
    """The garment's."""
    vertices: Tensor
    """Which of its vertices are controls, int32, shape (C,)."""

    @classmethod
    def of(cls, garment: GarmentTemplate, vertices: Tensor) -> Controls:
        """With these vertices (C,). Raises `WeightsError` unless they are vertices of the garment, each once."""
        numbers = vertices.tolist() if vertices.ndim == 1 and not vertices.is_floating_point() else []
        inside = bool(numbers) and 0 <= min(numbers) <= max(numbers) < garment.n_vertices
        if not inside or len(set(numbers)) < len(numbers):
            msg = f"wanted controls among the {garment.n_vertices} vertices of {garment.name}, each once, got "
            msg += f"{vertices.dtype} {tuple(vertices.shape)}: get the weights again"
            raise WeightsError(msg)
        return cls(garment.mesh, vertices.to(torch.int32))

    @classmethod
    def spread(cls, garment: GarmentTemplate, count: int) -> Controls:
        """`count` controls, each new one where it is farthest along the cloth from all before it."""
        points, (first, second) = garment.v_template.cpu().double().numpy(), garment.mesh.edges.T
        length = np.linalg.norm(points[first] - points[second], axis=1)
        graph = sparse.csr_array((length, (first, second)), (len(points), len(points)))
        chosen, way = [0], np.full(len(points), np.inf)
        while len(chosen) < min(count, len(points)):
            way = np.minimum(way, dijkstra(graph, directed=False, indices=[chosen[-1]])[0])
            chosen.append(int(way.argmax()))
        return cls(garment.mesh, torch.tensor(chosen, dtype=torch.int32))

    def __call__(self, values: Tensor) -> Tensor:
        """The field at all vertices, float32, shape (N, V, K), from its values at the controls (N, C, K)."""
        n_fields, n_controls, width = values.shape
        n, at = self.mesh.n_vertices, self.vertices.numpy()
        bend = self.mesh.uniform_laplacian()
        hold = np.full(n, _NEVER_SINGULAR)
        hold[at] += _HOLD
        known = np.zeros((n, n_fields * width))
        known[at] = _HOLD * values.detach().cpu().double().numpy().transpose(1, 0, 2).reshape(n_controls, -1)
        field = torch.from_numpy(symmetric_solver(bend.T @ bend + sparse.diags(hold))(known)).float()
        return field.view(n, n_fields, width).transpose(0, 1).contiguous()

    def matrix(self) -> Tensor:
        """The weight of each control at each vertex, shape (V, C)."""
        return self(torch.eye(len(self.vertices))[None])[0]


_A_FEW = 16
"""For more codes than this, a product of matrices is faster."""
_WHOLE = 32
"""Components in half precision; the others are bytes, which moves a garment by 0.06 mm on recorded motion, 0.5 mm at
most. With 16 it is 0.11 and 0.8 mm; with 64 it is 0.03 and 0.3 mm, but a garment's basis takes a third more."""


class DenseDecoder(nn.Module):
    """The code is the displacements themselves (preset `paper`)."""

    __call__: Callable[..., Tensor]

    def __init__(self, n_vertices: int) -> None:
        super().__init__()
        self.n_vertices = n_vertices
        self.size = 3 * n_vertices
        """Width of a code."""

    def forward(self, code: Tensor) -> Tensor:
        """Displacements [m], shape (B, V, 3), of codes (B, 3 V)."""
        return code.view(len(code), self.n_vertices, 3)

    def encode(self, displacement: Tensor) -> Tensor:
        """Codes, shape (B, 3 V), of displacements (B, V, 3) [m]."""
        return displacement.flatten(1)

    def directions(self, garment: GarmentTemplate) -> Tensor:
        """How a unit of each of (β, γ) changes the template, as codes [m], shape (14, 3 V)."""
        return _directions(garment)


class BasisDecoder(nn.Module):
    """The code is in an orthonormal basis of displacements (preset `realtime`): a head of R columns, not of 3 V.

    All networks of a garment share the basis. So it is stored once, and the product with it, which is most of a frame's
    cost, is computed once for the sum of all networks. The first components, which matter most, are stored in half
    precision, the others as whole numbers of steps, -127 to 127. Distances between codes are distances between
    garments: |code - code'|² = Σ_v |D_v - D'_v|², up to rounding.

    A basis made from few samples is smooth. It is stored at `controls`, in a hundredth of the bytes or less, and is
    expanded to all vertices when it is loaded.
    """

    __call__: Callable[..., Tensor]

    def __init__(self, mean: Tensor, components: Tensor, *, controls: Controls | None = None) -> None:
        """`mean` [m], shape (V, 3), and orthonormal rows `components`, shape (R, 3 V).

        With `controls` both are given at those, (C, 3) and (R, 3 C), and are orthonormal once expanded to all vertices.
        """
        super().__init__()
        if components.ndim != 2 or components.shape[1] != mean.numel():
            raise WeightsError(f"wanted a basis of (R, {mean.numel()}), got {tuple(components.shape)}: get them again")
        self.controls = controls
        self._at_controls = None
        if controls is not None:
            if len(mean) != len(controls.vertices):
                msg = f"wanted a basis at {len(controls.vertices)} controls, got one at {len(mean)}: get them again"
                raise WeightsError(msg)
            stored = _Stored.of(components.float())
            self._at_controls = {"mean": mean.half(), **stored.tensors()}
            both = torch.cat((mean.half().float().flatten()[None], stored.components()))
            mean, components = controls(both.view(len(both), -1, 3)).flatten(1).tensor_split((1,))
            mean = mean.view(-1, 3)
        self.n_vertices = len(mean)
        self.size = len(components)
        """Width R of a code."""
        # Computes with the numbers as they are stored; otherwise codes would change their meaning when saved.
        self.register_buffer("mean", mean.half().float().flatten())
        self.register_buffer("components", _Stored.of(components.float()).components())
        self.mean: Tensor
        self.components: Tensor
        self._strips: _Strips | None = None

    @classmethod
    def of_tensors(cls, tensors: Mapping[str, Tensor], garment: GarmentTemplate | None = None) -> BasisDecoder:
        """From what a basis file holds: the inverse of `tensors`. A basis at controls needs its `garment`.

        Raises `WeightsError` where something is missing, or parts don't fit each other or the garment.
        """
        if missing := [name for name in ("mean", "components") if name not in tensors]:
            raise WeightsError(f"has no {' and no '.join(missing)}: not an output basis")
        coarse, controls = tensors["components"].float(), None
        nothing = torch.zeros(0, *coarse.shape[1:], dtype=torch.int8)
        stored = _Stored(coarse, tensors.get("fine", nothing), tensors.get("steps", coarse.new_zeros(0)).float())
        if "controls" in tensors:
            if garment is None:
                raise WeightsError("is known at controls alone: say whose basis it is")
            controls = Controls.of(garment, tensors["controls"])
        return cls(tensors["mean"].float(), stored.components(), controls=controls)

    def forward(self, code: Tensor) -> Tensor:
        """Displacements [m], shape (B, V, 3), of codes (B, R)."""
        if len(code) <= _A_FEW and code.device.type == "cpu" and is_plain(code, self.components):
            if self._strips is None or not self._strips.is_of(self.components):
                self._strips = _Strips(self.mean, self.components)
            return self._strips(code)
        return torch.addmm(self.mean, code, self.components).view(len(code), self.n_vertices, 3)

    def encode(self, displacement: Tensor) -> Tensor:
        """Codes, shape (B, R), of the displacements nearest to `displacement` (B, V, 3) [m]."""
        return (displacement.flatten(1) - self.mean) @ self.components.T

    def directions(self, garment: GarmentTemplate) -> Tensor:
        """How a unit of each of (β, γ) changes the template, in coordinates isometric to vertices [m], (14, R + 14).

        The first R columns are in the basis, the others in an orthonormal basis of what lies outside of it.
        """
        whole = _directions(garment)
        inside = whole @ self.components.T
        outside = torch.linalg.qr((whole - inside @ self.components).T).R.T
        return torch.cat((inside, outside), 1)

    def is_stored_as(self, tensors: Mapping[str, Tensor]) -> bool:
        """Whether this is the basis of a file that holds `tensors`. Raises `WeightsError` as `of_tensors` does."""
        if "controls" not in tensors:
            return torch.equal(BasisDecoder.of_tensors(tensors).components, self.components.cpu())
        own = self.tensors()
        return own.keys() == tensors.keys() and all(torch.equal(own[name], tensors[name]) for name in own)

    def tensors(self) -> Mapping[str, Tensor]:
        """What a basis file holds."""
        if self.controls is not None and self._at_controls is not None:
            return self._at_controls | {"controls": self.controls.vertices}
        return {"mean": self.mean.view(-1, 3).half(), **_Stored.of(self.components).tensors()}


class _Stored(NamedTuple):
    """A basis as it is stored."""

    coarse: Tensor
    """The first components, rounded to half precision, shape (K, 3 V)."""
    fine: Tensor
    """The others in steps, int8, shape (R - K, 3 V)."""
    steps: Tensor
    """The size of a step of each of those, rounded to bfloat16, shape (R - K,)."""

    @classmethod
    def of(cls, components: Tensor) -> _Stored:
        """From components (R, 3 V). For components that were stored before, it gives what was stored, to the bit."""
        fine, steps = in_steps(components[_WHOLE:], 1)
        return cls(components[:_WHOLE].half().float(), fine, steps[:, 0])

    def components(self) -> Tensor:
        """Components as numbers, float32, shape (R, 3 V). Raises `WeightsError` for parts that don't fit each other."""
        sizes = (self.coarse.shape[1:], self.fine.shape[:1], self.fine.dtype)
        if self.coarse.ndim != 2 or sizes != (self.fine.shape[1:], self.steps.shape, torch.int8):
            shapes = ", ".join(str(tuple(part.shape)) for part in self)
            msg = f"wanted a basis of (K, 3 V), bytes (R - K, 3 V) and steps (R - K), got {shapes}: get them again"
            raise WeightsError(msg)
        return torch.cat((self.coarse, self.steps[:, None] * self.fine))

    def tensors(self) -> dict[str, Tensor]:
        """What a file holds of it."""
        fine = {"fine": self.fine, "steps": self.steps.bfloat16()} if len(self.fine) else {}
        return {"components": self.coarse.half(), **fine}


class _Strips:
    """A basis in strips of some columns, each contiguous in memory: for the codes of a few persons, on a CPU.

    The basis is then read once for all persons, and the product takes hardly longer than for one.
    """

    def __init__(self, mean: Tensor, components: Tensor) -> None:
        self._of, self._version = components, components._version
        self._n = components.shape[1]
        stored = _Stored.of(components)
        self._parts = _in_strips(stored.coarse), _in_strips(stored.fine), stored.steps, _in_strips(mean[None])[:, 0]

    def __call__(self, code: Tensor) -> Tensor:
        """Displacements, shape (B, V, 3), of codes (B, R)."""
        n_strips = len(self._parts[0])
        decoded = code.new_empty(len(code), n_strips, WIDTH)
        _decode((n_strips,), code.contiguous(), *self._parts, decoded)
        return decoded.view(len(code), n_strips * WIDTH)[:, : self._n].view(len(code), self._n // 3, 3)

    def is_of(self, components: Tensor) -> bool:
        """Whether these are the strips of `components`, as they are now."""
        return self._of is components and self._version == components._version


_decode = Repeated(decode_kernel, (wp.float32, Strip, Steps, wp.float32, Strip, Strip))


def _in_strips(rows: Tensor) -> Tensor:
    """Rows (N, C) as strips (S, N, WIDTH), the last one padded with zeros."""
    padded = functional.pad(rows, (0, -rows.shape[1] % WIDTH))
    return padded.view(len(rows), padded.shape[1] // WIDTH, WIDTH).transpose(0, 1).contiguous()


Decoder = DenseDecoder | BasisDecoder


def _directions(garment: GarmentTemplate) -> Tensor:
    shape, style = garment.shapedirs, garment.styledirs
    return torch.cat((shape, shape.new_zeros(len(shape), N_STYLES) if style is None else style), 1).T.contiguous()
