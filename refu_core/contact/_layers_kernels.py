"""Brings one garment's vertices to the outer side of another one's sheet: one code for CPU and CUDA."""

import warp as wp

from refu_core.sdf._closest_kernels import area_normal, closest_on_face

wp.set_module_options({"enable_backward": False})

# Steps of a search. No vertex moves so far from its place at rest; this bounds the search on a crumpled sheet.
MOST_STEPS = wp.constant(64)
# Stands for the vertex found, where a vertex isn't near the sheet at rest, as a sleeve isn't near shorts.
STRANGER = wp.constant(-2)


@wp.struct
class Cut:
    """A mesh, which doesn't change."""

    faces: wp.array2d[wp.int32]
    fan_start: wp.array[wp.int32]
    fan_face: wp.array[wp.int32]
    """The faces around vertex v are `fan_face[fan_start[v]:fan_start[v + 1]]`."""
    ring_start: wp.array[wp.int32]
    ring: wp.array[wp.int32]
    """Its neighbours, likewise."""
    rim: wp.array[wp.int32]
    """Bit k of a face's number is set where its feature k (as `closest_on_triangle` numbers them) is on an open rim."""


@wp.struct
class Below:
    """A sheet in a pose."""

    points: wp.array[wp.vec3]
    """[m]"""
    normals: wp.array[wp.vec3]
    """Unit normals of its vertices."""
    extent: wp.array[wp.vec3]
    """Two corners of the box around it [m]."""
    tree: wp.uint64
    """Warp's handle of a tree of its faces."""
    cut: Cut


@wp.struct
class Above:
    """The garment above a sheet, and memory to bring it off in."""

    given: wp.array[wp.vec3]
    """Its vertices [m]."""
    points: wp.array[wp.vec3]
    """Where they go [m]."""
    cut: Cut
    start: wp.array[wp.int32]
    near: wp.array[wp.int32]
    """Vertex i looks from the sheet's vertices `near[start[i]:start[i + 1]]`."""
    looks: wp.array[wp.int32]
    """Whether a vertex has to be looked at in this call."""
    found: wp.array[wp.int32]
    """The vertex of the sheet at which each one's search ended, or `STRANGER`."""
    moved: wp.array[wp.int32]
    """Whether the last call has moved it."""
    push: wp.array[wp.vec3]
    """The displacement that brings it to the gap above the sheet [m]."""
    field: wp.array[wp.vec3]
    smoother: wp.array[wp.vec3]
    reached: wp.array[wp.int32]
    is_reached: wp.array[wp.int32]
    """Memory for the sweeps; on a CPU all but `reached` is zero between launches."""
    count: wp.array[wp.int32]
    """How many have a push."""


@wp.struct
class LayerRules:
    """Lengths in metres."""

    gap: wp.float32
    reach: wp.float32
    longest: wp.float32
    alike: wp.float32
    asks_tree: wp.bool
    """Whether strangers, and vertices far below the sheet, are brought off whatever of it is closest."""


@wp.func
def normal_at(v: int, points: wp.array[wp.vec3], cut: Cut) -> wp.vec3:
    """Unit normal at a vertex, its faces weighted by area."""
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(cut.fan_start[v], cut.fan_start[v + 1]):
        total += area_normal(cut.fan_face[k], points, cut.faces)
    return wp.normalize(total)


@wp.func
def gather(n: int, rounds: int, cut: Cut, rows: wp.array[int], is_listed: wp.array[int]) -> int:
    """Lists after the first n `rows` the vertices up to `rounds` edges away, and returns how many there are in all."""
    first = int(0)
    last = int(n)
    found = int(n)
    for _ in range(rounds):
        for k in range(first, last):
            for r in range(cut.ring_start[rows[k]], cut.ring_start[rows[k] + 1]):
                j = cut.ring[r]
                if is_listed[j] == 0:
                    is_listed[j] = 1
                    rows[found] = j
                    found += 1
        first = last
        last = found
    return found


@wp.func
def heaviest(w: wp.vec3) -> int:
    """The corner of a face with the largest barycentric weight."""
    return wp.where(w[0] >= w[1] and w[0] >= w[2], 0, wp.where(w[1] >= w[2], 1, 2))


@wp.func
def nearest_vertex(p: wp.vec3, start: int, below: Below) -> int:
    """The vertex downhill from `start`: none of its neighbours is nearer to p."""
    v = int(start)
    squared = wp.length_sq(below.points[v] - p)
    for _step in range(MOST_STEPS):
        best = int(v)
        for r in range(below.cut.ring_start[v], below.cut.ring_start[v + 1]):
            u = below.cut.ring[r]
            other = wp.length_sq(below.points[u] - p)
            if other < squared:
                squared = other
                best = u
        if best == v:
            break
        v = best
    return v


