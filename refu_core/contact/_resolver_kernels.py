"""Most steps of `resolve`, each over the vertices that it concerns: one code for CPU and CUDA."""

import warp as wp

from refu_core.contact._state import (
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
    State,
    bounded,
    keep,
    listed,
)
from refu_core.sdf import Skin, query_skin
from refu_core.sdf._closest_kernels import mean_normal


@wp.func
def push_on(
    i: int, here: wp.vec3, distance: float, gradient: wp.vec3, scale: float, state: State, skin: Skin, rules: Rules
) -> None:
    """Pushes a vertex from `here` until it is clear, and keeps the best place; half as far once it is thrown back."""
    goal = wp.min(distance + scale * (rules.margin - distance), rules.margin) - rules.tolerance
    # One loop with one call of `query_skin`, here as elsewhere: so its code is there once.
    for _round in range(rules.max_pushes):
        if distance < rules.margin:
            offset = scale * (rules.margin - distance)
            here = here + wp.clamp(offset, -rules.max_displacement, rules.max_displacement) * gradient
        here = bounded(here, state.origin[i], rules.max_displacement)
        last = gradient
        distance, gradient, face = query_skin(skin, here, state.face[i])
        if distance > state.distance[i]:
            keep(i, here, distance, gradient, face, state)
        if distance >= goal:
            break
        scale = wp.where(wp.dot(last, gradient) < 0.0, 0.5, 1.0)


@wp.func
def contradict(i: int, j: int, state: State, rules: Rules) -> bool:
    """Whether the distances of two neighbours, one of them at the skin, differ by more than they are apart."""
    first = state.distance[i]
    second = state.distance[j]
    excess = wp.abs(first - second) - rules.contradiction
    return wp.min(first, second) < rules.margin and excess > wp.length(state.origin[i] - state.origin[j])


@wp.func
def suspect(i: int, state: State) -> None:
    if wp.atomic_max(state.mark, i, BESIDE) == 0:
        state.reached[wp.atomic_add(state.counts, SUSPECTS, 1)] = i


@wp.kernel(enable_backward=False)
def begin_kernel(state: State) -> None:
    """Everybody where it is."""
    i = wp.tid()
    keep(i, state.origin[i], state.first[i], state.first_gradient[i], state.first_face[i], state)
    if state.first_face[i] < 0:
        state.gradient[i] = wp.vec3()  # beyond a band nothing is known
    state.role[i] = FREE


@wp.kernel(enable_backward=False)
def compare_kernel(state: State, cloth: Cloth, rules: Rules) -> None:
    """Lists the ends of edges at the skin along which distances contradict each other."""
    i = wp.tid()
    if state.distance[i] >= rules.margin:
        return
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        j = cloth.ring[k]
        if contradict(i, j, state, rules):
            suspect(i, state)
            suspect(j, state)


@wp.kernel(enable_backward=False)
def retry_kernel(state: State, cloth: Cloth, skin: Skin, rules: Rules) -> None:
    """First remedy of a contradiction: from faces of neighbours that are nearer to theirs a nearer one may be found."""
    i = listed(wp.tid(), SUSPECTS, state.reached, state)
    if i < 0:
        return
    state.guess[i] = -1
    nearest = wp.abs(state.distance[i])
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        j = cloth.ring[k]
        if wp.abs(state.distance[j]) < wp.abs(state.distance[i]) and contradict(i, j, state, rules):
            distance, gradient, face = query_skin(skin, state.origin[i], state.face[j])
            if wp.abs(distance) < nearest:
                nearest = wp.abs(distance)
                state.depth[i] = distance
                state.heading[i] = gradient
                state.guess[i] = face


@wp.kernel(enable_backward=False)
def cut_off_kernel(state: State, cloth: Cloth, rules: Rules) -> None:
    """Second remedy: what is said to be outside of flesh that a neighbour is in goes with the neighbour."""
    i = listed(wp.tid(), SUSPECTS, state.reached, state)
    if i < 0:
        return
    state.guess[i] = -1
    if state.distance[i] < 0.0:
        return  # has a way out of its own
    nearest = float(1.0e12)
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        j = cloth.ring[k]
        within = state.distance[j]
        if within < 0.0 and cloth.own[i] == 1 << cloth.limb[state.face[j]]:
            to_plane = within + wp.dot(state.origin[i] - state.origin[j], state.gradient[j])
            if (
                to_plane < state.distance[i] - rules.contradiction
                and wp.abs(to_plane) < nearest
                and contradict(i, j, state, rules)
            ):
                nearest = wp.abs(to_plane)
                state.depth[i] = to_plane
                state.heading[i] = state.gradient[j]
                state.guess[i] = state.face[j]


