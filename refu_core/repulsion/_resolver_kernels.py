# mypy: ignore-errors
# ruff: noqa: RUF046, UP018
# (Warp reads a kernel's annotations as array types of its own; a type checker can't. A variable that changes in a loop
# has to be called int or float there.)
"""Most steps of `resolve`, each over the vertices that it concerns: one code for CPU and CUDA."""

import warp as wp

from refu_core.repulsion._sheet import (
    BACK,
    BESIDE,
    CHANGED,
    FILLED,
    FREE,
    INSIDE,
    LEFT,
    MISSED,
    MOVED,
    NEAR,
    PUSHED,
    REACHED,
    SOURCE,
    STUCK,
    SUSPECTS,
    Cloth,
    Rules,
    Sheet,
    bounded,
    keep,
    listed,
)
from refu_core.sdf import Skin, ask


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
def suspect(i: int, sheet: Sheet):
    if wp.atomic_max(sheet.mark, i, BESIDE) == 0:
        sheet.reached[wp.atomic_add(sheet.counts, SUSPECTS, 1)] = i


@wp.kernel(enable_backward=False)
def begin_kernel(sheet: Sheet):
    """Everybody where it is."""
    i = wp.tid()
    keep(i, sheet.origin[i], sheet.first[i], sheet.first_gradient[i], sheet.first_face[i], sheet)
    if sheet.first_face[i] < 0:
        sheet.gradient[i] = wp.vec3()  # beyond a band nothing is known
    sheet.role[i] = FREE


@wp.kernel(enable_backward=False)
def compare_kernel(sheet: Sheet, cloth: Cloth, rules: Rules):
    """Lists the ends of edges at the skin along which distances contradict each other."""
    i = wp.tid()
    if sheet.distance[i] >= rules.margin:
        return
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        j = cloth.ring[k]
        if contradict(i, j, sheet, rules):
            suspect(i, sheet)
            suspect(j, sheet)


@wp.kernel(enable_backward=False)
def look_again_kernel(sheet: Sheet, cloth: Cloth, skin: Skin, rules: Rules):
    """`mend`'s first remedy: from the faces of neighbours that are nearer to theirs a nearer one may be found."""
    i = listed(wp.tid(), SUSPECTS, sheet.reached, sheet)
    if i < 0:
        return
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
def cut_off_kernel(sheet: Sheet, cloth: Cloth, rules: Rules):
    """`mend`'s second: what is said to be outside of flesh that a neighbour is in goes with the neighbour."""
    i = listed(wp.tid(), SUSPECTS, sheet.reached, sheet)
    if i < 0:
        return
    sheet.guess[i] = -1
    if sheet.distance[i] < 0.0:
        return  # has a way out of its own
    nearest = float(1.0e12)
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        j = cloth.ring[k]
        within = sheet.distance[j]
        if within < 0.0 and cloth.own[i] == 1 << cloth.limb[sheet.face[j]]:
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
def adopt_kernel(sheet: Sheet, cloth: Cloth):
    """Takes over what was found, and suspects the neighbours of what changed."""
    i = listed(wp.tid(), SUSPECTS, sheet.reached, sheet)
    if i < 0:
        return
    if sheet.guess[i] < 0:
        return
    wp.atomic_add(sheet.counts, CHANGED, 1)
    sheet.first[i] = sheet.depth[i]
    sheet.first_gradient[i] = sheet.heading[i]
    sheet.first_face[i] = sheet.guess[i]
    keep(i, sheet.origin[i], sheet.depth[i], sheet.heading[i], sheet.guess[i], sheet)
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        suspect(cloth.ring[k], sheet)


@wp.kernel(enable_backward=False)
def list_kernel(sheet: Sheet, rules: Rules):
    """Lists who is nearer than the margin."""
    i = wp.tid()
    sheet.mark[i] = 0
    if sheet.distance[i] < rules.margin:
        sheet.near[wp.atomic_add(sheet.counts, NEAR, 1)] = i


@wp.kernel(enable_backward=False)
def look_kernel(sheet: Sheet, cloth: Cloth, rules: Rules):
    """Which way the cloth faces where that matters, and who is pushed inwards by a limb it doesn't lie on."""
    i = listed(wp.tid(), NEAR, sheet.near, sheet)
    if i < 0:
        return
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
def retreat_kernel(sheet: Sheet, cloth: Cloth, skin: Skin, rules: Rules):
    """What the gradient would take out on the far side of another limb goes back against its normal instead."""
    i = listed(wp.tid(), NEAR, sheet.near, sheet)
    if i < 0:
        return
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
        here = bounded(here - step * sheet.outward[i], sheet.origin[i], rules.max_displacement)
        way += step
        distance, gradient, face = ask(skin, here, sheet.face[i])
        if distance > sheet.distance[i]:
            keep(i, here, distance, gradient, face, sheet)
        if distance > 0.0 or way >= room:
            break
    sheet.role[i] = wp.where(sheet.distance[i] < 0.0, MISSED, LEFT)


