# mypy: ignore-errors
# ruff: noqa: RUF046, UP018  (to Warp, int(0) is a variable and 0 a constant)
# (Warp reads a kernel's annotations as array types of its own; a type checker can't.)
"""The spreading of pushes over a garment, for one CPU core: only where pushes can reach, and in one pass a round."""

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

wp.set_module_options({"enable_backward": False})


@wp.kernel
def spread_kernel(
    push: wp.array(dtype=wp.vec3),
    neighbours: wp.array(dtype=wp.int64),
    start: wp.array(dtype=wp.int64),
    share: wp.array(dtype=float),
    rounds: int,
    # room
    reached: wp.array(dtype=int),
    is_reached: wp.array(dtype=int),
    mean: wp.array(dtype=wp.vec3),
    # output
    field: wp.array(dtype=wp.vec3),
):
    """`Blend.spread` of one garment; what no push reaches stays zero and isn't looked at."""
    n = push.shape[0]
    tail = int(0)
    for v in range(n):
        field[v] = push[v]
        is_reached[v] = 0
        if wp.dot(push[v], push[v]) > 0.0:
            is_reached[v] = 1
            reached[tail] = v
            tail += 1
    ring = int(0)  # where in `reached` those begin that the last round added
    for _round in range(rounds):
        end = tail
        for k in range(ring, end):
            v = reached[k]
            last = neighbours.shape[0]
            if v + 1 < n:
                last = int(start[v + 1])
            for m in range(int(start[v]), last):
                other = int(neighbours[m])
                if is_reached[other] == 0:
                    is_reached[other] = 1
                    reached[tail] = other
                    tail += 1
        ring = end
        for k in range(tail):
            v = reached[k]
            last = neighbours.shape[0]
            if v + 1 < n:
                last = int(start[v + 1])
            total = wp.vec3()
            for m in range(int(start[v]), last):
                total += field[int(neighbours[m])]
            total *= share[v]
            # nᵀd ≥ p for the push p n: what is missing of it is added along n, without a root taken.
            wanted = wp.dot(push[v], push[v])
            got = wp.dot(total, push[v])
            if got < wanted:
                total += (1.0 - got / wanted) * push[v]
            mean[v] = total
        for k in range(tail):
            v = reached[k]
            field[v] = mean[v]
