"""What pulls a posed body apart when no derivative is asked for: the steps of `Collider`, a vertex or an edge a thread.

Segments are told apart by the bits of an integer. `touched` has the segments that a vertex has to give way to.
"""

from typing import TYPE_CHECKING

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

wp.set_module_options({"enable_backward": False})

if TYPE_CHECKING:
    Stations = wp.Vector[int]
    StationWeights = wp.Vector[float]
else:
    Stations = wp.types.vector(length=6, dtype=wp.int32)
    StationWeights = wp.types.vector(length=6, dtype=wp.float32)

DEEPEST = wp.constant(0.1)
"""Deeper than this no vertex is in another segment [m]: the trunk's half."""
# A ray along no axis of a mesh.
_RAY = wp.constant(wp.vec3(0.5418, 0.6389, 0.5461))
_LEAST_STEP = wp.constant(1e-5)


@wp.struct
class Bones:
    """A posed body's joints, and how skin hangs on them."""

    rotation: wp.array[wp.mat33]
    """Of each joint."""
    between: wp.array[wp.mat33]
    """Of each joint's seams, between the parent's rotation and the joint's."""
    start: wp.array[int]
    joint: wp.array[int]
    weight: wp.array[float]
    normal: wp.array[wp.vec3]
    """Of the skin in the rest pose, smoothed."""


@wp.struct
class Seams:
    """The rows of `Creases`, those of vertex v from `start[v]` on."""

    start: wp.array[int]
    rotation: wp.array[int]
    normal: wp.array[wp.vec3]
    least: wp.array[float]
    """Height over the plane that skin keeps [m]."""
    stations: wp.array[Stations]
    weights: wp.array[StationWeights]


@wp.struct
class Segments:
    """The segments of `Solids` in one pose: K trees over the same points."""

    trees: wp.array[wp.uint64]
    own: wp.array[int]
    """The segment of each vertex."""
    low: wp.array[wp.vec3]
    high: wp.array[wp.vec3]
    faces: wp.array[wp.vec3i]
    first_face: wp.array[int]
    gap: wp.array2d[float]
    """What vertex v keeps from segment k [m]."""
    ratio: wp.array2d[float]
    """How many times as soft segment k is as segment i."""


@wp.kernel
def between_kernel(
    rotation: wp.array[wp.mat33], parent: wp.array[int], levels: wp.array[float], between: wp.array[wp.mat33]
) -> None:
    """The rotations on the way from each joint's parent to the joint, one a seam."""
    j = wp.tid()
    above = rotation[parent[j]]
    turn = wp.transpose(above) @ rotation[j]
    w = 0.5 * wp.sqrt(wp.max(1.0 + wp.trace(turn), 1.0e-6))
    axis = wp.vec3(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]) / (4.0 * w)
    for i in range(levels.shape[0]):
        t = levels[i]
        q = wp.normalize(wp.quat(t * axis[0], t * axis[1], t * axis[2], t * w + 1.0 - t))
        between[j * levels.shape[0] + i] = above @ wp.quat_to_matrix(q)


@wp.kernel
def mean_kernel(
    points: wp.array[wp.vec3], start: wp.array[int], vertex: wp.array[int], weight: wp.array[float], mean: wp.array[wp.vec3]
) -> None:
    i = wp.tid()
    total = wp.vec3()
    for k in range(start[i], start[i + 1]):
        total += weight[k] * points[vertex[k]]
    mean[i] = total


@wp.kernel
def crease_kernel(
    skin: wp.array[wp.vec3],
    stations: wp.array[wp.vec3],
    bones: Bones,
    seams: Seams,
    rounds: int,
    # outputs
    out: wp.array[wp.vec3],
    moved: wp.array[int],
) -> None:
    """Brings skin back to its own side of the seams near by, from the one that it is farthest beyond."""
    v = wp.tid()
    p = skin[v]
    for _ in range(rounds):
        most = float(0.0)
        step = wp.vec3()
        for r in range(seams.start[v], seams.start[v + 1]):
            through = wp.vec3()
            which = seams.stations[r]
            weights = seams.weights[r]
            for k in range(wp.static(6)):
                through += weights[k] * stations[which[k]]
            normal = bones.between[seams.rotation[r]] @ seams.normal[r]
            lacks = seams.least[r] - wp.dot(p - through, normal)
            if lacks > most:
                most = lacks
                step = lacks * normal
        if most == 0.0:
            break
        p += step
        moved[0] = 1
    out[v] = p


