"""The cloth of many lanes at once: each kernel does for all lanes what a loop of `_solver` does for one.

Arrays of N vertices (or C constraints, E edges) and B lanes are shaped (N, B): neighbouring threads work on the same
vertex of neighbouring lanes, so that a GPU reads and writes whole lines of memory. Units are those of `_solver`.
"""

import warp as wp

TINY = wp.constant(1.0e-12)
FIXED = wp.constant(268435456.0)  # 2^28: pushes are added up as whole numbers, whose sum depends on no order
SHARE = wp.constant(0.25)  # of a lack of distance that one pair closes
SLACK = wp.constant(0.02)  # a vertex just past the edge of a face counts for the faces on both sides


@wp.struct
class Asked:
    """What is known of the skin below points, as of each one's last query; as `_Skin`."""

    at: wp.array2d[wp.vec3]
    face: wp.array2d[wp.int32]
    weights: wp.array2d[wp.vec3]
    distance: wp.array2d[wp.float32]
    normal: wp.array2d[wp.vec3]


@wp.struct
class Contacts:
    """Tangent planes of the skin below points; a normal of zero where there is none."""

    point: wp.array2d[wp.vec3]
    normal: wp.array2d[wp.vec3]
    motion: wp.array2d[wp.vec3]


@wp.struct
class Skin:
    """The bodies of all lanes, (B, V), at the present time step, and their motion in a step."""

    mesh: wp.uint64
    faces: wp.array2d[wp.int32]
    vertices: wp.array2d[wp.vec3]
    motion: wp.array2d[wp.vec3]
    origin: wp.array[wp.vec3]
    reach: wp.float32
    near: wp.float32
    slide: wp.float32


@wp.kernel(enable_backward=False)
def place_kernel(
    course: wp.array3d[wp.vec3],
    before: wp.array[wp.int32],
    after: wp.array[wp.int32],
    first: float,
    step: float,
    origin: wp.array[wp.vec3],
    # output
    vertices: wp.array2d[wp.vec3],
    motion: wp.array2d[wp.vec3],
    placed: wp.array2d[wp.vec3],
) -> None:
    """The bodies (B, V) after `first` of a frame's time steps, of which each takes the share `step`.

    `course` (B, T, V) has them from frame to frame; in `placed` they stand side by side.
    """
    b, v = wp.tid()
    start = course[b, before[b], v]
    moved = (course[b, after[b], v] - start) * step
    here = start + first * moved
    vertices[b, v] = here
    motion[b, v] = moved
    placed[b, v] = here + origin[b]


@wp.func
def held_at(
    a: int,
    b: int,
    frame: int,
    course: wp.array3d[wp.vec3],
    faces: wp.array2d[wp.int32],
    face: wp.array2d[wp.int32],
    weights: wp.array2d[wp.vec3],
    offset: wp.array2d[wp.float32],
) -> wp.vec3:
    """Where anchor a of lane b is in a frame of its course."""
    f, w = face[a, b], weights[a, b]
    p, q, r = course[b, frame, faces[f, 0]], course[b, frame, faces[f, 1]], course[b, frame, faces[f, 2]]
    across = wp.cross(q - p, r - p)
    return w[0] * p + w[1] * q + w[2] * r + (offset[a, b] / (wp.length(across) + TINY)) * across


@wp.kernel(enable_backward=False)
def anchor_kernel(
    course: wp.array3d[wp.vec3],
    before: wp.array[wp.int32],
    after: wp.array[wp.int32],
    step: float,
    faces: wp.array2d[wp.int32],
    face: wp.array2d[wp.int32],
    weights: wp.array2d[wp.vec3],
    offset: wp.array2d[wp.float32],
    # output
    point: wp.array2d[wp.vec3],
    motion: wp.array2d[wp.vec3],
) -> None:
    """Where each anchor (A, B) is at the start of a frame, and its motion in a time step."""
    a, b = wp.tid()
    start = held_at(a, b, before[b], course, faces, face, weights, offset)
    point[a, b] = start
    motion[a, b] = (held_at(a, b, after[b], course, faces, face, weights, offset) - start) * step


