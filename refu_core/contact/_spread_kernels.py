"""How pushes spread over the neighbourhood: all rounds in one launch (`_round_kernels` has those of a GPU)."""

import warp as wp

from refu_core.contact._state import BESIDE, REACHED, SOURCE, Cloth, State

wp.set_module_options({"enable_backward": False})


@wp.func
def reach(i: int, state: State, cloth: Cloth) -> None:
    """Lists the neighbours of a vertex, unless they are."""
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        j = cloth.ring[k]
        if state.mark[j] == 0 and wp.atomic_max(state.mark, j, BESIDE) == 0:
            state.reached[wp.atomic_add(state.counts, REACHED, 1)] = j


@wp.func
def spread(
    i: int, state: State, cloth: Cloth, step: float, field: wp.array[wp.vec3], smoother: wp.array[wp.vec3]
) -> None:
    """A step towards the mean of the neighbours, but no less than a vertex has to go."""
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
def blend_kernel(state: State, cloth: Cloth, rings: int, pairs: int, long_step: float, short_step: float) -> None:
    """All sweeps, in pairs, by one thread: the lists are short, and a launch costs what hundreds of steps do."""
    first = int(0)
    for _ring in range(rings):
        last = int(state.counts[REACHED])
        for k in range(first, last):
            reach(state.reached[k], state, cloth)
        first = last
    n = int(state.counts[REACHED])
    for _pair in range(pairs):
        for k in range(n):
            spread(state.reached[k], state, cloth, long_step, state.field, state.smoother)
        for k in range(n):
            spread(state.reached[k], state, cloth, short_step, state.smoother, state.field)
