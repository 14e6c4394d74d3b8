"""Launches of a GPU for what a CPU does in four (`_serial_kernels`); a CPU needn't compile them."""

import warp as wp

from refu_core.body._bundle_kernels import Bundles
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


@wp.kernel
def hold_kernel(work: Work, bones: Bones, seams: Seams, stations: Means, rounds: int) -> None:
    hold(wp.tid(), work, stations.mean, bones, seams, rounds)


@wp.kernel
def share_kernel(work: Work, full: float, step: float) -> None:
    i = wp.tid()
    if i < work.counts[MOVED]:
        find_share(work.moved[i], work, full, step)


@wp.kernel
def level_kernel(work: Work, rings: Rings, source: wp.array[wp.vec3], target: wp.array[wp.vec3]) -> None:
    i = wp.tid()
    if i < work.counts[MOVED]:
        level(work.moved[i], work, rings, source, target)


@wp.kernel
def settle_kernel(work: Work, sweeps: int) -> None:
    i = wp.tid()
    if i < work.counts[MOVED]:
        settle(work.moved[i], sweeps, work)


@wp.kernel
def near_kernel(work: Work, segments: Segments, bundles: Bundles, skins: Skins) -> None:
    find_near(wp.tid(), work, segments, bundles, skins)


@wp.kernel
def touch_kernel(work: Work, segments: Segments) -> None:
    i = wp.tid()
    if i < work.counts[NEAR]:
        touch(work.near[i], work, segments)


@wp.kernel
def deepen_kernel(work: Work, segments: Segments, rings: Rings, rounds: int) -> None:
    i = wp.tid()
    if i < work.counts[FRONT + rounds]:
        deepen(work.front[rounds, i], rounds, work, segments, rings)


@wp.kernel
def part_kernel(work: Work, segments: Segments, bones: Bones, rings: Rings, rounds: int) -> None:
    i = wp.tid()
    if i < work.counts[TOUCHING]:
        part(work.touching[i], work, segments, bones, rings, rounds)


@wp.kernel
def edge_kernel(
    rounds: int,
    work: Work,
    moved: wp.array[wp.vec3],
    rings: Rings,
    segments: Segments,
    bones: Bones,
    steep: float,
) -> None:
    i = wp.tid()
    if i < work.counts[HOT]:
        raise_edge(work.hot[i], rounds, work, moved, rings, segments, bones, steep)


@wp.kernel
def follow_kernel(rounds: int, work: Work, moved: wp.array[wp.vec3], rings: Rings) -> None:
    i = wp.tid()
    if i < work.counts[ENDS]:
        follow(work.ends[i], rounds, work, moved, rings)
