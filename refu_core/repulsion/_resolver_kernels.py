# mypy: ignore-errors
# ruff: noqa: UP018
# (Warp reads a kernel's annotations as array types of its own; a type checker can't. A variable that changes in a loop
# has to be called int or float there.)
"""The steps of `resolve`, each over the vertices that it concerns: one code for CPU and CUDA.

Lists of vertices are filled by kernels: `counts[NAME]` says how many they are. On a CPU they are in order, on a GPU in
any; nothing depends on it.
"""

import warp as wp

from refu_core.sdf import Skin, ask

# What a kernel counts.
NEAR = wp.constant(0)  # vertices nearer than the margin
PUSHED = wp.constant(1)  # those of them that are pushed along the gradient
REACHED = wp.constant(2)  # vertices that a push reaches by way of its neighbours
SUSPECTS = wp.constant(3)  # vertices at the ends of edges along which distances contradict each other
INSIDE = wp.constant(4)
MOVED = wp.constant(5)  # of those nearer than the margin
STUCK = wp.constant(6)  # inside after all
RAISED = wp.constant(7)  # ends of edges that cut the skin
CHANGED = wp.constant(8)  # distances that were mended
CUTTING = wp.constant(9)  # such edges; a number for each round follows
N_COUNTS = 16

# A vertex's role: pushed along the gradient, or out of another limb on the near side.
FREE = wp.constant(0)
LEFT = wp.constant(1)
MISSED = wp.constant(2)  # found no room on its own
FILLED = wp.constant(3)  # found it where its neighbours are
BACK = wp.constant(4)  # found none, so is pushed

# A vertex reached by pushes, or pushed itself.
BESIDE = wp.constant(1)
SOURCE = wp.constant(2)


@wp.struct
class Cloth:
    """What doesn't change of a garment and the body's limbs."""

    ring_start: wp.array(dtype=wp.int32)
    ring: wp.array(dtype=wp.int32)
    """The neighbours of vertex i are `ring[ring_start[i]:ring_start[i + 1]]`."""
    fan_start: wp.array(dtype=wp.int32)
    fan: wp.array(dtype=wp.int32)
    """The faces around it, likewise."""
    faces: wp.array2d(dtype=wp.int32)
    edges: wp.array2d(dtype=wp.int32)
    own: wp.array(dtype=wp.int32)
    """A bit for each limb that a vertex lies on."""
    clearance: wp.array(dtype=wp.float32)
    """How far off the skin it is cut [m]."""
    limb: wp.array(dtype=wp.int32)
    """Limb of each body face."""


@wp.struct
class Rules:
    """Numbers that are the same for all vertices; lengths in metres."""

    margin: wp.float32
    tolerance: wp.float32
    max_displacement: wp.float32
    max_pushes: wp.int32
    contradiction: wp.float32
    step_on: wp.float32
    deep: wp.float32
    sideways: wp.float32
    inward: wp.float32
    farthest: wp.float32
    detour: wp.float32
    sure: wp.float32
    bulge: wp.float32
    retreats: wp.int32
    turns: wp.int32


@wp.struct
class Sheet:
    """A garment in one frame, by vertex; lengths in metres."""

    origin: wp.array(dtype=wp.vec3)
    """Before."""
    first: wp.array(dtype=wp.float32)
    first_gradient: wp.array(dtype=wp.vec3)
    first_face: wp.array(dtype=wp.int32)
    """Distance there."""
    place: wp.array(dtype=wp.vec3)
    """The best place so far."""
    distance: wp.array(dtype=wp.float32)
    gradient: wp.array(dtype=wp.vec3)
    face: wp.array(dtype=wp.int32)
    """Distance there."""
    outward: wp.array(dtype=wp.vec3)
    """Unit normal, where a limb is near that may not pull the cloth through itself."""
    along: wp.array(dtype=wp.float32)
    """Cosine of gradient and normal."""
    way: wp.array(dtype=wp.float32)
    """How far a push is to go."""
    heading: wp.array(dtype=wp.vec3)
    """Unit direction of it."""
    depth: wp.array(dtype=wp.float32)
    """Distance that the push starts from."""
    goal: wp.array(dtype=wp.float32)
    """Distance that it leads to."""
    guess: wp.array(dtype=wp.int32)
    """A face that may be closer."""
    role: wp.array(dtype=wp.int32)
    mark: wp.array(dtype=wp.int32)
    counts: wp.array(dtype=wp.int32)
    touched: wp.array(dtype=wp.int32)
    """Vertices at each limb that they don't lie on."""
    inward: wp.array(dtype=wp.int32)
    """Those of them that it pushes inwards."""


