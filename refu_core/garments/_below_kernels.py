"""How far skin takes a garment along, when no derivative is needed: the same code for CPU and CUDA."""

from typing import TYPE_CHECKING

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

wp.set_module_options({"enable_backward": False})

N_BELOW = 8
"""Number of body vertices that a garment vertex lies on."""

if TYPE_CHECKING:
    Vertices = wp.Vector[int]
    Weights = wp.Vector[float]
else:
    Vertices = wp.types.vector(length=N_BELOW, dtype=wp.int32)
    Weights = wp.types.vector(length=N_BELOW, dtype=wp.float32)


@wp.kernel
def follow_kernel(
    vertex: wp.array[Vertices],
    weight: wp.array[Weights],
    skin: wp.array2d[wp.vec3],
    each: wp.array[int],
    # output
    cloth: wp.array2d[wp.vec3],
) -> None:
    """Averages the vectors of the body vertices that a garment vertex lies on, `each` garment vertices per thread."""
    b, strip = wp.tid()
    for i in range(strip * each[0], wp.min((strip + 1) * each[0], vertex.shape[0])):
        vertices = vertex[i]
        weights = weight[i]
        total = wp.vec3()
        for k in range(wp.static(N_BELOW)):
            total += weights[k] * skin[b, vertices[k]]
        cloth[b, i] = total
