"""A GPU's launches for what a CPU does in one; in a module of their own, which a CPU needn't compile."""

import warp as wp

from refu_core.contact._edge_kernels import choose, lift, measure
from refu_core.contact._resolver_kernels import reach, spread
from refu_core.contact._state import CUTTING, RAISED, REACHED, Cloth, Rules, State, listed
from refu_core.sdf import Skin

wp.set_module_options({"enable_backward": False})


@wp.kernel
def close_kernel(state: State, which: int) -> None:
    """From now on launches go through a list up to its present end, whatever is added to it meanwhile."""
    state.begins[which] = state.ends[which]
    state.ends[which] = state.counts[which]


@wp.kernel
def reach_kernel(state: State, cloth: Cloth) -> None:
    """Lists the neighbours of the vertices that were listed last."""
    i = listed(state.begins[REACHED] + wp.tid(), REACHED, state.reached, state)
    if i >= 0:
        reach(i, state, cloth)


@wp.kernel
def spread_kernel(
    state: State, cloth: Cloth, step: float, field: wp.array[wp.vec3], smoother: wp.array[wp.vec3]
) -> None:
    """One sweep of `Blend.spread`."""
    i = listed(wp.tid(), REACHED, state.reached, state)
    if i >= 0:
        spread(i, state, cloth, step, field, smoother)


@wp.kernel
def measure_kernel(
    state: State, cloth: Cloth, skin: Skin, rules: Rules, rounds: int, suspects: wp.array[int], low: wp.array[int]
) -> None:
    """Lists the suspected edges that are too low."""
    edge = listed(wp.tid(), CUTTING + rounds, suspects, state)
    if edge >= 0:
        measure(edge, rounds, state, cloth, skin, rules, low)


@wp.kernel
def choose_kernel(state: State, cloth: Cloth, rounds: int, low: wp.array[int]) -> None:
    """Lists the ends of edges that are too low."""
    k = wp.tid()
    if listed(k, CUTTING + 1 + rounds, low, state) >= 0:
        choose(k, state, cloth, low)


@wp.kernel
def lift_kernel(state: State, skin: Skin, rules: Rules) -> None:
    """Raises the listed ends."""
    i = listed(wp.tid(), RAISED, state.reached, state)
    if i >= 0:
        lift(i, state, skin, rules)
