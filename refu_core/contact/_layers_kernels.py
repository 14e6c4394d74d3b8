"""How far one garment's vertices are from the outer side of another one's sheet: one code for CPU and CUDA."""

import warp as wp

from refu_core.sdf._closest_kernels import closest_on_face, mean_normal

# Nothing is so far from where it was at rest; it is a limit to what a sheet crumpled into itself may take.
MOST_STEPS = wp.constant(64)
# In place of the vertex that one comes to: it isn't near the sheet at rest, as a sleeve isn't near shorts.
STRANGER = wp.constant(-2)


@wp.struct
class Cut:
    """A garment's mesh, which doesn't change."""

    faces: wp.array2d[wp.int32]
    fan_start: wp.array[wp.int32]
    fan_face: wp.array[wp.int32]
    """The faces around vertex v are `fan_face[fan_start[v]:fan_start[v + 1]]`."""
    ring_start: wp.array[wp.int32]
    ring: wp.array[wp.int32]
    """Its neighbours, likewise."""
    rim: wp.array[wp.int32]
    """Bit k of a face's number is set where its feature k is on an open rim."""


@wp.struct
class LayerRules:
    """Lengths in metres."""

    gap: wp.float32
    reach: wp.float32
    longest: wp.float32
    agreement: wp.float32
    doubt: wp.float32


@wp.func
def normal_at(v: int, points: wp.array[wp.vec3], cut: Cut) -> wp.vec3:
    """Unit normal of a garment's vertex."""
    return mean_normal(v, points, cut.faces, cut.fan_start, cut.fan_face)


@wp.func
def heaviest(w: wp.vec3) -> int:
    """The corner of a face that weighs most."""
    return wp.where(w[0] >= w[1] and w[0] >= w[2], 0, wp.where(w[1] >= w[2], 1, 2))


@wp.func
def nearest_vertex(p: wp.vec3, start: int, points: wp.array[wp.vec3], cut: Cut) -> int:
    """The vertex downhill from `start`: none of its neighbours is nearer to p."""
    v = int(start)
    squared = wp.length_sq(points[v] - p)
    for _step in range(MOST_STEPS):
        best = int(v)
        for r in range(cut.ring_start[v], cut.ring_start[v + 1]):
            u = cut.ring[r]
            other = wp.length_sq(points[u] - p)
            if other < squared:
                squared = other
                best = u
        if best == v:
            break
        v = best
    return v


@wp.func
def nearest_face(p: wp.vec3, start: int, points: wp.array[wp.vec3], cut: Cut) -> int:
    """The face closest to p downhill from the fan of vertex `start`."""
    v = int(start)
    squared = float(wp.inf)
    face = int(-1)
    w = wp.vec3(1.0, 0.0, 0.0)
    for _step in range(MOST_STEPS):
        last = face
        for k in range(cut.fan_start[v], cut.fan_start[v + 1]):
            f = cut.fan_face[k]
            f_w, _feature, f_offset = closest_on_face(p, f, points, cut.faces)
            other = wp.length_sq(f_offset)
            if other < squared:
                squared = other
                face = f
                w = f_w
        # The closest vertex isn't always a corner of the closest face: on, at the corner that weighs most.
        corner = heaviest(w)
        if face == last or cut.faces[face, corner] == v:
            break
        v = cut.faces[face, corner]
    return face


@wp.func
def is_within(p: wp.vec3, extent: wp.array[wp.vec3], room: float) -> bool:
    """Whether p is no farther than `room` outside of the box between the corners `extent`."""
    above_low = p - extent[0]
    below_high = extent[1] - p
    return wp.min(wp.min(above_low), wp.min(below_high)) >= -room


@wp.kernel(enable_backward=False)
def normals_kernel(
    points: wp.array[wp.vec3],
    cut: Cut,
    # output
    normals: wp.array[wp.vec3],
) -> None:
    """Unit normals of a garment's vertices."""
    v = wp.tid()
    normals[v] = normal_at(v, points, cut)


@wp.kernel(enable_backward=False)
def search_kernel(
    each: int,
    goes_on: bool,
    given: wp.array[wp.vec3],
    below: wp.array[wp.vec3],
    below_cut: Cut,
    near_start: wp.array[int],
    near: wp.array[int],
    # outputs; a call that goes on begins with the last one's
    above: wp.array[wp.vec3],
    moved: wp.array[int],
    looks: wp.array[int],
    found: wp.array[int],
) -> None:
    """Takes over what is `given`, and finds the vertex of the sheet below that each vertex comes to, downhill.

    From the nearest of those to look from, which are `near[near_start[i]:near_start[i + 1]]`; `STRANGER` where there
    are none. A call that goes on looks only at what isn't where it was left, or was `moved` there, from what it found.
    `each` vertices a thread (`strips`).
    """
    first = wp.tid() * each
    for i in range(first, first + each):
        p = given[i]
        looks[i] = wp.where(goes_on and moved[i] == 0 and p == above[i], 0, 1)
        above[i] = p
        moved[i] = 0
        if looks[i] == 0:
            continue
        if near_start[i] == near_start[i + 1]:
            found[i] = STRANGER
            continue
        v = int(near[near_start[i]])
        if goes_on:
            v = found[i]
        else:
            squared = float(wp.inf)
            for n in range(near_start[i], near_start[i + 1]):
                other = wp.length_sq(below[near[n]] - p)
                if other < squared:
                    squared = other
                    v = near[n]
        found[i] = nearest_vertex(p, v, below, below_cut)


