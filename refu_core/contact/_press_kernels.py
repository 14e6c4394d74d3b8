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
    room: wp.array[float],
    count: wp.array[int],
) -> None:
    """How far from the skin that it lies on a vertex may be: where a limb comes in between, on this side of it."""
    i = limb.foreign[wp.tid()]
    way = points[i] - skin[i]
    height = wp.length(way)
    if height < clearance:
        return
    up = way / height
    hit = wp.mesh_query_ray(limb.mesh, skin[i], up, height + clearance)
    if not hit.result or wp.dot(hit.normal, up) >= 0.0:
        return  # nothing there, or the skin itself is within the limb
    left = wp.max(hit.t - clearance, 0.5 * hit.t)
    if left < height:
        wp.atomic_add(count, PRESSED, 1)
        room[i] = wp.min(room[i], left)


@wp.kernel(enable_backward=False)
def spread_room_kernel(
    rows: wp.array[int],
    ring_start: wp.array[int],
    ring: wp.array[int],
    points: wp.array[wp.vec3],
    slope: float,
    room: wp.array[float],
    # output
    spread: wp.array[float],
) -> None:
    """A vertex has no more room than a neighbour of it, and what `slope` gives for the way from there."""
    i = rows[wp.tid()]
    least = room[i]
    for k in range(ring_start[i], ring_start[i + 1]):
        j = ring[k]
        least = wp.min(least, room[j] + slope * wp.length(points[i] - points[j]))
    spread[i] = least


@wp.kernel(enable_backward=False)
def lower_kernel(
    rows: wp.array[int],
    skin: wp.array[wp.vec3],
    room: wp.array[float],
    # output
    points: wp.array[wp.vec3],
) -> None:
    """Draws vertices back to the room that they have, towards the skin."""
    i = rows[wp.tid()]
    way = points[i] - skin[i]
    height = wp.length(way)
    if height > room[i]:
        points[i] = skin[i] + (room[i] / height) * way
