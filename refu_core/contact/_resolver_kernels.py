"""Most steps of `resolve`, each over the vertices that it concerns: one code for CPU and CUDA."""

import warp as wp

from refu_core.contact._state import (
    ASTRAY,
    BESIDE,
    CHANGED,
    NEAR,
    REACHED,
    SHIFTED,
    SOURCE,
    SUSPECTS,
    Cloth,
    Rules,
    State,
    bounded,
    keep,
    length,
)
from refu_core.sdf import Skin, query_skin
from refu_core.sdf._mesh import FARTHEST

wp.set_module_options({"enable_backward": False})

_FARTHEST_SQUARED = wp.constant(FARTHEST**2)


@wp.func
def push_on(
    i: int, here: wp.vec3, distance: float, gradient: wp.vec3, scale: float, state: State, skin: Skin, rules: Rules
) -> None:
    """Pushes a vertex from `here` until it is clear, keeping the best place; half as far once the gradient reverses."""
    goal = wp.min(distance + scale * (rules.margin - distance), rules.margin) - rules.tolerance
    # One loop with a single call of `query_skin`, here as elsewhere, so that its code is generated once.
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
    """Whether the distances of two neighbours, one of them at the skin, differ by more than their edge's length."""
    first = state.distance[i]
    second = state.distance[j]
    excess = wp.abs(first - second) - rules.tolerance
    return wp.min(first, second) < rules.margin and excess > wp.length(state.origin[i] - state.origin[j])


@wp.func
def suspect(i: int, state: State) -> None:
    if wp.atomic_max(state.mark, i, BESIDE) == 0:
        state.reached[wp.atomic_add(state.counts, SUSPECTS, 1)] = i


@wp.func
def is_astray(p: wp.vec3, state: State) -> bool:
    """Whether a vertex is at NaN or too far off to compute with (`require_finite`); counts those."""
    if wp.length_sq(p) <= _FARTHEST_SQUARED:
        return False
    wp.atomic_add(state.counts, ASTRAY, 1)
    return True


@wp.kernel
def begin_kernel(each: int, state: State, skin: Skin) -> None:
    """Starts every vertex where it is; `each` vertices a thread, as in every kernel for all vertices (`strips`)."""
    first = wp.tid() * each
    for i in range(first, first + each):
        here = state.origin[i]
        if state.first_face[i] < 0:
            state.first_gradient[i] = wp.vec3()  # beyond a band nothing is known
        is_known = state.first[i] > -wp.inf and wp.isfinite(state.first_gradient[i])  # a caller's own may be NaN
        if not is_astray(here, state) and not is_known:
            distance, gradient, face = query_skin(skin, here, wp.max(state.first_face[i], 0))
            state.first[i] = distance
            state.first_gradient[i] = gradient
            state.first_face[i] = face
        keep(i, here, state.first[i], state.first_gradient[i], state.first_face[i], state)
        state.fresh[i] = 1


@wp.kernel
def go_on_kernel(each: int, reach: float, state: State, skin: Skin) -> None:
    """Goes on from where the last call ended: queries vertices that moved since and may have come within `reach`."""
    first = wp.tid() * each
    for i in range(first, first + each):
        here = state.origin[i]
        way = wp.length(here - state.place[i])
        if is_astray(here, state):
            way = 0.0
        state.place[i] = here
        state.fresh[i] = wp.where(way > 0.0, 1, 0)
        if way > 0.0:
            wp.atomic_add(state.counts, SHIFTED, 1)
            # No vertex gets nearer by more than it moves.
            if state.distance[i] - way >= reach:
                state.distance[i] -= way
            else:
                distance, gradient, face = query_skin(skin, here, state.face[i])
                keep(i, here, distance, gradient, face, state)
        state.first[i] = state.distance[i]
        state.first_gradient[i] = state.gradient[i]
        state.first_face[i] = state.face[i]


