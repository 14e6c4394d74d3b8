"""What networks see of a pose, where no derivative is needed: a launch replaces fifteen small tensor operations."""

import warp as wp

from refu_core.body import rodrigues, up_seen

wp.set_module_options({"enable_backward": False})


@wp.func
def told(up: wp.vec3, most_tilt: float) -> wp.vec3:
    """`told_up`, tilted so far that its y is `most_tilt` at least."""
    if up[1] >= most_tilt:
        return up
    sine2 = 1.0 - most_tilt * most_tilt
    level = wp.sqrt(sine2 / wp.max(up[0] * up[0] + up[2] * up[2], sine2))
    return wp.vec3(up[0] * level, wp.max(wp.abs(up[1]), most_tilt), up[2] * level)


@wp.kernel
def features_kernel(
    most_tilt: float,
    joint: wp.array[int],
    pose: wp.array2d[wp.vec3],
    # output
    features: wp.array2d[float],
) -> None:
    """`PoseFeatures` of the encoding `matrix`; the root is the first `joint`."""
    b, j = wp.tid()
    rotvec = pose[b, joint[j]]
    if j == 0:
        up = told(up_seen(rotvec), most_tilt)
        for k in range(3):
            features[b, k] = up[k]
        return
    rotation = rodrigues(rotvec) - wp.identity(n=3, dtype=float)
    for row in range(3):
        for column in range(3):
            features[b, 9 * j - 6 + 3 * row + column] = rotation[row, column]
