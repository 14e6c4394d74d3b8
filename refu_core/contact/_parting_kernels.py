"""Parting garments whose triangles cut each other: one code for CPU and CUDA, each thread for one face or vertex."""

import warp as wp

from refu_core.contact._layers_kernels import Cut
from refu_core.sdf._crossing_kernels import BLOCK, Corners, double, meeting_edges

wp.set_module_options({"fuse_fp": False, "enable_backward": False})


@wp.func
def corner(face: int, k: int, points: wp.array[wp.vec3], faces: wp.array2d[int]) -> wp.vec3:
    return points[faces[face, k]]


@wp.func
def cut_each_other(
    face: int, points: wp.array[wp.vec3], faces: wp.array2d[int], a: wp.vec3, b: wp.vec3, c: wp.vec3
) -> bool:
    """Whether a face cuts triangle abc of another mesh."""
    i = faces[face, 0]
    j = faces[face, 1]
    k = faces[face, 2]
    own = wp.vec3i(i, j, k)
    # The other's edges are looked at from one face alone: any order of their ends will do.
    edges = meeting_edges(
        own, double(points[i]), double(points[j]), double(points[k]), own, double(a), double(b), double(c), False
    )
    return edges > 0


@wp.kernel
def find_kernel(
    tree: wp.uint64,
    extent: wp.array[wp.vec3],
    points: wp.array[wp.vec3],
    faces: wp.array2d[int],
    order: wp.array[int],
    # outputs
    marked: wp.array[int],
    count: wp.array[int],
) -> None:
    """Marks the corners of faces that cut the mesh of `tree`, and counts the pairs."""
    first = BLOCK * wp.tid()
    end = wp.min(first + BLOCK, order.shape[0])
    lower = wp.vec3(wp.inf)
    upper = wp.vec3(-wp.inf)
    lows = Corners()
    highs = Corners()
    for n in range(first, end):
        face = order[n]
        a = corner(face, 0, points, faces)
        b = corner(face, 1, points, faces)
        c = corner(face, 2, points, faces)
        low = wp.min(wp.min(a, b), c)
        high = wp.max(wp.max(a, b), c)
        lows[n - first] = low
        highs[n - first] = high
        lower = wp.min(lower, low)
        upper = wp.max(upper, high)
    lower = wp.max(lower, extent[0])
    upper = wp.min(upper, extent[1])
    if lower[0] > upper[0] or lower[1] > upper[1] or lower[2] > upper[2]:
        return
    query = wp.mesh_query_aabb(tree, lower, upper)
    other = int(0)
    while wp.mesh_query_aabb_next(query, other):
        p = wp.mesh_get_point(tree, 3 * other)
        q = wp.mesh_get_point(tree, 3 * other + 1)
        r = wp.mesh_get_point(tree, 3 * other + 2)
        low = wp.min(wp.min(p, q), r)
        high = wp.max(wp.max(p, q), r)
        for n in range(first, end):
            i = n - first
            if lows[i, 0] > high[0] or lows[i, 1] > high[1] or lows[i, 2] > high[2]:
                continue
            if highs[i, 0] < low[0] or highs[i, 1] < low[1] or highs[i, 2] < low[2]:
                continue
            if cut_each_other(order[n], points, faces, p, q, r):
                wp.atomic_add(count, 0, 1)
                for k in range(3):
                    marked[faces[order[n], k]] = 1


@wp.kernel
def widen_kernel(marked: wp.array[int], cut: Cut, wider: wp.array[int]) -> None:
    """The marked, and their neighbours."""
    i = wp.tid()
    mark = int(marked[i])
    for r in range(cut.ring_start[i], cut.ring_start[i + 1]):
        mark = wp.max(mark, marked[cut.ring[r]])
    wider[i] = mark


@wp.func
def turned(n: wp.vec3, a: wp.vec3, b: wp.vec3) -> float:
    """The area between a and b, seen along n."""
    return wp.dot(n, wp.cross(a, b))


