"""Raising edges that run too low between their ends: all rounds in one launch (for a GPU, see `_round_kernels`)."""

import warp as wp

from refu_core.contact._state import BESIDE, CUTTING, NEAR, RAISED, SHIFTED, Cloth, Rules, State, bounded, keep
from refu_core.sdf import Skin, query_skin

wp.set_module_options({"enable_backward": False})

CORNER = wp.constant(0.25)
"""How far a corner of two planes bulges towards the middle of an edge across it, per length of the edge and per radian
between the planes' normals: no skin between such normals bulges farther. A circle bulges by half of it."""


@wp.func
def middle_deficit(edge: int, state: State, cloth: Cloth, skin: Skin, rules: Rules) -> tuple[float, wp.vec3]:
    """By how much the middle of an edge falls short of half the margin [m], and the way up there."""
    a = cloth.edges[edge, 0]
    b = cloth.edges[edge, 1]
    # Beyond a band no face is known; a known one makes the answer cheap.
    near = wp.where(state.distance[a] <= state.distance[b] + rules.tolerance, state.face[a], state.face[b])
    distance, gradient, _face = query_skin(skin, 0.5 * (state.place[a] + state.place[b]), near)
    lack = 0.5 * rules.margin - distance
    # An edge that runs through a hand hasn't cut a corner, and isn't to be raised.
    return lack * wp.clamp(2.0 - lack / rules.gap, 0.0, 1.0), gradient


@wp.kernel
def suspect_kernel(each: int, state: State, cloth: Cloth, rules: Rules) -> None:
    """Lists the edges whose middle may be closer to the skin than half the margin (`_raise_edges`)."""
    if state.counts[NEAR] + state.counts[SHIFTED] == 0:
        return  # then nothing was moved
    # Each edge is handled at its lower end. Most are far off: few numbers must show that, with few branches to guess.
    begin = wp.tid() * each
    for a in range(begin, begin + each):
        first = state.distance[a]
        here = state.place[a]
        fresh = state.fresh[a]
        for edge in range(cloth.edge_start[a], cloth.edge_start[a + 1]):
            b = cloth.edges[edge, 1]
            if fresh + state.fresh[b] == 0:
                continue
            second = state.distance[b]
            way = here - state.place[b]
            beyond = 2.0 * wp.where(first > second, first, second) - rules.margin
            if wp.where(beyond > 0.0, beyond * beyond, 0.0) < wp.dot(way, way) and first >= 0.0 and second >= 0.0:
                is_low = first + second < rules.margin
                if not is_low and state.face[a] >= 0 and state.face[b] >= 0:  # otherwise the bulge isn't known
                    bulge = CORNER * wp.length(way) * wp.length(state.gradient[a] - state.gradient[b])
                    is_low = first + second < rules.margin + 2.0 * bulge
                if is_low:
                    state.suspects[wp.atomic_add(state.counts, CUTTING, 1)] = edge


@wp.func
def measure(edge: int, rounds: int, state: State, cloth: Cloth, skin: Skin, rules: Rules, low: wp.array[int]) -> None:
    """Lists a suspected edge that is too low, and by how much; after the first of the `rounds` only if it was moved."""
    a = cloth.edges[edge, 0]
    b = cloth.edges[edge, 1]
    if rounds > 0 and state.moved[a] == 0 and state.moved[b] == 0:
        return  # has no room, and stays where it is
    lack, up = middle_deficit(edge, state, cloth, skin, rules)
    if lack > 0.0:
        k = wp.atomic_add(state.counts, CUTTING + 1 + rounds, 1)
        low[k] = edge
        state.deficit[k] = lack
        state.rise[k] = lack * up
        wp.atomic_max(state.largest, a, lack)
        wp.atomic_max(state.largest, b, lack)


@wp.func
def choose(k: int, state: State, cloth: Cloth, low: wp.array[int]) -> None:
    """A vertex of several low edges follows the lowest of them."""
    for end in range(2):
        i = cloth.edges[low[k], end]
        if state.deficit[k] == state.largest[i]:
            state.field[i] = state.rise[k]
            if wp.atomic_max(state.mark, i, BESIDE) == 0:
                state.reached[wp.atomic_add(state.counts, RAISED, 1)] = i


@wp.func
def lift(i: int, state: State, skin: Skin, rules: Rules) -> None:
    """Raises an end of a low edge, unless that would bring it nearer to the skin."""
    here = bounded(state.place[i] + state.field[i], state.origin[i], rules.max_displacement)
    state.field[i] = wp.vec3()
    state.largest[i] = 0.0
    state.mark[i] = 0
    state.moved[i] = 0
    distance, gradient, face = query_skin(skin, here, state.face[i])
    if distance >= wp.min(state.distance[i], rules.margin - rules.tolerance):
        keep(i, here, distance, gradient, face, state)
        state.moved[i] = 1


@wp.kernel
def raise_edges_kernel(state: State, cloth: Cloth, skin: Skin, rules: Rules) -> None:
    """All rounds by one thread; edges that are still low overwrite the beginning of the list of suspects."""
    n = int(state.counts[CUTTING])
    for rounds in range(rules.max_pushes):
        for k in range(n):
            measure(state.suspects[k], rounds, state, cloth, skin, rules, state.suspects)
        n = int(state.counts[CUTTING + 1 + rounds])
        if n == 0:
            break
        state.counts[RAISED] = 0
        for k in range(n):
            choose(k, state, cloth, state.suspects)
        ends = int(state.counts[RAISED])
        for k in range(ends):
            lift(state.reached[k], state, skin, rules)
