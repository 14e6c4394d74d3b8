"""Closest point by walking over a posed triangle mesh from faces that are near already: one code for CPU and CUDA."""

import warp as wp

from refu_core.sdf._closest_kernels import (
    EDGE,
    FACE,
    VERTEX,
    PosedMesh,
    area_normal,
    closest_on_face,
    distance_and_gradient,
    measured_to,
    offset_from,
)

ROWS = 1 << 13
COLUMNS = 16
MAX_PARTS = wp.constant(10)
ABSENT = wp.constant(15)  # the column of bits
EMPTY = wp.constant(0x7FFFFFFF)  # also: every part is absent

# An entry is the squared distance from a guide to the cell's centre, UNITS to a square metre, above the face's bits.
FACE_BITS = wp.constant(20)
FACE_MASK = wp.constant((1 << 20) - 1)
UNITS = wp.constant(65536.0)
MAX_FACES = 1 << 20
# A guide is entered in cells whose centre is within this squared distance of its middle, in squared edges of a cell.
ENTER = wp.constant(2.6)

# No walk takes more steps than this; one over half a body's height takes as many.
MAX_STEPS = wp.constant(64)
# Parts other than the point's own matter only within this distance [m].
FAR = wp.constant(0.02)
# A guide is of use only if it is no farther away than the best distance so far plus REACH, the way from a guide to its
# part's closest face [m], and if its plane is no farther below the point than that distance plus ROOM, the height that
# the part rises above the plane on the way [m].
REACH = wp.constant(0.08)
ROOM = wp.constant(0.01)
# A guide that only continues the skin below the point is of no use, since a body mostly bends away. Such a guide
# faces the same way, by this cosine, and doesn't rise by more than this above that skin [m].
ALIKE = wp.constant(0.9)
RISE = wp.constant(0.005)
# A point deeper than this below a face [m] may be below other faces as well, as the centre of a sphere is below all of
# them. So that face's neighbours are looked at, too, unless it is farther than the best so far by more than CLOSER [m].
DEEP = wp.constant(0.008)
CLOSER = wp.constant(0.02)
# A step must shorten the squared distance by more than rounding does, or two faces of one edge take turns.
SHORTER = wp.constant(1.0 - 1e-6)


@wp.struct
class Guides:
    """What a walk reads besides the mesh."""

    links: wp.array[wp.vec4i]
    """Two rows a face, half a cache line together: its vertices and its part; the faces across its edges (0, 1),
    (1, 2), (2, 0), and nothing."""
    table: wp.array2d[wp.int32]
    """A row of sixteen, one cache line, for each cell of space: by part the guide closest to the cell's centre, and in
    the last column a bit for each part that has none."""
    cell: wp.float32
    """Edge of a cell [m]."""


@wp.func
def cell_of(p: wp.vec3, cell: float) -> wp.vec3i:
    return wp.vec3i(int(wp.floor(p[0] / cell)), int(wp.floor(p[1] / cell)), int(wp.floor(p[2] / cell)))


@wp.func
def row_of(x: int, y: int, z: int) -> int:
    """Row of a cell. The table repeats itself in space, at distances at which no part of a body occurs twice."""
    return ((x & 15) << 9) | ((y & 31) << 4) | (z & 15)


@wp.kernel(enable_backward=False)
def grid_lookup_kernel(
    low: wp.vec3,
    cell: float,
    grid: wp.array3d[int],
    places: wp.array[wp.vec3],
    # outputs
    near: wp.array[int],
) -> None:
    """Looks places up in a grid, by y, x and z, with the corner `low`; places outside of it at its border."""
    i = wp.tid()
    p = (places[i] - low) / cell
    x = int(wp.clamp(p[0], 0.0, float(grid.shape[1] - 1)))
    y = int(wp.clamp(p[1], 0.0, float(grid.shape[0] - 1)))
    z = int(wp.clamp(p[2], 0.0, float(grid.shape[2] - 1)))
    near[i] = grid[y, x, z]


@wp.kernel(enable_backward=False)
def enter_guides_kernel(
    points: wp.array[wp.vec3],
    cell: float,
    depth: float,
    guides: wp.array[wp.vec4i],
    # outputs
    table: wp.array2d[int],
) -> None:
    """Enters guide faces into the cell of a place below them and into its neighbours.

    A guide is given as its vertices, and its face number with the part in the bits above.
    """
    guide = guides[wp.tid()]
    part = guide[3] >> FACE_BITS
    face = guide[3] & FACE_MASK
    a = points[guide[0]]
    b = points[guide[1]]
    c = points[guide[2]]
    middle = (a + b + c) / 3.0
    home = cell_of(middle - depth * wp.normalize(wp.cross(b - a, c - a)), cell)
    most = ENTER * cell * cell
    for x in range(home[0] - 1, home[0] + 2):
        away_x = middle[0] - cell * (float(x) + 0.5)
        for y in range(home[1] - 1, home[1] + 2):
            away_y = middle[1] - cell * (float(y) + 0.5)
            beside = away_x * away_x + away_y * away_y
            if beside < most:
                for z in range(home[2] - 1, home[2] + 2):
                    away_z = middle[2] - cell * (float(z) + 0.5)
                    squared = beside + away_z * away_z
                    if squared < most:
                        row = row_of(x, y, z)
                        wp.atomic_min(table, row, part, (int(UNITS * squared) << FACE_BITS) | face)
                        wp.atomic_and(table, row, ABSENT, ~(1 << part))


