"""Parts the segments of a posed body: which vertices touch which segments, and the way to the surface between them."""

import warp as wp

from refu_core.body._bundle_kernels import Bundles, is_near
from refu_core.body._collider_kernels import (
    BENT_JOINTS,
    ENDS,
    FRONT,
    HOT,
    NEAR,
    TOUCHING,
    WANTED,
    Bones,
    Rings,
    Work,
    enlist,
    within,
)
from refu_core.body._pose_kernels import turned

wp.set_module_options({"enable_backward": False})

DEEPEST = wp.constant(0.1)
"""No vertex is deeper in another segment than this [m]: half of the trunk's thickness."""
# More than rounding can take from a distance [m].
ROUNDED = wp.constant(1e-5)
# A ray that isn't along any axis of a mesh.
_RAY = wp.constant(wp.vec3(0.5418, 0.6389, 0.5461))
# A closest point that has a smaller weight than this at a corner lies on the opposite edge.
_WITHIN = wp.constant(1e-4)


@wp.struct
class Segments:
    """The segments of `Solids` in one pose: K trees over the same points."""

    trees: wp.array[wp.uint64]
    own: wp.array[int]
    """The segment of each vertex."""
    faces: wp.array[wp.vec3i]
    first_face: wp.array[int]
    gap: wp.array2d[float]
    """The distance that vertex v keeps from segment k [m]."""
    ratio: wp.array2d[float]
    """How many times as soft segment k is as segment i."""
    path: wp.array2d[int]
    """The joints, as bits, by which segment i moves against segment k."""


@wp.struct
class Skins:
    """The vertices of bundles of segments, in pieces; every vertex is listed once."""

    start: wp.array[int]
    vertex: wp.array[int]
    bundle: wp.array[int]
    """The bundle of each piece."""
    of: wp.array[int]
    """The segment of each piece."""
    gap: wp.array2d[float]
    """The largest distance that any vertex of a piece keeps from segment k [m]."""


@wp.func
def find_near(i: int, work: Work, segments: Segments, bundles: Bundles, skins: Skins) -> None:
    """Lists the vertices of piece i that may be too near to a segment, judged by boxes."""
    found = int(0)
    low = bundles.low[skins.bundle[i]]
    high = bundles.high[skins.bundle[i]]
    for k in range(segments.trees.shape[0]):
        # If no joint between them is bent, segments are as far from each other as at rest.
        may = (segments.path[skins.of[i], k] & work.counts[BENT_JOINTS]) != 0 and skins.gap[i, k] > 0.0
        if may and is_near(low, high, k, skins.gap[i, k], bundles):
            found |= 1 << k
    if found == 0:
        return
    wanted = int(0)
    for c in range(skins.start[i], skins.start[i + 1]):
        v = skins.vertex[c]
        p = work.points[v]
        boxed = int(0)
        left = int(found)
        k = int(0)
        while left != 0:
            if left & 1 == 1 and segments.gap[v, k] > 0.0 and is_near(p, p, k, segments.gap[v, k], bundles):
                boxed |= 1 << k
            left = left >> 1
            k += 1
        if boxed != 0:
            wanted |= boxed
            work.boxed[v] = boxed
            work.near[wp.atomic_add(work.counts, NEAR, 1)] = v
    wp.atomic_or(work.counts, WANTED, wanted)


@wp.func
def distance_of(tree: wp.uint64, p: wp.vec3, hit: wp.MeshQueryPoint) -> float:
    """The signed distance [m] of p from the tree that has its closest point at `hit`.

    The sign is that of the face's normal where the closest point is within a face. Elsewhere it depends on how many
    faces a ray meets: at an edge of a cap the sign of a normal is wrong.
    """
    away = p - wp.mesh_eval_position(tree, hit.face, hit.u, hit.v)
    distance = wp.length(away)
    if wp.min(wp.min(hit.u, hit.v), 1.0 - hit.u - hit.v) > _WITHIN:
        return wp.where(wp.dot(away, wp.mesh_eval_face_normal(tree, hit.face)) < 0.0, -distance, distance)
    if wp.mesh_query_ray_count_intersections(tree, p, _RAY) % 2 == 1:
        return -distance
    return distance


