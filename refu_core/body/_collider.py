"""A posed body that doesn't run through itself: the repulsive force unit, applied to the body."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch import Tensor

from refu_core._warp import as_warp, is_plain, torch_stream
from refu_core.body import _bundle_kernels as bundling
from refu_core.body import _collider_kernels as kernels
from refu_core.body import _launch_kernels as launches
from refu_core.body import _part_kernels as parting
from refu_core.body import _serial_kernels as serial
from refu_core.body._anatomy import DEFAULT_GAP, Anatomy, ColliderSettings
from refu_core.body._closest import Closest
from refu_core.body._collider_gradient import part_with_gradient
from refu_core.body._kinematics import PARENTS, RigidTransforms
from refu_core.body._model import SmplBody


class Collider:
    """Gives way where a posed body runs through itself, as flesh does; the pose stays.

    1. *Arms* that are inside the body by more than half of their thickness go aside as a whole (`Aside`).
    2. *Creases.* Where a joint bends, skinning folds skin over itself. Skin is brought back to its own side of the
       seams near by (`Creases`), along the normal of a plane that turns with the joint.
    3. *Segments.* Parts that are in each other, or nearer than the gap, each give way until they are on their own side
       of the surface half way between them, by the softness of each: ReFU with the distance of one part from the other.
       Of no pair of parts can both then be at the same place.
    4. Dents are levelled, and edges that cut their corners raised.

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
        self._commands: dict[str, Any] = {}

    @property
    def gap(self) -> float:
        """Room that is left between two parts [m]."""
        return self.settings.gap

    def __call__(self, skin: Tensor, transforms: RigidTransforms) -> Tensor:
        """The bodies `skin` [m], shape (B, V, 3), pulled apart, in the same axes.

        `transforms` are those that they were posed with, leading shape (B, 24).
        """
        return self.apart(*self.aside(skin, transforms.rotation))

    def aside(self, skin: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor]:
        """The first step: bodies `skin` [m], shape (B, V, 3), and their joints' `rotation` (B, 24, 3, 3) with arms
        aside. Differentiable."""
        if not len(skin):
            return skin, rotation
        found = [self.anatomy.aside(one, turn) for one, turn in zip(skin, rotation, strict=True)]
        skins, turns = zip(*found, strict=True)
        return torch.stack(skins), torch.stack(turns)

    def apart(self, skin: Tensor, rotation: Tensor) -> Tensor:
        """All other steps: bodies with arms `aside`, their joints' `rotation` and the result as there."""
        if not is_plain(skin, rotation):
            apart = [part_with_gradient(self, one, turn) for one, turn in zip(skin, rotation, strict=True)]
            return torch.stack(apart) if apart else torch.zeros_like(skin)
        parted = torch.empty_like(skin)
        for result, one, turn in zip(parted, skin, rotation, strict=True):
            result.copy_(self._part(one, turn))
        return parted

    @torch.no_grad()
    def _part(self, skin: Tensor, rotation: Tensor) -> Tensor:
        """One body, in memory that the next one overwrites."""
        how, work, run = self.settings, self.anatomy.tensors, self._run
        work.rotation.copy_(rotation)
        work.ints.zero_()
        with torch_stream(self.device):
            run("between")
            if self._is_serial and not work.counts[kernels.BENT_JOINTS]:
                return skin
            work.take(skin)
            if self._is_serial:
                run("unfold")
            else:
                for name in ("stations", "hold"):
                    run(name)
                self._smooth(how.smooth_first)
                run("settle")
            self._touch()
            if self._is_serial:
                run("part all")
            else:
                run("part")
                self._smooth(how.smooth_last)
                for r in range(how.edge_rounds):
                    run(f"edge {r}")
                    run(f"follow {r}")
        return self._levelled(how.smooth_last)

    def _touch(self) -> None:
        """Which segments each vertex has to give way to."""
        if self._is_serial:
            self._run("look")
            wanted = int(self.anatomy.tensors.counts[kernels.WANTED])
        else:
            for name in ("caps", "bound", "enclose", "near"):
                self._run(name)
            wanted = -1
        for k, tree in enumerate(self.anatomy.trees):
            if (wanted >> k) & 1:
                tree.refit()
        if self._is_serial:
            if wanted:
                self._run("touch all")
            return
        self._run("touch")
        for r in range(self.settings.deepen_rounds):
            self._run(f"deepen {r}")

    def _smooth(self, sweeps: int) -> None:
        self._run("share")
        for i in range(sweeps):
            self._run("level" if i % 2 == 0 else "level back")

    def _levelled(self, sweeps: int) -> Tensor:
        """Where so many sweeps end."""
        work = self.anatomy.tensors
        at: Tensor = work.here if sweeps % 2 == 0 else work.there
        return at

    def _run(self, name: str) -> None:
        if name not in self._commands:
            self._commands |= self._of_cpu() if self._is_serial else self._of_gpu()
        self._commands[name].launch()

    def _of_cpu(self) -> dict[str, Any]:
        how, known = self.settings, self.anatomy
        work, bones, segments, rings, bundles = known.work, known.bones, known.segments, known.rings, known.bundles
        levelling = [how.smooth_full, how.smooth_step]
        moved = as_warp(self._levelled(how.smooth_last), wp.vec3)
        inputs = {
            "between": [work, bones],
            "unfold": [
                work,
                bones,
                known.seams,
                known.stations,
                rings,
                how.crease_rounds,
                how.smooth_first,
                *levelling,
            ],
            "look": [work, known.caps, segments, bundles, known.skins],
            "touch all": [work, segments, rings, how.deepen_rounds],
            "part all": [
                *(work, segments, bones, rings, moved),
                *(how.part_rounds, how.smooth_last, *levelling, how.edge_rounds, how.steep),
            ],
        }
        of_step = {
            "between": kernels.between_kernel,
            "unfold": serial.unfold_kernel,
            "look": serial.look_kernel,
            "touch all": serial.touch_kernel,
            "part all": serial.part_kernel,
        }
        return {
            name: self._recorded(of_step[name], len(PARENTS) if name == "between" else 1, given)
            for name, given in inputs.items()
        }

    def _of_gpu(self) -> dict[str, Any]:
        how, known = self.settings, self.anatomy
        work, bones, segments, rings, bundles = known.work, known.bones, known.segments, known.rings, known.bundles
        n, n_bundles = len(work.skin), len(bundles.low)
        moved = as_warp(self._levelled(how.smooth_last), wp.vec3)
        steps: dict[str, tuple[Any, int, list[Any]]] = {
            "between": (kernels.between_kernel, len(PARENTS), [work, bones]),
            "stations": (kernels.mean_kernel, len(known.stations.mean), [work.skin, known.stations]),
            "hold": (
                launches.hold_kernel,
                len(known.seams.vertex),
                [work, bones, known.seams, known.stations, how.crease_rounds],
            ),
            "share": (launches.share_kernel, n, [work, how.smooth_full, how.smooth_step]),
            "level": (launches.level_kernel, n, [work, rings, work.here, work.there]),
            "level back": (launches.level_kernel, n, [work, rings, work.there, work.here]),
            "settle": (launches.settle_kernel, n, [work, how.smooth_first]),
            "caps": (kernels.mean_kernel, len(known.caps.mean), [work.points, known.caps]),
            "bound": (bundling.bound_kernel, n_bundles, [work.points, bundles]),
            "enclose": (bundling.enclose_kernel, len(known.trees), [bundles]),
            "near": (launches.near_kernel, n_bundles, [work, segments, bundles, known.skins]),
            "touch": (launches.touch_kernel, n, [work, segments]),
            "part": (launches.part_kernel, n, [work, segments, bones, rings, how.part_rounds]),
        }
        for r in range(how.edge_rounds):
            edge = [r, work, moved, rings, segments, bones, how.steep]
            steps[f"edge {r}"] = (launches.edge_kernel, len(work.steps), edge)
            steps[f"follow {r}"] = (launches.follow_kernel, n, [r, work, moved, rings])
        for r in range(how.deepen_rounds):
            steps[f"deepen {r}"] = (launches.deepen_kernel, n, [work, segments, rings, r])
        return {name: self._recorded(*step) for name, step in steps.items()}

    def _recorded(self, kernel: Any, dim: int, inputs: list[Any]) -> Any:
        return wp.launch(kernel, dim, inputs, device=str(self.device), record_cmd=True)

    def is_held(self, aside: Tensor, way: Tensor) -> Tensor:
        """Whether skin that went `aside` with its arm, and gave `way` from there, (B, V) both [m], has gone as far as
        it may in one of the two: bool, shape (B, V).

        Where it has, two parts may still be in each other: as deep as flesh doesn't give way to.
        """
        return (aside > _HELD * self.settings.aside_farthest) | (way > _HELD * self.anatomy.farthest.to(way))

    @torch.no_grad()
    def touched(self, skin: Tensor) -> Tensor:
        """Which segments each vertex of `skin` (V, 3) [m] has to give way to, bool, shape (V, K)."""
        self.anatomy.tensors.ints.zero_()
        self.anatomy.tensors.take(skin)
        self.anatomy.tensors.counts[kernels.BENT_JOINTS] = -1  # any may be
        with torch_stream(self.device):
            self._touch()
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
        caps = self.anatomy.caps
        start, vertex, weight = (wp.to_torch(one) for one in (caps.start, caps.vertex, caps.weight))
        of_middle = torch.repeat_interleave(torch.arange(len(start) - 1, device=skin.device), start.long().diff())
        middles = skin.new_zeros(len(start) - 1, 3)
        return torch.cat((skin, middles.index_add(0, of_middle, skin[vertex.long()] * weight.to(skin)[:, None])))


_HELD = 0.99
"""Share of the farthest that counts as all of it: levelling and edges come after, and move skin by a little."""