@wp.func
def walk_under(
    p: wp.vec3, start: int, points: wp.array[wp.vec3], links: wp.array[wp.vec4i]
) -> tuple[int, int, wp.vec3, wp.vec3]:
    """The face that p is above or below, or a face of an edge or vertex that p is above or below instead.

    Each step goes over the edge that p is most beyond. Also gives the feature of the face that is closest, as far as
    this walk can tell, -1 where it can't; the barycentrics on an edge; and the face's normal, of twice its area.
    """
    face = start
    last = int(-1)
    feature = int(-1)
    w = wp.vec3()
    normal = wp.vec3()
    for _step in range(MAX_STEPS):
        corners = links[2 * face]
        beside = links[2 * face + 1]
        a = points[corners[0]]
        ab = points[corners[1]] - a
        ac = points[corners[2]] - a
        ap = p - a
        normal = wp.cross(ab, ac)
        around = wp.cross(ap, normal)
        area = wp.dot(normal, normal)
        weight_b = -wp.dot(around, ac)
        weight_c = wp.dot(around, ab)
        weight_a = area - weight_b - weight_c
        # Selections, since a processor has to predict branches; and wp.min checks for NaN.
        lowest = wp.where(weight_b < weight_a, weight_b, weight_a)
        edge = wp.where(weight_b < weight_a, 2, 1)
        ahead = wp.where(weight_b < weight_a, beside[2], beside[1])
        edge = wp.where(weight_c < lowest, 0, edge)
        ahead = wp.where(weight_c < lowest, beside[0], ahead)
        lowest = wp.where(weight_c < lowest, weight_c, lowest)
        if lowest >= 0.0 and area > 0.0:
            feature = FACE
            break
        if ahead == last:
            # p is beyond the edge as seen from either face: closest to it, or else to something at one of its ends.
            if edge == 0:
                t = wp.dot(ap, ab) / wp.dot(ab, ab)
                w = wp.vec3(1.0 - t, t, 0.0)
            elif edge == 2:
                t = wp.dot(ap, ac) / wp.dot(ac, ac)
                w = wp.vec3(1.0 - t, 0.0, t)
            else:
                t = wp.dot(ap - ab, ac - ab) / wp.dot(ac - ab, ac - ab)
                w = wp.vec3(0.0, 1.0 - t, t)
            if t > 0.0 and t < 1.0:
                feature = EDGE + edge
            break
        last = face
        face = ahead
    return face, feature, w, normal


@wp.func
def descend(p: wp.vec3, start: int, mesh: PosedMesh) -> tuple[int, wp.vec3, int, float]:
    """Walks downhill until no neighbouring face is closer to p; gives that face, and the place on it closest to p."""
    face = start
    w, feature, offset = closest_on_face(p, face, mesh.points, mesh.faces)
    squared = wp.dot(offset, offset)
    for _step in range(MAX_STEPS):
        here = face
        kind = int(feature)  # the feature on `here`; `feature` may change while neighbours are looked at
        first = int(0)
        n = int(1)
        edge = kind - EDGE
        if kind == FACE:
            n = 3
        elif edge < 0:
            vertex = mesh.faces[here, kind - VERTEX]
            first = mesh.fan_start[vertex]
            n = mesh.fan_start[vertex + 1] - first
        for k in range(n):
            ahead = int(0)
            if kind == FACE:
                ahead = mesh.across[here, k]
            elif edge >= 0:
                ahead = mesh.across[here, edge]
            else:
                ahead = mesh.fan_face[first + k]
            w_, feature_, offset = closest_on_face(p, ahead, mesh.points, mesh.faces)
            squared_ = wp.dot(offset, offset)
            if squared_ < SHORTER * squared:
                face = ahead
                w = w_
                feature = feature_
                squared = squared_
        if face == here:
            break
    return face, w, feature, squared