@wp.func
def bounded(moved: wp.vec3, origin: wp.vec3, most: float):
    """`moved`, drawn back to within `most` of where the vertex began."""
    way = moved - origin
    return origin + way * wp.min(1.0, most / wp.max(wp.length(way), 1.0e-12))


@wp.func
def normal_of(i: int, cloth: Cloth, points: wp.array(dtype=wp.vec3)):
    """Unit normal of the garment at a vertex, its faces weighted by area."""
    total = wp.vec3()
    for k in range(cloth.fan_start[i], cloth.fan_start[i + 1]):
        face = cloth.fan[k]
        a = points[cloth.faces[face, 0]]
        total += wp.cross(points[cloth.faces[face, 1]] - a, points[cloth.faces[face, 2]] - a)
    return wp.normalize(total)


@wp.func
def keep(i: int, place: wp.vec3, distance: float, gradient: wp.vec3, face: int, sheet: Sheet):
    sheet.place[i] = place
    sheet.distance[i] = distance
    sheet.gradient[i] = gradient
    sheet.face[i] = face


@wp.func
def push_on(
    i: int, here: wp.vec3, distance: float, gradient: wp.vec3, scale: float, sheet: Sheet, skin: Skin, rules: Rules
):
    """Pushes a vertex from `here` until it is clear, and keeps the best place; half as far once it is thrown back."""
    goal = wp.min(distance + scale * (rules.margin - distance), rules.margin) - rules.tolerance
    # One loop with one call of `ask`, here as elsewhere: so its code is there once.
    for _round in range(rules.max_pushes):
        if distance < rules.margin:
            offset = scale * (rules.margin - distance)
            here = here + wp.clamp(offset, -rules.max_displacement, rules.max_displacement) * gradient
        here = bounded(here, sheet.origin[i], rules.max_displacement)
        last = gradient
        distance, gradient, face = ask(skin, here, sheet.face[i])
        if distance > sheet.distance[i]:
            keep(i, here, distance, gradient, face, sheet)
        if distance >= goal:
            break
        scale = wp.where(wp.dot(last, gradient) < 0.0, 0.5, 1.0)


@wp.func
def contradict(i: int, j: int, sheet: Sheet, rules: Rules):
    """Whether the distances of two neighbours, one of them at the skin, differ by more than they are apart."""
    first = sheet.distance[i]
    second = sheet.distance[j]
    excess = wp.abs(first - second) - rules.contradiction
    if excess <= 0.0 or wp.min(first, second) >= rules.margin:
        return False
    return excess > wp.length(sheet.origin[i] - sheet.origin[j])


@wp.func
def suspect(i: int, sheet: Sheet, suspects: wp.array(dtype=int)):
    if wp.atomic_max(sheet.mark, i, BESIDE) == 0:
        suspects[wp.atomic_add(sheet.counts, SUSPECTS, 1)] = i


@wp.kernel(enable_backward=False)
def begin_kernel(sheet: Sheet):
    """Everybody where it is."""
    i = wp.tid()
    keep(i, sheet.origin[i], sheet.first[i], sheet.first_gradient[i], sheet.first_face[i], sheet)
    if sheet.first_face[i] < 0:
        sheet.gradient[i] = wp.vec3()  # beyond a band nothing is known
    sheet.role[i] = FREE


@wp.kernel(enable_backward=False)
def compare_kernel(sheet: Sheet, cloth: Cloth, rules: Rules, suspects: wp.array(dtype=int)):
    """Lists the ends of edges at the skin along which distances contradict each other."""
    i = wp.tid()
    if sheet.distance[i] >= rules.margin:
        return
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        j = cloth.ring[k]
        if contradict(i, j, sheet, rules):
            suspect(i, sheet, suspects)
            suspect(j, sheet, suspects)