@wp.func
def touch(v: int, work: Work, segments: Segments) -> None:
    """Finds the segments whose surface is nearer to a vertex than the gap, and which of them it is outside of."""
    p = work.points[v]
    mine = int(0)
    seen = int(0)
    boxed = work.boxed[v]
    k = int(0)
    while boxed != 0:
        if boxed & 1 == 1:
            hit = wp.mesh_query_point_no_sign(segments.trees[k], p, segments.gap[v, k])
            if hit.result:
                mine |= 1 << k
                if distance_of(segments.trees[k], p, hit) > 0.0:
                    seen |= 1 << k
        boxed = boxed >> 1
        k += 1
    if mine != 0:
        work.touched[v] = mine
        work.outside[v] = seen
        work.touching[wp.atomic_add(work.counts, TOUCHING, 1)] = v
        work.front[0, wp.atomic_add(work.counts, FRONT, 1)] = v


@wp.func
def deepen(v: int, rounds: int, work: Work, segments: Segments, rings: Rings) -> None:
    """Finds which neighbours of a vertex that is inside a segment are inside it, too: the surface may run between."""
    inside = work.touched[v] & ~work.outside[v]
    if inside == 0:
        return
    for r in range(rings.start[v], rings.start[v + 1]):
        w = rings.vertex[r]
        ahead = inside & ~(work.touched[w] | work.outside[w] | (1 << segments.own[w]))
        k = int(0)
        while ahead != 0:
            if ahead & 1 == 1 and segments.gap[w, k] > 0.0:
                if wp.mesh_query_ray_count_intersections(segments.trees[k], work.points[w], _RAY) % 2 == 1:
                    if wp.atomic_or(work.touched, w, 1 << k) == 0:
                        work.touching[wp.atomic_add(work.counts, TOUCHING, 1)] = w
                    if wp.atomic_exch(work.is_front, w, rounds + 1) != rounds + 1:
                        work.front[rounds + 1, wp.atomic_add(work.counts, FRONT + rounds + 1, 1)] = w
                else:
                    wp.atomic_or(work.outside, w, 1 << k)
            ahead = ahead >> 1
            k += 1


@wp.func
def normal_at(bones: Bones, v: int) -> wp.vec3:
    """The smoothed rest normal of vertex v, turned with the bones: a fold doesn't flip it."""
    return wp.normalize(turned(v, bones.start, bones.joint, bones.weight, bones.rotation, bones.normal))


@wp.func
def way_out(
    p: wp.vec3,
    normal: wp.vec3,
    sunk: float,
    k: int,
    ratio: float,
    keeps: float,
    farthest: float,
    segments: Segments,
    bones: Bones,
) -> tuple[wp.vec3, float]:
    """The step by which p gives way to segment k within `farthest` [m], and the distance of k's surface, at most that.

    `normal` is that of p's skin, and `sunk` how far p has already sunk below where it started [m].
    """
    hit = wp.mesh_query_point_no_sign(segments.trees[k], p, farthest)
    if not hit.result:
        return wp.vec3(), farthest
    distance = distance_of(segments.trees[k], p, hit)
    lacks = keeps - distance - ratio * sunk
    if lacks <= 0.0:
        return wp.vec3(), wp.abs(distance)
    corners = segments.faces[segments.first_face[k] + hit.face]
    other = wp.vec3()
    for c in range(3):
        if corners[c] < segments.own.shape[0]:  # not the middle of a cap
            weight = wp.where(c == 0, hit.u, wp.where(c == 1, hit.v, 1.0 - hit.u - hit.v))
            other += weight * normal_at(bones, corners[c])
    other = wp.normalize(other)
    way = wp.normalize(other - wp.max(wp.dot(other, normal), 0.0) * normal - normal)
    rate = wp.dot(way, other) - ratio * wp.dot(way, normal)
    return lacks / wp.clamp(rate, 0.5 + 0.5 * ratio, 1.0 + ratio) * way, wp.abs(distance)