@wp.kernel
def compare_kernel(each: int, state: State, cloth: Cloth, rules: Rules) -> None:
    """Lists the ends of edges at the skin along which distances contradict each other."""
    first = wp.tid() * each
    for i in range(first, first + each):
        if state.distance[i] < rules.margin:
            for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
                j = cloth.ring[k]
                if contradict(i, j, state, rules):
                    suspect(i, state)
                    suspect(j, state)


@wp.kernel
def retry_kernel(each: int, state: State, cloth: Cloth, skin: Skin, rules: Rules) -> None:
    """Queries each suspect from the faces of neighbours that are nearer to the skin, which may lead to a nearer face.

    `each` entries of a list a thread, here and below.
    """
    state.counts[CHANGED] = 0
    begin = wp.tid() * each
    for n in range(begin, wp.min(begin + each, length(SUSPECTS, state))):
        i = state.reached[n]
        nearest = wp.abs(state.distance[i])
        for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
            j = cloth.ring[k]
            if wp.abs(state.distance[j]) < wp.abs(state.distance[i]) and contradict(i, j, state, rules):
                distance, gradient, face = query_skin(skin, state.origin[i], state.face[j])
                if wp.abs(distance) < nearest:
                    nearest = wp.abs(distance)
                    state.first[i] = distance
                    state.first_gradient[i] = gradient
                    state.first_face[i] = face


@wp.kernel
def adopt_kernel(each: int, state: State, cloth: Cloth) -> None:
    """Takes over what was found, and suspects the neighbours of vertices that changed."""
    begin = wp.tid() * each
    for n in range(begin, wp.min(begin + each, length(SUSPECTS, state))):
        i = state.reached[n]
        if state.first[i] == state.distance[i]:
            continue
        wp.atomic_add(state.counts, CHANGED, 1)
        state.fresh[i] = 1
        keep(i, state.origin[i], state.first[i], state.first_gradient[i], state.first_face[i], state)
        for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
            suspect(cloth.ring[k], state)


@wp.kernel
def list_near_kernel(each: int, state: State, rules: Rules) -> None:
    """Lists the vertices that are nearer than the margin, of those that were moved."""
    first = wp.tid() * each
    for i in range(first, first + each):
        state.mark[i] = 0
        if state.distance[i] < rules.margin and state.fresh[i] == 1:
            k = wp.atomic_add(state.counts, NEAR, 1)
            state.near[k] = i
            state.alpha[k] = state.distance[i]


@wp.func
def in_order(deficit: float, margin: float) -> float:
    """The share of what a vertex lacks to the margin that it is pushed, for cloth to stay in order above the skin.

    What is deeper ends lower, at half the margin at least. Were all pushed to the margin, the layers of a fold would
    end in one place and run through each other. Close to the margin the share falls to nothing: no push sets in at
    once.
    """
    half = 0.5 * margin
    return 1.0 - half * (1.0 - float(wp.exp(-deficit / half))) / deficit


@wp.kernel
def scale_kernel(each: int, state: State, rules: Rules) -> None:
    """How far each near vertex goes by its predicted scale: at least until it is outside."""
    begin = wp.tid() * each
    for k in range(begin, wp.min(begin + each, length(NEAR, state))):
        i = state.near[k]
        distance = state.distance[i]
        deficit = rules.margin - distance
        # Where α is below 1, the distance was predicted to exaggerate; its sign is trusted all the same.
        least = (wp.min(rules.tolerance, rules.margin) - distance) / deficit
        scale = wp.max(state.alpha[k] * in_order(deficit, rules.margin), least)
        way = wp.min(scale * deficit, rules.max_displacement)
        state.goal[i] = wp.min(distance + scale * deficit, rules.margin)
        state.way[i] = wp.min(way, deficit)
        state.field[i] = way * state.gradient[i]
        state.mark[i] = SOURCE
        state.reached[wp.atomic_add(state.counts, REACHED, 1)] = i


@wp.func
def reach(i: int, state: State, cloth: Cloth) -> None:
    """Lists the neighbours of a vertex that aren't listed yet."""
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        j = cloth.ring[k]
        if state.mark[j] == 0 and wp.atomic_max(state.mark, j, BESIDE) == 0:
            state.reached[wp.atomic_add(state.counts, REACHED, 1)] = j


