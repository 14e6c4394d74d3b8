# mypy: ignore-errors
# (Warp reads a kernel's annotations as array types of its own; a type checker can't. A variable that changes in a loop
# has to be called int or float there.)
"""Raising edges that run too low between their ends: all rounds in one launch (`_round_kernels` has a GPU's)."""

import warp as wp

from refu_core.repulsion._sheet import BESIDE, CUTTING, NEAR, RAISED, Cloth, Rules, Sheet, bounded, keep
from refu_core.sdf import Skin, ask


@wp.func
def look_between(edge: int, sheet: Sheet, cloth: Cloth, skin: Skin, rules: Rules):
    """How much the middle of an edge lacks of half the margin [m], and the way up there."""
    a = cloth.edges[edge, 0]
    b = cloth.edges[edge, 1]
    # Beyond a band no face is known; a known one makes the answer cheap.
    near = wp.where(sheet.distance[a] <= sheet.distance[b] + rules.tolerance, sheet.face[a], sheet.face[b])
    distance, gradient, _face = ask(skin, 0.5 * (sheet.place[a] + sheet.place[b]), near)
    lack = 0.5 * rules.margin - distance
    # What runs through a limb hasn't cut a corner, and isn't to be raised.
    return lack * wp.clamp(2.0 - lack / rules.through, 0.0, 1.0), gradient


@wp.kernel(enable_backward=False)
def suspect_kernel(sheet: Sheet, cloth: Cloth, rules: Rules):
    """Lists the edges whose middle may be closer to the skin than half the margin (`_raise_edges`)."""
    if sheet.counts[NEAR] == 0:
        return  # nothing is moved then
    edge = wp.tid()
    a = cloth.edges[edge, 0]
    b = cloth.edges[edge, 1]
    first = sheet.distance[a]
    second = sheet.distance[b]
    if first < 0.0 or second < 0.0:
        return
    # Most edges are far off, which is to be seen from as few numbers as may be.
    is_low = first + second < rules.margin
    if not is_low and (sheet.face[a] < 0 or sheet.face[b] < 0):
        return  # what bulges there isn't known
    way = sheet.place[a] - sheet.place[b]
    beyond = 2.0 * wp.where(first > second, first, second) - rules.margin
    if beyond >= 0.0 and beyond * beyond >= wp.dot(way, way):
        return
    if not is_low:
        bulge = rules.bulge * wp.length(way) * wp.length(sheet.gradient[a] - sheet.gradient[b])
        is_low = first + second < rules.margin + 2.0 * bulge
    if is_low:
        sheet.suspects[wp.atomic_add(sheet.counts, CUTTING, 1)] = edge


@wp.func
def measure(
    edge: int,
    rounds: int,
    sheet: Sheet,
    cloth: Cloth,
    skin: Skin,
    rules: Rules,
    # output
    low: wp.array(dtype=int),
):
    """Whether a suspected edge is too low, and by how much; after the first of the `rounds`, if it was moved."""
    a = cloth.edges[edge, 0]
    b = cloth.edges[edge, 1]
    if rounds > 0 and sheet.moved[a] == 0 and sheet.moved[b] == 0:
        return  # between two limbs, and stays there
    lack, up = look_between(edge, sheet, cloth, skin, rules)
    if lack > 0.0:
        k = wp.atomic_add(sheet.counts, CUTTING + 1 + rounds, 1)
        low[k] = edge
        sheet.deficit[k] = lack
        sheet.rise[k] = lack * up
        wp.atomic_max(sheet.largest, a, lack)
        wp.atomic_max(sheet.largest, b, lack)


@wp.func
def choose(k: int, sheet: Sheet, cloth: Cloth, low: wp.array(dtype=int)):
    """A vertex of several low edges follows the lowest of them."""
    for end in range(2):
        i = cloth.edges[low[k], end]
        if sheet.deficit[k] == sheet.largest[i]:
            sheet.field[i] = sheet.rise[k]
            if wp.atomic_max(sheet.mark, i, BESIDE) == 0:
                sheet.reached[wp.atomic_add(sheet.counts, RAISED, 1)] = i


@wp.func
def lift(i: int, sheet: Sheet, skin: Skin, rules: Rules):
    """Raises an end of a low edge, unless it came nearer to the skin by it."""
    here = bounded(sheet.place[i] + sheet.field[i], sheet.origin[i], rules.max_displacement)
    sheet.field[i] = wp.vec3()
    sheet.largest[i] = 0.0
    sheet.mark[i] = 0
    sheet.moved[i] = 0
    distance, gradient, face = ask(skin, here, sheet.face[i])
    if distance >= wp.min(sheet.distance[i], rules.margin - rules.tolerance):
        keep(i, here, distance, gradient, face, sheet)
        sheet.moved[i] = 1


@wp.kernel(enable_backward=False)
def raise_edges_kernel(sheet: Sheet, cloth: Cloth, skin: Skin, rules: Rules):
    """All rounds by one thread; those that stay low take the places of those before them in the list of suspects."""
    n = int(sheet.counts[CUTTING])
    for rounds in range(rules.max_pushes):
        for k in range(n):
            measure(sheet.suspects[k], rounds, sheet, cloth, skin, rules, sheet.suspects)
        n = int(sheet.counts[CUTTING + 1 + rounds])
        if n == 0:
            break
        sheet.counts[RAISED] = 0
        for k in range(n):
            choose(k, sheet, cloth, sheet.suspects)
        ends = int(sheet.counts[RAISED])
        for k in range(ends):
            lift(sheet.reached[k], sheet, skin, rules)