@wp.func
def ask(p: wp.vec3, is_all: bool, i: int, b: int, skin: Skin, asked: Asked) -> int:
    """Asks for the skin below point i of lane b, if it has moved too far since it last asked; 0."""
    known = asked.distance[i, b]
    allowed = wp.where(known > skin.near + skin.slide, known - skin.near, skin.slide)
    if not is_all and wp.length_sq(p - asked.at[i, b]) <= allowed * allowed:
        return 0
    asked.at[i, b] = p
    hit = wp.mesh_query_point_sign_normal(skin.mesh, p + skin.origin[b], skin.reach, 1.0e-3)
    if not hit.result:
        asked.face[i, b] = -1
        asked.distance[i, b] = skin.reach
        return 0
    f = hit.face - b * skin.faces.shape[0]
    w = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
    q, r, s = skin.faces[f, 0], skin.faces[f, 1], skin.faces[f, 2]
    normal = p - (w[0] * skin.vertices[b, q] + w[1] * skin.vertices[b, r] + w[2] * skin.vertices[b, s])
    length = wp.length(normal)
    if length > 1.0e-4:
        normal = normal * (hit.sign / length)
    else:  # on the skin the difference has no direction: the face's normal
        corner = skin.vertices[b, q]
        normal = wp.normalize(wp.cross(skin.vertices[b, r] - corner, skin.vertices[b, s] - corner))
    asked.face[i, b] = f
    asked.weights[i, b] = w
    asked.distance[i, b] = length * hit.sign
    asked.normal[i, b] = normal
    return 0


@wp.func
def meet(i: int, b: int, skin: Skin, asked: Asked, contacts: Contacts) -> int:
    """The contact of point i of lane b, if the skin is near; 0."""
    f = asked.face[i, b]
    if f < 0 or asked.distance[i, b] >= 2.0 * skin.near:
        contacts.normal[i, b] = wp.vec3(0.0, 0.0, 0.0)
        return 0
    w = asked.weights[i, b]
    q, r, s = skin.faces[f, 0], skin.faces[f, 1], skin.faces[f, 2]
    contacts.point[i, b] = w[0] * skin.vertices[b, q] + w[1] * skin.vertices[b, r] + w[2] * skin.vertices[b, s]
    contacts.motion[i, b] = w[0] * skin.motion[b, q] + w[1] * skin.motion[b, r] + w[2] * skin.motion[b, s]
    contacts.normal[i, b] = asked.normal[i, b]
    return 0


@wp.kernel(enable_backward=False)
def touch_kernel(
    x: wp.array2d[wp.vec3],
    refreshed: wp.array[wp.int32],
    moved_on: wp.array[wp.int32],
    skin: Skin,
    # in and out
    asked: Asked,
    contacts: Contacts,
) -> None:
    """Contacts of vertices in lanes that are `refreshed`; where the body has `moved_on`, all ask again."""
    i, b = wp.tid()
    if refreshed[b] == 0:
        return
    ask(x[i, b], moved_on[b] != 0, i, b, skin, asked)
    meet(i, b, skin, asked, contacts)


@wp.kernel(enable_backward=False)
def touch_edges_kernel(
    x: wp.array2d[wp.vec3],
    edges: wp.array2d[wp.int32],
    careful: wp.array[wp.int32],
    skin: Skin,
    below: Asked,
    # in and out
    asked: Asked,
    contacts: Contacts,
) -> None:
    """Contacts of the midpoints of edges near the skin, in `careful` lanes."""
    e, b = wp.tid()
    if careful[b] == 0:
        return
    i, j = edges[e, 0], edges[e, 1]
    if wp.max(below.distance[i, b], below.distance[j, b]) >= skin.near:
        contacts.normal[e, b] = wp.vec3(0.0, 0.0, 0.0)
        return
    ask(0.5 * (x[i, b] + x[j, b]), False, e, b, skin, asked)
    meet(e, b, skin, asked, contacts)


