"""Cloth levelled where it has to give way to the cloth around it: one code for CPU and CUDA."""

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)


@wp.func
def level(
    i: int, points: wp.array[wp.vec3], weight: wp.array[float], ring_start: wp.array[int], ring: wp.array[int]
) -> wp.vec3:
    """A vertex by its weight towards the middle of its neighbours, `ring[ring_start[i]:ring_start[i + 1]]`."""
    place = points[i]
    start = ring_start[i]
    end = ring_start[i + 1]
    if weight[i] > 0.0 and end > start:
        total = wp.vec3()
        for r in range(start, end):
            total += points[ring[r]]
        place += weight[i] * (total / float(end - start) - place)
    return place


@wp.kernel(enable_backward=False)
def level_kernel(
    points: wp.array[wp.vec3],
    weight: wp.array[float],
    ring_start: wp.array[int],
    ring: wp.array[int],
    # output
    leveller: wp.array[wp.vec3],
) -> None:
    """`level` of one vertex a thread."""
    i = wp.tid()
    leveller[i] = level(i, points, weight, ring_start, ring)


@wp.kernel(enable_backward=False)
def level_rows_kernel(
    rounds: int,
    n_rows: int,
    rows: wp.array[int],
    points: wp.array[wp.vec3],
    weight: wp.array[float],
    ring_start: wp.array[int],
    ring: wp.array[int],
    # output, where all others are already
    other: wp.array[wp.vec3],
) -> None:
    """An even number of rounds by one thread, over the vertices that have a weight; they end in `points`."""
    for round_ in range(rounds):
        for k in range(n_rows):
            i = rows[k]
            if round_ % 2 == 0:
                other[i] = level(i, points, weight, ring_start, ring)
            else:
                points[i] = level(i, other, weight, ring_start, ring)