@wp.func
def spread(
    i: int, state: State, cloth: Cloth, step: float, field: wp.array[wp.vec3], smoother: wp.array[wp.vec3]
) -> None:
    """A step towards the mean of the neighbours; a pushed vertex still goes at least as far as it has to."""
    first = cloth.ring_start[i]
    last = cloth.ring_start[i + 1]
    mean = wp.vec3()
    for k in range(first, last):
        mean += field[cloth.ring[k]]
    if last > first:
        mean = mean * (1.0 / float(last - first))
    here = field[i]
    here += step * (mean - here)
    if state.mark[i] == SOURCE:
        lack = state.way[i] - wp.dot(here, state.gradient[i])
        here += wp.max(lack, 0.0) * state.gradient[i]
    smoother[i] = here


@wp.kernel
def blend_kernel(state: State, cloth: Cloth, near: int, sweeps: int, long_step: float, short_step: float) -> None:
    """All sweeps, in pairs, by one thread: lists are short, and a launch costs as much as hundreds of steps."""
    first = int(0)
    for _ring in range(near):
        last = int(state.counts[REACHED])
        for k in range(first, last):
            reach(state.reached[k], state, cloth)
        first = last
    n = int(state.counts[REACHED])
    for _pair in range(sweeps // 2):
        for k in range(n):
            spread(state.reached[k], state, cloth, long_step, state.field, state.smoother)
        for k in range(n):
            spread(state.reached[k], state, cloth, short_step, state.smoother, state.field)


@wp.func
def settle(i: int, state: State, skin: Skin, rules: Rules) -> None:
    """Moves a vertex by `field`, and pushes it on if it isn't clear yet. Leaves fields and marks empty."""
    shift = state.field[i]
    mark = state.mark[i]
    state.field[i] = wp.vec3()
    state.smoother[i] = wp.vec3()
    state.mark[i] = 0
    state.fresh[i] = 1
    origin = state.origin[i]
    here = bounded(origin + shift, origin, rules.max_displacement)
    known = state.distance[i]
    if mark != SOURCE:
        # No vertex gets nearer by more than it moves: what stays beyond the margin needn't be asked.
        floor = known - wp.length(here - origin)
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
        distance = known
        gradient = state.gradient[i]
    push_on(i, here, distance, gradient, (goal - distance) / (rules.margin - distance), state, skin, rules)


@wp.kernel
def settle_kernel(each: int, state: State, skin: Skin, rules: Rules) -> None:
    """`settle` for the vertices reached, `each` of them a thread."""
    begin = wp.tid() * each
    for k in range(begin, wp.min(begin + each, length(REACHED, state))):
        settle(state.reached[k], state, skin, rules)


@wp.kernel
def conclude_kernel(
    each: int,
    state: State,
    # outputs, the fields of a `Resolution`
    vertices: wp.array[wp.vec3],
    distance: wp.array[float],
    gradient: wp.array[wp.vec3],
    face: wp.array[int],
    numbers: wp.array[float],
) -> None:
    """Hands the result out. Counts the near vertices that were inside, that were moved, and that are still inside."""
    begin = wp.tid() * each
    for k in range(begin, wp.min(begin + each, length(NEAR, state))):
        i = state.near[k]
        if state.first[i] < 0.0:
            wp.atomic_add(numbers, 0, 1.0)
        way = state.place[i] - state.origin[i]
        if way[0] != 0.0 or way[1] != 0.0 or way[2] != 0.0:
            wp.atomic_add(numbers, 1, 1.0)
        if state.distance[i] < 0.0:
            wp.atomic_add(numbers, 2, 1.0)
    for i in range(begin, begin + each):
        wp.atomic_max(numbers, 3, -state.first[i])
        if state.first_face[i] < 0:
            wp.atomic_add(numbers, 4, 1.0)
        vertices[i] = state.place[i]
        distance[i] = state.distance[i]
        gradient[i] = state.gradient[i]
        face[i] = state.face[i]
