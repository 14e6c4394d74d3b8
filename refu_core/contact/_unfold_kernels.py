"""Levelling cloth that has folded over: one code for CPU and CUDA."""

import warp as wp

from refu_core.contact._layers_kernels import Cut
from refu_core.contact._level_kernels import levelled


@wp.func
def facing(i: int, points: wp.array[wp.vec3], cut: Cut, way: wp.vec3) -> float:
    """Mean cosine between `way` and the faces around a vertex, by their areas.

    That is the cosine of its normal where they are in a plane; where they fold the normal leaps, and this doesn't.
    """
    along = float(0.0)
    area = float(0.0)
    for k in range(cut.fan_start[i], cut.fan_start[i + 1]):
        face = cut.fan_face[k]
        a = points[cut.faces[face, 0]]
        normal = wp.cross(points[cut.faces[face, 1]] - a, points[cut.faces[face, 2]] - a)
        along += wp.dot(normal, way)
        area += wp.length(normal)
    return wp.where(area > 0.0, along / area, 0.0)


@wp.kernel(enable_backward=False)
def fold_kernel(
    points: wp.array[wp.vec3],
    turned: wp.array[wp.vec3],
    cut: Cut,
    flat: float,
    folded: float,
    share: wp.array[float],
    # outputs
    weight: wp.array[float],
    count: wp.array[int],
) -> None:
    """How far each vertex has folded over, 0 to its `share`: by where it is `facing`, and where it should, `turned`."""
    i = wp.tid()
    fold = float(0.0)
    if share[i] > 0.0:
        cosine = facing(i, points, cut, turned[i])
        fold = share[i] * wp.clamp((flat - cosine) / (flat - folded), 0.0, 1.0)
    weight[i] = fold
    if fold > 0.0:
        wp.atomic_add(count, 0, 1)


@wp.func
def widest(i: int, weight: wp.array[float], share: wp.array[float], cut: Cut, fade: float) -> float:
    """The weight of a vertex, or what is left of the largest of its neighbours'."""
    most = float(0.0)
    if share[i] == 0.0:
        return most
    for r in range(cut.ring_start[i], cut.ring_start[i + 1]):
        most = wp.max(most, weight[cut.ring[r]])
    return wp.max(weight[i], wp.min(fade * most, share[i]))


@wp.kernel(enable_backward=False)
def widen_kernel(
    weight: wp.array[float],
    share: wp.array[float],
    cut: Cut,
    fade: float,
    # output
    wider: wp.array[float],
) -> None:
    """`widest` of one vertex a thread."""
    i = wp.tid()
    wider[i] = widest(i, weight, share, cut, fade)


@wp.kernel(enable_backward=False)
def unfold_all_kernel(
    share: wp.array[float],
    cut: Cut,
    fade: float,
    reach: int,
    rounds: int,
    # memory
    wider: wp.array[float],
    rows: wp.array[int],
    leveller: wp.array[wp.vec3],
    # outputs
    weight: wp.array[float],
    points: wp.array[wp.vec3],
) -> None:
    """All rounds by one thread; what isn't near a fold isn't looked at. Both numbers are even."""
    for k in range(reach):
        for i in range(weight.shape[0]):
            if k % 2 == 0:
                wider[i] = widest(i, weight, share, cut, fade)
            else:
                weight[i] = widest(i, wider, share, cut, fade)
    n = int(0)
    for i in range(weight.shape[0]):
        leveller[i] = points[i]
        if weight[i] > 0.0:
            rows[n] = i
            n += 1
    for k in range(rounds):
        for r in range(n):
            i = rows[r]
            if k % 2 == 0:
                leveller[i] = levelled(i, points, weight[i], cut.ring_start, cut.ring)
            else:
                points[i] = levelled(i, leveller, weight[i], cut.ring_start, cut.ring)
