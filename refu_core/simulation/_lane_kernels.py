"""A time step of the cloth in many lanes: each kernel does for all lanes what a loop of `_solver` does for one.

Arrays are shaped as in `_lane_contact_kernels`; C is the number of distance constraints, K that of faces near a vertex.
"""

import warp as wp

from refu_core.simulation._cloth import PAST_EDGE
from refu_core.simulation._lane_contact_kernels import TINY, Contacts

FIXED = wp.constant(268435456.0)  # 2^28: pushes are added up as whole numbers, whose sum depends on no order
SHARE = wp.constant(0.25)  # of a lack of distance that one pair closes
SLACK = wp.constant(PAST_EDGE)


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
def push(i: int, b: int, way: wp.vec3, pushes: wp.array3d[wp.int32]) -> None:
    """Adds to the push of a vertex, in whole numbers."""
    wp.atomic_add(pushes, 0, i, b, int(way[0] * FIXED))
    wp.atomic_add(pushes, 1, i, b, int(way[1] * FIXED))
    wp.atomic_add(pushes, 2, i, b, int(way[2] * FIXED))


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
