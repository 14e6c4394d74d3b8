"""Triangle-triangle intersections in double precision, candidates from a BVH."""

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

# Contracted multiply-adds would round a x b and b x a differently, and open cracks between neighbouring triangles.
wp.set_module_options({"fuse_fp": False, "enable_backward": False})

FLOAT0 = wp.constant(wp.float64(0.0))


@wp.func
def double(v: wp.vec3) -> wp.vec3d:
    return wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))


@wp.func
def shared_corner(i: int, j0: int, j1: int, j2: int) -> int:
    """Which of a face's corners j0, j1, j2 is vertex i, -1 if none is."""
    return wp.where(i == j0, 0, wp.where(i == j1, 1, wp.where(i == j2, 2, -1)))


@wp.func
def pierces(a: wp.vec3d, b: wp.vec3d, p: wp.vec3d, q: wp.vec3d, r: wp.vec3d) -> bool:
    """Whether segment ab meets triangle pqr; touching counts, lying in its plane doesn't.

    The line's side of each of the triangle's edges is the sign of a volume that changes its sign, and nothing else,
    when the edge is traversed the other way: a segment can't slip between two triangles that share an edge.
    """
    normal = wp.cross(q - p, r - p)
    height_a = wp.dot(normal, a - p)
    height_b = wp.dot(normal, b - p)
    if height_a == height_b or (height_a > FLOAT0 and height_b > FLOAT0) or (height_a < FLOAT0 and height_b < FLOAT0):
        return False
    d = b - a
    side_pq = wp.dot(d, wp.cross(p - a, q - a))
    side_qr = wp.dot(d, wp.cross(q - a, r - a))
    side_rp = wp.dot(d, wp.cross(r - a, p - a))
    return (side_pq >= FLOAT0 and side_qr >= FLOAT0 and side_rp >= FLOAT0) or (
        side_pq <= FLOAT0 and side_qr <= FLOAT0 and side_rp <= FLOAT0
    )


@wp.func
def edge_pierces(i: int, j: int, a: wp.vec3d, b: wp.vec3d, p: wp.vec3d, q: wp.vec3d, r: wp.vec3d) -> bool:
    """`pierces` for the edge between vertices i and j, the same from both of the edge's faces."""
    if i < j:
        return pierces(a, b, p, q, r)
    return pierces(b, a, p, q, r)


@wp.kernel
def intersect_kernel(
    body: wp.uint64,
    vertices: wp.array[wp.vec3],
    faces: wp.array2d[int],
    is_body: bool,
    # outputs
    count: wp.array[int],
    pairs: wp.array[wp.vec3i],
) -> None:
    """Appends (face, body face, edges) for each face that meets a body face; counts on beyond the room in `pairs`.

    Bits 0 to 2 of `edges`: the face's edges that pierce the body face; bits 3 to 5: the body face's that pierce the
    face. With `is_body` the faces are the body's own: each pair once, none of two that share an edge.
    """
    i = wp.tid()
    i0 = faces[i, 0]
    i1 = faces[i, 1]
    i2 = faces[i, 2]
    lower = wp.min(wp.min(vertices[i0], vertices[i1]), vertices[i2])
    upper = wp.max(wp.max(vertices[i0], vertices[i1]), vertices[i2])
    a = double(vertices[i0])
    b = double(vertices[i1])
    c = double(vertices[i2])
    query = wp.mesh_query_aabb(body, lower, upper)
    j = int(0)
    while wp.mesh_query_aabb_next(query, j):
        j0 = wp.mesh_get_index(body, 3 * j)
        j1 = wp.mesh_get_index(body, 3 * j + 1)
        j2 = wp.mesh_get_index(body, 3 * j + 2)
        # Faces with a vertex in common meet there anyway, and only the edges that end elsewhere can tell more.
        tested = 63
        if is_body:
            if j <= i:
                continue
            s0 = shared_corner(i0, j0, j1, j2)
            s1 = shared_corner(i1, j0, j1, j2)
            s2 = shared_corner(i2, j0, j1, j2)
            n_shared = wp.where(s0 >= 0, 1, 0) + wp.where(s1 >= 0, 1, 0) + wp.where(s2 >= 0, 1, 0)
            if n_shared > 1:
                continue
            if n_shared == 1:
                # Opposite corner k lies edge (k + 1) % 3.
                own = wp.where(s0 >= 0, 2, wp.where(s1 >= 0, 4, 1))
                other = wp.max(s0, wp.max(s1, s2))
                tested = own + wp.where(other == 0, 16, wp.where(other == 1, 32, 8))
        p = double(wp.mesh_get_point(body, 3 * j))
        q = double(wp.mesh_get_point(body, 3 * j + 1))
        r = double(wp.mesh_get_point(body, 3 * j + 2))
        edges = wp.where(edge_pierces(i0, i1, a, b, p, q, r), 1, 0)
        edges += wp.where(edge_pierces(i1, i2, b, c, p, q, r), 2, 0)
        edges += wp.where(edge_pierces(i2, i0, c, a, p, q, r), 4, 0)
        edges += wp.where(edge_pierces(j0, j1, p, q, a, b, c), 8, 0)
        edges += wp.where(edge_pierces(j1, j2, q, r, a, b, c), 16, 0)
        edges += wp.where(edge_pierces(j2, j0, r, p, a, b, c), 32, 0)
        edges = edges & tested
        if edges > 0:
            slot = wp.atomic_add(count, 0, 1)
            if slot < pairs.shape[0]:
                pairs[slot] = wp.vec3i(i, j, edges)