@wp.kernel(enable_backward=False)
def wandered_kernel(
    x: wp.array2d[wp.vec3],
    searched_at: wp.array2d[wp.vec3],
    refreshed: wp.array[wp.int32],
    allowed: float,
    # output
    wandered: wp.array[wp.int32],
) -> None:
    """Which lanes have a vertex farther than `allowed` from where it was when faces near it were searched."""
    i, b = wp.tid()
    if refreshed[b] != 0 and wp.length_sq(x[i, b] - searched_at[i, b]) > allowed * allowed:
        wandered[b] = 1


@wp.kernel(enable_backward=False)
def centre_kernel(
    x: wp.array2d[wp.vec3], faces: wp.array2d[wp.int32], origin: wp.array[wp.vec3], centre: wp.array2d[wp.vec3]
) -> None:
    """Centres of all faces of all lanes, (B, F), side by side."""
    b, f = wp.tid()
    centre[b, f] = (x[faces[f, 0], b] + x[faces[f, 1], b] + x[faces[f, 2], b]) / 3.0 + origin[b]


@wp.kernel(enable_backward=False)
def search_kernel(
    x: wp.array2d[wp.vec3],
    rest: wp.array2d[wp.vec3],
    faces: wp.array2d[wp.int32],
    centre: wp.array2d[wp.vec3],
    origin: wp.array[wp.vec3],
    grid: wp.uint64,
    cell: wp.array[wp.float32],
    apart: wp.array[wp.float32],
    wandered: wp.array[wp.int32],
    # output
    count: wp.array2d[wp.int32],
    near: wp.array3d[wp.int32],
    searched_at: wp.array2d[wp.vec3],
) -> None:
    """Faces (K, N, B) near each vertex and apart from it at rest, in lanes that have `wandered`; as
    `find_candidates`."""
    b, i = wp.tid()
    if wandered[b] == 0:
        return
    n_faces = faces.shape[0]
    p, q = x[i, b] + origin[b], rest[i, b]
    found = int(0)
    for hit in wp.hash_grid_query(grid, p, cell[b]):
        f = hit - b * n_faces
        if f >= 0 and f < n_faces and wp.length_sq(centre[b, f] - p) <= cell[b] * cell[b]:
            at_rest = (rest[faces[f, 0], b] + rest[faces[f, 1], b] + rest[faces[f, 2], b]) / 3.0
            if wp.length_sq(at_rest - q) >= apart[b] * apart[b] and found < near.shape[0]:
                near[found, i, b] = f
                found += 1
    count[i, b] = found
    searched_at[i, b] = x[i, b]


@wp.kernel(enable_backward=False)
def side_kernel(
    x: wp.array2d[wp.vec3],
    faces: wp.array2d[wp.int32],
    count: wp.array2d[wp.int32],
    near: wp.array3d[wp.int32],
    refreshed: wp.array[wp.int32],
    reach: float,
    # output
    side: wp.array3d[wp.int8],
) -> None:
    """The side of each face (K, N, B) that the vertex is on, or 0 if it is out of reach; as `near_pairs`."""
    i, b = wp.tid()
    if refreshed[b] == 0:
        return
    for k in range(count[i, b]):
        f = near[k, i, b]
        corner = x[faces[f, 0], b]
        normal = wp.cross(x[faces[f, 1], b] - corner, x[faces[f, 2], b] - corner)
        height = wp.dot(x[i, b] - corner, normal)
        if wp.abs(height) >= reach * wp.length(normal):
            side[k, i, b] = wp.int8(0)
        elif height >= 0.0:
            side[k, i, b] = wp.int8(1)
        else:
            side[k, i, b] = wp.int8(-1)