@wp.kernel(enable_backward=False)
def adopt_kernel(state: State, cloth: Cloth) -> None:
    """Takes over what was found, and suspects the neighbours of what changed."""
    i = listed(wp.tid(), SUSPECTS, state.reached, state)
    if i < 0:
        return
    if state.guess[i] < 0:
        return
    wp.atomic_add(state.counts, CHANGED, 1)
    state.first[i] = state.depth[i]
    state.first_gradient[i] = state.heading[i]
    state.first_face[i] = state.guess[i]
    keep(i, state.origin[i], state.depth[i], state.heading[i], state.guess[i], state)
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        suspect(cloth.ring[k], state)


@wp.kernel(enable_backward=False)
def list_near_kernel(state: State, rules: Rules) -> None:
    """Lists who is nearer than the margin."""
    i = wp.tid()
    state.mark[i] = 0
    if state.distance[i] < rules.margin:
        state.near[wp.atomic_add(state.counts, NEAR, 1)] = i


@wp.kernel(enable_backward=False)
def orient_kernel(state: State, cloth: Cloth, rules: Rules) -> None:
    """Which way the cloth faces where that matters, and who is pushed inwards by a limb it doesn't lie on."""
    i = listed(wp.tid(), NEAR, state.near, state)
    if i < 0:
        return
    limb = cloth.limb[state.face[i]]
    foreign = (cloth.own[i] >> limb) & 1 == 0
    if foreign or state.distance[i] < -rules.deep:
        outward = mean_normal(i, state.origin, cloth.faces, cloth.fan_start, cloth.fan)
        along = wp.dot(state.gradient[i], outward)
        state.outward[i] = outward
        state.along[i] = along
        if foreign:
            wp.atomic_add(state.touched, limb, 1)
            if along < 0.0:
                wp.atomic_add(state.inward, limb, 1)


@wp.kernel(enable_backward=False)
def retreat_kernel(state: State, cloth: Cloth, skin: Skin, rules: Rules) -> None:
    """What the gradient would take out on the far side of another limb goes back against its normal instead."""
    i = listed(wp.tid(), NEAR, state.near, state)
    if i < 0:
        return
    limb = cloth.limb[state.face[i]]
    if (cloth.own[i] >> limb) & 1 == 1 or state.along[i] <= rules.sideways:
        return
    # A limb that nearly all of the cloth would leave outwards is under the cloth: there the gradient is right.
    if float(state.inward[limb]) < rules.inward * float(state.touched[limb]):
        return
    here = state.origin[i]
    distance = float(state.distance[i])
    way = float(0.0)
    room = cloth.clearance[i]
    for _step in range(rules.retreats):
        # No surface is nearer than |f|: a step of |f| can't jump over the room that is sought, however narrow it is.
        step = wp.min(-distance, room - way) + rules.step_on
        here = bounded(here - step * state.outward[i], state.origin[i], rules.max_displacement)
        way += step
        distance, gradient, face = query_skin(skin, here, state.face[i])
        if distance > state.distance[i]:
            keep(i, here, distance, gradient, face, state)
        if distance > 0.0 or way >= room:
            break
    state.role[i] = wp.where(state.distance[i] < 0.0, MISSED, LEFT)


@wp.kernel(enable_backward=False)
def fill_kernel(state: State, cloth: Cloth, skin: Skin, rules: Rules) -> None:
    """The few that found no room go where their neighbours went."""
    i = listed(wp.tid(), NEAR, state.near, state)
    if i < 0:
        return
    if state.role[i] != MISSED:
        return
    total = wp.vec3()
    number = float(0.0)
    for k in range(cloth.fan_start[i], cloth.fan_start[i + 1]):
        for corner in range(3):
            j = cloth.faces[cloth.fan[k], corner]
            # Roles are written meanwhile, but none of these becomes one that isn't.
            if j != i and state.role[j] < MISSED:
                total += state.place[j]
                number += 1.0
    here = state.place[i]
    if number > 0.0:
        here = bounded(total / number, state.origin[i], rules.max_displacement)
    distance, gradient, face = query_skin(skin, here, state.face[i])
    if distance > 0.0:
        keep(i, here, distance, gradient, face, state)
        state.role[i] = FILLED
    else:
        # No room at all: out on the far side.
        keep(i, state.origin[i], state.first[i], state.first_gradient[i], state.first_face[i], state)
        state.role[i] = BACK


