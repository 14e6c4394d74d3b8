"""Draws triangles into a depth buffer, and compares vertices with it: the same code for CPU and CUDA."""

import warp as wp

MICRO = wp.constant(1.0e6)  # depths are kept as whole micrometres: 2 km fit beside a triangle's number
FAR = wp.constant(wp.int64(9223372036854775807))


@wp.func
def edge(a: wp.vec2, b: wp.vec2, x: float, y: float) -> float:
    """Twice the signed area of the triangle of two corners, a and b, and the point (x, y)."""
    return (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])


@wp.kernel(enable_backward=False)
def raster_kernel(
    seen: wp.array[wp.vec3],
    faces: wp.array2d[wp.int32],
    near: float,
    # output
    buffer: wp.array2d[wp.int64],
) -> None:
    """The nearest triangle and its depth at the middle of each pixel; vertices are column, row and depth [m]."""
    f = wp.tid()
    a, b, c = seen[faces[f, 0]], seen[faces[f, 1]], seen[faces[f, 2]]
    if wp.min(a[2], wp.min(b[2], c[2])) < near:
        return
    height, width = buffer.shape[0], buffer.shape[1]
    left = wp.max(int(wp.ceil(wp.min(a[0], wp.min(b[0], c[0])) - 0.5)), 0)
    right = wp.min(int(wp.floor(wp.max(a[0], wp.max(b[0], c[0])) - 0.5)), width - 1)
    top = wp.max(int(wp.ceil(wp.min(a[1], wp.min(b[1], c[1])) - 0.5)), 0)
    bottom = wp.min(int(wp.floor(wp.max(a[1], wp.max(b[1], c[1])) - 0.5)), height - 1)
    if left > right or top > bottom:
        return
    p, q, r = wp.vec2(a[0], a[1]), wp.vec2(b[0], b[1]), wp.vec2(c[0], c[1])
    area = edge(p, q, r[0], r[1])
    if area == 0.0:
        return
    for row in range(top, bottom + 1):
        y = float(row) + 0.5
        for column in range(left, right + 1):
            x = float(column) + 0.5
            u, v, w = edge(q, r, x, y) / area, edge(r, p, x, y) / area, edge(p, q, x, y) / area
            if u >= 0.0 and v >= 0.0 and w >= 0.0:
                z = 1.0 / (u / a[2] + v / b[2] + w / c[2])
                wp.atomic_min(buffer, row, column, wp.int64(z * MICRO) << wp.int64(32) | wp.int64(f))


@wp.func
def before(f: int, i: int, seen: wp.array[wp.vec3], faces: wp.array2d[wp.int32]) -> wp.vec2:
    """Depth of the plane of triangle f where vertex i is in the picture [m], and 1 if the triangle covers that place,
    else 0."""
    p = seen[i]
    if faces[f, 0] == i or faces[f, 1] == i or faces[f, 2] == i:
        return wp.vec2(p[2], 1.0)
    a, b, c = seen[faces[f, 0]], seen[faces[f, 1]], seen[faces[f, 2]]
    # 1 / z is linear in the picture.
    low = wp.min(1.0 / a[2], wp.min(1.0 / b[2], 1.0 / c[2]))
    high = wp.max(1.0 / a[2], wp.max(1.0 / b[2], 1.0 / c[2]))
    q, r, s = wp.vec2(a[0], a[1]), wp.vec2(b[0], b[1]), wp.vec2(c[0], c[1])
    area = edge(q, r, s[0], s[1])
    u, v, w = edge(r, s, p[0], p[1]) / area, edge(s, q, p[0], p[1]) / area, edge(q, r, p[0], p[1]) / area
    inverse = wp.clamp(u / a[2] + v / b[2] + w / c[2], low, high)
    return wp.vec2(1.0 / inverse, wp.where(wp.min(u, wp.min(v, w)) >= 0.0, 1.0, 0.0))


@wp.kernel(enable_backward=False)
def visible_kernel(
    seen: wp.array[wp.vec3],
    faces: wp.array2d[wp.int32],
    near: float,
    tolerance: float,
    buffer: wp.array2d[wp.int64],
    # output
    visible: wp.array[wp.bool],
) -> None:
    """Whether a vertex is within the picture and nothing is in front of it.

    The triangles that are nearest in its pixel and in those around are tested exactly where the vertex is. If none of
    them covers that place, because triangles are smaller than pixels, the plane of the one in its own pixel decides.
    """
    i = wp.tid()
    p = seen[i]
    visible[i] = False
    if p[2] < near or p[0] < 0.0 or p[1] < 0.0:
        return
    column, row = int(p[0]), int(p[1])
    if column >= buffer.shape[1] or row >= buffer.shape[0]:
        return
    shows = bool(False)
    own = float(3.0e38)
    for y in range(wp.max(row - 1, 0), wp.min(row + 2, buffer.shape[0])):
        for x in range(wp.max(column - 1, 0), wp.min(column + 2, buffer.shape[1])):
            found = buffer[y, x]
            if found != FAR:
                at = before(int(found & wp.int64(4294967295)), i, seen, faces)
                if at[1] > 0.0:
                    if at[0] < p[2] - tolerance:
                        return
                    shows = True
                if x == column and y == row:
                    own = at[0]
    visible[i] = shows or own > p[2] - tolerance
