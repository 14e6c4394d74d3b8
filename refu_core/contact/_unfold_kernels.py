"""Levelling cloth that has folded over: one code for CPU and CUDA."""

import warp as wp

from refu_core.body._pose_kernels import turned
from refu_core.contact._layers_kernels import Cut, gather
from refu_core.contact._state import bounded

wp.set_module_options({"enable_backward": False})


@wp.struct
class Fold:
    """A garment, and memory to level it in."""

    cut: Cut
    normal: wp.array[wp.vec3]
    """Which way its vertices face at rest."""
    start: wp.array[int]
    joint: wp.array[int]
    weight_of_joint: wp.array[float]
    """Weights of the joints `joint[start[v]:start[v + 1]]`, which turn vertex v."""
    rotation: wp.array[wp.mat33]
    """Rotations of the joints."""
    may: wp.array[int]
    """The vertices that may give way."""
    share: wp.array[float]
    """How much each vertex may give way, 0 to 1."""
    weight: wp.array[float]
    """How much each vertex gives way."""
    wider: wp.array[float]
    origin: wp.array[wp.vec3]
    points: wp.array[wp.vec3]
    leveller: wp.array[wp.vec3]
    """The garment before, now, and a sweep later [m]."""
    rows: wp.array[int]
    count: wp.array[int]
    """The vertices that give way, and how many they are."""
    is_listed: wp.array[int]
    """Zero between launches."""


@wp.func
def facing(i: int, fold: Fold, way: wp.vec3) -> float:
    """Mean cosine between `way` and the normals of the faces around a vertex, weighted by area.

    Where these lie in a plane it is the cosine of the vertex normal. Where they fold the normal leaps; this doesn't.
    """
    along = float(0.0)
    area = float(0.0)
    for k in range(fold.cut.fan_start[i], fold.cut.fan_start[i + 1]):
        face = fold.cut.fan_face[k]
        a = fold.points[fold.cut.faces[face, 0]]
        normal = wp.cross(fold.points[fold.cut.faces[face, 1]] - a, fold.points[fold.cut.faces[face, 2]] - a)
        along += wp.dot(normal, way)
        area += wp.length(normal)
    return wp.where(area > 0.0, along / area, 0.0)


@wp.kernel
def fold_kernel(each: int, fold: Fold, alike: float) -> None:
    """How far each vertex has folded over, 0 to its share, by which way it is `facing` and which way it should.

    Vertices that have folded over are listed. `each` vertices a thread (`strips`).
    """
    first = wp.tid() * each
    for k in range(first, first + each):
        i = fold.may[k]
        way = turned(i, fold.start, fold.joint, fold.weight_of_joint, fold.rotation, fold.normal)
        cosine = facing(i, fold, way)
        weight = fold.share[i] * wp.clamp(1.0 - cosine / alike, 0.0, 1.0)
        fold.weight[i] = weight
        if weight > 0.0:
            fold.rows[wp.atomic_add(fold.count, 0, 1)] = i


@wp.func
def levelled(i: int, points: wp.array[wp.vec3], weight: float, cut: Cut) -> wp.vec3:
    """A vertex, moved by its weight towards the mean of its neighbours."""
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
    """`levelled`, one vertex a thread."""
    i = wp.tid()
    leveller[i] = levelled(i, points, weight[i], cut)


@wp.func
def widest(i: int, weight: wp.array[float], share: wp.array[float], cut: Cut, fade: float) -> float:
    """The weight of a vertex, or `fade` times the largest of its neighbours', up to its share, if that is larger."""
    most = float(0.0)
    for r in range(cut.ring_start[i], cut.ring_start[i + 1]):
        most = wp.max(most, weight[cut.ring[r]])
    return wp.max(weight[i], wp.min(fade * most, share[i]))


@wp.kernel
def widen_kernel(
    weight: wp.array[float], share: wp.array[float], cut: Cut, fade: float, wider: wp.array[float]
) -> None:
    """`widest`, one vertex a thread."""
    i = wp.tid()
    wider[i] = widest(i, weight, share, cut, fade)


@wp.kernel
def bound_kernel(fold: Fold, most: float) -> None:
    """Draws what was levelled back to within `most` [m] of its origin."""
    i = wp.tid()
    fold.points[i] = bounded(fold.points[i], fold.origin[i], most)


@wp.kernel
def unfold_all_kernel(fold: Fold, fade: float, reach: int, rounds: int, most: float) -> None:
    """All steps after `fold_kernel`, by one thread, up to `reach` edges around what has folded; `rounds` is even."""
    for r in range(fold.count[0]):
        fold.is_listed[fold.rows[r]] = 1
    n = gather(fold.count[0], reach, fold.cut, fold.rows, fold.is_listed)
    for _ in range(reach):
        for r in range(n):
            fold.wider[r] = widest(fold.rows[r], fold.weight, fold.share, fold.cut, fade)
        for r in range(n):
            fold.weight[fold.rows[r]] = fold.wider[r]
    for r in range(n):
        i = fold.rows[r]
        fold.origin[i] = fold.points[i]
        fold.leveller[i] = fold.points[i]
        for s in range(fold.cut.ring_start[i], fold.cut.ring_start[i + 1]):
            fold.leveller[fold.cut.ring[s]] = fold.points[fold.cut.ring[s]]
    for k in range(rounds):
        for r in range(n):
            i = fold.rows[r]
            if k % 2 == 0:
                fold.leveller[i] = levelled(i, fold.points, fold.weight[i], fold.cut)
            else:
                fold.points[i] = levelled(i, fold.leveller, fold.weight[i], fold.cut)
    for r in range(n):
        i = fold.rows[r]
        fold.points[i] = bounded(fold.points[i], fold.origin[i], most)
        fold.is_listed[i] = 0