@wp.kernel(enable_backward=False)
def look_again_kernel(sheet: Sheet, cloth: Cloth, skin: Skin, rules: Rules, suspects: wp.array(dtype=int)):
    """`mend`'s first remedy: from the faces of neighbours that are nearer to theirs a nearer one may be found."""
    i = suspects[wp.tid()]
    sheet.guess[i] = -1
    nearest = wp.abs(sheet.distance[i])
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        j = cloth.ring[k]
        if wp.abs(sheet.distance[j]) < wp.abs(sheet.distance[i]) and contradict(i, j, sheet, rules):
            distance, gradient, face = ask(skin, sheet.origin[i], sheet.face[j])
            if wp.abs(distance) < nearest:
                nearest = wp.abs(distance)
                sheet.depth[i] = distance
                sheet.heading[i] = gradient
                sheet.guess[i] = face


@wp.kernel(enable_backward=False)
def cut_off_kernel(sheet: Sheet, cloth: Cloth, rules: Rules, suspects: wp.array(dtype=int)):
    """`mend`'s second: what is said to be outside of flesh that a neighbour is in goes with the neighbour."""
    i = suspects[wp.tid()]
    sheet.guess[i] = -1
    nearest = float(1.0e12)
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        j = cloth.ring[k]
        within = sheet.distance[j]
        if within < 0.0 and within < sheet.distance[i] and cloth.own[i] == 1 << cloth.limb[sheet.face[j]]:
            to_plane = within + wp.dot(sheet.origin[i] - sheet.origin[j], sheet.gradient[j])
            if (
                to_plane < sheet.distance[i] - rules.contradiction
                and wp.abs(to_plane) < nearest
                and contradict(i, j, sheet, rules)
            ):
                nearest = wp.abs(to_plane)
                sheet.depth[i] = to_plane
                sheet.heading[i] = sheet.gradient[j]
                sheet.guess[i] = sheet.face[j]


@wp.kernel(enable_backward=False)
def adopt_kernel(sheet: Sheet, cloth: Cloth, suspects: wp.array(dtype=int)):
    """Takes over what was found, and suspects the neighbours of what changed."""
    i = suspects[wp.tid()]
    if sheet.guess[i] < 0:
        return
    wp.atomic_add(sheet.counts, CHANGED, 1)
    sheet.first[i] = sheet.depth[i]
    sheet.first_gradient[i] = sheet.heading[i]
    sheet.first_face[i] = sheet.guess[i]
    keep(i, sheet.origin[i], sheet.depth[i], sheet.heading[i], sheet.guess[i], sheet)
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        suspect(cloth.ring[k], sheet, suspects)


@wp.kernel(enable_backward=False)
def list_kernel(sheet: Sheet, rules: Rules, near: wp.array(dtype=int)):
    """Lists who is nearer than the margin."""
    i = wp.tid()
    sheet.mark[i] = 0
    if sheet.distance[i] < rules.margin:
        near[wp.atomic_add(sheet.counts, NEAR, 1)] = i


@wp.kernel(enable_backward=False)
def look_kernel(sheet: Sheet, cloth: Cloth, rules: Rules, near: wp.array(dtype=int)):
    """Which way the cloth faces where that matters, and who is pushed inwards by a limb it doesn't lie on."""
    i = near[wp.tid()]
    limb = cloth.limb[sheet.face[i]]
    foreign = (cloth.own[i] >> limb) & 1 == 0
    if foreign or sheet.distance[i] < -rules.deep:
        outward = normal_of(i, cloth, sheet.origin)
        along = wp.dot(sheet.gradient[i], outward)
        sheet.outward[i] = outward
        sheet.along[i] = along
        if foreign:
            wp.atomic_add(sheet.touched, limb, 1)
            if along < 0.0:
                wp.atomic_add(sheet.inward, limb, 1)


@wp.kernel(enable_backward=False)
def retreat_kernel(sheet: Sheet, cloth: Cloth, skin: Skin, rules: Rules, near: wp.array(dtype=int)):
    """What the gradient would take out on the far side of another limb goes back against its normal instead."""
    i = near[wp.tid()]
    limb = cloth.limb[sheet.face[i]]
    if (cloth.own[i] >> limb) & 1 == 1 or sheet.along[i] <= rules.sideways:
        return
    # A limb that nearly all of the cloth would leave outwards is under the cloth: there the gradient is right.
    if float(sheet.inward[limb]) < rules.inward * float(sheet.touched[limb]):
        return
    here = sheet.origin[i]
    distance = float(sheet.distance[i])
    way = float(0.0)
    room = cloth.clearance[i]
    for _step in range(rules.retreats):
        # No surface is nearer than |f|: a step of |f| can't jump over the room that is sought, however narrow it is.
        step = wp.min(-distance, room - way) + rules.step_on
        here = here - step * sheet.outward[i]
        way += step
        distance, gradient, face = ask(skin, here, sheet.face[i])
        if distance > sheet.distance[i]:
            keep(i, here, distance, gradient, face, sheet)
        if distance > 0.0 or way >= room:
            break
    sheet.role[i] = wp.where(sheet.distance[i] < 0.0, MISSED, LEFT)


