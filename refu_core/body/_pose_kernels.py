"""Kernels that pose a body when no derivative is needed: a few launches replace two hundred small tensor operations."""

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

wp.set_module_options({"enable_backward": False})


@wp.func
def rodrigues(r: wp.vec3) -> wp.mat33:
    """The rotation matrix of a rotation vector, with the same series near zero as `rotvec_to_rotmat`."""
    angle2 = wp.dot(r, r)
    a = float(1.0) - angle2 / 6.0 + angle2 * angle2 / 120.0
    b = float(0.5) - angle2 / 24.0 + angle2 * angle2 / 720.0
    if angle2 >= 1.0e-4:
        angle = wp.sqrt(angle2)
        half = wp.sin(0.5 * angle)
        a = wp.sin(angle) / angle
        b = 2.0 * half * half / angle2
    sine = a * r
    return wp.matrix_from_rows(
        wp.vec3(1.0 + b * (r[0] * r[0] - angle2), b * r[0] * r[1] - sine[2], b * r[0] * r[2] + sine[1]),
        wp.vec3(b * r[1] * r[0] + sine[2], 1.0 + b * (r[1] * r[1] - angle2), b * r[1] * r[2] - sine[0]),
        wp.vec3(b * r[2] * r[0] - sine[1], b * r[2] * r[1] + sine[0], 1.0 + b * (r[2] * r[2] - angle2)),
    )


@wp.func
def up_seen(root: wp.vec3) -> wp.vec3:
    """World up in the axes of a root with this rotation vector, on the grid of `up_in`."""
    up = rodrigues(root)[1] / UP_STEP
    return UP_STEP * wp.vec3(wp.rint(up[0]), wp.rint(up[1]), wp.rint(up[2]))


UP_STEP = wp.constant(2.0**-14)


@wp.kernel
def rotation_kernel(rotvec: wp.array[wp.vec3], rotation: wp.array[wp.mat33]) -> None:
    """`rodrigues` for each vector."""
    i = wp.tid()
    rotation[i] = rodrigues(rotvec[i])


@wp.kernel
def chain_kernel(
    in_root: wp.bool,
    pose: wp.array2d[wp.vec3],
    joints: wp.array2d[wp.vec3],
    parents: wp.array[int],
    # outputs
    local: wp.array2d[wp.mat33],
    rotation: wp.array2d[wp.mat33],
    translation: wp.array2d[wp.vec3],
    posed: wp.array2d[wp.vec3],
) -> None:
    """Poses the joints of each body, parents first; `joints` of a single shape are used for all bodies."""
    b = wp.tid()
    shape = wp.min(b, joints.shape[0] - 1)
    for j in range(parents.shape[0]):
        parent = parents[j]
        here = joints[shape, j]
        turn = rodrigues(pose[b, j])
        local[b, j] = turn
        place = here
        if parent >= 0:
            turn = rotation[b, parent] @ turn
            place = posed[b, parent] + rotation[b, parent] @ (here - joints[shape, parent])
        elif in_root:
            turn = wp.identity(n=3, dtype=float)
        rotation[b, j] = turn
        posed[b, j] = place
        translation[b, j] = place - turn @ here


@wp.func
def turned(
    v: int,
    start: wp.array[int],
    joint: wp.array[int],
    weight: wp.array[float],
    rotation: wp.array[wp.mat33],
    normal: wp.array[wp.vec3],
) -> wp.vec3:
    """The rest normal of vertex v, rotated as skinning rotates the vertex (`JointWeights`)."""
    way = wp.vec3()
    for k in range(start[v], start[v + 1]):
        way += weight[k] * (rotation[joint[k]] @ normal[v])
    return way


@wp.kernel
def skin_kernel(
    points: wp.array2d[wp.vec3],
    start: wp.array[int],
    joint: wp.array[int],
    weight: wp.array[float],
    rotation: wp.array2d[wp.mat33],
    translation: wp.array2d[wp.vec3],
    each: wp.array[int],
    # output
    posed: wp.array2d[wp.vec3],
) -> None:
    """Moves point v by the joints in rows `start[v]` to `start[v + 1]`.

    Points of a single shape are used for all bodies. A thread moves `each` points of one body.
    """
    b, strip = wp.tid()
    shape = wp.min(b, points.shape[0] - 1)
    for v in range(strip * each[0], wp.min((strip + 1) * each[0], posed.shape[1])):
        turn = wp.mat33()
        shift = wp.vec3()
        k = int(start[v])
        last = start[v + 1]
        while k < last:  # takes half the instructions of Warp's range
            turn += weight[k] * rotation[b, joint[k]]
            shift += weight[k] * translation[b, joint[k]]
            k += 1
        posed[b, v] = turn @ points[shape, v] + shift
