"""How the pushes of one garment off another spread over it, and move it: one code for CPU and CUDA."""

import warp as wp

from refu_core.contact._layers_kernels import Cut

wp.set_module_options({"enable_backward": False})


@wp.func
def spread(
    i: int,
    push: wp.array[wp.vec3],
    cut: Cut,
    field: wp.array[wp.vec3],
    # output
    smoother: wp.array[wp.vec3],
) -> None:
    """One round of `Blend.spread`."""
    start = cut.ring_start[i]
    end = cut.ring_start[i + 1]
    total = wp.vec3(0.0, 0.0, 0.0)
    for r in range(start, end):
        total += field[cut.ring[r]]
    mean = total / float(wp.max(end - start, 1))
    length = wp.length(push[i])
    if length > 0.0:
        way = push[i] / length
        mean += wp.max(0.0, length - wp.dot(mean, way)) * way
    smoother[i] = mean


@wp.kernel
def spread_kernel(
    push: wp.array[wp.vec3],
    cut: Cut,
    field: wp.array[wp.vec3],
    # output
    smoother: wp.array[wp.vec3],
) -> None:
    """`spread` of one vertex a thread."""
    spread(wp.tid(), push, cut, field, smoother)


@wp.kernel
def move_kernel(
    field: wp.array[wp.vec3],
    # outputs
    points: wp.array[wp.vec3],
    moved: wp.array[int],
) -> None:
    """Moves the vertices, and says which have `moved`."""
    i = wp.tid()
    points[i] += field[i]
    moved[i] = wp.where(wp.length_sq(field[i]) > 0.0, 1, 0)


@wp.kernel
def move_all_kernel(
    push: wp.array[wp.vec3],
    cut: Cut,
    rounds: int,
    # memory, zero between launches
    is_reached: wp.array[int],
    reached: wp.array[int],
    field: wp.array[wp.vec3],
    smoother: wp.array[wp.vec3],
    # outputs
    points: wp.array[wp.vec3],
    moved: wp.array[int],
) -> None:
    """All rounds, and the move, by one thread: of the pushed, and of those that so many rounds reach from there.

    Those have `moved`.
    """
    n = int(0)
    for i in range(push.shape[0]):
        if wp.length_sq(push[i]) > 0.0:
            field[i] = push[i]
            is_reached[i] = 1
            reached[n] = i
            n += 1
    first = int(0)
    for _ in range(rounds):
        last = int(n)
        for k in range(first, last):
            for r in range(cut.ring_start[reached[k]], cut.ring_start[reached[k] + 1]):
                j = cut.ring[r]
                if is_reached[j] == 0:
                    is_reached[j] = 1
                    reached[n] = j
                    n += 1
        first = last
    for sweep in range(rounds):
        for k in range(n):
            if sweep % 2 == 0:
                spread(reached[k], push, cut, field, smoother)
            else:
                spread(reached[k], push, cut, smoother, field)
    for k in range(n):
        i = reached[k]
        points[i] += field[i]
        moved[i] = 1
        is_reached[i] = 0
        field[i] = wp.vec3()
        smoother[i] = wp.vec3()
