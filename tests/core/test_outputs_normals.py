"""Normals in one pass after another are those of the slow, obvious sum."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from refu_core import MeshError, load_garment
from refu_core.mesh import vertex_normals
from refu_core.outputs._dressed import VertexNormals


@given(st.integers(4, 40), st.integers(1, 80), st.integers(0, 10**6))
def test_random_meshes(n: int, f: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    faces = np.array([rng.choice(n, 3, replace=False) for _ in range(f)], np.int32)
    normals = VertexNormals(faces, n)
    for _ in range(2):  # nothing of one frame is left in the next
        vertices = rng.normal(size=(n, 3)).astype(np.float32)
        found, wanted = normals(vertices), vertex_normals(vertices.astype(np.float64), faces)
        lengths = np.linalg.norm(found, axis=1)
        assert (np.isclose(lengths, 1, atol=1e-5) | (lengths == 0)).all()
        # What the sum's terms cancel to is rounded, and nothing else.
        spread = np.zeros(n)
        a, b, c = vertices[faces].transpose(1, 0, 2)
        np.add.at(spread, faces, np.linalg.norm(np.cross(b - a, c - a), axis=1)[:, None])
        total = np.zeros((n, 3))
        np.add.at(total, faces, np.cross(b - a, c - a).astype(np.float64)[:, None])
        clear = np.linalg.norm(total, axis=1) > 1e-2 * np.maximum(spread, 1e-9)
        np.testing.assert_allclose(found[clear], wanted[clear], atol=1e-3)


def test_a_garment() -> None:
    garment = load_garment("tshirt-male")
    vertices, faces = garment.v_template.numpy(), garment.faces.numpy()
    normals = VertexNormals(faces, len(vertices))
    np.testing.assert_allclose(normals(vertices), vertex_normals(vertices, faces), atol=1e-5)
    assert not np.shares_memory(normals(vertices), normals(vertices))
    with pytest.raises(MeshError, match="shape"):
        normals(vertices[:-1])
    with pytest.raises(MeshError, match="faces"):
        VertexNormals(faces, 10)