@wp.kernel(enable_backward=False)
def fall_kernel(
    h: float,
    gravity: wp.array[wp.vec3],
    damping: wp.array[wp.float32],
    contacts: Contacts,
    # in and out
    x: wp.array2d[wp.vec3],
    v: wp.array2d[wp.vec3],
    previous: wp.array2d[wp.vec3],
) -> None:
    """The start of a time step: cloth falls, and contacts go with the skin."""
    i, b = wp.tid()
    faster = v[i, b] * damping[b] + h * gravity[b]
    here = x[i, b]
    previous[i, b] = here
    v[i, b] = faster
    x[i, b] = here + h * faster
    contacts.point[i, b] = contacts.point[i, b] + contacts.motion[i, b]


@wp.kernel(enable_backward=False)
def hold_kernel(
    stiffness: float,
    vertex: wp.array[wp.int32],
    motion: wp.array2d[wp.vec3],
    # in and out
    point: wp.array2d[wp.vec3],
    x: wp.array2d[wp.vec3],
) -> None:
    """Waistbands follow the skin that they are held at."""
    a, b = wp.tid()
    i = vertex[a]
    there = point[a, b] + motion[a, b]
    point[a, b] = there
    x[i, b] = x[i, b] + stiffness * (there - x[i, b])


@wp.kernel(enable_backward=False)
def length_kernel(
    first: int,
    ends: wp.array2d[wp.int32],
    shortest: wp.array2d[wp.float32],
    longest: wp.array2d[wp.float32],
    softness: wp.array[wp.float32],
    inverse_mass: wp.array2d[wp.float32],
    # in and out
    x: wp.array2d[wp.vec3],
) -> None:
    """Distance constraints of one colour, from number `first` on: no two of them share a vertex."""
    t, b = wp.tid()
    e = first + t
    i, j = ends[e, 0], ends[e, 1]
    p, q = x[i, b], x[j, b]
    way = p - q
    length = wp.length(way) + TINY
    wi, wj = inverse_mass[i, b], inverse_mass[j, b]
    wanted = wp.clamp(length, shortest[e, b], longest[e, b])
    s = (wanted - length) / ((wi + wj + softness[e]) * length)
    x[i, b] = p + (s * wi) * way
    x[j, b] = q - (s * wj) * way


@wp.func
def push(i: int, b: int, way: wp.vec3, pushes: wp.array3d[wp.int32]) -> int:
    """Adds to the push of a vertex, in whole numbers; 0."""
    wp.atomic_add(pushes, 0, i, b, int(way[0] * FIXED))
    wp.atomic_add(pushes, 1, i, b, int(way[1] * FIXED))
    wp.atomic_add(pushes, 2, i, b, int(way[2] * FIXED))
    return 0


@wp.kernel(enable_backward=False)
def pair_kernel(
    thickness: float,
    faces: wp.array2d[wp.int32],
    count: wp.array2d[wp.int32],
    near: wp.array3d[wp.int32],
    side: wp.array3d[wp.int8],
    inverse_mass: wp.array2d[wp.float32],
    x: wp.array2d[wp.vec3],
    # output
    pushes: wp.array3d[wp.int32],
) -> None:
    """Pushes (3, N, B) that keep vertices off other parts of the cloth; as `_separate_pairs`, all pairs at once.

    A vertex belongs to some three pairs, its own and those of the faces around it, so each closes less of the lack.
    """
    i, b = wp.tid()
    for k in range(count[i, b]):
        on = float(side[k, i, b])
        if on == 0.0:
            continue
        f = near[k, i, b]
        ia, ib, ic = faces[f, 0], faces[f, 1], faces[f, 2]
        corner = x[ia, b]
        u, v, r = x[ib, b] - corner, x[ic, b] - corner, x[i, b] - corner
        normal = wp.cross(u, v)
        area2 = wp.length_sq(normal) + TINY * TINY
        area = wp.sqrt(area2)
        distance = wp.dot(r, normal) / area * on
        if distance >= thickness or distance < -2.0 * thickness:
            continue
        wb = wp.dot(wp.cross(r, v), normal) / area2
        wc = wp.dot(wp.cross(u, r), normal) / area2
        wa = 1.0 - wb - wc
        if wa < -SLACK or wb < -SLACK or wc < -SLACK:
            continue
        mi, ma, mb, mc = inverse_mass[i, b], inverse_mass[ia, b], inverse_mass[ib, b], inverse_mass[ic, b]
        mass = (mi + ma * wa * wa + mb * wb * wb + mc * wc * wc) * area
        way = (SHARE * (thickness - distance) / mass * on) * normal
        push(i, b, mi * way, pushes)
        push(ia, b, (-ma * wa) * way, pushes)
        push(ib, b, (-mb * wb) * way, pushes)
        push(ic, b, (-mc * wc) * way, pushes)


