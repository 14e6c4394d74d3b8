"""Parting garments whose triangles cut each other: one code for CPU and CUDA, each thread for one face or vertex."""

import warp as wp

from refu_core.contact._edge_kernels import CORNER
from refu_core.contact._layers_kernels import Below, Cut
from refu_core.sdf import Skin, query_skin
from refu_core.sdf._crossing_kernels import Corners, double, meeting_edges

wp.set_module_options({"fuse_fp": False, "enable_backward": False})

MOST_LEVELS = wp.constant(4)
"""How often a face is quartered: its parts are about a millimetre wide then."""


@wp.struct
class Outer:
    """The garment above a sheet, and memory to part it in."""

    points: wp.array[wp.vec3]
    """Its vertices [m]."""
    cut: Cut
    order: wp.array[int]
    """Its faces, sorted so that those of each `BLOCK` are near each other."""
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
def may_bulge(corner: wp.mat33, far: wp.vec3, normal: wp.mat33) -> bool:
    """Whether skin may bulge up to a triangle between its corners, by how `far` they are off and the normals below."""
    spread = wp.max(wp.length_sq(normal[0] - normal[1]), wp.length_sq(normal[1] - normal[2]))
    spread = wp.max(spread, wp.length_sq(normal[2] - normal[0]))
    longest = wp.max(wp.length_sq(corner[0] - corner[1]), wp.length_sq(corner[1] - corner[2]))
    longest = wp.max(longest, wp.length_sq(corner[2] - corner[0]))
    lowest = wp.min(wp.min(far[0], far[1]), far[2])
    return lowest <= 0.0 or lowest * lowest <= CORNER * CORNER * longest * spread


@wp.func
def quarter(triangle: wp.mat33, number: int, level: int) -> wp.mat33:
    """Triangle `number` of the 4^level that a triangle is cut into, at the middles of its edges again and again."""
    part = triangle
    for i in range(level):
        k = (number >> (2 * (level - 1 - i))) & 3
        middles = 0.5 * wp.matrix_from_rows(part[0] + part[1], part[1] + part[2], part[2] + part[0])
        if k == 3:
            part = middles
        else:
            part = wp.matrix_from_rows(
                wp.where(k == 0, part[0], middles[wp.where(k == 1, 0, 2)]),
                wp.where(k == 1, part[1], middles[wp.where(k == 0, 0, 1)]),
                wp.where(k == 2, part[2], middles[wp.where(k == 0, 2, 1)]),
            )
    return part


@wp.func
def is_cut(own: wp.mat33, near: int, skin: Skin) -> bool:
    """Whether a place on a face is inside the body, or at least may be: asks wherever skin may bulge up to the face."""
    number = int(0)
    level = int(1)
    while level > 0:
        part = quarter(own, number, level)
        far = wp.vec3()
        normal = Corners()
        for k in range(3):
            distance, gradient, _face = query_skin(skin, part[k], near)
            far[k] = distance
            normal[k] = gradient
        if wp.min(wp.min(far[0], far[1]), far[2]) < 0.0:
            return True
        if may_bulge(part, far, wp.matrix_from_rows(normal[0], normal[1], normal[2])):
            if level == MOST_LEVELS:
                return True
            level += 1
            number *= 4
        else:
            number += 1
            while level > 0 and number % 4 == 0:
                level -= 1
                number = wp.where(level > 0, number // 4, 1)
    return False


@wp.kernel
def glimpse_kernel(
    each: int,
    faces: wp.array2d[int],
    skin: Skin,
    points: wp.array[wp.vec3],
    distance: wp.array[float],
    gradient: wp.array[wp.vec3],
    closest: wp.array[int],
    # outputs
    count: wp.array[int],
) -> None:
    """Counts faces that cut the skin, or of which a corner's distance is 0, so unknown; `each` faces a thread."""
    first = each * wp.tid()
    for face in range(first, wp.min(first + each, faces.shape[0])):
        i = faces[face, 0]
        j = faces[face, 1]
        k = faces[face, 2]
        own = corners(face, points, faces)
        far = wp.vec3(distance[i], distance[j], distance[k])
        if may_bulge(own, far, wp.matrix_from_rows(gradient[i], gradient[j], gradient[k])):
            is_known = distance[i] != 0.0 and distance[j] != 0.0 and distance[k] != 0.0
            if not is_known or is_cut(own, closest[i], skin):
                wp.atomic_add(count, 0, 1)


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
