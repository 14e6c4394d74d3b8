"""The closest points of an open sheet, by a tree of all its triangles: what the search of `Layer` is held against."""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

FAR = wp.constant(10.0)  # [m]; no garment is farther from another one


def closest_on_sheet(
    points: NDArray[np.float32], vertices: NDArray[np.float32], faces: NDArray[np.integer]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The points of a sheet that are closest to `points` [m], both (N, 3), and how high the latter are above it, (N,).

    The sheet has `vertices` (V, 3) [m] and `faces` (F, 3), counter-clockwise seen from above. Height is along the
    normal of the closest face, and negative below.
    """
    with wp.ScopedDevice("cpu"):
        mesh = wp.Mesh(wp.array(vertices, dtype=wp.vec3), wp.array(faces.ravel(), dtype=wp.int32))
        closest, height = wp.empty(len(points), dtype=wp.vec3), wp.empty(len(points), dtype=wp.float32)
        wp.launch(closest_kernel, len(points), [mesh.id, wp.array(points, dtype=wp.vec3)], [closest, height])
    return closest.numpy(), height.numpy()


@wp.kernel(enable_backward=False)
def closest_kernel(
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    # outputs
    closest: wp.array[wp.vec3],
    height: wp.array[float],
) -> None:
    """The closest point of `mesh` to each point, and the point's height above its face."""
    i = wp.tid()
    found = wp.mesh_query_point_no_sign(mesh, points[i], FAR)
    closest[i] = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
    height[i] = wp.dot(points[i] - closest[i], wp.mesh_eval_face_normal(mesh, found.face))