@wp.kernel(enable_backward=False)
def aim_kernel(state: State, cloth: Cloth, skin: Skin, rules: Rules) -> None:
    """Which way each vertex goes: those that left a limb as far as they are; the others are listed, to be pushed."""
    i = listed(wp.tid(), NEAR, state.near, state)
    if i < 0:
        return
    role = state.role[i]
    if role == LEFT or role == FILLED:  # noqa: SIM109
        # In the room between limb and skin the gradient keeps to the middle, or at the margin where it is wide enough.
        push_on(i, state.place[i], state.distance[i], state.gradient[i], 1.0, state, skin, rules)
        push = state.place[i] - state.origin[i]
        way = wp.length(push)
        if way == 0.0:
            state.role[i] = FREE  # nowhere better than where it was, outside: as anyone's neighbour
            return
        state.way[i] = way
        state.heading[i] = push / way
        state.field[i] = push
        state.mark[i] = SOURCE
        state.reached[wp.atomic_add(state.counts, REACHED, 1)] = i
        return
    depth = state.distance[i]
    heading = state.gradient[i]
    limb = cloth.limb[state.face[i]]
    if depth < -rules.deep and cloth.own[i] == 1 << limb and state.along[i] < 0.0:
        # In the middle of a thin limb the closest skin of one vertex is in front and that of the next one behind:
        # all go along the cloth's normal, as far as that is; or between both, where that is nearly too far.
        shortest = heading
        side = state.outward[i]
        first = -depth
        way = -depth
        farthest = wp.min(rules.farthest, rules.detour * first)
        looks = int(0)
        is_second = bool(False)
        for _look in range(2 * rules.turns):
            height, _gradient, _face = query_skin(skin, state.origin[i] + way * side, state.face[i])
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
    state.depth[i] = depth
    state.heading[i] = heading
    state.pushed[wp.atomic_add(state.counts, PUSHED, 1)] = i


@wp.kernel(enable_backward=False)
def scale_kernel(state: State, rules: Rules) -> None:
    """How far each pushed vertex goes, for predicted scales: at least until it is outside."""
    k = wp.tid()
    i = listed(k, PUSHED, state.pushed, state)
    if i < 0:
        return
    deficit = rules.margin - state.depth[i]
    # Where α is below 1, the distance was predicted to exaggerate; its sign is trusted all the same.
    scale = wp.max(state.alpha[k], (wp.min(rules.tolerance, rules.margin) - state.depth[i]) / deficit)
    way = wp.min(scale * deficit, rules.max_displacement)
    state.goal[i] = wp.min(state.depth[i] + scale * deficit, rules.margin)
    state.way[i] = wp.min(way, deficit)
    state.field[i] = way * state.heading[i]
    state.mark[i] = SOURCE
    state.reached[wp.atomic_add(state.counts, REACHED, 1)] = i


@wp.kernel(enable_backward=False)
def settle_kernel(state: State, skin: Skin, rules: Rules) -> None:
    """Takes vertices along, and pushes on those that aren't clear yet. Leaves fields and marks empty."""
    i = listed(wp.tid(), REACHED, state.reached, state)
    if i < 0:
        return
    shift = state.field[i]
    mark = state.mark[i]
    state.field[i] = wp.vec3()
    state.smoother[i] = wp.vec3()
    state.mark[i] = 0
    role = state.role[i]
    if role == LEFT or role == FILLED:  # noqa: SIM109
        return
    origin = state.origin[i]
    here = bounded(origin + shift, origin, rules.max_displacement)
    known = state.distance[i]
    if mark != SOURCE:
        # No vertex gets nearer by more than it moves: what stays beyond the margin needn't be asked.
        floor = wp.min(known, rules.margin + rules.sure) - wp.length(here - origin)
        if floor >= rules.margin + rules.tolerance:
            state.place[i] = here
            state.distance[i] = floor
            return
    goal = rules.margin
    if mark == SOURCE:
        goal = state.goal[i]
    distance, gradient, face = query_skin(skin, here, state.face[i])
    if distance >= goal - rules.tolerance:
        keep(i, here, distance, gradient, face, state)
        return
    if mark != SOURCE:
        return  # a neighbour that would come too close stays where it was
    if distance > known:
        keep(i, here, distance, gradient, face, state)
    else:
        here = origin
        distance = state.depth[i]
        gradient = state.heading[i]
    push_on(i, here, distance, gradient, (goal - distance) / (rules.margin - distance), state, skin, rules)
    if state.distance[i] < 0.0:
        state.place[i] = origin
        state.distance[i] = state.first[i]


@wp.kernel(enable_backward=False)
def tally_kernel(state: State) -> None:
    """Counts who was inside, who was moved, and who is inside."""
    i = listed(wp.tid(), NEAR, state.near, state)
    if i < 0:
        return
    way = state.place[i] - state.origin[i]
    if way[0] != 0.0 or way[1] != 0.0 or way[2] != 0.0:
        wp.atomic_add(state.counts, MOVED, 1)
    if state.first[i] < 0.0:
        wp.atomic_add(state.counts, INSIDE, 1)
    if state.distance[i] < 0.0:
        wp.atomic_add(state.counts, STUCK, 1)