@wp.func
def nearest_face(p: wp.vec3, start: int, below: Below) -> tuple[int, wp.vec3, int, wp.vec3]:
    """The face closest to p downhill from the fan of vertex `start`, and what `closest_on_face` says of it."""
    v = int(start)
    squared = float(wp.inf)
    face = int(-1)
    w = wp.vec3(1.0, 0.0, 0.0)
    feature = int(0)
    offset = wp.vec3()
    for _step in range(MOST_STEPS):
        last = face
        for k in range(below.cut.fan_start[v], below.cut.fan_start[v + 1]):
            f = below.cut.fan_face[k]
            f_w, f_feature, f_offset = closest_on_face(p, f, below.points, below.cut.faces)
            other = wp.length_sq(f_offset)
            if other < squared:
                squared = other
                face = f
                w = f_w
                feature = f_feature
                offset = f_offset
        # The closest vertex isn't always a corner of the closest face: go on at the corner of largest weight.
        corner = heaviest(w)
        if face == last or below.cut.faces[face, corner] == v:
            break
        v = below.cut.faces[face, corner]
    return face, w, feature, offset


@wp.func
def is_within(p: wp.vec3, extent: wp.array[wp.vec3], room: float) -> bool:
    """Whether p is no farther than `room` outside of the box between the corners `extent`."""
    above_low = p - extent[0]
    below_high = extent[1] - p
    return wp.min(wp.min(above_low), wp.min(below_high)) >= -room


@wp.kernel
def normals_kernel(points: wp.array[wp.vec3], cut: Cut, normals: wp.array[wp.vec3]) -> None:
    """`normal_at` each vertex."""
    v = wp.tid()
    normals[v] = normal_at(v, points, cut)


@wp.kernel
def search_kernel(each: int, goes_on: bool, below: Below, above: Above) -> None:
    """Takes over the given vertices, and searches the sheet downhill for the vertex nearest to each.

    The search starts at the nearest of the vertex's starts. A call that goes on starts at what the last call found, and
    skips vertices that the last call didn't move and that are where it left them. `each` vertices a thread (`strips`).
    """
    first = wp.tid() * each
    for i in range(first, first + each):
        p = above.given[i]
        above.looks[i] = wp.where(goes_on and above.moved[i] == 0 and p == above.points[i], 0, 1)
        above.points[i] = p
        above.moved[i] = 0
        if above.looks[i] == 0:
            continue
        if above.start[i] == above.start[i + 1]:
            above.found[i] = STRANGER
            continue
        v = int(above.near[above.start[i]])
        if goes_on:
            v = above.found[i]
        else:
            squared = float(wp.inf)
            for n in range(above.start[i], above.start[i + 1]):
                other = wp.length_sq(below.points[above.near[n]] - p)
                if other < squared:
                    squared = other
                    v = above.near[n]
        above.found[i] = nearest_vertex(p, v, below)


@wp.func
def normal_on(face: int, w: wp.vec3, below: Below) -> wp.vec3:
    """Unit normal of the sheet at a place on a face, interpolated between those of its vertices."""
    a = below.cut.faces[face, 0]
    b = below.cut.faces[face, 1]
    c = below.cut.faces[face, 2]
    return wp.normalize(w[0] * below.normals[a] + w[1] * below.normals[b] + w[2] * below.normals[c])


@wp.func
def lift_off(
    i: int, face: int, w: wp.vec3, feature: int, offset: wp.vec3, below: Below, above: Above, rules: LayerRules
) -> None:
    """Stores the displacement that brings vertex i to the gap above its closest place on the sheet."""
    normal = normal_on(face, w, below)
    height = wp.dot(offset, normal)
    far = wp.length(offset)
    if height >= rules.gap or far > rules.reach:
        return
    # Cloth lies on the sheet and faces as it does, or faces it: a sleeve beside shorts, a hem in the crease of a hip.
    agreement = wp.abs(wp.dot(normal_at(i, above.points, above.cut), normal))
    share = wp.min(1.0, agreement / rules.alike)
    # Every influence fades out gradually; otherwise cloth would jump from frame to frame.
    share *= wp.min(1.0, 4.0 * (1.0 - far / rules.reach))
    if (below.cut.rim[face] >> feature) & 1 != 0:
        share *= wp.max(0.0, 1.0 - wp.length(offset - height * normal) / rules.reach)
    lift = share * (rules.gap - height) * normal
    if wp.length_sq(lift) > 0.0:
        above.push[i] = lift
        wp.atomic_add(above.count, 0, 1)


