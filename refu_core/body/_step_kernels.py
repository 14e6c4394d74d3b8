"""Pulls a posed body apart, in four kernels of a few steps each.

On a CPU, where a launch costs as much as hundreds of vertices, one thread takes all steps (`only` is -1). On a GPU each
launch takes one step, number `only`, and each of its `stride` threads takes every `stride`-th item.
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
    hold,
    level,
    look_around,
    settle,
)
from refu_core.body._part_kernels import Segments, Skins, deepen, find_near, follow, part, raise_edge, touch

wp.set_module_options({"enable_backward": False})


@wp.func
def is_due(step: int, only: int) -> bool:
    return only < 0 or only == step


@wp.func
def smooth(
    before: int, only: int, first: int, stride: int, work: Work, rings: Rings, sweeps: int, full: float, share: float
) -> None:
    """Sweeps over what was moved, in 1 + `sweeps` steps; the result is in `here` or, if `sweeps` is odd, in `there`.

    `before` is the number of the kernel's steps that come first.
    """
    if is_due(before, only):
        for i in range(first, work.counts[MOVED], stride):
            look_around(work.moved[i], work, rings)
    for sweep in range(sweeps):
        if is_due(before + 1 + sweep, only):
            for i in range(first, work.counts[MOVED], stride):
                if sweep % 2 == 0:
                    level(work.moved[i], full, share, work, rings, work.here, work.there)
                else:
                    level(work.moved[i], full, share, work, rings, work.there, work.here)


@wp.kernel
def unfold_kernel(
    only: int,
    stride: int,
    work: Work,
    bones: Bones,
    seams: Seams,
    stations: Means,
    rings: Rings,
    rounds: int,
    sweeps: int,
    full: float,
    share: float,
) -> None:
    """Brings skin to its own side of the nearby seams, in 4 + `sweeps` steps."""
    first = wp.tid()
    if is_due(0, only):
        for i in range(first, stations.mean.shape[0], stride):
            find_mean(i, work.skin, stations)
    if is_due(1, only):
        for i in range(first, seams.vertex.shape[0], stride):
            hold(i, work, stations.mean, bones, seams, rings, rounds)
    smooth(2, only, first, stride, work, rings, sweeps, full, share)
    if is_due(3 + sweeps, only):
        for i in range(first, work.counts[MOVED], stride):
            settle(work.moved[i], sweeps, work)


@wp.kernel
def look_kernel(
    only: int, stride: int, work: Work, caps: Means, segments: Segments, bundles: Bundles, skins: Skins
) -> None:
    """Finds which vertices may be near which segments, in 4 steps."""
    first = wp.tid()
    if is_due(0, only):
        for i in range(first, caps.mean.shape[0], stride):
            find_mean(i, work.points, caps)
    if is_due(1, only):
        for i in range(first, bundles.low.shape[0], stride):
            bound(i, work.points, bundles)
    if is_due(2, only):
        for k in range(first, segments.trees.shape[0], stride):
            enclose(k, bundles)
    if is_due(3, only):
        for i in range(first, skins.bundle.shape[0], stride):
            find_near(i, work, segments, bundles, skins)


@wp.kernel
def touch_kernel(only: int, stride: int, work: Work, segments: Segments, rings: Rings, rounds: int) -> None:
    """Finds which segments the `near` vertices have to give way to, in 1 + `rounds` steps."""
    first = wp.tid()
    if is_due(0, only):
        for i in range(first, work.counts[NEAR], stride):
            touch(work.near[i], work, segments)
    for r in range(rounds):
        if is_due(1 + r, only):
            for i in range(first, work.counts[FRONT + r], stride):
                deepen(work.front[r, i], r, work, segments, rings)


@wp.kernel
def part_kernel(
    only: int,
    stride: int,
    work: Work,
    segments: Segments,
    bones: Bones,
    rings: Rings,
    moved: wp.array[wp.vec3],
    rounds: int,
    sweeps: int,
    full: float,
    share: float,
    edge_rounds: int,
    steep: float,
) -> None:
    """Makes vertices give way, levels all that moved and raises edges, in 2 + `sweeps` + 2 `edge_rounds` steps."""
    first = wp.tid()
    if is_due(0, only):
        for i in range(first, work.counts[TOUCHING], stride):
            part(work.touching[i], work, segments, bones, rings, rounds)
    smooth(1, only, first, stride, work, rings, sweeps, full, share)
    for r in range(edge_rounds):
        if is_due(2 + sweeps + 2 * r, only):
            for i in range(first, work.counts[HOT], stride):
                raise_edge(work.hot[i], r, work, moved, rings, segments, bones, steep)
        if is_due(3 + sweeps + 2 * r, only):
            for i in range(first, work.counts[ENDS], stride):
                follow(work.ends[i], r, work, moved, rings)
