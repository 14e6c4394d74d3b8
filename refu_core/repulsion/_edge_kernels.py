# mypy: ignore-errors
# ruff: noqa: UP018
# (Warp reads a kernel's annotations as array types of its own; a type checker can't. A variable that changes in a loop
# has to be called int or float there.)
"""Raising edges that run too low between their ends: all rounds in one launch on a CPU, three a round on a GPU."""

import warp as wp

from refu_core.repulsion._sheet import BESIDE, CUTTING, NEAR, RAISED, Cloth, Rules, Sheet, bounded, keep, listed
from refu_core.sdf import Skin, ask


@wp.func
def look_between(edge: int, sheet: Sheet, cloth: Cloth, skin: Skin, rules: Rules):
    """How much the middle of an edge lacks of half the margin [m], and the way up there."""
    a = cloth.edges[edge, 0]
    b = cloth.edges[edge, 1]
    # Beyond a band no face is known; a known one makes the answer cheap.
    near = wp.where(sheet.distance[a] <= sheet.distance[b] + rules.tolerance, sheet.face[a], sheet.face[b])
    distance, gradient, _face = ask(skin, 0.5 * (sheet.place[a] + sheet.place[b]), near)
    return 0.5 * rules.margin - distance, gradient


@wp.kernel(enable_backward=False)
def suspect_kernel(sheet: Sheet, cloth: Cloth, rules: Rules, suspects: wp.array(dtype=int)):
    """Lists the edges whose middle may be closer to the skin than half the margin (`_raise_edges`)."""
    if sheet.counts[NEAR] == 0:
        return  # nothing is moved then
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


@wp.func
def measure(
    edge: int,
    rounds: int,
    sheet: Sheet,
    cloth: Cloth,
    skin: Skin,
    rules: Rules,
    moved: wp.array(dtype=int),
    # outputs
    low: wp.array(dtype=int),
    deficit: wp.array(dtype=float),
    rise: wp.array(dtype=wp.vec3),
    largest: wp.array(dtype=float),
):
    """Whether a suspected edge is too low, and by how much; after the first of the `rounds`, if it was moved."""
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


@wp.func
def choose(
    k: int,
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
    for end in range(2):
        i = cloth.edges[low[k], end]
        if deficit[k] == largest[i]:
            field[i] = rise[k]
            if wp.atomic_max(sheet.mark, i, BESIDE) == 0:
                raised[wp.atomic_add(sheet.counts, RAISED, 1)] = i


@wp.func
def lift(
    i: int,
    sheet: Sheet,
    skin: Skin,
    rules: Rules,
    # outputs
    field: wp.array(dtype=wp.vec3),
    largest: wp.array(dtype=float),
    moved: wp.array(dtype=int),
):
    """Raises an end of a low edge, unless it came nearer to the skin by it."""
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
def measure_kernel(
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
    edge = listed(wp.tid(), CUTTING + rounds, suspects, sheet)
    if edge >= 0:
        measure(edge, rounds, sheet, cloth, skin, rules, moved, low, deficit, rise, largest)


@wp.kernel(enable_backward=False)
def choose_kernel(
    sheet: Sheet,
    cloth: Cloth,
    rounds: int,
    low: wp.array(dtype=int),
    deficit: wp.array(dtype=float),
    rise: wp.array(dtype=wp.vec3),
    largest: wp.array(dtype=float),
    # outputs
    field: wp.array(dtype=wp.vec3),
    raised: wp.array(dtype=int),
):
    k = wp.tid()
    if listed(k, CUTTING + 1 + rounds, low, sheet) >= 0:
        choose(k, sheet, cloth, low, deficit, rise, largest, field, raised)


@wp.kernel(enable_backward=False)
def lift_kernel(
    sheet: Sheet,
    skin: Skin,
    rules: Rules,
    raised: wp.array(dtype=int),
    # outputs
    field: wp.array(dtype=wp.vec3),
    largest: wp.array(dtype=float),
    moved: wp.array(dtype=int),
):
    i = listed(wp.tid(), RAISED, raised, sheet)
    if i >= 0:
        lift(i, sheet, skin, rules, field, largest, moved)


@wp.kernel(enable_backward=False)
def raise_edges_kernel(
    sheet: Sheet,
    cloth: Cloth,
    skin: Skin,
    rules: Rules,
    low: wp.array(dtype=int),
    moved: wp.array(dtype=int),
    deficit: wp.array(dtype=float),
    rise: wp.array(dtype=wp.vec3),
    largest: wp.array(dtype=float),
    field: wp.array(dtype=wp.vec3),
    raised: wp.array(dtype=int),
):
    """All rounds by one thread; those that stay low take the places of those before them in `low`, the suspects."""
    n = int(sheet.counts[CUTTING])
    for rounds in range(rules.max_pushes):
        for k in range(n):
            measure(low[k], rounds, sheet, cloth, skin, rules, moved, low, deficit, rise, largest)
        n = int(sheet.counts[CUTTING + 1 + rounds])
        if n == 0:
            break
        sheet.counts[RAISED] = 0
        for k in range(n):
            choose(k, sheet, cloth, low, deficit, rise, largest, field, raised)
        ends = int(sheet.counts[RAISED])
        for k in range(ends):
            lift(raised[k], sheet, skin, rules, field, largest, moved)
