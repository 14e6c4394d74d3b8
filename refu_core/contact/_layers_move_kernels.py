"""How the pushes of one garment off another spread over it, and move it: one code for CPU and CUDA."""

import warp as wp


@wp.func
def spread(
    k: int,
    push: wp.array[wp.vec3],
    ring_start: wp.array[int],
    ring: wp.array[int],
    field: wp.array[wp.vec3],
    # output
    smoother: wp.array[wp.vec3],
) -> None:
    """One round of `Blend.spread`."""
    start = ring_start[k]
    end = ring_start[k + 1]
    total = wp.vec3(0.0, 0.0, 0.0)
    for r in range(start, end):
        total += field[ring[r]]
    mean = total / float(wp.max(end - start, 1))
    if k < push.shape[0]:
        length = wp.length(push[k])
        if length > 0.0:
            way = push[k] / length
            mean += wp.max(0.0, length - wp.dot(mean, way)) * way
    smoother[k] = mean


@wp.kernel(enable_backward=False)
def spread_kernel(
    push: wp.array[wp.vec3],
    ring_start: wp.array[int],
    ring: wp.array[int],
    field: wp.array[wp.vec3],
    # output
    smoother: wp.array[wp.vec3],
) -> None:
    """`spread` of one of the region a thread."""
    spread(wp.tid(), push, ring_start, ring, field, smoother)


@wp.kernel(enable_backward=False)
def move_kernel(
    rows: wp.array[int],
    field: wp.array[wp.vec3],
    # outputs
    points: wp.array[wp.vec3],
    moved: wp.array[int],
) -> None:
    """Moves the vertices of the region, and says which have `moved`."""
    k = wp.tid()
    points[rows[k]] += field[k]
    moved[k] = wp.where(wp.length_sq(field[k]) > 0.0, 1, 0)


@wp.kernel(enable_backward=False)
def move_all_kernel(
    push: wp.array[wp.vec3],
    ring_start: wp.array[int],
    ring: wp.array[int],
    rows: wp.array[int],
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
    for k in range(push.shape[0]):
        if wp.length_sq(push[k]) > 0.0:
            field[k] = push[k]
            is_reached[k] = 1
            reached[n] = k
            n += 1
    first = int(0)
    for _ in range(rounds):
        last = int(n)
        for i in range(first, last):
            for r in range(ring_start[reached[i]], ring_start[reached[i] + 1]):
                j = ring[r]
                if j < rows.shape[0] and is_reached[j] == 0:
                    is_reached[j] = 1
                    reached[n] = j
                    n += 1
        first = last
    for sweep in range(rounds):
        for i in range(n):
            if sweep % 2 == 0:
                spread(reached[i], push, ring_start, ring, field, smoother)
            else:
                spread(reached[i], push, ring_start, ring, smoother, field)
    for i in range(n):
        k = reached[i]
        points[rows[k]] += field[k]
        moved[k] = 1
        is_reached[k] = 0
        field[k] = wp.vec3()
        smoother[k] = wp.vec3()
