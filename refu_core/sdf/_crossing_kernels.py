"""Whether two triangles cut each other, in double precision: one code for CPU and CUDA."""

from typing import TYPE_CHECKING

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

# Contracted multiply-adds would round a x b and b x a differently, and open cracks between neighbouring triangles.
wp.set_module_options({"fuse_fp": False, "enable_backward": False})

BLOCK = wp.constant(8)
"""How many faces search for others together."""
if TYPE_CHECKING:
    Corners = wp.Matrix[float]
else:
    Corners = wp.types.matrix(shape=(8, 3), dtype=wp.float32)

FLOAT0 = wp.constant(wp.float64(0.0))
APART = wp.constant(wp.float64(1e-9))
"""A triangle on one side of another's plane by more than this [m] doesn't meet it, whatever is rounded: computed
heights are off by some 1e-15 m."""


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

    On which side of a triangle's edge the line passes is the sign of a volume. Traversing the edge the other way
    changes the sign and nothing else: a segment can't slip between two triangles that share an edge.
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
def is_beside(normal: wp.vec3d, origin: wp.vec3d, p: wp.vec3d, q: wp.vec3d, r: wp.vec3d) -> bool:
    """Whether triangle pqr is on one side of a plane for certain, as one is in most pairs whose boxes overlap."""
    least = APART * (wp.abs(normal[0]) + wp.abs(normal[1]) + wp.abs(normal[2]))
    height_p = wp.dot(normal, p - origin)
    height_q = wp.dot(normal, q - origin)
    height_r = wp.dot(normal, r - origin)
    lowest = wp.min(wp.min(height_p, height_q), height_r)
    highest = wp.max(wp.max(height_p, height_q), height_r)
    return lowest > least or highest + least < FLOAT0


@wp.func
def edge_pierces(i: int, j: int, a: wp.vec3d, b: wp.vec3d, p: wp.vec3d, q: wp.vec3d, r: wp.vec3d) -> bool:
    """`pierces` for the edge between vertices i and j, the same from both of the edge's faces."""
    if i < j:
        return pierces(a, b, p, q, r)
    return pierces(b, a, p, q, r)


@wp.func
def meeting_edges(
    triangle: wp.vec3i,
    a: wp.vec3d,
    b: wp.vec3d,
    c: wp.vec3d,
    other: wp.vec3i,
    p: wp.vec3d,
    q: wp.vec3d,
    r: wp.vec3d,
    share: bool,
) -> int:
    """Which edges of triangle abc pierce pqr (bits 0 to 2), and which of pqr pierce abc (bits 3 to 5).

    With `share` the vertex numbers are of one mesh: faces that share an edge aren't looked at.
    """
    if is_beside(wp.cross(b - a, c - a), a, p, q, r) or is_beside(wp.cross(q - p, r - p), p, a, b, c):
        return 0
    # Faces with a vertex in common meet there anyway, and only the edges that end elsewhere can tell more.
    tested = 63
    if share:
        s0 = shared_corner(triangle[0], other[0], other[1], other[2])
        s1 = shared_corner(triangle[1], other[0], other[1], other[2])
        s2 = shared_corner(triangle[2], other[0], other[1], other[2])
        n_shared = wp.where(s0 >= 0, 1, 0) + wp.where(s1 >= 0, 1, 0) + wp.where(s2 >= 0, 1, 0)
        if n_shared > 1:
            return 0
        if n_shared == 1:
            # Edge (k + 1) % 3 is opposite corner k.
            own = wp.where(s0 >= 0, 2, wp.where(s1 >= 0, 4, 1))
            corner = wp.max(s0, wp.max(s1, s2))
            tested = own + wp.where(corner == 0, 16, wp.where(corner == 1, 32, 8))
    edges = wp.where(edge_pierces(triangle[0], triangle[1], a, b, p, q, r), 1, 0)
    edges += wp.where(edge_pierces(triangle[1], triangle[2], b, c, p, q, r), 2, 0)
    edges += wp.where(edge_pierces(triangle[2], triangle[0], c, a, p, q, r), 4, 0)
    edges += wp.where(edge_pierces(other[0], other[1], p, q, a, b, c), 8, 0)
    edges += wp.where(edge_pierces(other[1], other[2], q, r, a, b, c), 16, 0)
    edges += wp.where(edge_pierces(other[2], other[0], r, p, a, b, c), 32, 0)
    return edges & tested
