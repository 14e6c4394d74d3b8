"""The distance of vertices that were moved: one code for CPU and CUDA."""

import warp as wp

from refu_core.sdf import Skin, query_skin


@wp.kernel(enable_backward=False)
def ask_moved_kernel(
    skin: Skin,
    reach: float,
    before: wp.array[wp.vec3],
    points: wp.array[wp.vec3],
    # in and out
    distance: wp.array[float],
    gradient: wp.array[wp.vec3],
    face: wp.array[int],
) -> None:
    """Signed distance, its gradient and the closest face of those that aren't where they were `before`."""
    i = wp.tid()
    here = points[i]
    way = wp.length(here - before[i])
    if way > 0.0:
        # No vertex gets nearer by more than it moves: what stays beyond the reach needn't be asked.
        if distance[i] - way >= reach:
            distance[i] -= way
        else:
            there, up, closest = query_skin(skin, here, face[i])
            distance[i] = there
            gradient[i] = up
            face[i] = closest
