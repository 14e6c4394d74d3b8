"""What the cloth of many lanes is near: skin below its vertices, and other parts of itself.

Arrays of N vertices, E edges or A anchors and B lanes are shaped (N, B): neighbouring threads work on the same vertex
of neighbouring lanes, so that a GPU reads and writes whole lines of memory. Units are those of `_solver`.
"""

import warp as wp

TINY = wp.constant(1.0e-12)


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
class LaneSkin:
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
def ask(p: wp.vec3, is_all: bool, i: int, b: int, skin: LaneSkin, asked: Asked) -> None:
    """Asks for the skin below point i of lane b, if it has moved too far since it last asked."""
    known = asked.distance[i, b]
    allowed = wp.where(known > skin.near + skin.slide, known - skin.near, skin.slide)
    if not is_all and wp.length_sq(p - asked.at[i, b]) <= allowed * allowed:
        return
    asked.at[i, b] = p
    hit = wp.mesh_query_point_sign_normal(skin.mesh, p + skin.origin[b], skin.reach, 1.0e-3)
    if not hit.result:
        asked.face[i, b] = -1
        asked.distance[i, b] = skin.reach
        return
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


@wp.func
def meet(i: int, b: int, skin: LaneSkin, asked: Asked, contacts: Contacts) -> None:
    """The contact of point i of lane b, if the skin is near."""
    f = asked.face[i, b]
    if f < 0 or asked.distance[i, b] >= 2.0 * skin.near:
        contacts.normal[i, b] = wp.vec3(0.0, 0.0, 0.0)
        return
    w = asked.weights[i, b]
    q, r, s = skin.faces[f, 0], skin.faces[f, 1], skin.faces[f, 2]
    contacts.point[i, b] = w[0] * skin.vertices[b, q] + w[1] * skin.vertices[b, r] + w[2] * skin.vertices[b, s]
    contacts.motion[i, b] = w[0] * skin.motion[b, q] + w[1] * skin.motion[b, r] + w[2] * skin.motion[b, s]
    contacts.normal[i, b] = asked.normal[i, b]


@wp.kernel(enable_backward=False)
def touch_kernel(
    x: wp.array2d[wp.vec3],
    refreshed: wp.array[wp.int32],
    moved_on: wp.array[wp.int32],
    skin: LaneSkin,
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
    skin: LaneSkin,
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