@wp.func
def shadow(p: wp.vec3, n: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """Barycentrics in triangle abc of where p is, seen along n; negative ones where abc is seen from its edge."""
    area = turned(n, b - a, c - a)
    w_b = turned(n, p - a, c - a) / area
    w_c = turned(n, b - a, p - a) / area
    return wp.where(area == 0.0, wp.vec3(-1.0), wp.vec3(1.0 - w_b - w_c, w_b, w_c))


@wp.func
def is_in(w: wp.vec3) -> bool:
    return wp.min(wp.min(w[0], w[1]), w[2]) >= 0.0


@wp.func
def depth_below(
    n: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3, p: wp.vec3, q: wp.vec3, r: wp.vec3
) -> tuple[float, wp.vec3]:
    """How far triangle abc has to go along n to be above pqr, and which place of it that is, in barycentrics.

    Over what both cover, seen along n, the difference of their heights is linear: it is largest at a corner of that.
    """
    own = wp.matrix_from_rows(a, b, c)
    other = wp.matrix_from_rows(p, q, r)
    most = float(0.0)
    place = wp.vec3()
    for k in range(3):
        corner = other[k]
        w = shadow(corner, n, a, b, c)
        depth = wp.dot(n, corner - (w[0] * a + w[1] * b + w[2] * c))
        if is_in(w) and depth > most:
            most = depth
            place = w
        corner = own[k]
        w = shadow(corner, n, p, q, r)
        depth = wp.dot(n, w[0] * p + w[1] * q + w[2] * r - corner)
        if is_in(w) and depth > most:
            most = depth
            place = wp.vec3()
            place[k] = 1.0
    for i in range(3):
        j = (i + 1) % 3
        along = own[j] - own[i]
        for k in range(3):
            other_along = other[(k + 1) % 3] - other[k]
            between = other[k] - own[i]
            area = turned(n, along, other_along)
            if area == 0.0:
                continue
            s = turned(n, between, other_along) / area
            t = turned(n, between, along) / area
            depth = wp.dot(n, between + t * other_along - s * along)
            if s >= 0.0 and s <= 1.0 and t >= 0.0 and t <= 1.0 and depth > most:
                most = depth
                place = wp.vec3()
                place[i] = 1.0 - s
                place[j] = s
    return most, place


@wp.kernel
def measure_kernel(
    tree: wp.uint64,
    below_normals: wp.array[wp.vec3],
    below_faces: wp.array2d[int],
    points: wp.array[wp.vec3],
    faces: wp.array2d[int],
    marked: wp.array[int],
    gap: float,
    most: float,
    # outputs
    count: wp.array[int],
    way: wp.array[wp.vec3],
    place: wp.array[wp.vec3],
    pulled: wp.array[int],
) -> None:
    """The way of each face with a marked corner out of what it cuts deepest, and the place on it where that is.

    Along the normal of the sheet, as far as clears it, but no farther than `most`. Counts the faces that cut, whose
    corners are `pulled`.
    """
    face = wp.tid()
    if marked[faces[face, 0]] == 0 and marked[faces[face, 1]] == 0 and marked[faces[face, 2]] == 0:
        return
    place[face] = wp.vec3()
    a = corner(face, 0, points, faces)
    b = corner(face, 1, points, faces)
    c = corner(face, 2, points, faces)
    deepest = float(0.0)
    query = wp.mesh_query_aabb(tree, wp.min(wp.min(a, b), c), wp.max(wp.max(a, b), c))
    other = int(0)
    while wp.mesh_query_aabb_next(query, other):
        p = wp.mesh_get_point(tree, 3 * other)
        q = wp.mesh_get_point(tree, 3 * other + 1)
        r = wp.mesh_get_point(tree, 3 * other + 2)
        if cut_each_other(face, points, faces, p, q, r):
            n = wp.normalize(
                below_normals[below_faces[other, 0]]
                + below_normals[below_faces[other, 1]]
                + below_normals[below_faces[other, 2]]
            )
            depth, w = depth_below(n, a, b, c, p, q, r)
            if depth > deepest:
                deepest = depth
                place[face] = w
                way[face] = wp.min(depth + gap, most) * n
    if deepest > 0.0:
        wp.atomic_add(count, 0, 1)
        for k in range(3):
            pulled[faces[face, k]] = 1


@wp.kernel
def part_kernel(
    way: wp.array[wp.vec3],
    place: wp.array[wp.vec3],
    cut: Cut,
    # outputs
    points: wp.array[wp.vec3],
    pulled: wp.array[int],
    marked: wp.array[int],
) -> None:
    """Moves the corners of faces as far as brings their deepest places out; who is moved is marked, and nobody else.

    A face that cut has a corner that is moved. Where no corner was, there is nothing new to measure.
    """
    i = wp.tid()
    marked[i] = 0
    if pulled[i] == 0:
        return
    pulled[i] = 0
    total = wp.vec3()
    weight = float(0.0)
    for f in range(cut.fan_start[i], cut.fan_start[i + 1]):
        face = cut.fan_face[f]
        w = place[face]
        own = wp.where(cut.faces[face, 0] == i, w[0], wp.where(cut.faces[face, 1] == i, w[1], w[2]))
        if own > 0.0:
            total += own * own / wp.dot(w, w) * way[face]
            weight += own
    if weight > 0.0:
        points[i] += total / weight
        marked[i] = 1
