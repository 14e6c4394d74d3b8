# mypy: ignore-errors
# (Warp reads a kernel's annotations as array types of its own; a type checker can't.)
"""What is summed over a garment's mesh in every frame."""

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def add_normals_kernel(
    points: wp.array(dtype=wp.vec3),
    faces: wp.array2d(dtype=wp.int64),
    # output
    summed: wp.array(dtype=wp.vec3),
):
    """Adds the normal of each face, twice its area long, to its vertices."""
    f = wp.tid()
    a = int(faces[f, 0])
    b = int(faces[f, 1])
    c = int(faces[f, 2])
    normal = wp.cross(points[b] - points[a], points[c] - points[a])
    wp.atomic_add(summed, a, normal)
    wp.atomic_add(summed, b, normal)
    wp.atomic_add(summed, c, normal)
