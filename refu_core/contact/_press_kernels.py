"""What presses cloth to the skin that it lies on, vertex by vertex: one code for CPU and CUDA."""

import warp as wp

PRESSED = wp.constant(0)  # place of the count


@wp.struct
class Limb:
    """One limb of a body, and the garment's vertices that don't lie on it."""

    mesh: wp.uint64
    foreign: wp.array[wp.int32]
    """Numbers of these vertices, shape (R,)."""


@wp.kernel(enable_backward=False)
def press_kernel(
    limb: Limb,
    skin: wp.array[wp.vec3],
    points: wp.array[wp.vec3],
    clearance: float,
    # output
    push: wp.array[wp.vec3],
    count: wp.array[int],
) -> None:
    """Where a limb comes between a vertex and the skin that it lies on, or nearly, the vertex stays on this side."""
    i = limb.foreign[wp.tid()]
    way = points[i] - skin[i]
    height = wp.length(way)
    if height < clearance:
        return
    up = way / height
    hit = wp.mesh_query_ray(limb.mesh, skin[i], up, height + clearance)
    if not hit.result or wp.dot(hit.normal, up) >= 0.0:
        return  # nothing there, or the skin itself is within the limb
    room = wp.max(hit.t - clearance, 0.5 * hit.t)
    down = height - room
    if down > wp.length(push[i]):
        push[i] = -down * up
        wp.atomic_add(count, PRESSED, 1)


@wp.kernel(enable_backward=False)
def spread_press_kernel(
    rows: wp.array[int],
    ring_start: wp.array[int],
    ring: wp.array[int],
    push: wp.array[wp.vec3],
    step: float,
    field: wp.array[wp.vec3],
    # output
    smoother: wp.array[wp.vec3],
) -> None:
    """A step towards the mean of the neighbours, but no less than a vertex is pressed."""
    i = rows[wp.tid()]
    first = ring_start[i]
    last = ring_start[i + 1]
    mean = wp.vec3()
    for k in range(first, last):
        mean += field[ring[k]]
    here = field[i] + step * (mean / float(wp.max(last - first, 1)) - field[i])
    least = wp.length(push[i])
    if least > 0.0:
        heading = push[i] / least
        here += wp.max(least - wp.dot(here, heading), 0.0) * heading
    smoother[i] = here
