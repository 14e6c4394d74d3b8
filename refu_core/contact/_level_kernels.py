"""Cloth levelled where it has to give way to the cloth around it: one code for CPU and CUDA."""

import warp as wp

from refu_core.contact._layers_kernels import Cut

wp.set_module_options({"enable_backward": False})


@wp.func
def levelled(i: int, points: wp.array[wp.vec3], weight: float, cut: Cut) -> wp.vec3:
    """A vertex by its weight towards the middle of its neighbours."""
    place = points[i]
    start = cut.ring_start[i]
    end = cut.ring_start[i + 1]
    if weight > 0.0 and end > start:
        total = wp.vec3()
        for r in range(start, end):
            total += points[cut.ring[r]]
        place += weight * (total / float(end - start) - place)
    return place


@wp.kernel
def level_kernel(points: wp.array[wp.vec3], weight: wp.array[float], cut: Cut, leveller: wp.array[wp.vec3]) -> None:
    """`levelled` of one vertex a thread."""
    i = wp.tid()
    leveller[i] = levelled(i, points, weight[i], cut)


@wp.func
def widest(i: int, weight: wp.array[float], share: wp.array[float], cut: Cut, fade: float) -> float:
    """The weight of a vertex, or what is left of the largest of its neighbours', up to its share."""
    most = float(0.0)
    for r in range(cut.ring_start[i], cut.ring_start[i + 1]):
        most = wp.max(most, weight[cut.ring[r]])
    return wp.max(weight[i], wp.min(fade * most, share[i]))


@wp.kernel
def widen_kernel(
    weight: wp.array[float], share: wp.array[float], cut: Cut, fade: float, wider: wp.array[float]
) -> None:
    """`widest` of one vertex a thread."""
    i = wp.tid()
    wider[i] = widest(i, weight, share, cut, fade)
