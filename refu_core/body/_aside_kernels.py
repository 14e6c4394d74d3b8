"""Finds which places are inside the body, or too near to it."""

import warp as wp

from refu_core.body._bundle_kernels import greater, lesser
from refu_core.body._collider_kernels import Means, find_mean

wp.set_module_options({"enable_backward": False})


@wp.kernel
def near_kernel(
    skin: wp.array[wp.vec3],
    n_skin: int,
    n_middles: int,
    means: Means,
    clear: wp.array[float],
    segment_start: wp.array[int],
    corner: wp.array[int],
    # outputs
    low_of_all: wp.array[wp.vec3],
    high_of_all: wp.array[wp.vec3],
    count: wp.array[int],
) -> None:
    """Counts how often one of the first `n_middles` means is in, or within `clear` of, the box of a segment.

    For a single thread of a CPU.

    The vertices of segment k's faces are `corner[segment_start[k]:segment_start[k + 1]]`. The other means close the
    body: they are appended to its skin.
    """
    for c in range(means.mean.shape[0]):
        find_mean(c, skin, means)
        if c >= n_middles:
            skin[n_skin + c - n_middles] = means.mean[c]
    near = int(0)
    low_of_all[0] = wp.vec3(1.0e9)
    high_of_all[0] = wp.vec3(-1.0e9)
    for k in range(segment_start.shape[0] - 1):
        low = skin[corner[segment_start[k]]]
        high = low
        for i in range(segment_start[k] + 1, segment_start[k + 1]):
            at = skin[corner[i]]
            low = lesser(low, at)
            high = greater(high, at)
        low_of_all[0] = lesser(low_of_all[0], low)
        high_of_all[0] = greater(high_of_all[0], high)
        for c in range(n_middles):
            at = means.mean[c]
            by = wp.vec3(clear[c])
            if low == lesser(low, at + by) and high == greater(high, at - by):
                near += 1
    count[0] = near


@wp.kernel
def near_surface_kernel(
    tree: wp.uint64,
    low: wp.array[wp.vec3],
    high: wp.array[wp.vec3],
    clear: wp.array[float],
    points: wp.array[wp.vec3],
    # outputs
    face: wp.array[int],
    corners: wp.array[wp.vec3],
    side: wp.array[float],
) -> None:
    """Finds the mesh's closest face to each point inside of it or within `clear`, and the weights of its corners.

    The face is -1 for other points. The side is -1 for points inside, and 1. `low` and `high` are the mesh's box.
    """
    i = wp.tid()
    p = points[i]
    face[i] = -1
    side[i] = 1.0
    for c in range(3):
        if p[c] < low[0][c] - clear[i] or p[c] > high[0][c] + clear[i]:
            return
    # A ray that points away from the middle of the box leaves it soonest, and meets few boxes of the tree.
    ray = wp.vec3(wp.where(p[0] < 0.5 * (low[0][0] + high[0][0]), -0.9418, 0.9418), 0.2389, 0.2361)
    reach = clear[i]
    if wp.mesh_query_ray_count_intersections(tree, p, ray) % 2 == 1:
        reach = 1.0e3
        side[i] = -1.0
    hit = wp.mesh_query_point_no_sign(tree, p, reach)
    if hit.result:
        face[i] = hit.face
        corners[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
