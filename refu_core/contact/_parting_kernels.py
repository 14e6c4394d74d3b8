"""Parting garments whose triangles cut each other: one code for CPU and CUDA, each thread for one face or vertex."""

import warp as wp

from refu_core.contact._layers_kernels import Below, Cut
from refu_core.sdf._crossing_kernels import Corners, double, meeting_edges

wp.set_module_options({"fuse_fp": False, "enable_backward": False})


@wp.struct
class Outer:
    """The garment above a sheet, and memory to part it in."""

    points: wp.array[wp.vec3]
    """Its vertices [m]."""
    cut: Cut
    order: wp.array[int]
    """Its faces, sorted so that those of each `BLOCK` are near each other."""
    far: wp.array[float]
    """How far from the sheet each vertex is at least [m]; 0 where that isn't known."""
    marked: wp.array[float]
    """1 for corners of faces that cut the sheet; later, for vertices that were moved last."""
    pulled: wp.array[int]
    """Whether a vertex is a corner of a face that still cuts the sheet."""
    way: wp.array[wp.vec3]
    place: wp.array[wp.vec3]
    """The way that each face has to go [m], and the place on it that has to, in barycentrics."""
    count: wp.array[int]
    """Pairs of faces, or faces, that cut each other."""


@wp.func
def corners(face: int, points: wp.array[wp.vec3], faces: wp.array2d[int]) -> wp.mat33:
    """A triangle, one row for each corner."""
    return wp.matrix_from_rows(points[faces[face, 0]], points[faces[face, 1]], points[faces[face, 2]])


@wp.func
def lowest(triangle: wp.mat33) -> wp.vec3:
    return wp.min(wp.min(triangle[0], triangle[1]), triangle[2])


@wp.func
def highest(triangle: wp.mat33) -> wp.vec3:
    return wp.max(wp.max(triangle[0], triangle[1]), triangle[2])


@wp.func
def cut_each_other(face: int, own: wp.mat33, other: wp.mat33, faces: wp.array2d[int]) -> bool:
    """Whether a face cuts the triangle of another mesh."""
    # The other triangle's edges are seen from this face alone, so any order of their ends will do.
    order = wp.vec3i(faces[face, 0], faces[face, 1], faces[face, 2])
    edges = meeting_edges(
        order,
        double(own[0]),
        double(own[1]),
        double(own[2]),
        order,
        double(other[0]),
        double(other[1]),
        double(other[2]),
        False,
    )
    return edges > 0


@wp.func
def may_cut(face: int, own: wp.mat33, outer: Outer) -> bool:
    """Whether a face is near enough to the sheet to cut it.

    No place on a triangle is farther from the nearest corner than the longest edge, divided by the root of three.
    """
    faces = outer.cut.faces
    far = wp.min(wp.min(outer.far[faces[face, 0]], outer.far[faces[face, 1]]), outer.far[faces[face, 2]])
    longest = wp.max(wp.length_sq(own[0] - own[1]), wp.length_sq(own[1] - own[2]))
    return far <= 0.0 or 3.0 * far * far <= wp.max(longest, wp.length_sq(own[2] - own[0]))


@wp.kernel
def find_kernel(each: int, below: Below, outer: Outer) -> None:
    """Marks the corners of faces that cut the sheet, and counts the pairs; `each` faces a thread, `BLOCK` at most."""
    first = each * wp.tid()
    end = wp.min(first + each, outer.order.shape[0])
    lower = wp.vec3(wp.inf)
    upper = wp.vec3(-wp.inf)
    lows = Corners()
    highs = Corners()
    for n in range(first, end):
        own = corners(outer.order[n], outer.points, outer.cut.faces)
        lows[n - first] = wp.vec3(wp.inf)
        if may_cut(outer.order[n], own, outer):
            lows[n - first] = lowest(own)
            highs[n - first] = highest(own)
            lower = wp.min(lower, lowest(own))
            upper = wp.max(upper, highest(own))
    lower = wp.max(lower, below.extent[0])
    upper = wp.min(upper, below.extent[1])
    if lower[0] > upper[0] or lower[1] > upper[1] or lower[2] > upper[2]:
        return
    query = wp.mesh_query_aabb(below.tree, lower, upper)
    other = int(0)
    while wp.mesh_query_aabb_next(query, other):
        sheet = corners(other, below.points, below.cut.faces)
        low = lowest(sheet)
        high = highest(sheet)
        for n in range(first, end):
            i = n - first
            if lows[i, 0] > high[0] or lows[i, 1] > high[1] or lows[i, 2] > high[2]:
                continue
            if highs[i, 0] < low[0] or highs[i, 1] < low[1] or highs[i, 2] < low[2]:
                continue
            face = outer.order[n]
            if cut_each_other(face, corners(face, outer.points, outer.cut.faces), sheet, outer.cut.faces):
                wp.atomic_add(outer.count, 0, 1)
                for k in range(3):
                    outer.marked[outer.cut.faces[face, k]] = 1.0