@wp.kernel(enable_backward=False)
def contact_kernel(
    margin: float,
    friction: float,
    contacts: Contacts,
    previous: wp.array2d[wp.vec3],
    # in and out
    pushes: wp.array3d[wp.int32],
    x: wp.array2d[wp.vec3],
) -> None:
    """Takes the pushes in, and keeps vertices off the skin, with Coulomb's friction."""
    i, b = wp.tid()
    p = x[i, b]
    px, py, pz = pushes[0, i, b], pushes[1, i, b], pushes[2, i, b]
    if px != 0 or py != 0 or pz != 0:
        p = p + wp.vec3(float(px), float(py), float(pz)) / FIXED
        pushes[0, i, b] = 0
        pushes[1, i, b] = 0
        pushes[2, i, b] = 0
    normal = contacts.normal[i, b]
    if wp.length_sq(normal) > 0.0:
        depth = margin - wp.dot(p - contacts.point[i, b], normal)
        if depth > 0.0:
            p = p + depth * normal
            over = p - previous[i, b] - contacts.motion[i, b]
            slide = over - wp.dot(over, normal) * normal
            p = p - wp.min(1.0, friction * depth / (wp.length(slide) + TINY)) * slide
    x[i, b] = p


@wp.kernel(enable_backward=False)
def edge_kernel(
    first: int,
    margin: float,
    edges: wp.array2d[wp.int32],
    careful: wp.array[wp.int32],
    inverse_mass: wp.array2d[wp.float32],
    # in and out
    contacts: Contacts,
    x: wp.array2d[wp.vec3],
) -> None:
    """Keeps midpoints of the edges of one colour off the skin, in `careful` lanes."""
    t, b = wp.tid()
    if careful[b] == 0:
        return
    e = first + t
    normal = contacts.normal[e, b]
    if wp.length_sq(normal) == 0.0:
        return
    i, j = edges[e, 0], edges[e, 1]
    point = contacts.point[e, b] + contacts.motion[e, b]
    contacts.point[e, b] = point
    depth = margin - wp.dot(0.5 * (x[i, b] + x[j, b]) - point, normal)
    if depth > 0.0:
        wi, wj = inverse_mass[i, b], inverse_mass[j, b]
        s = depth / (wi + wj)
        x[i, b] = x[i, b] + (s * wi) * normal
        x[j, b] = x[j, b] + (s * wj) * normal


@wp.kernel(enable_backward=False)
def finish_kernel(
    h: float, max_step: float, previous: wp.array2d[wp.vec3], x: wp.array2d[wp.vec3], v: wp.array2d[wp.vec3]
) -> None:
    """The end of a time step: no vertex goes farther than `max_step`."""
    i, b = wp.tid()
    step = x[i, b] - previous[i, b]
    length = wp.length(step)
    if length > max_step:
        step = step * (max_step / length)
        x[i, b] = previous[i, b] + step
    v[i, b] = step / h


@wp.kernel(enable_backward=False)
def speed_kernel(v: wp.array2d[wp.vec3], total: wp.array2d[wp.float32]) -> None:
    """Sums of squared speeds (S, B), each of every S-th vertex."""
    s, b = wp.tid()
    squares = float(0.0)
    for i in range(s, v.shape[0], total.shape[0]):
        squares += wp.length_sq(v[i, b])
    total[s, b] = squares