@wp.kernel(enable_backward=False)
def fill_kernel(sheet: Sheet, cloth: Cloth, skin: Skin, rules: Rules):
    """The few that found no room go where their neighbours went."""
    i = listed(wp.tid(), NEAR, sheet.near, sheet)
    if i < 0:
        return
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
        here = bounded(total / number, sheet.origin[i], rules.max_displacement)
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
):
    """Which way each vertex goes: those that left a limb as far as they are; the others are listed, to be pushed."""
    i = listed(wp.tid(), NEAR, sheet.near, sheet)
    if i < 0:
        return
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
        sheet.field[i] = push
        sheet.mark[i] = SOURCE
        sheet.reached[wp.atomic_add(sheet.counts, REACHED, 1)] = i
        return
    depth = sheet.distance[i]
    heading = sheet.gradient[i]
    limb = cloth.limb[sheet.face[i]]
    if depth < -rules.deep and cloth.own[i] == 1 << limb and sheet.along[i] < 0.0:
        # In the middle of a thin limb the closest skin of one vertex is in front and that of the next one behind:
        # all go along the cloth's normal, as far as that is; or between both, where that is nearly too far.
        shortest = heading
        side = sheet.outward[i]
        first = -depth
        way = -depth
        farthest = wp.min(rules.farthest, rules.detour * first)
        looks = int(0)
        is_second = bool(False)
        for _look in range(2 * rules.turns):
            height, _gradient, _face = ask(skin, sheet.origin[i] + way * side, sheet.face[i])
            way = way - height
            looks += 1
            if height >= 0.0:
                if way <= 0.0 or way >= farthest:
                    break
                depth = -way
                heading = side
                share = (rules.detour - way / first) / rules.turning
                if is_second or share >= 1.0:
                    break
                side = wp.normalize(share * side + (1.0 - share) * shortest)
                way = first
                looks = 0
                is_second = True
            else:
                way += rules.step_on
                if way >= farthest or looks >= rules.turns:
                    break
    sheet.depth[i] = depth
    sheet.heading[i] = heading
    sheet.pushed[wp.atomic_add(sheet.counts, PUSHED, 1)] = i


@wp.kernel(enable_backward=False)
def scale_kernel(
    sheet: Sheet,
    rules: Rules,
):
    """How far each pushed vertex goes, for predicted scales: at least until it is outside."""
    k = wp.tid()
    i = listed(k, PUSHED, sheet.pushed, sheet)
    if i < 0:
        return
    deficit = rules.margin - sheet.depth[i]
    # Where α is below 1, the distance was predicted to exaggerate; its sign is trusted all the same.
    scale = wp.max(sheet.alpha[k], (wp.min(rules.tolerance, rules.margin) - sheet.depth[i]) / deficit)
    way = wp.min(scale * deficit, rules.max_displacement)
    sheet.goal[i] = wp.min(sheet.depth[i] + scale * deficit, rules.margin)
    sheet.way[i] = wp.min(way, deficit)
    sheet.field[i] = way * sheet.heading[i]
    sheet.mark[i] = SOURCE
    sheet.reached[wp.atomic_add(sheet.counts, REACHED, 1)] = i


@wp.kernel(enable_backward=False)
def settle_kernel(
    sheet: Sheet,
    skin: Skin,
    rules: Rules,
):
    """Takes vertices along, and pushes on those that aren't clear yet. Leaves fields and marks empty."""
    i = listed(wp.tid(), REACHED, sheet.reached, sheet)
    if i < 0:
        return
    shift = sheet.field[i]
    mark = sheet.mark[i]
    sheet.field[i] = wp.vec3()
    sheet.smoother[i] = wp.vec3()
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


@wp.kernel(enable_backward=False)
def tally_kernel(sheet: Sheet):
    """Counts who was inside, who was moved, and who is inside."""
    i = listed(wp.tid(), NEAR, sheet.near, sheet)
    if i < 0:
        return
    way = sheet.place[i] - sheet.origin[i]
    if way[0] != 0.0 or way[1] != 0.0 or way[2] != 0.0:
        wp.atomic_add(sheet.counts, MOVED, 1)
    if sheet.first[i] < 0.0:
        wp.atomic_add(sheet.counts, INSIDE, 1)
    if sheet.distance[i] < 0.0:
        wp.atomic_add(sheet.counts, STUCK, 1)
