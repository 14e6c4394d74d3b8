# mypy: ignore-errors
# ruff: noqa: RUF046, UP018
# (Warp reads a kernel's annotations as array types of its own; a type checker can't. A variable that changes in a loop
# has to be called int or float there.)
"""How pushes spread over the neighbourhood: all rounds in one launch on a CPU, a round a launch on a GPU."""

import warp as wp

from refu_core.repulsion._sheet import BESIDE, REACHED, SOURCE, Cloth, Sheet, listed


@wp.func
def reach(i: int, sheet: Sheet, cloth: Cloth, reached: wp.array(dtype=int)):
    """Lists the neighbours of a vertex, unless they are."""
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        j = cloth.ring[k]
        if sheet.mark[j] == 0 and wp.atomic_max(sheet.mark, j, BESIDE) == 0:
            reached[wp.atomic_add(sheet.counts, REACHED, 1)] = j


@wp.func
def spread(
    i: int, sheet: Sheet, cloth: Cloth, step: float, field: wp.array(dtype=wp.vec3), smoother: wp.array(dtype=wp.vec3)
):
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
    if sheet.mark[i] == SOURCE:
        lack = sheet.way[i] - wp.dot(here, sheet.heading[i])
        here += wp.max(lack, 0.0) * sheet.heading[i]
    smoother[i] = here


@wp.kernel(enable_backward=False)
def reach_kernel(sheet: Sheet, cloth: Cloth, reached: wp.array(dtype=int)):
    """Lists the neighbours of those that came to the list last."""
    i = listed(sheet.begins[REACHED] + wp.tid(), REACHED, reached, sheet)
    if i >= 0:
        reach(i, sheet, cloth, reached)


@wp.kernel(enable_backward=False)
def spread_kernel(
    sheet: Sheet,
    cloth: Cloth,
    step: float,
    reached: wp.array(dtype=int),
    field: wp.array(dtype=wp.vec3),
    # output
    smoother: wp.array(dtype=wp.vec3),
):
    """One sweep of `Blend.spread`."""
    i = listed(wp.tid(), REACHED, reached, sheet)
    if i >= 0:
        spread(i, sheet, cloth, step, field, smoother)


@wp.kernel(enable_backward=False)
def blend_kernel(
    sheet: Sheet,
    cloth: Cloth,
    rings: int,
    pairs: int,
    long_step: float,
    short_step: float,
    reached: wp.array(dtype=int),
    # kept up to date
    field: wp.array(dtype=wp.vec3),
    smoother: wp.array(dtype=wp.vec3),
):
    """All sweeps, in pairs, by one thread: the lists are short, and a launch costs what hundreds of steps do."""
    first = int(0)
    for _ring in range(rings):
        last = int(sheet.counts[REACHED])
        for k in range(first, last):
            reach(reached[k], sheet, cloth, reached)
        first = last
    n = int(sheet.counts[REACHED])
    for _pair in range(pairs):
        for k in range(n):
            spread(reached[k], sheet, cloth, long_step, field, smoother)
        for k in range(n):
            spread(reached[k], sheet, cloth, short_step, smoother, field)
