"""Who is next to whom in a mesh: held against trimesh, and against the definition."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

from refu_core import MeshError, load_garment
from refu_core._cache import remembered
from refu_core.mesh import Connectivity

BALL = trimesh.creation.icosphere(subdivisions=2)
SHORTS = trimesh.Trimesh(
    load_garment("short-pant-male").v_template.numpy(), load_garment("short-pant-male").faces.numpy(), process=False
)


@pytest.fixture(params=[BALL, SHORTS], ids=["closed", "open"])
def reference(request: pytest.FixtureRequest) -> trimesh.Trimesh:
    return request.param


def test_edges_and_boundary(reference: trimesh.Trimesh) -> None:
    mesh = Connectivity.of(reference.faces)
    assert mesh.n_vertices == len(reference.vertices)
    wanted = np.unique(reference.edges_sorted, axis=0)
    np.testing.assert_array_equal(mesh.edges, wanted)
    ends = np.sort(np.stack((reference.faces, np.roll(reference.faces, -1, axis=1)), axis=-1), axis=-1)
    np.testing.assert_array_equal(mesh.edges[mesh.edge_of_corner], ends)
    assert mesh.n_faces_of_edge.sum() == 3 * len(reference.faces)
    assert (len(mesh.boundary) == 0) == reference.is_watertight


def test_rings_and_fans(reference: trimesh.Trimesh) -> None:
    mesh = Connectivity.of(reference.faces)
    for vertex in range(0, mesh.n_vertices, 17):
        around, faces = (
            rows.items[rows.start[vertex] : rows.start[vertex + 1]].tolist() for rows in (mesh.ring, mesh.fan)
        )
        assert around == sorted(reference.vertex_neighbors[vertex])
        assert faces == np.flatnonzero((reference.faces == vertex).any(axis=1)).tolist()
    np.testing.assert_array_equal(np.bincount(mesh.ring.owner), np.diff(mesh.ring.start))
    # The Laplacian is zero where a field is constant.
    np.testing.assert_allclose(mesh.uniform_laplacian() @ np.ones(mesh.n_vertices), 0, atol=1e-12)


def test_vertices_that_no_face_has_are_alone() -> None:
    mesh = Connectivity.of([[0, 1, 2]], 5)
    assert np.diff(mesh.ring.start).tolist() == [2, 2, 2, 0, 0]
    assert np.diff(mesh.fan.start).tolist() == [1, 1, 1, 0, 0]


def test_faces_across_share_the_edge() -> None:
    mesh = Connectivity.of(BALL.faces)
    for corner in range(3):
        mine = np.stack((mesh.faces[:, corner], mesh.faces[:, (corner + 1) % 3]), axis=1)
        other = mesh.faces[mesh.across[:, corner]]
        assert ((other[:, :, None] == mine[:, None, :]).any(axis=1)).all()
        assert (mesh.across[:, corner] != np.arange(len(mesh.faces))).all()


@pytest.mark.parametrize(
    ("faces", "wanted"),
    [
        (BALL.faces[1:], "3 open edges, 0 edges of more than two faces and 0 edges whose"),
        (
            np.concatenate((BALL.faces[:1, ::-1], BALL.faces[1:])),
            "0 open edges, 0 edges .* and 3 edges whose two faces",
        ),
        (np.concatenate((BALL.faces, BALL.faces[:1])), "0 open edges, 3 edges of more than two faces"),
    ],
)
def test_what_isnt_closed_is_refused(faces: np.ndarray, wanted: str) -> None:
    with pytest.raises(MeshError, match=wanted):
        Connectivity.of(faces).require_closed()
    with pytest.raises(MeshError, match=wanted):
        _ = Connectivity.of(faces).across


def test_what_is_remembered_is_what_is_computed() -> None:
    """By content: arrays that have changed are other arguments, and a caller's array is the caller's."""
    calls = []

    @remembered(2)
    def doubled(values: Any, by: float = 2.0) -> Any:
        calls.append(by)
        return by * values

    values = np.arange(3.0)
    first = doubled(values)
    assert doubled(values.copy()) is first
    values[0] = 5.0
    np.testing.assert_array_equal(doubled(values), 2 * values)
    np.testing.assert_array_equal(doubled(values, by=3.0), 3 * values)  # the oldest is forgotten
    assert len(calls) == 3
    doubled(np.arange(3.0))
    assert len(calls) == 4
    faces = np.array([[0, 1, 2]], np.int32)
    mesh = Connectivity.of(faces, 3)
    faces[:] = [[2, 1, 0]]
    assert mesh.faces.tolist() == [[0, 1, 2]]
    assert Connectivity.of(faces, 3) is not mesh
    assert Connectivity.of(mesh.faces, 3) is mesh
