"""Finds which places are inside the body, or inside an arm."""

import warp as wp

from refu_core.body._bundle_kernels import greater, lesser
from refu_core.body._collider_kernels import Means, find_mean

wp.set_module_options({"enable_backward": False})


@wp.kernel
def near_kernel(
    skin: wp.array[wp.vec3],
    n_skin: int,
    arm: wp.array[int],
    means: Means,
    segment_start: wp.array[int],
    corner: wp.array[int],
    solid: wp.array[int],
    # outputs
    low_of_all: wp.array[wp.vec3],
    high_of_all: wp.array[wp.vec3],
    count: wp.array[int],
) -> None:
    """Counts, for each solid, how often a middle is in the box of one of its segments; for a single thread of a CPU.

    Segment k belongs to `solid[k]`, 0 for the body, or else 1 + an arm. The vertices of its faces are
    `corner[segment_start[k]:segment_start[k + 1]]`. The first means are middles, each of an `arm`, which doesn't count
    for itself. The other means close the solids: they are appended to the skin.
    """
    for c in range(means.mean.shape[0]):
        find_mean(c, skin, means)
        if c >= arm.shape[0]:
            skin[n_skin + c - arm.shape[0]] = means.mean[c]
    for s in range(count.shape[0]):
        count[s] = 0
        low_of_all[s] = wp.vec3(1.0e9)
        high_of_all[s] = wp.vec3(-1.0e9)
    for k in range(segment_start.shape[0] - 1):
        s = solid[k]
        low = skin[corner[segment_start[k]]]
        high = low
        for i in range(segment_start[k] + 1, segment_start[k + 1]):
            at = skin[corner[i]]
            low = lesser(low, at)
            high = greater(high, at)
        low_of_all[s] = lesser(low_of_all[s], low)
        high_of_all[s] = greater(high_of_all[s], high)
        for c in range(arm.shape[0]):
            at = means.mean[c]
            if arm[c] + 1 != s and low == lesser(low, at) and high == greater(high, at):
                count[s] += 1


@wp.kernel
def inside_kernel(
    trees: wp.array[wp.uint64],
    first_face: wp.array[int],
    low: wp.array[wp.vec3],
    high: wp.array[wp.vec3],
    solid: wp.array[int],
    points: wp.array[wp.vec3],
    # outputs
    face: wp.array[int],
    corners: wp.array[wp.vec3],
) -> None:
    """Finds the closest face of a `solid` to each point inside of it, -1 for one outside, and its corners' weights.

    `low` and `high` are the solids' boxes; the faces of each are counted from `first_face`.
    """
    i = wp.tid()
    s = solid[i]
    p = points[i]
    face[i] = -1
    for c in range(3):
        if p[c] < low[s][c] or p[c] > high[s][c]:
            return
    # A ray that points away from the middle of the box leaves it soonest, and meets few boxes of the tree.
    side = wp.vec3(wp.where(p[0] < 0.5 * (low[s][0] + high[s][0]), -0.9418, 0.9418), 0.2389, 0.2361)
    if wp.mesh_query_ray_count_intersections(trees[s], p, side) % 2 == 1:
        hit = wp.mesh_query_point_no_sign(trees[s], p, 1.0e3)
        face[i] = first_face[s] + hit.face
        corners[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