@wp.func
def normal_on(face: int, w: wp.vec3, normals: wp.array[wp.vec3], cut: Cut) -> wp.vec3:
    """Unit normal of a garment at a place on a face, between those of its vertices."""
    a = cut.faces[face, 0]
    b = cut.faces[face, 1]
    c = cut.faces[face, 2]
    return wp.normalize(w[0] * normals[a] + w[1] * normals[b] + w[2] * normals[c])


@wp.func
def closest_of_all(tree: wp.uint64, p: wp.vec3, reach: float) -> int:
    """The closest face of the whole sheet, -1 where none is within reach."""
    hit = wp.mesh_query_point_no_sign(tree, p, reach)
    face = int(-1)
    if hit.result:
        face = hit.face
    return face


@wp.func
def lift_off(
    i: int,
    face: int,
    below: wp.array[wp.vec3],
    below_normals: wp.array[wp.vec3],
    below_cut: Cut,
    above: wp.array[wp.vec3],
    above_cut: Cut,
    faces_it: bool,
    rules: LayerRules,
    # outputs
    push: wp.array[wp.vec3],
    count: wp.array[int],
) -> None:
    """What brings vertex i to the gap above the face of the sheet that is closest to it, if any is."""
    if face < 0:
        return
    w, feature, offset = closest_on_face(above[i], face, below, below_cut.faces)
    normal = normal_on(face, w, below_normals, below_cut)
    height = wp.dot(offset, normal)
    far = wp.length(offset)
    if height >= rules.gap or far > rules.reach:
        return
    agreement = wp.dot(normal_at(i, above, above_cut), normal)
    # A stranger's outside may face the sheet's: a sleeve that hangs beside shorts.
    agreement = wp.where(faces_it, wp.abs(agreement), agreement)
    share = wp.clamp(agreement / rules.agreement, 0.0, 1.0)
    # Whatever ends does so gradually, or cloth would jump from frame to frame.
    share *= wp.min(1.0, 4.0 * (1.0 - far / rules.reach))
    if (below_cut.rim[face] >> feature) & 1 != 0:
        share *= wp.max(0.0, 1.0 - wp.length(offset - height * normal) / rules.reach)
    lift = share * (rules.gap - height) * normal
    if wp.length_sq(lift) > 0.0:
        push[i] = lift
        wp.atomic_add(count, 0, 1)


@wp.kernel(enable_backward=False)
def lift_kernel(
    each: int,
    # the garment below
    tree: wp.uint64,
    below: wp.array[wp.vec3],
    below_normals: wp.array[wp.vec3],
    below_cut: Cut,
    extent: wp.array[wp.vec3],
    # the garment above
    above: wp.array[wp.vec3],
    above_cut: Cut,
    looks: wp.array[int],
    found: wp.array[int],
    rules: LayerRules,
    # outputs
    push: wp.array[wp.vec3],
    count: wp.array[int],
) -> None:
    """What brings each vertex that `looks` to the gap above the sheet, and how many they are that lack something.

    A fold that one vertex's search ended in is seldom in the way of its neighbours': what these `found` is looked at,
    too. Strangers, and whoever is far below the sheet, ask a tree. `each` vertices a thread (`strips`).
    """
    first = wp.tid() * each
    for i in range(first, first + each):
        push[i] = wp.vec3(0.0, 0.0, 0.0)
        if looks[i] == 0:
            continue
        p = above[i]
        v = int(found[i])
        if v == STRANGER:
            if is_within(p, extent, rules.gap):
                face = closest_of_all(tree, p, rules.reach)
                lift_off(i, face, below, below_normals, below_cut, above, above_cut, True, rules, push, count)
            continue
        squared = wp.length_sq(below[v] - p)
        # As near as that, it is the right fold.
        if 4.0 * squared > rules.longest * rules.longest:
            for r in range(above_cut.ring_start[i], above_cut.ring_start[i + 1]):
                beside = found[above_cut.ring[r]]
                if beside != STRANGER and beside != v:
                    other = wp.length_sq(below[beside] - p)
                    if other < squared:
                        squared = other
                        v = beside
            if v != found[i]:
                v = nearest_vertex(p, v, below, below_cut)
        # No point of a face is farther from its closest corner than from the middle of three edges of its longest one.
        if wp.length(below[v] - p) <= rules.reach + 0.578 * rules.longest:
            face = nearest_face(p, v, below, below_cut)
            w, _feature, offset = closest_on_face(p, face, below, below_cut.faces)
            is_low = wp.dot(offset, normal_on(face, w, below_normals, below_cut)) < rules.gap
            if is_low and wp.length(offset) > rules.doubt:
                face = closest_of_all(tree, p, rules.reach)
            lift_off(i, face, below, below_normals, below_cut, above, above_cut, False, rules, push, count)
