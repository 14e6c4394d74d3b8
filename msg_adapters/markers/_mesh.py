"""What of a marker stays the same from frame to frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.errors import EncodeError

Rgba = tuple[float, float, float, float]
CLOTH: Rgba = (0.55, 0.63, 0.75, 1.0)
SKIN: Rgba = (0.80, 0.67, 0.58, 1.0)


def numbers(what: str, values: Any) -> NDArray[Any]:
    """Real numbers as an array; raises `EncodeError` for anything else."""
    try:
        array = np.asarray(values)
    except (ValueError, TypeError, OverflowError) as error:
        msg = f"{what}: wanted an array of numbers, got {type(values).__name__}: {error}"
        raise EncodeError(msg) from None
    if array.dtype.kind not in "iuf":
        msg = f"{what}: wanted an array of numbers, got {array.dtype} of shape {array.shape}"
        raise EncodeError(msg)
    return array


def garment_namespace(garment: str, person: str = "") -> str:
    """Namespace of a garment's marker: `<person>/<garment>`, or the garment's name where there is one person."""
    return f"{person}/{garment}" if person else garment


@dataclass(frozen=True, eq=False)
class MarkerMesh:
    """Topology, name and colour of one marker.

    Raises `EncodeError` when faces or colour can't be drawn: viewers drop such a marker without a word.
    """

    ns: str
    """Namespace; with `id` it names the marker."""
    faces: NDArray[np.integer[Any]]
    """Vertex indices of the triangles, shape (F, 3), F > 0."""
    n_vertices: int
    """Number of vertices each frame will bring."""
    color: Rgba = CLOTH
    """Red, green, blue, alpha in [0, 1]."""
    id: int = 0
    vertex_colors: bool = False
    """Whether frames bring a colour for each vertex (RViz draws those without shading)."""

    def __post_init__(self) -> None:
        faces = numbers(f"{self.ns}: faces", self.faces)
        if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces) or not np.issubdtype(faces.dtype, np.integer):
            msg = f"{self.ns}: wanted faces of shape (F, 3) of integers, F > 0, got {faces.shape} of {faces.dtype}"
            raise EncodeError(msg)
        if faces.min() < 0 or faces.max() >= self.n_vertices:
            msg = f"{self.ns}: wanted face indices in [0, {self.n_vertices}), got {faces.min()} ... {faces.max()}"
            raise EncodeError(msg)
        color = numbers(f"{self.ns}: colour", self.color).astype(np.float64)
        if color.shape != (4,) or not ((color >= 0) & (color <= 1)).all():
            msg = f"{self.ns}: wanted a colour of 4 numbers in [0, 1] (red, green, blue, alpha), got {self.color}"
            raise EncodeError(msg)
        object.__setattr__(self, "faces", faces)
