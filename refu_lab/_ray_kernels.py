"""Ray casting kernels of the renderer: how much light reaches a point, and what a pixel sees."""

import warp as wp

from refu_core import _warp  # noqa: F401  (quiets Warp before it starts)

GOLDEN_ANGLE = wp.constant(2.399963)


@wp.func
def cone_direction(axis: wp.vec3, spread: float, k: int, count: int) -> wp.vec3:
    """The k-th of `count` directions spread evenly over the cap 1 - cos(angle) <= `spread` around `axis`."""
    z = 1.0 - spread * (float(k) + 0.5) / float(count)
    r = wp.sqrt(wp.max(1.0 - z * z, 0.0))
    angle = GOLDEN_ANGLE * float(k)
    side = wp.vec3(0.0, 0.0, 1.0)
    if wp.abs(axis[2]) > 0.7:
        side = wp.vec3(1.0, 0.0, 0.0)
    u = wp.normalize(wp.cross(side, axis))
    v = wp.cross(axis, u)
    return u * (r * wp.cos(angle)) + v * (r * wp.sin(angle)) + axis * z


@wp.kernel
def light_kernel(
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    to_sun: wp.vec3,
    sun_spread: float,
    sun_rays: int,
    sky_rays: int,
    reach: float,
    sun: wp.array[float],
    sky: wp.array[float],
) -> None:
    """Shares of the sun's disc and (cosine-weighted) of the half space around the normal that a point sees."""
    i = wp.tid()
    n = normals[i]
    start = points[i] + n * 1.5e-3
    seen = float(0.0)
    if wp.dot(n, to_sun) > -0.2:
        for k in range(sun_rays):
            if not wp.mesh_query_ray_anyhit(mesh, start, cone_direction(to_sun, sun_spread, k, sun_rays), 1e3, -1):
                seen += 1.0 / float(sun_rays)
    sun[i] = seen
    total = float(0.0)
    unseen = float(0.0)
    for k in range(sky_rays):
        # The same directions for every point: neighbours agree, so there is no grain.
        d = cone_direction(wp.vec3(0.0, 1.0, 0.0), 2.0, k, sky_rays)
        weight = wp.dot(n, d)
        if weight > 0.0:
            total += weight
            query = wp.mesh_query_ray(mesh, start, d, reach)
            if query.result:
                # Far surfaces hide less of the sky than near ones.
                unseen += weight * (1.0 - query.t / reach)
    sky[i] = 1.0 - unseen / wp.max(total, 1e-6)


@wp.func
def vertex_mean(values: wp.array[float], faces: wp.array[int], face: int, bary: wp.vec3) -> float:
    """A vertex attribute interpolated within a face."""
    a = values[faces[3 * face]] * bary[0]
    return a + values[faces[3 * face + 1]] * bary[1] + values[faces[3 * face + 2]] * bary[2]


@wp.func
def grid_mean(values: wp.array2d[float], x: float, z: float, low: wp.vec2, step: float) -> float:
    """A value of the ground's grid, interpolated bilinearly; 1 (in full light) outside."""
    u = (x - low[0]) / step
    v = (z - low[1]) / step
    i = int(wp.floor(u))
    j = int(wp.floor(v))
    if i < 0 or j < 0 or i + 1 >= values.shape[0] or j + 1 >= values.shape[1]:
        return 1.0
    s = u - float(i)
    t = v - float(j)
    near = values[i, j] * (1.0 - s) + values[i + 1, j] * s
    far = values[i, j + 1] * (1.0 - s) + values[i + 1, j + 1] * s
    return near * (1.0 - t) + far * t


@wp.kernel
def pixel_kernel(
    mesh: wp.uint64,
    faces: wp.array[int],
    colours: wp.array[wp.vec3],
    corner_normals: wp.array[wp.vec3],
    sun: wp.array[float],
    sky: wp.array[float],
    ground_sun: wp.array2d[float],
    ground_sky: wp.array2d[float],
    ground_low: wp.vec2,
    ground_step: float,
    ground_y: float,
    ground_centre: wp.vec2,
    ground_radius: float,
    ground_colour: wp.vec3,
    background: wp.vec3,
    to_sun: wp.vec3,
    sun_strength: float,
    sky_strength: float,
    eye: wp.vec3,
    right: wp.vec3,
    up: wp.vec3,
    forward: wp.vec3,
    half_height: float,
    width: int,
    height: int,
    per_side: int,
    image: wp.array2d[wp.vec3],
) -> None:
    """One pixel: the mean of per_side² evenly spaced rays, in linear light."""
    row, column = wp.tid()
    mean = wp.vec3(0.0, 0.0, 0.0)
    for k in range(per_side * per_side):
        sub_x = (float(k % per_side) + 0.5) / float(per_side)
        sub_y = (float(k // per_side) + 0.5) / float(per_side)
        x = (2.0 * (float(column) + sub_x) / float(width) - 1.0) * half_height * float(width) / float(height)
        y = (1.0 - 2.0 * (float(row) + sub_y) / float(height)) * half_height
        ray = wp.normalize(forward + right * x + up * y)
        colour = background
        query = wp.mesh_query_ray(mesh, eye, ray, 1e6)
        if query.result:
            face = query.face
            bary = wp.vec3(query.u, query.v, 1.0 - query.u - query.v)
            n = corner_normals[3 * face] * bary[0]
            n += corner_normals[3 * face + 1] * bary[1]
            n = wp.normalize(n + corner_normals[3 * face + 2] * bary[2])
            albedo = colours[faces[3 * face]] * bary[0]
            albedo += colours[faces[3 * face + 1]] * bary[1]
            albedo += colours[faces[3 * face + 2]] * bary[2]
            direct = vertex_mean(sun, faces, face, bary)
            ambient = vertex_mean(sky, faces, face, bary)
            if wp.dot(query.normal, ray) > 0.0:
                # The inside of cloth is lit by the little light that gets in or through.
                n = -n
                direct = 0.0
                ambient = 0.35
            lambert = wp.max(wp.dot(n, to_sun), 0.0) * direct
            dome = wp.vec3(0.56, 0.58, 0.62) * (0.62 + 0.38 * n[1]) * (ambient * sky_strength)
            # Cloth and skin look a little paler at grazing angles.
            rim = wp.pow(1.0 - wp.clamp(-wp.dot(n, ray), 0.0, 1.0), 4.0) * 0.16 * ambient
            light = wp.vec3(1.02, 0.97, 0.90) * (sun_strength * lambert) + dome
            colour = wp.cw_mul(albedo, light) + wp.vec3(rim, rim, rim)
        elif ray[1] < -1e-6 and eye[1] > ground_y and ground_radius > 0.0:
            t = (ground_y - eye[1]) / ray[1]
            gx = eye[0] + t * ray[0]
            gz = eye[2] + t * ray[2]
            distance = wp.length(wp.vec2(gx, gz) - ground_centre)
            if distance < ground_radius:
                direct = grid_mean(ground_sun, gx, gz, ground_low, ground_step)
                ambient = grid_mean(ground_sky, gx, gz, ground_low, ground_step)
                lit = 0.42 * direct + 0.58 * ambient
                fade = wp.smoothstep(0.25, 1.0, distance / ground_radius)
                colour = ground_colour * (lit * (1.0 - fade)) + background * fade
        mean += colour / float(per_side * per_side)
    image[row, column] = mean