@wp.kernel(enable_backward=False)
def fill_kernel(sheet: Sheet, cloth: Cloth, skin: Skin, near: wp.array(dtype=int)):
    """The few that found no room go where their neighbours went."""
    i = near[wp.tid()]
    if sheet.role[i] != MISSED:
        return
    total = wp.vec3()
    number = float(0.0)
    for k in range(cloth.fan_start[i], cloth.fan_start[i + 1]):
        for corner in range(3):
            j = cloth.faces[cloth.fan[k], corner]
            # Roles are written meanwhile, but none of these becomes one that isn't.
            if j != i and sheet.role[j] < MISSED:
                total += sheet.place[j]
                number += 1.0
    here = sheet.place[i]
    if number > 0.0:
        here = total / number
    distance, gradient, face = ask(skin, here, sheet.face[i])
    if distance > 0.0:
        keep(i, here, distance, gradient, face, sheet)
        sheet.role[i] = FILLED
    else:
        # No room at all: out on the far side.
        keep(i, sheet.origin[i], sheet.first[i], sheet.first_gradient[i], sheet.first_face[i], sheet)
        sheet.role[i] = BACK


@wp.kernel(enable_backward=False)
def aim_kernel(
    sheet: Sheet,
    cloth: Cloth,
    skin: Skin,
    rules: Rules,
    near: wp.array(dtype=int),
    # outputs
    pushed: wp.array(dtype=int),
    reached: wp.array(dtype=int),
    field: wp.array(dtype=wp.vec3),
):
    """Which way each vertex goes: those that left a limb as far as they are; the others are listed, to be pushed."""
    i = near[wp.tid()]
    role = sheet.role[i]
    if role == LEFT or role == FILLED:  # noqa: SIM109
        # In the room between limb and skin the gradient keeps to the middle, or at the margin where it is wide enough.
        push_on(i, sheet.place[i], sheet.distance[i], sheet.gradient[i], 1.0, sheet, skin, rules)
        push = sheet.place[i] - sheet.origin[i]
        way = wp.length(push)
        if way == 0.0:
            sheet.role[i] = FREE  # nowhere better than where it was, outside: as anyone's neighbour
            return
        sheet.way[i] = way
        sheet.heading[i] = push / way
        field[i] = push
        sheet.mark[i] = SOURCE
        reached[wp.atomic_add(sheet.counts, REACHED, 1)] = i
        return
    depth = sheet.distance[i]
    heading = sheet.gradient[i]
    limb = cloth.limb[sheet.face[i]]
    if depth < -rules.deep and cloth.own[i] == 1 << limb and sheet.along[i] < 0.0:
        # In the middle of a thin limb the closest skin of one vertex is in front and that of the next one behind:
        # all go along the cloth's normal, as far as that is.
        outward = sheet.outward[i]
        way = -depth
        farthest = wp.min(rules.farthest, rules.detour * way)
        turned = bool(False)
        for _look in range(rules.turns):
            height, _gradient, _face = ask(skin, sheet.origin[i] + way * outward, sheet.face[i])
            way = way - height
            if height >= 0.0:
                turned = way > 0.0 and way < farthest
                break
            way += rules.step_on
            if way >= farthest:
                break
        if turned:
            depth = -way
            heading = outward
    sheet.depth[i] = depth
    sheet.heading[i] = heading
    pushed[wp.atomic_add(sheet.counts, PUSHED, 1)] = i


@wp.kernel(enable_backward=False)
def scale_kernel(
    sheet: Sheet,
    rules: Rules,
    pushed: wp.array(dtype=int),
    alpha: wp.array(dtype=float),
    # outputs
    reached: wp.array(dtype=int),
    field: wp.array(dtype=wp.vec3),
):
    """How far each pushed vertex goes, for predicted scales: at least until it is outside."""
    k = wp.tid()
    i = pushed[k]
    deficit = rules.margin - sheet.depth[i]
    # Where α is below 1, the distance was predicted to exaggerate; its sign is trusted all the same.
    scale = wp.max(alpha[k], (wp.min(rules.tolerance, rules.margin) - sheet.depth[i]) / deficit)
    way = wp.min(scale * deficit, rules.max_displacement)
    sheet.goal[i] = wp.min(sheet.depth[i] + scale * deficit, rules.margin)
    sheet.way[i] = way
    field[i] = way * sheet.heading[i]
    sheet.mark[i] = SOURCE
    reached[wp.atomic_add(sheet.counts, REACHED, 1)] = i


