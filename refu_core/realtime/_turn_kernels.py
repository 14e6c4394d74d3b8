"""Turns points about a person's root, when no derivative is needed: in half the time of a product of matrices."""

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def turn_kernel(
    rotation: wp.array[wp.mat33],
    root: wp.array[wp.vec3],
    points: wp.array[wp.vec3],
    each: wp.array[int],
    # output
    turned: wp.array[wp.vec3],
) -> None:
    """Turns `each` points per thread; the root stays in its place."""
    strip = wp.tid()
    turn = rotation[0]
    shift = root[0] - turn @ root[0]
    for i in range(strip * each[0], wp.min((strip + 1) * each[0], points.shape[0])):
        turned[i] = turn @ points[i] + shift
