"""How the pushes of one garment off another spread over it, and move it: one code for CPU and CUDA."""

import warp as wp

from refu_core.contact._layers_kernels import Above

wp.set_module_options({"enable_backward": False})


@wp.func
def spread(i: int, above: Above, field: wp.array[wp.vec3], smoother: wp.array[wp.vec3]) -> None:
    """One round of `Blend.spread`."""
    start = above.cut.ring_start[i]
    end = above.cut.ring_start[i + 1]
    total = wp.vec3(0.0, 0.0, 0.0)
    for r in range(start, end):
        total += field[above.cut.ring[r]]
    mean = total / float(wp.max(end - start, 1))
    length = wp.length(above.push[i])
    if length > 0.0:
        way = above.push[i] / length
        mean += wp.max(0.0, length - wp.dot(mean, way)) * way
    smoother[i] = mean


@wp.kernel
def spread_kernel(above: Above, field: wp.array[wp.vec3], smoother: wp.array[wp.vec3]) -> None:
    """`spread` of one vertex a thread."""
    spread(wp.tid(), above, field, smoother)


@wp.kernel
def move_kernel(above: Above) -> None:
    """Moves the vertices."""
    i = wp.tid()
    above.points[i] += above.field[i]
    above.moved[i] = wp.where(wp.length_sq(above.field[i]) > 0.0, 1, 0)


@wp.kernel
def move_all_kernel(above: Above, rounds: int) -> None:
    """All rounds, and the move, by one thread: of the pushed, and of those that so many rounds reach from there."""
    n = int(0)
    for i in range(above.push.shape[0]):
        if wp.length_sq(above.push[i]) > 0.0:
            above.field[i] = above.push[i]
            above.is_reached[i] = 1
            above.reached[n] = i
            n += 1
    first = int(0)
    for _ in range(rounds):
        last = int(n)
        for k in range(first, last):
            for r in range(above.cut.ring_start[above.reached[k]], above.cut.ring_start[above.reached[k] + 1]):
                j = above.cut.ring[r]
                if above.is_reached[j] == 0:
                    above.is_reached[j] = 1
                    above.reached[n] = j
                    n += 1
        first = last
    for sweep in range(rounds):
        for k in range(n):
            if sweep % 2 == 0:
                spread(above.reached[k], above, above.field, above.smoother)
            else:
                spread(above.reached[k], above, above.smoother, above.field)
    for k in range(n):
        i = above.reached[k]
        above.points[i] += above.field[i]
        above.moved[i] = 1
        above.is_reached[i] = 0
        above.field[i] = wp.vec3()
        above.smoother[i] = wp.vec3()
