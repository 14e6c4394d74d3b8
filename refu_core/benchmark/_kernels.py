# mypy: ignore-errors
# (Warp reads a kernel's annotations as array types of its own; a type checker can't.)
"""Warp's own signed distance query, as its documentation has it."""

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)


@wp.kernel(enable_backward=False)
def plain_kernel(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
    gradient: wp.array(dtype=wp.vec3),
):
    """Distance [m] and its gradient at each of `points` [m], the sign by the pseudo-normal."""
    i = wp.tid()
    hit = wp.mesh_query_point_sign_normal(mesh, points[i], 10.0)
    offset = points[i] - wp.mesh_eval_position(mesh, hit.face, hit.u, hit.v)
    distance[i] = hit.sign * wp.length(offset)
    gradient[i] = hit.sign * wp.normalize(offset)
