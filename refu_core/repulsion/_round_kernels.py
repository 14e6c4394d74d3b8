# mypy: ignore-errors
# (Warp reads a kernel's annotations as array types of its own; a type checker can't.)
"""Launches of a GPU for what a CPU does in one; in a module of their own, which a CPU needn't compile."""

import warp as wp

from refu_core.repulsion._edge_kernels import choose, lift, measure
from refu_core.repulsion._sheet import CUTTING, RAISED, REACHED, Cloth, Rules, Sheet, listed
from refu_core.repulsion._spread_kernels import reach, spread
from refu_core.sdf import Skin


@wp.kernel(enable_backward=False)
def close_kernel(sheet: Sheet, which: int):
    """From now on launches go through a list as long as it is now, whatever is added to it meanwhile."""
    sheet.begins[which] = sheet.ends[which]
    sheet.ends[which] = sheet.counts[which]


@wp.kernel(enable_backward=False)
def reach_kernel(sheet: Sheet, cloth: Cloth):
    """Lists the neighbours of those that came to the list last."""
    i = listed(sheet.begins[REACHED] + wp.tid(), REACHED, sheet.reached, sheet)
    if i >= 0:
        reach(i, sheet, cloth)


@wp.kernel(enable_backward=False)
def spread_kernel(
    sheet: Sheet,
    cloth: Cloth,
    step: float,
    field: wp.array(dtype=wp.vec3),
    # output
    smoother: wp.array(dtype=wp.vec3),
):
    """One sweep of `Blend.spread`."""
    i = listed(wp.tid(), REACHED, sheet.reached, sheet)
    if i >= 0:
        spread(i, sheet, cloth, step, field, smoother)


@wp.kernel(enable_backward=False)
def measure_kernel(
    sheet: Sheet,
    cloth: Cloth,
    skin: Skin,
    rules: Rules,
    rounds: int,
    suspects: wp.array(dtype=int),
    # output
    low: wp.array(dtype=int),
):
    """Lists those of the edges that are low."""
    edge = listed(wp.tid(), CUTTING + rounds, suspects, sheet)
    if edge >= 0:
        measure(edge, rounds, sheet, cloth, skin, rules, low)


@wp.kernel(enable_backward=False)
def choose_kernel(sheet: Sheet, cloth: Cloth, rounds: int, low: wp.array(dtype=int)):
    """Lists their ends."""
    k = wp.tid()
    if listed(k, CUTTING + 1 + rounds, low, sheet) >= 0:
        choose(k, sheet, cloth, low)


@wp.kernel(enable_backward=False)
def lift_kernel(sheet: Sheet, skin: Skin, rules: Rules):
    """Raises these."""
    i = listed(wp.tid(), RAISED, sheet.reached, sheet)
    if i >= 0:
        lift(i, sheet, skin, rules)
