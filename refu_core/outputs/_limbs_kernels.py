"""Which two parts of a body a vertex of cloth is pressed between."""

import warp as wp


@wp.struct
class Parts:
    """A posed body in parts, each a mesh of its own; P parts."""

    mesh: wp.array[wp.uint64]
    start: wp.array[wp.int32]
    corner: wp.array[wp.int32]
    """The vertices of part k's faces are `corner[start[k]:start[k + 1]]`, three a face."""
    low: wp.array[wp.vec3]
    high: wp.array[wp.vec3]
    """Corners of each part's box [m]."""
    shift: wp.array[wp.vec3]
    """How far each vertex of the body has left the skin [m]."""


@wp.struct
class Beside:
    """The part that is nearest to a point."""

    part: wp.int32
    """-1 for none."""
    distance: wp.float32
    normal: wp.vec3
    gave: wp.float32
    """How far its skin has given way there, inwards [m]."""


@wp.func
def to_box(p: wp.vec3, parts: Parts, k: int) -> float:
    """The distance from a point to a part's box [m]."""
    return wp.length(wp.max(wp.max(parts.low[k] - p, p - parts.high[k]), wp.vec3()))


@wp.func
def beside(p: wp.vec3, parts: Parts, within: float, other: int, facing: wp.vec3, opposed: float) -> Beside:
    """The nearest part except `other` whose skin there faces against `facing`; the nearest of all if `other` is -1."""
    found = Beside()
    found.part = -1
    found.distance = within
    for k in range(parts.mesh.shape[0]):
        if k != other and to_box(p, parts, k) < found.distance:
            query = wp.mesh_query_point_no_sign(parts.mesh[k], p, found.distance)
            if query.result:
                normal = wp.mesh_eval_face_normal(parts.mesh[k], query.face)
                distance = wp.length(p - wp.mesh_eval_position(parts.mesh[k], query.face, query.u, query.v))
                if distance < found.distance and (other < 0 or wp.dot(normal, facing) < opposed):
                    i = parts.start[k] + 3 * query.face
                    shift = query.u * parts.shift[parts.corner[i]] + query.v * parts.shift[parts.corner[i + 1]]
                    shift += (1.0 - query.u - query.v) * parts.shift[parts.corner[i + 2]]
                    found.part = k
                    found.distance = distance
                    found.normal = normal
                    found.gave = wp.max(-wp.dot(shift, normal), 0.0)
    return found


@wp.kernel(enable_backward=False)
def pressed_kernel(
    points: wp.array[wp.vec3],
    parts: Parts,
    within: float,
    opposed: float,
    # output
    pair: wp.array[wp.int32],
    depth: wp.array[float],
) -> None:
    """The pair of parts, lower times P plus higher, whose skins face each other on both sides of a vertex; -1 for none.

    The distances to both add up to less than `within`. `depth` is how far the two overlapped before they were parted.
    """
    i = wp.tid()
    p = points[i]
    pair[i] = -1
    depth[i] = 0.0
    nearest, next_ = float(within), float(within)
    for k in range(parts.mesh.shape[0]):
        d = to_box(p, parts, k)
        if d < nearest:
            next_ = nearest
            nearest = d
        elif d < next_:
            next_ = d
    if nearest + next_ >= within:  # no two parts are near enough
        return
    first = beside(p, parts, within, -1, wp.vec3(), opposed)
    if first.part < 0:
        return
    second = beside(p, parts, within - first.distance, first.part, first.normal, opposed)
    if second.part >= 0:
        pair[i] = wp.min(first.part, second.part) * parts.mesh.shape[0] + wp.max(first.part, second.part)
        # They overlapped by as much as they gave way, less the room that is between them now.
        depth[i] = wp.max(first.gave + second.gave - first.distance - second.distance, 0.0)
