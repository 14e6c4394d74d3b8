"""Which points a self-contact of the body concerns."""

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

FAR = wp.constant(1.0)  # [m]; no point within a body is further from its surface


@wp.kernel(enable_backward=False)
def self_contact_kernel(
    contact: wp.uint64,
    body: wp.uint64,
    in_contact: wp.array[wp.bool],
    points: wp.array[wp.vec3],
    distance: float,
    near: wp.array[wp.bool],
) -> None:
    """Points within `distance` of the mesh `contact`, and those inside the body whose closest face is `in_contact`."""
    i = wp.tid()
    p = points[i]
    if wp.mesh_query_point_no_sign(contact, p, distance).result:
        near[i] = True
        return
    hit = wp.mesh_query_point_no_sign(body, p, FAR)
    if hit.result and in_contact[hit.face]:
        near[i] = wp.mesh_query_point_sign_winding_number(body, p, FAR).sign < 0.0