@wp.func
def part(v: int, work: Work, segments: Segments, bones: Bones, rings: Rings, rounds: int) -> None:
    """Moves a vertex to its own side of the surface between its segment and another one, by Newton steps."""
    touched = work.touched[v]
    outside = work.outside[v]
    start = work.points[v]
    p = start
    own = segments.own[v]
    normal = normal_at(bones, v)
    reach = float(DEEPEST)  # no surface is farther, which keeps queries short
    for _ in range(rounds):
        step = wp.vec3()
        total = float(0.0)
        most = float(0.0)
        sunk = wp.dot(start - p, normal)
        for k in range(segments.trees.shape[0]):
            if (touched >> k) & 1 == 1:
                # `touch` finds vertices whose start is within the gap of the surface; only `deepen` finds deeper ones.
                is_at = (outside >> k) & 1 == 1 or work.is_front[v] == 0
                far = wp.where(is_at, wp.min(segments.gap[v, k] + wp.length(p - start), reach), reach)
                ratio = segments.ratio[own, k]
                found, away = way_out(p, normal, sunk, k, ratio, segments.gap[v, k], far, segments, bones)
                step += wp.length_sq(found) * found
                total += wp.length_sq(found)
                most = wp.max(most, away)
        if total > 0.0:
            step /= total
        p += step
        reach = wp.min(most + wp.length(step) + ROUNDED, DEEPEST)
        if total == 0.0:
            break
    work.parted[v] = p
    work.reach[v] = reach
    if wp.length_sq(p - start) > 0.0:
        p = within(p, work.skin[v], work.farthest[v])
        work.here[v] = p
        work.there[v] = p
        enlist(v, work, rings)
    for r in range(rings.start[v], rings.start[v + 1]):
        e = rings.edge[r]
        w = rings.vertex[r]
        if v < w or work.touched[w] == 0:  # each edge once
            work.hot[wp.atomic_add(work.counts, HOT, 1)] = e
            for c in range(2):
                end = rings.ends[e][c]
                if wp.atomic_exch(work.is_end, end, 1) == 0:
                    work.ends[wp.atomic_add(work.counts, ENDS, 1)] = end


@wp.func
def raise_edge(
    e: int,
    rounds: int,
    work: Work,
    moved: wp.array[wp.vec3],
    rings: Rings,
    segments: Segments,
    bones: Bones,
    steep: float,
) -> None:
    """Finds how a hot edge's midpoint gives way; it does where the ends' moves differ by more than `steep` [m]."""
    v = rings.ends[e][0]
    w = rings.ends[e][1]
    # If neither end moved in the last round, the edge gives way as before.
    if rounds > 0 and work.is_end[v] <= rounds and work.is_end[w] <= rounds:
        return
    step = wp.vec3()
    total = float(0.0)
    gone_v = work.points[v] - moved[v]
    gone_w = work.points[w] - moved[w]
    apart = wp.length(gone_v - gone_w)
    if apart > steep:
        either = work.touched[v] | work.touched[w]
        normal_v = normal_at(bones, v)
        normal_w = normal_at(bones, w)
        normal = wp.normalize(normal_v + normal_w)
        sunk = 0.5 * (wp.dot(gone_v, normal_v) + wp.dot(gone_w, normal_w))
        middle = 0.5 * (moved[v] + moved[w])
        for k in range(segments.trees.shape[0]):
            if (either >> k) & 1 == 1 and k != segments.own[v] and k != segments.own[w]:
                # The surface is at most as far as it was from an end, plus the way from there to the midpoint.
                far = float(DEEPEST)
                if (work.touched[v] >> k) & 1 == 1:
                    far = wp.min(far, work.reach[v] + wp.length(middle - work.parted[v]))
                if (work.touched[w] >> k) & 1 == 1:
                    far = wp.min(far, work.reach[w] + wp.length(middle - work.parted[w]))
                keeps = wp.min(segments.gap[v, k], segments.gap[w, k])
                ratio = segments.ratio[segments.own[v], k]
                found, _ = way_out(middle, normal, sunk, k, ratio, keeps, far, segments, bones)
                step += wp.length_sq(found) * found
                total += wp.length_sq(found)
    if total > 0.0:
        step *= wp.min(apart / steep - 1.0, 1.0) / total
    work.steps[e] = step


