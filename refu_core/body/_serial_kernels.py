"""What pulls a posed body apart on a CPU, where a launch costs what hundreds of vertices do: all steps in four.

`_launch_kernels` has those of a GPU.
"""

import warp as wp

from refu_core.body._bundle_kernels import Bundles, bound, enclose
from refu_core.body._collider_kernels import (
    ENDS,
    FRONT,
    HOT,
    MOVED,
    NEAR,
    TOUCHING,
    Bones,
    Means,
    Rings,
    Seams,
    Work,
    find_mean,
    find_share,
    hold,
    level,
    settle,
)
from refu_core.body._part_kernels import (
    Segments,
    Skins,
    deepen,
    find_near,
    follow,
    part,
    raise_edge,
    touch,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def smooth(work: Work, rings: Rings, sweeps: int, full: float, step: float) -> None:
    """Sweeps over what was moved; they end in `here` or, if they are odd, in `there`."""
    for i in range(work.counts[MOVED]):
        find_share(work.moved[i], work, full, step)
    for sweep in range(sweeps):
        for i in range(work.counts[MOVED]):
            if sweep % 2 == 0:
                level(work.moved[i], work, rings, work.here, work.there)
            else:
                level(work.moved[i], work, rings, work.there, work.here)


@wp.kernel
def unfold_kernel(
    work: Work,
    bones: Bones,
    seams: Seams,
    stations: Means,
    rings: Rings,
    rounds: int,
    sweeps: int,
    full: float,
    step: float,
) -> None:
    """Skin is brought to its own side of the seams near by."""
    for i in range(stations.mean.shape[0]):
        find_mean(i, work.skin, stations)
    for i in range(seams.vertex.shape[0]):
        hold(i, work, stations.mean, bones, seams, rounds)
    smooth(work, rings, sweeps, full, step)
    for i in range(work.counts[MOVED]):
        settle(work.moved[i], sweeps, work)


@wp.kernel
def look_kernel(work: Work, caps: Means, segments: Segments, bundles: Bundles, skins: Skins) -> None:
    """Which vertices may be near which segments."""
    for i in range(caps.mean.shape[0]):
        find_mean(i, work.points, caps)
    for i in range(bundles.low.shape[0]):
        bound(i, work.points, bundles)
    for k in range(segments.trees.shape[0]):
        enclose(k, bundles)
    for i in range(bundles.low.shape[0]):
        find_near(i, work, segments, bundles, skins)


@wp.kernel
def touch_kernel(work: Work, segments: Segments, rings: Rings, rounds: int) -> None:
    """Which segments they have to give way to."""
    for i in range(work.counts[NEAR]):
        touch(work.near[i], work, segments)
    for r in range(rounds):
        for i in range(work.counts[FRONT + r]):
            deepen(work.front[r, i], r, work, segments, rings)


@wp.kernel
def part_kernel(
    work: Work,
    segments: Segments,
    bones: Bones,
    rings: Rings,
    moved: wp.array[wp.vec3],
    rounds: int,
    sweeps: int,
    full: float,
    step: float,
    edge_rounds: int,
    steep: float,
) -> None:
    """They give way; what was moved is levelled, and edges are raised."""
    for i in range(work.counts[TOUCHING]):
        part(work.touching[i], work, segments, bones, rings, rounds)
    smooth(work, rings, sweeps, full, step)
    for rounds in range(edge_rounds):
        for i in range(work.counts[HOT]):
            raise_edge(work.hot[i], rounds, work, moved, rings, segments, bones, steep)
        for i in range(work.counts[ENDS]):
            follow(work.ends[i], rounds, work, moved, rings)
