"""A posed body that doesn't run through itself: the repulsive force unit, applied to the body."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import as_warp, is_plain, torch_stream
from refu_core.body import _collider_kernels as kernels
from refu_core.body import _part_kernels as parting
from refu_core.body._anatomy import DEFAULT_GAP, Anatomy, ColliderSettings
from refu_core.body._collider_gradient import Closest, part_with_gradient
from refu_core.body._kinematics import PARENTS, RigidTransforms
from refu_core.body._model import SmplBody


class Collider:
    """Gives way where a posed body runs through itself, as flesh does; pose and joints stay.

    1. *Creases.* Where a joint bends, skinning folds skin over itself. Skin is brought back to its own side of the
       seams near by (`Creases`), along the normal of a plane that turns with the joint.
    2. *Segments.* Parts that are in each other, or nearer than the gap, each give way until they are on their own side
       of the surface half way between them, by the softness of each: ReFU with the distance of one part from the other.
       Of no pair of parts can both then be at the same place.
    3. Dents are levelled, and edges that cut their corners raised.

    The result depends on the pose alone, not on the frames before, and continuously. Nothing moves where nothing is
    near: skin keeps its distance only as far as it has one in the rest pose.

    One call at a time: memory is kept from call to call.
    """

    def __init__(self, body: SmplBody, *, gap: float = DEFAULT_GAP, settings: ColliderSettings | None = None) -> None:
        """Prepares for a body, on its device, in about a second.

        Raises `MeshError` for a body that isn't a closed, consistently oriented surface.
        """
        self.settings = ColliderSettings(gap=gap) if settings is None else settings
        self.anatomy = Anatomy(body, self.settings)
        self.device = body.device
        self._is_serial = body.device.type == "cpu"
        self._commands = self._record()

    @property
    def gap(self) -> float:
        """Room that is left between two parts [m]."""
        return self.settings.gap

    def __call__(self, skin: Tensor, transforms: RigidTransforms) -> Tensor:
        """The bodies `skin` [m], shape (B, V, 3), pulled apart, in the same axes.

        `transforms` are those that they were posed with, leading shape (B, 24).
        """
        rotation = transforms.rotation
        part = self._part if is_plain(skin, rotation) else partial(part_with_gradient, self)
        if not len(skin):
            return torch.zeros_like(skin)
        return torch.stack([part(one, turn) for one, turn in zip(skin, rotation, strict=True)])

    @torch.no_grad()
    def _part(self, skin: Tensor, rotation: Tensor) -> Tensor:
        how, work, run = self.settings, self.anatomy.tensors, self._run
        work.skin.copy_(skin)
        work.here.copy_(skin)
        work.there.copy_(skin)
        work.rotation.copy_(rotation)
        work.ints.zero_()
        with torch_stream(self.device):
            run("between")
            run("stations")
            run("crease")
            at = self._smooth(work.here, work.there, how.smooth_first)
            self._touch(at)
            work.here.copy_(at)
            work.there.copy_(at)
            run("part", kernels.NEAR)
            at = self._smooth(work.here, work.there, how.smooth_last)
            which = "here" if at is work.here else "there"
            for _ in range(how.edge_rounds):
                run(f"edge {which}", kernels.HOT)
                run(f"follow {which}", kernels.ENDS)
        return at.clone()

    def _touch(self, at: Tensor) -> None:
        """Which segments each vertex has to give way to, for the points (V, 3) [m]."""
        work, run = self.anatomy.tensors, self._run
        work.points[: len(at)] = at
        run("caps")
        work.low.fill_(torch.inf)
        work.high.fill_(-torch.inf)
        run("box")
        run("meet")
        run("near")
        wanted = int(work.counts[kernels.WANTED]) if self._is_serial else -1
        for k, tree in enumerate(self.anatomy.trees):
            if (wanted >> k) & 1:
                tree.refit()
        run("touch", kernels.NEAR)
        for _ in range(self.settings.deepen_rounds):
            work.counts[kernels.FOUND : kernels.FOUND + 1].zero_()
            run("deepen", kernels.NEAR)
            if self._is_serial and not work.counts[kernels.FOUND]:
                break

    def _smooth(self, source: Tensor, target: Tensor, sweeps: int) -> Tensor:
        self._run("share", kernels.MOVED)
        for i in range(sweeps):
            self._run("smooth" if i % 2 == 0 else "smooth back", kernels.MOVED)
            source, target = target, source
        return source

    def _run(self, name: str, which: int | None = None) -> None:
        """Launches a step: on a CPU for as many as its list has, on a GPU for as many as it could have."""
        command = self._commands[name]
        if which is not None and self._is_serial:
            n = int(self.anatomy.tensors.counts[which])
            if n == 0:
                return
            command.set_dim(n)
        command.launch()

    def _record(self) -> dict[str, Any]:
        how, known = self.settings, self.anatomy
        work, bones, segments, rings = known.work, known.bones, known.segments, known.rings
        n, n_edges = len(work.skin), len(work.steps)
        commands = {}

        def record(name: str, kernel: Any, most: int, inputs: list[Any]) -> None:
            commands[name] = wp.launch(kernel, most, inputs, device=str(self.device), record_cmd=True)

        record(
            "between", kernels.between_kernel, len(PARENTS), [bones.rotation, *known.chain, bones.between, bones.bent]
        )
        record("stations", kernels.mean_kernel, len(known.stations[-1]), [work.skin, *known.stations])
        inputs = [work, known.held, known.stations[-1], bones, known.seams, how.crease_rounds]
        record("crease", kernels.crease_kernel, len(known.held), inputs)
        record("share", kernels.share_kernel, n, [work, how.smooth_full, how.smooth_step])
        record("smooth", kernels.smooth_kernel, n, [work, rings, work.here, work.there])
        record("smooth back", kernels.smooth_kernel, n, [work, rings, work.there, work.here])
        record("caps", kernels.mean_kernel, len(known.caps[-1]), [work.points, *known.caps])
        record("box", parting.box_kernel, len(segments.member), [work.points, segments])
        record("meet", parting.meet_kernel, len(known.trees), [segments, how.gap, work.meets])
        record("near", parting.near_kernel, n, [work, segments])
        record("touch", parting.touch_kernel, n, [work, segments])
        record("deepen", parting.deepen_kernel, n, [work, segments, rings])
        record("part", parting.part_kernel, n, [work, segments, bones, rings, how.part_rounds])
        for which, moved in (("here", work.here), ("there", work.there)):
            record(f"edge {which}", parting.edge_kernel, n_edges, [work, moved, rings, segments, bones, how.steep])
            record(f"follow {which}", parting.follow_kernel, n, [work, moved, rings])
        return commands

    @torch.no_grad()
    def touched(self, skin: Tensor) -> Tensor:
        """Which segments each vertex of `skin` (V, 3) [m] has to give way to, bool, shape (V, K)."""
        self.anatomy.tensors.ints.zero_()
        with torch_stream(self.device):
            self._touch(skin.float())
        bits: Tensor = wp.to_torch(self.anatomy.work.touched)
        return (bits[:, None] >> torch.arange(len(self.anatomy.trees), device=bits.device)) & 1 == 1

    @torch.no_grad()
    def closest(self, points: Tensor, segment: Tensor) -> Closest:
        """What points (N, 3) [m] are closest to of a segment each (N,), in the pose that `touched` was asked for."""
        n = len(points)
        face = torch.zeros(n, dtype=torch.int32, device=self.device)
        weights, sign = torch.zeros(n, 3, device=self.device), torch.zeros(n, device=self.device)
        inputs = [
            as_warp(points.float().contiguous(), wp.vec3),
            as_warp(segment.int(), wp.int32),
            self.anatomy.segments,
        ]
        outputs = [as_warp(face, wp.int32), as_warp(weights, wp.vec3), as_warp(sign, wp.float32)]
        if n:
            with torch_stream(self.device):
                wp.launch(parting.closest_kernel, n, inputs, outputs, device=str(self.device))
        return Closest(face.long(), weights, sign)

    def with_caps(self, skin: Tensor) -> Tensor:
        """`skin` (V, 3) [m] and the middles of the caps after it. Differentiable."""
        start, vertex, weight, _ = (wp.to_torch(one) for one in self.anatomy.caps)
        of_middle = torch.repeat_interleave(torch.arange(len(start) - 1, device=skin.device), start.long().diff())
        middles = skin.new_zeros(len(start) - 1, 3)
        return torch.cat((skin, middles.index_add(0, of_middle, skin[vertex.long()] * weight.to(skin)[:, None])))
