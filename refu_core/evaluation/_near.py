# mypy: ignore-errors
# (Warp reads a kernel's annotations as array types of its own; a type checker can't.)
"""Whether anything of a set of triangles lies within a distance."""

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)


@wp.kernel(enable_backward=False)
def near_kernel(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), distance: float, near: wp.array(dtype=wp.bool)):
    i = wp.tid()
    near[i] = wp.mesh_query_point_no_sign(mesh, points[i], distance).result