@wp.func
def lift_off_all(i: int, below: Below, above: Above, rules: LayerRules) -> None:
    """`lift_off` the closest face of the whole sheet, if one is within reach."""
    hit = wp.mesh_query_point_no_sign(below.tree, above.points[i], rules.reach)
    if hit.result:
        w, feature, offset = closest_on_face(above.points[i], hit.face, below.points, below.cut.faces)
        lift_off(i, hit.face, w, feature, offset, below, above, rules)


@wp.kernel
def lift_kernel(each: int, below: Below, above: Above, rules: LayerRules) -> None:
    """Stores what brings each vertex that is looked at to the gap above the sheet, and counts those below the gap.

    Where one vertex's search ended in a fold, its neighbours' seldom did, so what these found is tried, too. Strangers,
    and vertices far below the sheet, ask a tree. `each` vertices a thread (`strips`).
    """
    first = wp.tid() * each
    for i in range(first, first + each):
        above.push[i] = wp.vec3(0.0, 0.0, 0.0)
        if above.looks[i] == 0:
            continue
        p = above.points[i]
        v = int(above.found[i])
        if v == STRANGER:
            if rules.asks_tree and is_within(p, below.extent, rules.gap):
                lift_off_all(i, below, above, rules)
            continue
        squared = wp.length_sq(below.points[v] - p)
        # A vertex this near is in the right fold.
        if 4.0 * squared > rules.longest * rules.longest:
            for r in range(above.cut.ring_start[i], above.cut.ring_start[i + 1]):
                beside = above.found[above.cut.ring[r]]
                if beside != STRANGER and beside != v:
                    other = wp.length_sq(below.points[beside] - p)
                    if other < squared:
                        squared = other
                        v = beside
            if v != above.found[i]:
                v = nearest_vertex(p, v, below)
        # No point of a face is farther from its closest corner than the middle of an equilateral one: 0.578 of an edge.
        if wp.length(below.points[v] - p) <= rules.reach + 0.578 * rules.longest:
            face, w, feature, offset = nearest_face(p, v, below)
            if wp.dot(offset, normal_on(face, w, below)) < rules.gap:
                if rules.asks_tree and wp.length(offset) > 0.5 * rules.reach:  # this may be another fold
                    lift_off_all(i, below, above, rules)
                else:
                    lift_off(i, face, w, feature, offset, below, above, rules)


@wp.func
def spread(i: int, above: Above, field: wp.array[wp.vec3], smoother: wp.array[wp.vec3]) -> None:
    """One round of `Blend.spread`."""
    start = above.cut.ring_start[i]
    end = above.cut.ring_start[i + 1]
    total = wp.vec3(0.0, 0.0, 0.0)
    for r in range(start, end):
        total += field[above.cut.ring[r]]
    mean = total / float(wp.max(end - start, 1))
    length = wp.length(above.push[i])
    if length > 0.0:
        way = above.push[i] / length
        mean += wp.max(0.0, length - wp.dot(mean, way)) * way
    smoother[i] = mean


@wp.kernel
def spread_kernel(above: Above, field: wp.array[wp.vec3], smoother: wp.array[wp.vec3]) -> None:
    """`spread`, one vertex a thread."""
    spread(wp.tid(), above, field, smoother)


@wp.kernel
def move_kernel(above: Above) -> None:
    """Moves the vertices."""
    i = wp.tid()
    above.points[i] += above.field[i]
    above.moved[i] = wp.where(wp.length_sq(above.field[i]) > 0.0, 1, 0)


@wp.kernel
def move_all_kernel(above: Above, rounds: int) -> None:
    """All rounds, and the move, by one thread: for pushed vertices, and for those that the rounds reach from them."""
    n = int(0)
    for i in range(above.push.shape[0]):
        if wp.length_sq(above.push[i]) > 0.0:
            above.field[i] = above.push[i]
            above.is_reached[i] = 1
            above.reached[n] = i
            n += 1
    n = gather(n, rounds, above.cut, above.reached, above.is_reached)
    for sweep in range(rounds):
        for k in range(n):
            if sweep % 2 == 0:
                spread(above.reached[k], above, above.field, above.smoother)
            else:
                spread(above.reached[k], above, above.smoother, above.field)
    for k in range(n):
        i = above.reached[k]
        above.points[i] += above.field[i]
        above.moved[i] = 1
        above.is_reached[i] = 0
        above.field[i] = wp.vec3()
        above.smoother[i] = wp.vec3()
