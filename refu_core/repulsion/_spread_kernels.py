# mypy: ignore-errors
# ruff: noqa: RUF046, UP018
# (Warp reads a kernel's annotations as array types of its own; a type checker can't. A variable that changes in a loop
# has to be called int or float there.)
"""How pushes spread over the neighbourhood: all rounds in one launch (`_round_kernels` has those of a GPU)."""

import warp as wp

from refu_core.repulsion._sheet import BESIDE, REACHED, SOURCE, Cloth, Sheet


@wp.func
def reach(i: int, sheet: Sheet, cloth: Cloth):
    """Lists the neighbours of a vertex, unless they are."""
    for k in range(cloth.ring_start[i], cloth.ring_start[i + 1]):
        j = cloth.ring[k]
        if sheet.mark[j] == 0 and wp.atomic_max(sheet.mark, j, BESIDE) == 0:
            sheet.reached[wp.atomic_add(sheet.counts, REACHED, 1)] = j


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
def blend_kernel(
    sheet: Sheet,
    cloth: Cloth,
    rings: int,
    pairs: int,
    long_step: float,
    short_step: float,
):
    """All sweeps, in pairs, by one thread: the lists are short, and a launch costs what hundreds of steps do."""
    first = int(0)
    for _ring in range(rings):
        last = int(sheet.counts[REACHED])
        for k in range(first, last):
            reach(sheet.reached[k], sheet, cloth)
        first = last
    n = int(sheet.counts[REACHED])
    for _pair in range(pairs):
        for k in range(n):
            spread(sheet.reached[k], sheet, cloth, long_step, sheet.field, sheet.smoother)
        for k in range(n):
            spread(sheet.reached[k], sheet, cloth, short_step, sheet.smoother, sheet.field)