@wp.kernel
def smooth_kernel(
    skin: wp.array[wp.vec3],
    moved: wp.array[wp.vec3],
    start: wp.array[int],
    ring: wp.array[int],
    full: float,
    step: float,
    source: wp.array[wp.vec3],
    # output
    target: wp.array[wp.vec3],
) -> None:
    """Levels skin that was moved, in full where it was moved by `full` [m] or farther; what wasn't stays."""
    v = wp.tid()
    p = source[v]
    share = wp.min(wp.length(moved[v] - skin[v]) / full, 1.0) * step
    if share > 0.0:
        total = wp.vec3()
        for k in range(start[v], start[v + 1]):
            total += source[ring[k]]
        p += share * (total / float(start[v + 1] - start[v]) - p)
    target[v] = p


@wp.kernel
def box_kernel(points: wp.array[wp.vec3], own: wp.array[int], low: wp.array[wp.vec3], high: wp.array[wp.vec3]) -> None:
    v = wp.tid()
    wp.atomic_min(low, own[v], points[v])
    wp.atomic_max(high, own[v], points[v])


@wp.func
def distance_of(tree: wp.uint64, p: wp.vec3, hit: wp.MeshQueryPoint) -> float:
    """Signed by how many faces a ray meets: caps have edges where a normal's sign is wrong."""
    distance = wp.length(p - wp.mesh_eval_position(tree, hit.face, hit.u, hit.v))
    if wp.mesh_query_ray_count_intersections(tree, p, _RAY) % 2 == 1:
        return -distance
    return distance


@wp.kernel
def touch_kernel(
    points: wp.array[wp.vec3], segments: Segments, gap: float, touched: wp.array[int], outside: wp.array[int]
) -> None:
    """Which segments each vertex is nearer to than it may be, of those whose surface is that near."""
    v = wp.tid()
    p = points[v]
    mine = int(0)
    seen = int(0)
    for k in range(segments.trees.shape[0]):
        low = segments.low[k]
        high = segments.high[k]
        if (
            p[0] > low[0] - gap
            and p[1] > low[1] - gap
            and p[2] > low[2] - gap
            and p[0] < high[0] + gap
            and p[1] < high[1] + gap
            and p[2] < high[2] + gap
        ):
            keeps = segments.gap[v, k]
            if keeps > 0.0 and k != segments.own[v]:
                hit = wp.mesh_query_point_no_sign(segments.trees[k], p, keeps)
                if hit.result:
                    mine |= 1 << k
                    if distance_of(segments.trees[k], p, hit) > 0.0:
                        seen |= 1 << k
    touched[v] = mine
    outside[v] = seen


@wp.kernel
def deepen_kernel(
    points: wp.array[wp.vec3],
    segments: Segments,
    start: wp.array[int],
    ring: wp.array[int],
    touched: wp.array[int],
    outside: wp.array[int],
) -> None:
    """A vertex next to one that is inside a segment is inside it, too, unless the surface runs between them."""
    v = wp.tid()
    near = int(0)
    for k in range(start[v], start[v + 1]):
        w = ring[k]
        near |= touched[w] & ~outside[w]
    near &= ~(touched[v] | outside[v] | (1 << segments.own[v]))
    if near == 0:
        return
    for k in range(segments.trees.shape[0]):
        if (near >> k) & 1 == 1:
            if wp.mesh_query_ray_count_intersections(segments.trees[k], points[v], _RAY) % 2 == 1:
                touched[v] = touched[v] | (1 << k)
            else:
                outside[v] = outside[v] | (1 << k)


@wp.func
def normal_at(bones: Bones, v: int) -> wp.vec3:
    """The smoothed normal that the bones give vertex v: a fold doesn't turn it over."""
    normal = wp.vec3()
    for k in range(bones.start[v], bones.start[v + 1]):
        normal += bones.weight[k] * (bones.rotation[bones.joint[k]] @ bones.normal[v])
    return wp.normalize(normal)