@wp.func
def is_of_use(
    guide: int, p: wp.vec3, distance: float, outward: wp.vec3, points: wp.array[wp.vec3], links: wp.array[wp.vec4i]
) -> bool:
    """Whether a walk from another part's guide may end closer to p than p's own skin, whose normal is `outward`."""
    corners = links[2 * guide]
    a = points[corners[0]]
    if wp.length(a - p) >= wp.min(distance, FAR) + REACH:
        return False
    normal = wp.normalize(wp.cross(points[corners[1]] - a, points[corners[2]] - a))
    rise = wp.dot(a - p, outward) + distance
    goes_on = rise < RISE and wp.dot(normal, outward) > ALIKE
    return wp.dot(p - a, normal) < distance + ROOM and not goes_on


@wp.func
def walk_from(p: wp.vec3, near: int, mesh: PosedMesh, guides: Guides) -> tuple[int, int, wp.vec3, wp.vec3]:
    """The closest of the faces that walks from `near` and from other parts' guides end at.

    Also the closest feature on it, the barycentrics there unless it is the interior, and the face's normal, of any
    length.
    """
    home = cell_of(p, guides.cell)
    row = row_of(home[0], home[1], home[2])
    absent = int(guides.table[row, ABSENT])
    face = int(-1)
    feature = int(FACE)
    w = wp.vec3()
    squared = float(1.0e12)
    distance = float(1.0e6)
    others = int(0)
    above = wp.vec3()
    outward = wp.vec3()
    # -1 is the walk from `near`. One loop with one call of each function, so that a compiler inlines them.
    for part in range(-1, MAX_PARTS):
        start = int(near)
        walks = bool(part < 0)
        if part >= 0:
            if others >> part == 0:
                break
            if (others >> part) & 1 == 1:
                start = guides.table[row, part] & FACE_MASK
                walks = is_of_use(start, p, distance, outward, mesh.points, guides.links)
        if walks:
            face_, feature_, w_, normal = walk_under(p, start, mesh.points, guides.links)
            if face_ != face:
                depth = wp.dot(mesh.points[guides.links[2 * face_][0]] - p, normal) / wp.length(normal)
                squared_ = depth * depth
                if feature_ >= EDGE:
                    offset = offset_from(p, face_, w_, mesh.points, mesh.faces)
                    squared_ = wp.dot(offset, offset)
                if feature_ < 0 or (depth >= DEEP and depth <= distance + CLOSER):
                    face_, w_, feature_, squared_ = descend(p, face_, mesh)
                    normal = area_normal(face_, mesh.points, mesh.faces)
                if squared_ < squared:
                    face = face_
                    w = w_
                    feature = feature_
                    squared = squared_
                    distance = wp.sqrt(squared)
                    above = normal
        if part < 0:
            outward = wp.normalize(above)
            others = (EMPTY ^ absent) & ~(1 << guides.links[2 * face][3])
    return face, feature, w, above


@wp.func
def first_at(face: int, feature: int, mesh: PosedMesh) -> int:
    """The first of the two faces if their edge is closest: which of them a walk ends at depends on rounding."""
    if feature >= EDGE:
        return wp.min(face, mesh.across[face, feature - EDGE])
    return face


@wp.kernel(enable_backward=False)
def walk_kernel(
    mesh: PosedMesh,
    guides: Guides,
    queries: wp.array[wp.vec3],
    near: wp.array[int],
    order: wp.array[int],
    # outputs
    out_face: wp.array[int],
    out_distance: wp.array[float],
    out_gradient: wp.array[wp.vec3],
) -> None:
    """What `walk_from` finds for each query, in `order` unless that is empty; outputs as `closest_kernel`'s."""
    i = wp.tid()
    if order.shape[0] > 0:
        i = order[i]
    p = queries[i]
    face, feature, w, above = walk_from(p, near[i], mesh, guides)
    offset = p - mesh.points[guides.links[2 * face][0]]
    if feature != FACE:
        offset = offset_from(p, face, w, mesh.points, mesh.faces)
    distance, gradient = distance_and_gradient(offset, face, feature, wp.normalize(above), mesh)
    out_face[i] = first_at(face, feature, mesh)
    out_distance[i] = distance
    out_gradient[i] = gradient


@wp.kernel(enable_backward=False)
def requery_deep_kernel(
    tree: wp.uint64,
    mesh: PosedMesh,
    depth: float,
    queries: wp.array[wp.vec3],
    # what walks found, and what is found now
    out_face: wp.array[int],
    out_distance: wp.array[float],
    out_gradient: wp.array[wp.vec3],
) -> None:
    """Asks the tree about each query that its walk found deeper than `depth`, no farther away than the walk ended."""
    i = wp.tid()
    far = -out_distance[i]
    if far <= depth:
        return
    p = queries[i]
    found = wp.mesh_query_point_no_sign(tree, p, far)
    if found.result and found.face != out_face[i]:
        distance, gradient = measured_to(p, found.face, mesh)
        if wp.abs(distance) < far:
            out_face[i] = found.face
            out_distance[i] = distance
            out_gradient[i] = gradient