@wp.func
def turned(n: wp.vec3, a: wp.vec3, b: wp.vec3) -> float:
    """The area between a and b, seen along n."""
    return wp.dot(n, wp.cross(a, b))


@wp.func
def shadow(p: wp.vec3, n: wp.vec3, triangle: wp.mat33) -> wp.vec3:
    """Barycentrics of p in a triangle, seen along n; negative ones where the triangle is seen edge-on."""
    a = triangle[0]
    b = triangle[1]
    c = triangle[2]
    area = turned(n, b - a, c - a)
    w_b = turned(n, p - a, c - a) / area
    w_c = turned(n, b - a, p - a) / area
    return wp.where(area == 0.0, wp.vec3(-1.0), wp.vec3(1.0 - w_b - w_c, w_b, w_c))


@wp.func
def is_in(w: wp.vec3) -> bool:
    return wp.min(wp.min(w[0], w[1]), w[2]) >= 0.0


@wp.func
def depth_below(n: wp.vec3, own: wp.mat33, other: wp.mat33) -> tuple[float, wp.vec3]:
    """How far a triangle has to go along n to be above the other, and the place on it that is deepest, in barycentrics.

    Seen along n, the difference of their heights is linear over the area that both cover: it is largest at a corner of
    that area.
    """
    most = float(0.0)
    place = wp.vec3()
    for k in range(3):
        corner = other[k]
        w = shadow(corner, n, own)
        depth = wp.dot(n, corner - (w[0] * own[0] + w[1] * own[1] + w[2] * own[2]))
        if is_in(w) and depth > most:
            most = depth
            place = w
        corner = own[k]
        w = shadow(corner, n, other)
        depth = wp.dot(n, w[0] * other[0] + w[1] * other[1] + w[2] * other[2] - corner)
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
def measure_kernel(below: Below, outer: Outer, gap: float, most: float) -> None:
    """For each face with a marked corner, the way out of what it cuts deepest, and the deepest place on it.

    The way is along the sheet's normal, as far as clears it, but no farther than `most`. Counts the faces that cut.
    """
    face = wp.tid()
    is_marked = float(0.0)
    for k in range(3):
        is_marked += outer.marked[outer.cut.faces[face, k]]
    if is_marked == 0.0:
        return
    outer.place[face] = wp.vec3()
    own = corners(face, outer.points, outer.cut.faces)
    deepest = float(0.0)
    query = wp.mesh_query_aabb(below.tree, lowest(own), highest(own))
    other = int(0)
    while wp.mesh_query_aabb_next(query, other):
        sheet = corners(other, below.points, below.cut.faces)
        if cut_each_other(face, own, sheet, outer.cut.faces):
            n = wp.normalize(
                below.normals[below.cut.faces[other, 0]]
                + below.normals[below.cut.faces[other, 1]]
                + below.normals[below.cut.faces[other, 2]]
            )
            depth, w = depth_below(n, own, sheet)
            if depth > deepest:
                deepest = depth
                outer.place[face] = w
                outer.way[face] = wp.min(depth + gap, most) * n
    if deepest > 0.0:
        wp.atomic_add(outer.count, 0, 1)
        for k in range(3):
            outer.pulled[outer.cut.faces[face, k]] = 1


@wp.kernel
def part_kernel(outer: Outer) -> None:
    """Moves the corners of faces so that their deepest places come out, and marks only the vertices that it moves.

    Every face that cut has a corner that is moved. A face without one has nothing new to measure.
    """
    i = wp.tid()
    outer.marked[i] = 0.0
    if outer.pulled[i] == 0:
        return
    outer.pulled[i] = 0
    total = wp.vec3()
    weight = float(0.0)
    for f in range(outer.cut.fan_start[i], outer.cut.fan_start[i + 1]):
        face = outer.cut.fan_face[f]
        w = outer.place[face]
        own = wp.where(outer.cut.faces[face, 0] == i, w[0], wp.where(outer.cut.faces[face, 1] == i, w[1], w[2]))
        if own > 0.0:
            total += own * own / wp.dot(w, w) * outer.way[face]
            weight += own
    if weight > 0.0:
        outer.points[i] += total / weight
        outer.marked[i] = 1.0