@wp.kernel(enable_backward=False)
def reach_kernel(sheet: Sheet, cloth: Cloth, first: int, reached: wp.array(dtype=int)):
    """Lists the neighbours of those listed from `first` on."""
    i = reached[first + wp.tid()]
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        j = cloth.ring[k]
        if wp.atomic_max(sheet.mark, j, BESIDE) == 0:
            reached[wp.atomic_add(sheet.counts, REACHED, 1)] = j


@wp.kernel(enable_backward=False)
def spread_kernel(
    sheet: Sheet,
    cloth: Cloth,
    reached: wp.array(dtype=int),
    field: wp.array(dtype=wp.vec3),
    # output
    smoother: wp.array(dtype=wp.vec3),
):
    """One Jacobi sweep of `Blend.spread`: the mean of the neighbours, but no less than a vertex has to go."""
    i = reached[wp.tid()]
    first = cloth.ring_start[i]
    last = cloth.ring_start[i + 1]
    total = wp.vec3()
    for k in range(first, last):
        total += field[cloth.ring[k]]
    if last > first:
        total = total / float(last - first)
    if sheet.mark[i] == SOURCE:
        lack = sheet.way[i] - wp.dot(total, sheet.heading[i])
        total += wp.max(lack, 0.0) * sheet.heading[i]
    smoother[i] = total


@wp.kernel(enable_backward=False)
def settle_kernel(
    sheet: Sheet,
    skin: Skin,
    rules: Rules,
    reached: wp.array(dtype=int),
    # outputs
    field: wp.array(dtype=wp.vec3),
    smoother: wp.array(dtype=wp.vec3),
):
    """Takes vertices along, and pushes on those that aren't clear yet. Leaves fields and marks empty."""
    i = reached[wp.tid()]
    shift = field[i]
    mark = sheet.mark[i]
    field[i] = wp.vec3()
    smoother[i] = wp.vec3()
    sheet.mark[i] = 0
    role = sheet.role[i]
    if role == LEFT or role == FILLED:  # noqa: SIM109
        return
    origin = sheet.origin[i]
    here = bounded(origin + shift, origin, rules.max_displacement)
    known = sheet.distance[i]
    if mark != SOURCE:
        # No vertex gets nearer by more than it moves: what stays beyond the margin needn't be asked.
        floor = wp.min(known, rules.margin + rules.sure) - wp.length(here - origin)
        if floor >= rules.margin + rules.tolerance:
            sheet.place[i] = here
            sheet.distance[i] = floor
            return
    goal = rules.margin
    if mark == SOURCE:
        goal = sheet.goal[i]
    distance, gradient, face = ask(skin, here, sheet.face[i])
    if distance >= goal - rules.tolerance:
        keep(i, here, distance, gradient, face, sheet)
        return
    if mark != SOURCE:
        return  # a neighbour that would come too close stays where it was
    if distance > known:
        keep(i, here, distance, gradient, face, sheet)
    else:
        here = origin
        distance = sheet.depth[i]
        gradient = sheet.heading[i]
    push_on(i, here, distance, gradient, (goal - distance) / (rules.margin - distance), sheet, skin, rules)
    if sheet.distance[i] < 0.0:
        sheet.place[i] = origin
        sheet.distance[i] = sheet.first[i]


@wp.func
def look_between(edge: int, sheet: Sheet, cloth: Cloth, skin: Skin, rules: Rules):
    """How much the middle of an edge lacks of half the margin [m], and the way up there."""
    a = cloth.edges[edge, 0]
    b = cloth.edges[edge, 1]
    # Beyond a band no face is known; a known one makes the answer cheap.
    near = wp.where(sheet.distance[a] <= sheet.distance[b], sheet.face[a], sheet.face[b])
    distance, gradient, _face = ask(skin, 0.5 * (sheet.place[a] + sheet.place[b]), near)
    return 0.5 * rules.margin - distance, gradient


