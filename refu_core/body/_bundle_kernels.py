"""Finds what is near what, by boxes around bundles of some dozens of faces and around groups of bundles like limbs."""

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

wp.set_module_options({"enable_backward": False})


@wp.struct
class Bundles:
    """Groups of a posed mesh's faces, in bundles."""

    first: wp.array[int]
    """The bundles of group k are `first[k]` to `first[k + 1]`."""
    start: wp.array[int]
    corner: wp.array[int]
    """The vertices of bundle i's faces are `corner[start[i]:start[i + 1]]`."""
    low: wp.array[wp.vec3]
    high: wp.array[wp.vec3]
    """The boxes of bundles."""
    group_low: wp.array[wp.vec3]
    group_high: wp.array[wp.vec3]
    """The boxes of groups."""


@wp.func
def lesser(p: wp.vec3, q: wp.vec3) -> wp.vec3:
    """The minimum of each coordinate, without the check for NaN that wp.min makes."""
    return wp.vec3(
        wp.where(q[0] < p[0], q[0], p[0]), wp.where(q[1] < p[1], q[1], p[1]), wp.where(q[2] < p[2], q[2], p[2])
    )


@wp.func
def greater(p: wp.vec3, q: wp.vec3) -> wp.vec3:
    return -lesser(-p, -q)


@wp.func
def bound(i: int, points: wp.array[wp.vec3], bundles: Bundles) -> None:
    """Finds the box of bundle i."""
    low = points[bundles.corner[bundles.start[i]]]
    high = low
    for c in range(bundles.start[i] + 1, bundles.start[i + 1]):
        p = points[bundles.corner[c]]
        low = lesser(low, p)
        high = greater(high, p)
    bundles.low[i] = low
    bundles.high[i] = high


@wp.func
def enclose(k: int, bundles: Bundles) -> None:
    """Finds the box of group k; nothing is near a group without faces."""
    low = wp.vec3(wp.inf, wp.inf, wp.inf)
    high = -low
    for i in range(bundles.first[k], bundles.first[k + 1]):
        low = lesser(low, bundles.low[i])
        high = greater(high, bundles.high[i])
    bundles.group_low[k] = low
    bundles.group_high[k] = high


@wp.func
def do_meet(low: wp.vec3, high: wp.vec3, other_low: wp.vec3, other_high: wp.vec3, gap: float) -> bool:
    return (
        low[0] - gap < other_high[0]
        and low[1] - gap < other_high[1]
        and low[2] - gap < other_high[2]
        and other_low[0] < high[0] + gap
        and other_low[1] < high[1] + gap
        and other_low[2] < high[2] + gap
    )


@wp.func
def is_near(low: wp.vec3, high: wp.vec3, k: int, gap: float, bundles: Bundles) -> bool:
    """Whether something in a box may be within `gap` [m] of group k."""
    if not do_meet(low, high, bundles.group_low[k], bundles.group_high[k], gap):
        return False
    for j in range(bundles.first[k], bundles.first[k + 1]):
        if do_meet(low, high, bundles.low[j], bundles.high[j], gap):
            return True
    return False


@wp.kernel
def bound_kernel(points: wp.array[wp.vec3], bundles: Bundles) -> None:
    bound(wp.tid(), points, bundles)


@wp.kernel
def enclose_kernel(bundles: Bundles) -> None:
    enclose(wp.tid(), bundles)
