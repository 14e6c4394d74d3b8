"""A posed body that custom kernels can query for distances, however its `MeshSdf` finds the closest face."""

import warp as wp

from refu_core.sdf._box_kernels import Boxes, closest_in_boxes, guess
from refu_core.sdf._closest_kernels import PosedMesh, distance_to_face, measured_to
from refu_core.sdf._walk_kernels import Guides, first_at, walk_from

_UNLIMITED = wp.constant(1e18)
# A known face's distance limits the search for the closest one; rounding must not exclude that face.
_SLACK = wp.constant(1e-6)


@wp.struct
class Skin:
    """One posed body: `MeshSdf.skin` gives it."""

    tree: wp.uint64
    """Warp's mesh, if the closest face is searched for in its tree; otherwise 0."""
    boxes: Boxes
    """The boxes, if it is searched for in these; otherwise without faces."""
    mesh: PosedMesh
    guides: Guides
    """The guides, if it is found by walking."""


@wp.func
def query_skin(skin: Skin, p: wp.vec3, near: int) -> tuple[float, wp.vec3, int]:
    """Signed distance at p [m], its unit gradient, and the closest face; `near` is a face near by, or -1."""
    face = int(near)
    if skin.boxes.order.shape[0] > 0:
        if near < 0:
            face = guess(p, skin.boxes)
        face = closest_in_boxes(p, face, skin.boxes, skin.mesh)
    elif skin.tree != wp.uint64(0):
        limit = float(_UNLIMITED)
        if near >= 0:
            known = distance_to_face(p, near, skin.mesh)
            limit = known * (1.0 + _SLACK) + _SLACK
        hit = wp.mesh_query_point_no_sign(skin.tree, p, limit)
        if hit.result:
            face = hit.face
    else:
        face, feature, _w, _above = walk_from(p, near, skin.mesh, skin.guides)
        face = first_at(face, feature, skin.mesh)
    distance, gradient = measured_to(p, face, skin.mesh)
    return distance, gradient, face


@wp.kernel(enable_backward=False)
def query_skin_kernel(
    skin: Skin,
    queries: wp.array[wp.vec3],
    near: wp.array[int],
    is_asked: wp.array[wp.bool],
    # outputs
    out_face: wp.array[int],
    out_distance: wp.array[float],
    out_gradient: wp.array[wp.vec3],
) -> None:
    """`query_skin` at the queries that are asked, or at all if `is_asked` is empty; `near` has a face for each."""
    i = wp.tid()
    if is_asked.shape[0] > 0 and not is_asked[i]:
        return
    distance, gradient, face = query_skin(skin, queries[i], near[i])
    out_face[i] = face
    out_distance[i] = distance
    out_gradient[i] = gradient
