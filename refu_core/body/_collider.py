"""A posed body that doesn't run through itself: the repulsive force unit, applied to the body."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import (
    IN_ROW,
    Recorded,
    Repeated,
    Unpicklable,
    as_torch,
    as_warp,
    is_plain,
    refit,
    strips,
    torch_stream,
)
from refu_core.body import _collider_kernels as kernels
from refu_core.body import _step_kernels as steps
from refu_core.body._anatomy import Anatomy, ColliderSettings
from refu_core.body._collider_gradient import part_with_gradient
from refu_core.body._kinematics import RigidTransforms
from refu_core.body._model import SmplBody
from refu_core.skeleton import PARENTS

_DEFAULT = ColliderSettings()


class Collider(Unpicklable):
    """Gives way where a posed body runs through itself, as flesh does; the pose stays.

    1. *Arms* that are inside the body by more than half of their thickness move aside as a whole (`Aside`).
    2. *Creases.* Where a joint bends, skinning folds skin over itself. Skin is brought back to its own side of the
       nearby seams (`Creases`), along the normal of a plane that turns with the joint.
    3. *Segments.* Parts that overlap, or are nearer than the gap, each give way, according to their softness, until
       they are on their own side of the surface half way between them: ReFU with the distance of one part from the
       other. No two parts can then be at the same place.
    4. What was moved is levelled, and the skin next to it, so that no ridge is left beside a dent. Edges that cut
       corners are raised.

    The result depends on the pose alone, not on earlier frames, and changes continuously with it. Nothing moves where
    nothing is near: skin keeps no more distance than it has in the rest pose.

    Make one call at a time: memory is reused from call to call.
    """

    def __init__(self, body: SmplBody, *, settings: ColliderSettings = _DEFAULT) -> None:
        """For a body, on its device. Raises `MeshError` unless it is a closed, consistently oriented surface."""
        self.settings, self.anatomy = settings, Anatomy(body, settings)
        self.device = body.device
        self._is_serial = body.device.type == "cpu"
        most = _HELD * settings.aside_farthest, as_warp((_HELD * self.anatomy.farthest).float(), wp.float32)
        self._shift = Repeated(kernels.shift_kernel, (wp.vec3, wp.vec3, wp.vec3, wp.int32, wp.float32), most)

    def __call__(self, skin: Tensor, transforms: RigidTransforms) -> Tensor:
        """The bodies `skin` [m], shape (B, V, 3), pulled apart, in the same axes.

        `transforms` are those that they were posed with, leading shape (B, 24).
        """
        return self.apart(*self.aside(skin, transforms.rotation))

    def aside(self, skin: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor]:
        """The first step: bodies `skin` [m], shape (B, V, 3), and joints' `rotation` (B, 24, 3, 3), arms moved aside.

        Differentiable.
        """
        given = [*zip(skin, rotation, strict=True)]
        found = [self.anatomy.aside(*one) for one in given]
        if all(new[0] is old[0] for new, old in zip(found, given, strict=True)):
            return skin, rotation
        skins, turns = zip(*found, strict=True)
        return torch.stack(skins), torch.stack(turns)

    def apart(self, skin: Tensor, rotation: Tensor) -> Tensor:
        """All other steps, on what `aside` returns; the bodies pulled apart [m], shape (B, V, 3)."""
        if not is_plain(skin, rotation):
            apart = [part_with_gradient(self, one, turn) for one, turn in zip(skin, rotation, strict=True)]
            return torch.stack(apart) if apart else torch.zeros_like(skin)
        parted = torch.empty_like(skin)
        for result, one, turn in zip(parted, skin, rotation, strict=True):
            result.copy_(self._part(one, turn))
        return parted

    @torch.no_grad()
    def _part(self, skin: Tensor, rotation: Tensor) -> Tensor:
        """Pulls one body apart; the result may be in memory that the next call overwrites."""
        work = self.anatomy.memory
        work.rotation.copy_(rotation)
        work.ints.zero_()
        with torch_stream(self.device):
            self._run("between")
            if self._is_serial and not work.read_counts[kernels.BENT_JOINTS]:
                return skin
            work.take(skin)
            self._run("unfold")
            self._touch()
            self._run("part")
        return self._parted

    def _touch(self) -> None:
        """Finds which segments each vertex has to give way to."""
        self._run("look")
        wanted = int(self.anatomy.memory.read_counts[kernels.WANTED]) if self._is_serial else -1
        refit([tree for k, tree in enumerate(self.anatomy.trees) if (wanted >> k) & 1], self.device)
        if wanted:
            self._run("touch")

    def _run(self, name: str) -> None:
        for command in self._commands[name]:
            command.launch()

    @property
    def _parted(self) -> Tensor:
        """The buffer that holds the result of the last sweeps."""
        work = self.anatomy.memory
        return work.here if self.settings.smooth_last % 2 == 0 else work.there

    @cached_property
    def _commands(self) -> dict[str, list[Any]]:
        """Recorded launches, by step."""
        how, known = self.settings, self.anatomy
        work, bones, segments, rings = known.work, known.bones, known.segments, known.rings
        levelling = [how.smooth_full, how.smooth_step]
        unfold = [work, bones, known.seams, known.stations, rings, how.crease_rounds, how.smooth_first, *levelling]
        part = [work, segments, bones, rings, as_warp(self._parted, wp.vec3), how.part_rounds, how.smooth_last]
        part += [*levelling, how.edge_rounds, how.steep]
        kernel_of = {
            "unfold": (steps.unfold_kernel, 4 + how.smooth_first, unfold),
            "look": (steps.look_kernel, 4, [work, known.caps, segments, known.bundles, known.skins]),
            "touch": (steps.touch_kernel, 1 + how.deepen_rounds, [work, segments, rings, how.deepen_rounds]),
            "part": (steps.part_kernel, 2 + how.smooth_last + 2 * how.edge_rounds, part),
        }
        commands = {"between": [Recorded(kernels.between_kernel, len(PARENTS), [work, bones], self.device)]}
        n = len(work.skin)
        for name, (kernel, n_steps, inputs) in kernel_of.items():
            if self._is_serial:
                commands[name] = [Recorded(kernel, 1, [-1, 1, *inputs], self.device)]
            else:
                commands[name] = [Recorded(kernel, n, [step, n, *inputs], self.device) for step in range(n_steps)]
        return commands

    @torch.no_grad()
    def shift(self, skin: Tensor, aside: Tensor, apart: Tensor) -> Tensor:
        """How far bodies moved from `skin` to `aside` to `apart`, each (B, V, 3) [m], as figures of shape (B, 4).

        How many vertices moved; how far at most and on average [m]; and how many moved as far as they may in one of
        the two steps: there two parts may still overlap, because flesh doesn't give way that far.
        """
        numbers = skin.new_zeros(len(skin), 4, dtype=torch.float32)
        n_strips, each = strips(skin.shape[1], self.device, at_least=IN_ROW)
        bodies = (one.float().contiguous() for one in (skin, aside, apart))
        self._shift((len(skin), n_strips), *bodies, each, numbers)
        return numbers

    @torch.no_grad()
    def touched(self, skin: Tensor) -> Tensor:
        """Which segments each vertex of `skin` (V, 3) [m] has to give way to, bool, shape (V, K)."""
        self.anatomy.memory.ints.zero_()
        self.anatomy.memory.take(skin)
        self.anatomy.memory.counts[kernels.BENT_JOINTS] = -1  # any joint may be bent
        with torch_stream(self.device):
            self._touch()
        bits: Tensor = as_torch(self.anatomy.work.touched)
        return (bits[:, None] >> torch.arange(len(self.anatomy.trees), device=bits.device)) & 1 == 1


_HELD = 0.99
"""Share of the farthest way that counts as all of it: levelling and edges come later, and move skin a little."""