@wp.func
def way_out(
    p: wp.vec3, normal: wp.vec3, sunk: float, k: int, ratio: float, keeps: float, segments: Segments, bones: Bones
) -> wp.vec3:
    """How p, with its skin's `normal` and `sunk` below its own skin [m], gives way to segment k."""
    hit = wp.mesh_query_point_no_sign(segments.trees[k], p, DEEPEST)
    if not hit.result:
        return wp.vec3()
    lacks = keeps - distance_of(segments.trees[k], p, hit) - ratio * sunk
    if lacks < _LEAST_STEP:
        return wp.vec3()
    corners = segments.faces[segments.first_face[k] + hit.face]
    other = wp.vec3()
    for c in range(3):
        if corners[c] < segments.own.shape[0]:  # not the middle of a cap
            weight = wp.where(c == 0, hit.u, wp.where(c == 1, hit.v, 1.0 - hit.u - hit.v))
            other += weight * normal_at(bones, corners[c])
    other = wp.normalize(other)
    way = wp.normalize(other - wp.max(wp.dot(other, normal), 0.0) * normal - normal)
    rate = wp.dot(way, other) - ratio * wp.dot(way, normal)
    return lacks / wp.clamp(rate, 0.5 + 0.5 * ratio, 1.0 + ratio) * way


@wp.kernel
def part_kernel(
    points: wp.array[wp.vec3],
    touched: wp.array[int],
    segments: Segments,
    bones: Bones,
    rounds: int,
    # output
    out: wp.array[wp.vec3],
) -> None:
    """Moves each vertex to its own side of the surface between its segment and another one, in Newton's steps."""
    v = wp.tid()
    start = points[v]
    p = start
    if touched[v] != 0:
        own = segments.own[v]
        normal = normal_at(bones, v)
        for _ in range(rounds):
            step = wp.vec3()
            sunk = wp.dot(start - p, normal)
            for k in range(segments.trees.shape[0]):
                if (touched[v] >> k) & 1 == 1:
                    found = way_out(p, normal, sunk, k, segments.ratio[own, k], segments.gap[v, k], segments, bones)
                    if wp.length_sq(found) > wp.length_sq(step):
                        step = found
            if wp.length_sq(step) == 0.0:
                break
            p += step
    out[v] = p


@wp.kernel
def edge_kernel(
    points: wp.array[wp.vec3],
    edges: wp.array[wp.vec2i],
    touched: wp.array[int],
    moved: wp.array[wp.vec3],
    steep: float,
    segments: Segments,
    bones: Bones,
    # output
    steps: wp.array[wp.vec3],
) -> None:
    """How the middle of each edge gives way, where its ends were moved by more than `steep` [m] apart from each other."""
    e = wp.tid()
    v = edges[e][0]
    w = edges[e][1]
    step = wp.vec3()
    either = touched[v] | touched[w]
    if either != 0:
        gone_v = points[v] - moved[v]
        gone_w = points[w] - moved[w]
        if wp.length(gone_v - gone_w) > steep:
            normal_v = normal_at(bones, v)
            normal_w = normal_at(bones, w)
            normal = wp.normalize(normal_v + normal_w)
            sunk = 0.5 * (wp.dot(gone_v, normal_v) + wp.dot(gone_w, normal_w))
            middle = 0.5 * (moved[v] + moved[w])
            for k in range(segments.trees.shape[0]):
                if (either >> k) & 1 == 1 and k != segments.own[v] and k != segments.own[w]:
                    keeps = wp.min(segments.gap[v, k], segments.gap[w, k])
                    ratio = segments.ratio[segments.own[v], k]
                    found = way_out(middle, normal, sunk, k, ratio, keeps, segments, bones)
                    if wp.length_sq(found) > wp.length_sq(step):
                        step = found
    steps[e] = step


@wp.kernel
def follow_kernel(
    start: wp.array[int], of_edge: wp.array[int], steps: wp.array[wp.vec3], moved: wp.array[wp.vec3]
) -> None:
    """Vertices go with that of their edges that has farthest to go."""
    v = wp.tid()
    step = wp.vec3()
    for k in range(start[v], start[v + 1]):
        found = steps[of_edge[k]]
        if wp.length_sq(found) > wp.length_sq(step):
            step = found
    moved[v] += step


@wp.kernel
def clearance_kernel(points: wp.array[wp.vec3], segments: Segments, clearance: wp.array2d[float]) -> None:
    """The signed distance of each vertex from each segment but its own [m]."""
    v, k = wp.tid()
    distance = float(0.0)
    if segments.own[v] != k:
        hit = wp.mesh_query_point_no_sign(segments.trees[k], points[v], 1.0e3)
        if hit.result:
            distance = distance_of(segments.trees[k], points[v], hit)
    clearance[v, k] = distance
