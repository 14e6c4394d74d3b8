"""What the scale's network reads, where no derivative is needed: a launch replaces twenty small tensor operations."""

import math

import warp as wp

from refu_core.body import up_seen

wp.set_module_options({"enable_backward": False})

_PI = wp.constant(math.pi)


@wp.kernel
def scale_inputs_kernel(
    pose: wp.array2d[wp.vec3],
    betas: wp.array2d[float],
    style: wp.array2d[float],
    # output
    inputs: wp.array2d[float],
) -> None:
    """`scale_inputs` of each person; a `style` of one row is everybody's."""
    b = wp.tid()
    at = int(betas.shape[1])
    for k in range(at):
        inputs[b, k] = betas[b, k]
    for j in range(1, pose.shape[1]):
        r = pose[b, j]
        angle = wp.length(r)
        if angle > _PI:
            r = r * (wp.mod(angle + _PI, 2.0 * _PI) - _PI) / angle
        for k in range(3):
            inputs[b, at + k] = r[k]
        at += 3
    up = up_seen(pose[b, 0])
    for k in range(3):
        inputs[b, at + k] = up[k]
    for k in range(style.shape[1]):
        inputs[b, at + 3 + k] = style[wp.min(b, style.shape[0] - 1), k]
