"""What pulls a body apart when no derivative is asked for: the steps of `Collider`, a vertex a thread."""

from typing import TYPE_CHECKING

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

wp.set_module_options({"enable_backward": False})

N_STATIONS = wp.constant(6)
_FARTHEST = wp.constant(0.08)
"""Overlaps are looked for up to this depth [m]."""


@wp.struct
class Skeleton:
    """A posed body's bones, and how its skin hangs on them."""

    rotation: wp.array2d[wp.mat33]
    start: wp.array[int]
    joint: wp.array[int]
    weight: wp.array[float]
    normal: wp.array[wp.vec3]
    """Of the smoothed skin in the rest pose."""
    half: wp.array2d[wp.mat33]
    """Half way from a joint's parent to the joint."""


@wp.struct
class Folds:
    """`Creases`, the rows of vertex v from `start[v]` on."""

    start: wp.array[int]
    joint: wp.array[int]
    side: wp.array[float]
    normal: wp.array[wp.vec3]
    least: wp.array[float]
    stations: wp.array2d[int]
    weights: wp.array2d[float]


@wp.struct
class Bodies:
    """The segments, each a mesh of its own over the same vertices."""

    of_vertex: wp.array[int]
    trees: wp.array[wp.uint64]
    faces: wp.array[wp.vec3i]
    """Of all segments, one after another."""
    first_face: wp.array[int]
    low: wp.array[wp.vec3]
    high: wp.array[wp.vec3]
    gap: wp.array2d[float]
    """That vertex v keeps from segment k [m]."""
    ratio: wp.array2d[float]
    """How much more segment k gives way than segment i."""


@wp.kernel
def half_kernel(rotation: wp.array2d[wp.mat33], parent: wp.array[int], half: wp.array2d[wp.mat33]) -> None:
    """The rotation half way between each joint's and its parent's."""
    b, j = wp.tid()
    above = rotation[b, wp.max(parent[j], 0)]
    turn = wp.transpose(above) @ rotation[b, j]
    w = 0.5 * wp.sqrt(wp.max(1.0 + wp.trace(turn), 1.0e-8))
    axis = wp.vec3(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]) / (4.0 * w)
    q = wp.normalize(wp.quat(axis[0], axis[1], axis[2], w + 1.0))
    half[b, j] = above @ wp.quat_to_matrix(q)


@wp.kernel
def mean_kernel(
    points: wp.array[wp.vec3], start: wp.array[int], vertex: wp.array[int], weight: wp.array[float], mean: wp.array[wp.vec3]
) -> None:
    s = wp.tid()
    total = wp.vec3()
    for k in range(start[s], start[s + 1]):
        total += weight[k] * points[vertex[k]]
    mean[s] = total


@wp.kernel
def crease_kernel(
    skin: wp.array[wp.vec3],
    station: wp.array[wp.vec3],
    skeleton: Skeleton,
    b: int,
    folds: Folds,
    rounds: int,
    # outputs
    out: wp.array[wp.vec3],
    moved: wp.array[int],
) -> None:
    """Brings skin back to its own side of the seams near by; the farthest astray first."""
    v = wp.tid()
    p = skin[v]
    first = folds.start[v]
    last = folds.start[v + 1]
    for _ in range(rounds):
        most = float(0.0)
        step = wp.vec3()
        for r in range(first, last):
            through = wp.vec3()
            for k in range(N_STATIONS):
                through += folds.weights[r, k] * station[folds.stations[r, k]]
            normal = skeleton.half[b, folds.joint[r]] @ folds.normal[r]
            lacks = folds.least[r] - folds.side[r] * wp.dot(p - through, normal)
            if lacks > most:
                most = lacks
                step = folds.side[r] * lacks * normal
        p += step
        if most == 0.0:
            break
    out[v] = p
    if wp.length_sq(p - skin[v]) > 0.0:
        moved[0] = 1


