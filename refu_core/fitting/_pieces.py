"""The pieces of a mesh on a body: those that are no cloth, and those that nobody has sewn together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from refu_core.body import JOINT_NAMES
from refu_core.errors import GarmentError
from refu_core.fitting._clean import components, rim_of
from refu_core.fitting._mesh_file import SurfaceMesh
from refu_core.fitting._posed import PosedBody

F64 = NDArray[np.float64]

_ENDS = tuple(JOINT_NAMES.index(name) for name in ("head", "left_hand", "right_hand", "left_foot", "right_foot"))
_ON_SKIN = 0.02
"""Half of a body lies nearer than this to another one's skin [m]; of an overall with hood and gloves it doesn't."""
_SEAM = 0.01
"""Rims of two pieces that are nearer to each other than this were meant to be sewn [m]: panels are laid out so."""
_SHARE = 0.1
"""Of a piece's rim that has to be so near to another one's."""


def without_bodies(mesh: SurfaceMesh, posed: PosedBody) -> tuple[SurfaceMesh, list[str]]:
    """The mesh on a body, without pieces that are bodies themselves, and a note of each.

    Characters come in one file with their clothes. A piece is a body if it has a head, hands and feet and lies on the
    skin.

    Raises:
        GarmentError: nothing else is left.
    """
    n_pieces, label = components(mesh.faces, len(mesh.vertices))
    is_body = np.zeros(n_pieces, np.bool_)
    joint = posed.body.weights.argmax(1).numpy()[posed.body.faces[:, 0].numpy()]
    for piece in range(n_pieces):
        points = mesh.vertices[label == piece]
        face, _ = posed.closest(points)
        if np.isin(_ENDS, joint[face]).all():
            is_body[piece] = np.median(np.abs(posed(points)[0])) < _ON_SKIN
    if not is_body.any():
        return mesh, []
    kept = ~is_body[label[mesh.faces[:, 0]]]
    if not kept.any():
        msg = "it is a body with head, hands and feet, and no garment: wanted clothes (--body says who wears them)"
        raise GarmentError(msg)
    used, local = np.unique(mesh.faces[kept], return_inverse=True)
    uv = None if mesh.uv is None else replace(mesh.uv, faces=mesh.uv.faces[kept])
    note = "a piece with head, hands and feet was taken for the wearer's body and left out"
    return SurfaceMesh(mesh.vertices[used], local.reshape(-1, 3).astype(np.int64), uv), [note] * int(is_body.sum())


def unsewn(mesh: SurfaceMesh) -> list[str]:
    """A note of pieces whose rims lie along each other, for a mesh in metres."""
    _, label = components(mesh.faces, len(mesh.vertices))
    rim = rim_of(mesh.faces)
    gaps, pieces = [], set()
    for piece in np.unique(label[rim]):
        own, others = rim[label[rim] == piece], rim[label[rim] != piece]
        if len(others):
            gap = np.asarray(cKDTree(mesh.vertices[others]).query(mesh.vertices[own])[0])
            if (gap < _SEAM).mean() > _SHARE:
                pieces.add(int(piece))
                gaps.append(np.median(gap[gap < _SEAM]))
    if not pieces:
        return []
    return [
        f"{len(pieces)} pieces lie along each other, {1e3 * float(np.median(gaps)):.1f} mm apart, and aren't sewn: "
        "weld their seams, or simulated cloth comes apart there"
    ]