@wp.kernel(enable_backward=False)
def suspect_kernel(sheet: Sheet, cloth: Cloth, rules: Rules, suspects: wp.array(dtype=int)):
    """Lists the edges whose middle may be closer to the skin than half the margin (`_raise_edges`)."""
    edge = wp.tid()
    a = cloth.edges[edge, 0]
    b = cloth.edges[edge, 1]
    first = sheet.distance[a]
    second = sheet.distance[b]
    length = wp.length(sheet.place[a] - sheet.place[b])
    if wp.min(first, second) < 0.0 or wp.max(first, second) >= 0.5 * (rules.margin + length):
        return
    bulge = float(0.0)
    if sheet.face[a] >= 0 and sheet.face[b] >= 0:
        bulge = rules.bulge * length * wp.length(sheet.gradient[a] - sheet.gradient[b])
    if 0.5 * (first + second) < 0.5 * rules.margin + bulge:
        suspects[wp.atomic_add(sheet.counts, CUTTING, 1)] = edge


@wp.kernel(enable_backward=False)
def middle_kernel(
    sheet: Sheet,
    cloth: Cloth,
    skin: Skin,
    rules: Rules,
    rounds: int,
    suspects: wp.array(dtype=int),
    moved: wp.array(dtype=int),
    # outputs
    low: wp.array(dtype=int),
    deficit: wp.array(dtype=float),
    rise: wp.array(dtype=wp.vec3),
    largest: wp.array(dtype=float),
):
    """Which of the suspected edges are too low, and by how much; after the first of the `rounds`, of those moved."""
    edge = suspects[wp.tid()]
    a = cloth.edges[edge, 0]
    b = cloth.edges[edge, 1]
    if rounds > 0 and moved[a] == 0 and moved[b] == 0:
        return  # between two limbs, and stays there
    lack, up = look_between(edge, sheet, cloth, skin, rules)
    if lack > 0.0:
        k = wp.atomic_add(sheet.counts, CUTTING + 1 + rounds, 1)
        low[k] = edge
        deficit[k] = lack
        rise[k] = lack * up
        wp.atomic_max(largest, a, lack)
        wp.atomic_max(largest, b, lack)


@wp.kernel(enable_backward=False)
def choose_kernel(
    sheet: Sheet,
    cloth: Cloth,
    low: wp.array(dtype=int),
    deficit: wp.array(dtype=float),
    rise: wp.array(dtype=wp.vec3),
    largest: wp.array(dtype=float),
    # outputs
    field: wp.array(dtype=wp.vec3),
    raised: wp.array(dtype=int),
):
    """A vertex of several low edges follows the lowest of them."""
    k = wp.tid()
    for end in range(2):
        i = cloth.edges[low[k], end]
        if deficit[k] == largest[i]:
            field[i] = rise[k]
            if wp.atomic_max(sheet.mark, i, BESIDE) == 0:
                raised[wp.atomic_add(sheet.counts, RAISED, 1)] = i


@wp.kernel(enable_backward=False)
def raise_kernel(
    sheet: Sheet,
    skin: Skin,
    rules: Rules,
    raised: wp.array(dtype=int),
    # outputs
    field: wp.array(dtype=wp.vec3),
    largest: wp.array(dtype=float),
    moved: wp.array(dtype=int),
):
    """Raises the ends of low edges that don't come nearer to the skin by it."""
    i = raised[wp.tid()]
    here = bounded(sheet.place[i] + field[i], sheet.origin[i], rules.max_displacement)
    field[i] = wp.vec3()
    largest[i] = 0.0
    sheet.mark[i] = 0
    moved[i] = 0
    distance, gradient, face = ask(skin, here, sheet.face[i])
    if distance >= wp.min(sheet.distance[i], rules.margin - rules.tolerance):
        keep(i, here, distance, gradient, face, sheet)
        moved[i] = 1


@wp.kernel(enable_backward=False)
def tally_kernel(sheet: Sheet, near: wp.array(dtype=int)):
    """Counts who was inside, who was moved, and who is inside."""
    i = near[wp.tid()]
    way = sheet.place[i] - sheet.origin[i]
    if way[0] != 0.0 or way[1] != 0.0 or way[2] != 0.0:
        wp.atomic_add(sheet.counts, MOVED, 1)
    if sheet.first[i] < 0.0:
        wp.atomic_add(sheet.counts, INSIDE, 1)
    if sheet.distance[i] < 0.0:
        wp.atomic_add(sheet.counts, STUCK, 1)
