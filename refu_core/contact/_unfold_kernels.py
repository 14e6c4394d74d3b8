"""Levelling cloth that has folded over: one code for CPU and CUDA."""

import warp as wp

from refu_core.body._pose_kernels import turned
from refu_core.contact._layers_kernels import Cut
from refu_core.contact._level_kernels import levelled
from refu_core.contact._state import bounded

wp.set_module_options({"enable_backward": False})


@wp.struct
class Upright:
    """Where the cloth of a garment faces without its folds: its normals at rest, and the joints that turn them."""

    normal: wp.array[wp.vec3]
    start: wp.array[int]
    joint: wp.array[int]
    weight: wp.array[float]
    """Of the joints `joint[start[v]:start[v + 1]]` at vertex v."""
    may: wp.array[int]
    """The vertices that may give way."""
    share: wp.array[float]
    """How much each vertex may, 0 to 1."""


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


@wp.kernel
def fold_kernel(
    each: int,
    points: wp.array[wp.vec3],
    rotation: wp.array[wp.mat33],
    cut: Cut,
    upright: Upright,
    flat: float,
    folded: float,
    # outputs
    weight: wp.array[float],
    rows: wp.array[int],
    count: wp.array[int],
) -> None:
    """How far each vertex has folded over, 0 to its share: by where it is `facing`, and where it should be.

    Those that have are listed in `rows`. `each` vertices a thread (`strips`).
    """
    first = wp.tid() * each
    for k in range(first, first + each):
        i = upright.may[k]
        way = turned(i, upright.start, upright.joint, upright.weight, rotation, upright.normal)
        cosine = facing(i, points, cut, way)
        fold = upright.share[i] * wp.clamp((flat - cosine) / (flat - folded), 0.0, 1.0)
        weight[i] = fold
        if fold > 0.0:
            rows[wp.atomic_add(count, 0, 1)] = i


@wp.func
def widest(i: int, weight: wp.array[float], share: wp.array[float], cut: Cut, fade: float) -> float:
    """The weight of a vertex, or what is left of the largest of its neighbours'."""
    most = float(0.0)
    for r in range(cut.ring_start[i], cut.ring_start[i + 1]):
        most = wp.max(most, weight[cut.ring[r]])
    return wp.max(weight[i], wp.min(fade * most, share[i]))


@wp.kernel
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


@wp.kernel
def bound_kernel(origin: wp.array[wp.vec3], most: float, points: wp.array[wp.vec3]) -> None:
    """Draws what was levelled back to within `most` [m] of its origin; what wasn't stays to the bit."""
    i = wp.tid()
    if wp.length_sq(points[i] - origin[i]) > 0.0:
        points[i] = bounded(points[i], origin[i], most)


@wp.kernel
def unfold_all_kernel(
    share: wp.array[float],
    cut: Cut,
    fade: float,
    reach: int,
    rounds: int,
    most: float,
    # memory; `is_listed` is zero between launches
    rows: wp.array[int],
    count: wp.array[int],
    is_listed: wp.array[int],
    wider: wp.array[float],
    origin: wp.array[wp.vec3],
    leveller: wp.array[wp.vec3],
    # outputs
    weight: wp.array[float],
    points: wp.array[wp.vec3],
) -> None:
    """All that follows on `fold_kernel`, by one thread: of those that have folded over, and of who is `reach` around.

    `reach` and `rounds` are even.
    """
    n = count[0]
    for r in range(n):
        is_listed[rows[r]] = 1
    first = int(0)
    for _ in range(reach):
        last = int(n)
        for r in range(first, last):
            for s in range(cut.ring_start[rows[r]], cut.ring_start[rows[r] + 1]):
                j = cut.ring[s]
                if is_listed[j] == 0 and share[j] > 0.0:
                    is_listed[j] = 1
                    rows[n] = j
                    n += 1
        first = last
        for r in range(n):
            wider[r] = widest(rows[r], weight, share, cut, fade)
        for r in range(n):
            weight[rows[r]] = wider[r]
    for r in range(n):
        i = rows[r]
        origin[i] = points[i]
        leveller[i] = points[i]
        for s in range(cut.ring_start[i], cut.ring_start[i + 1]):
            leveller[cut.ring[s]] = points[cut.ring[s]]
    for k in range(rounds):
        for r in range(n):
            i = rows[r]
            if k % 2 == 0:
                leveller[i] = levelled(i, points, weight[i], cut.ring_start, cut.ring)
            else:
                points[i] = levelled(i, leveller, weight[i], cut.ring_start, cut.ring)
    for r in range(n):
        i = rows[r]
        points[i] = bounded(points[i], origin[i], most)
        is_listed[i] = 0