@wp.func
def follow(v: int, rounds: int, work: Work, moved: wp.array[wp.vec3], rings: Rings) -> None:
    """Moves a vertex with its edges, above all with those that have far to go."""
    step = wp.vec3()
    total = float(0.0)
    for r in range(rings.start[v], rings.start[v + 1]):
        if (work.touched[v] | work.touched[rings.vertex[r]]) != 0:
            found = work.steps[rings.edge[r]]
            step += wp.length_sq(found) * found
            total += wp.length_sq(found)
    if total > 0.0:
        moved[v] = within(moved[v] + step / total, work.skin[v], work.farthest[v])
        work.is_end[v] = rounds + 2


@wp.kernel
def closest_kernel(
    segments: Segments,
    points: wp.array[wp.vec3],
    which: wp.array[int],
    # outputs
    face: wp.array[int],
    corners: wp.array[wp.vec3],
    sign: wp.array[float],
) -> None:
    """Finds each point's closest face of segment `which`, the weights of its corners there, and the point's side."""
    i = wp.tid()
    k = which[i]
    hit = wp.mesh_query_point_no_sign(segments.trees[k], points[i], DEEPEST)
    face[i] = -1
    if hit.result:
        face[i] = segments.first_face[k] + hit.face
        corners[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
        sign[i] = wp.sign(distance_of(segments.trees[k], points[i], hit))


@wp.kernel
def thickness_kernel(
    body: wp.uint64,
    points: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    face: wp.array2d[int],
    own: wp.array[int],
    meets: wp.array2d[int],
    # outputs
    thickness: wp.array[float],
) -> None:
    """Finds how far it is from each vertex to the skin on the other side [m], that of a segment that `meets` its own.

    Where thighs touch at rest, the first skin that is met is the other thigh's.
    """
    v = wp.tid()
    start = float(1.0e-4)
    found = float(DEEPEST)
    while start < DEEPEST:
        hit = wp.mesh_query_ray(body, points[v] - start * normal[v], -normal[v], DEEPEST)
        if not hit.result:
            break
        if meets[own[v], own[face[hit.face, 0]]] == 1:
            found = (start - 1.0e-4) + hit.t
            break
        start += hit.t + 1.0e-4
    thickness[v] = wp.min(found, DEEPEST)


@wp.kernel
def clearance_kernel(most: float, points: wp.array[wp.vec3], segments: Segments, clearance: wp.array2d[float]) -> None:
    """Finds the signed distance of each vertex from each segment but its own, limited to `most` [m] either way."""
    v, k = wp.tid()
    p = points[v]
    distance = float(0.0)
    if segments.own[v] != k:
        hit = wp.mesh_query_point_no_sign(segments.trees[k], p, most)
        if hit.result:
            distance = distance_of(segments.trees[k], p, hit)
        else:  # then it is far outside or deep inside
            distance = wp.where(wp.mesh_query_ray_count_intersections(segments.trees[k], p, _RAY) % 2 == 1, -most, most)
    clearance[v, k] = distance


@wp.kernel
def nearest_kernel(
    tree: wp.uint64, points: wp.array[wp.vec3], face: wp.array[wp.int32], weight: wp.array[wp.vec3]
) -> None:
    """Finds the face closest to each point, and the barycentrics of the closest point at its vertices 0, 1, 2."""
    i = wp.tid()
    hit = wp.mesh_query_point_no_sign(tree, points[i], 1.0e3)
    face[i] = hit.face
    weight[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
