"""Which place of a garment each measured point belongs to."""

import warp as wp


@wp.kernel(enable_backward=False)
def match_kernel(
    points: wp.array[wp.vec3],
    cloth: wp.uint64,
    skin: wp.uint64,
    others: wp.array[wp.uint64],
    rim: wp.array[wp.int32],
    reach: float,
    slack: float,
    has_eye: bool,
    eye: wp.vec3,
    # output
    face: wp.array[wp.int32],
    weight: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    height: wp.array[float],
) -> None:
    """The closest place of the cloth within `reach`; the face is -1 for a point that isn't the cloth's.

    Such a point is nearer to one of the `others`, is nearer by more than `slack` to skin that isn't below the cloth, as
    that of a hand in front of it, is beyond a rim, or is closest to a face that faces away from the camera. Skin below
    the cloth can't be seen: without its points, noise would be taken for cloth that lies farther out.
    """
    i = wp.tid()
    p = points[i]
    face[i] = -1
    query = wp.mesh_query_point_no_sign(cloth, p, reach)
    if not query.result:
        return
    w = 1.0 - query.u - query.v
    place = wp.mesh_eval_position(cloth, query.face, query.u, query.v)
    n = wp.mesh_eval_face_normal(cloth, query.face)
    way = p - place
    if has_eye and wp.dot(n, eye - place) <= 0.0:
        return
    edges = rim[query.face]  # bit k: the edge from corner k to the next is on the boundary
    if (
        ((edges & 1) != 0 and w < 1.0e-4)
        or ((edges & 2) != 0 and query.u < 1.0e-4)
        or ((edges & 4) != 0 and query.v < 1.0e-4)
    ):
        return
    for k in range(others.shape[0]):
        other = wp.mesh_query_point_no_sign(others[k], p, wp.length(way))
        if other.result:
            return
    nearer = wp.length(way) - slack
    if nearer > 0.0:
        below = wp.mesh_query_point_no_sign(skin, p, nearer)
        if below.result:
            on_skin = wp.mesh_eval_position(skin, below.face, below.u, below.v)
            if wp.dot(on_skin - place, n) > 0.0:
                return
    face[i] = query.face
    weight[i] = wp.vec3(query.u, query.v, w)
    normal[i] = n
    height[i] = wp.dot(n, way)
