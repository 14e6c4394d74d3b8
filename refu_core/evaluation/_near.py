# mypy: ignore-errors
# (Warp reads a kernel's annotations as array types of its own; a type checker can't.)
"""Which points a self-contact of the body concerns."""

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

FAR = wp.constant(1.0)  # [m]; no point within a body is further from its surface


@wp.kernel(enable_backward=False)
def near_kernel(
    contact: wp.uint64,
    body: wp.uint64,
    in_contact: wp.array(dtype=wp.bool),
    points: wp.array(dtype=wp.vec3),
    distance: float,
    near: wp.array(dtype=wp.bool),
):
    """Points within `distance` of the mesh `contact`, and those inside the body whose closest face is `in_contact`."""
    i = wp.tid()
    p = points[i]
    if wp.mesh_query_point_no_sign(contact, p, distance).result:
        near[i] = True
        return
    hit = wp.mesh_query_point_no_sign(body, p, FAR)
    if hit.result and in_contact[hit.face]:
        near[i] = wp.mesh_query_point_sign_winding_number(body, p, FAR).sign < 0.0