@wp.kernel
def smooth_kernel(
    skin: wp.array[wp.vec3],
    moved: wp.array[wp.vec3],
    start: wp.array[int],
    ring: wp.array[int],
    scale: float,
    step: float,
    source: wp.array[wp.vec3],
    # output
    target: wp.array[wp.vec3],
) -> None:
    """Levels what was moved, the more the farther; what wasn't stays."""
    v = wp.tid()
    p = source[v]
    share = wp.min(wp.length(moved[v] - skin[v]) / scale, 1.0) * step
    if share > 0.0:
        total = wp.vec3()
        for k in range(start[v], start[v + 1]):
            total += source[ring[k]]
        p += share * (total / float(start[v + 1] - start[v]) - p)
    target[v] = p


@wp.kernel
def box_kernel(points: wp.array[wp.vec3], of_vertex: wp.array[int], low: wp.array[wp.vec3], high: wp.array[wp.vec3]) -> None:
    v = wp.tid()
    k = of_vertex[v]
    wp.atomic_min(low, k, points[v])
    wp.atomic_max(high, k, points[v])


@wp.func
def normal_at(skeleton: Skeleton, b: int, v: int) -> wp.vec3:
    """The smoothed normal that the bones give vertex v: a fold doesn't turn it over."""
    normal = wp.vec3()
    for k in range(skeleton.start[v], skeleton.start[v + 1]):
        normal += skeleton.weight[k] * (skeleton.rotation[b, skeleton.joint[k]] @ skeleton.normal[v])
    return wp.normalize(normal)


@wp.kernel
def part_kernel(
    points: wp.array[wp.vec3],
    n_vertices: int,
    skeleton: Skeleton,
    b: int,
    bodies: Bodies,
    gap: float,
    rounds: int,
    # output
    out: wp.array[wp.vec3],
) -> None:
    """Moves each vertex to its own side of the surface half way between its segment and another one."""
    v = wp.tid()
    start = points[v]
    p = start
    own = bodies.of_vertex[v]
    normal = wp.vec3()
    for _ in range(rounds):
        most = float(1.0e-5)
        step = wp.vec3()
        for k in range(bodies.trees.shape[0]):
            low = bodies.low[k]
            high = bodies.high[k]
            if (
                k != own
                and p[0] > low[0] - gap
                and p[1] > low[1] - gap
                and p[2] > low[2] - gap
                and p[0] < high[0] + gap
                and p[1] < high[1] + gap
                and p[2] < high[2] + gap
            ):
                hit = wp.mesh_query_point_sign_winding_number(bodies.trees[k], p, _FARTHEST, 2.0, 0.5)
                if hit.result:
                    at = wp.mesh_eval_position(bodies.trees[k], hit.face, hit.u, hit.v)
                    distance = hit.sign * wp.length(p - at)
                    ratio = bodies.ratio[own, k]
                    if wp.length_sq(normal) == 0.0:
                        normal = normal_at(skeleton, b, v)
                    lacks = bodies.gap[v, k] - distance - ratio * wp.dot(start - p, normal)
                    if lacks > 1.0e-5:
                        corners = bodies.faces[bodies.first_face[k] + hit.face]
                        other = wp.vec3()
                        for c in range(3):
                            w = wp.where(c == 0, hit.u, wp.where(c == 1, hit.v, 1.0 - hit.u - hit.v))
                            if corners[c] < n_vertices:
                                other += w * normal_at(skeleton, b, corners[c])
                        other = wp.normalize(other)
                        facing = wp.dot(other, normal)
                        way = wp.normalize(other - wp.max(facing, 0.0) * normal - normal)
                        rate = wp.dot(way, other) - ratio * wp.dot(way, normal)
                        rate = wp.clamp(rate, 0.5 + 0.5 * ratio, 1.0 + ratio)
                        lacks /= rate
                        if lacks > most:
                            most = lacks
                            step = lacks * way
        p += step
        if most == 1.0e-5:
            break
    out[v] = p
