"""The garment pipeline: frame → body → backbone → posed garment → signed distance → ReFU → vertices."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, overload

import numpy as np
import torch
from torch import Tensor

from refu_core._device import checked_device
from refu_core.backbones import Backbone, load_backbone
from refu_core.body import RigidTransforms, SmplBody, load_body
from refu_core.errors import GarmentError, RefuError
from refu_core.frames import SmplFrame
from refu_core.garments import N_STYLES, GarmentTemplate, load_garment
from refu_core.realtime._collisions import Collisions, Fabric
from refu_core.repulsion import DEFAULT_MARGIN, Refu, VertexScale, read_refu
from refu_core.sdf import ExactSdf
from refu_core.weights import shipped_weights

if TYPE_CHECKING:
    from os import PathLike

    from numpy.typing import ArrayLike, NDArray

SDF_MODES: tuple[str, ...] = ("hybrid", "approx", "accurate", "none")
"""How collisions are found (paper, Sec. 4.1): with the approximate signed distance, by weights that were trained with
the accurate one in the loss or without it; with the accurate one; or not at all (the raw backbone)."""


@dataclass(frozen=True)
class GarmentStats:
    """What collision handling found and did for one garment in one frame."""

    n_inside: int = 0
    """Vertices inside the body before."""
    n_pushed: int = 0
    """Vertices that were moved: inside, or nearer to the skin than the margin."""
    n_unresolved: int = 0
    """Vertices still inside afterwards; only where the body touches itself."""
    max_depth: float = 0.0
    """Deepest penetration before [m]."""
    ms: float = 0.0
    """Wall time of the stages that were run for this garment alone: backbone and refu [ms]."""


@dataclass(frozen=True)
class FrameStats:
    """How long the stages of one frame took, and what they did."""

    stage_ms: Mapping[str, float]
    """Wall time of each stage, all garments together [ms]: body, backbone, sdf (new pose), refu (distances, pushes)."""
    garments: Mapping[str, GarmentStats] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class GarmentMesh:
    """A garment on a body, in SMPL axes."""

    local: NDArray[np.float32]
    """Vertices relative to the body's own origin, that is without the translation [m], shape (V, 3)."""
    raw: NDArray[np.float32]
    """The same before collision handling [m], shape (V, 3)."""
    faces: NDArray[np.int64]
    """Counter-clockwise from outside, shape (F, 3)."""
    transl: NDArray[np.float64]
    """Translation of the person [m], shape (3,)."""

    @property
    def vertices(self) -> NDArray[np.float64]:
        """Vertices with the translation [m], shape (V, 3); added in float64, so that distant bodies stay precise."""
        return self.local + self.transl


@dataclass(frozen=True, eq=False)
class PipelineOutput(Mapping[str, GarmentMesh]):
    """The garments of one person in one frame, by name."""

    garments: Mapping[str, GarmentMesh]
    body: NDArray[np.float32]
    """Vertices of the posed body without the translation, SMPL axes [m], shape (V, 3)."""
    stats: FrameStats

    def __getitem__(self, name: str) -> GarmentMesh:
        return self.garments[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.garments)

    def __len__(self) -> int:
        return len(self.garments)


@dataclass(frozen=True, eq=False)
class _Wearable:
    """A loaded garment, its networks, and what collision handling knows of it."""

    template: GarmentTemplate
    backbone: Backbone
    refu: Refu | None
    fabric: Fabric
    faces: NDArray[np.int64]
    margin: float


@dataclass(frozen=True, eq=False)
class _Dressed:
    """One garment on a batch of bodies, before collisions are handled."""

    posed: Tensor
    """Vertices [m], shape (B, V, 3)."""
    near: Tensor | None
    """A body face near each vertex, shape (B, V), where the distance wants to know."""
    scale: list[float | VertexScale]
    """α of each body."""
    ms: float
    """Wall time of one of the bodies [ms]."""


class GarmentPipeline:
    """Predicts garments on SMPL bodies, frame by frame, and pushes them out of the body (paper, Fig. "pipeline").

    Example:
        >>> pipeline = GarmentPipeline.load(["tshirt-male"])
        >>> out = pipeline(SmplFrame(pose=np.zeros((24, 3))))
        >>> out["tshirt-male"].vertices.shape[1]
        3
    """

    def __init__(
        self,
        body: SmplBody,
        wearables: Mapping[str, _Wearable],
        *,
        collisions: Collisions | None,
        margin: float | None,
        style: Tensor | None,
    ) -> None:
        self.body = body
        self.margin = margin
        """Clearance that is kept from the skin [m]; None for what each garment's weights were trained with."""
        self._wearables = wearables
        self._style = style
        self._collisions = collisions

    @classmethod
    def load(
        cls,
        garments: Sequence[str],
        *,
        sdf: str = "hybrid",
        backbone: str = "tailornet",
        style: ArrayLike | None = None,
        margin: float | None = None,
        weights: str | PathLike[str] | None = None,
        device: str = "cpu",
    ) -> GarmentPipeline:
        """Loads garments and what they need.

        Args:
            garments: names of built-in garments of one body.
            sdf: `hybrid`, `approx`, `accurate` or `none`.
            backbone: `tailornet`, `mlp`, `gcnn`, or `skinned`, which needs no weights.
            style: γ of all garments, shape (4,); the mean style if not given.
            margin: clearance ε that is kept from the skin [m]; by default what the weights were trained with.
            weights: folder with a folder a garment of weights of one's own (`refu train`); those that ship by default.
            device: torch device, `cpu` or `cuda`.

        Raises:
            GarmentError: no garment, an unknown one, garments of two bodies, or a bad style.
            WeightsError: no such backbone, or no weights of it for a garment, a mode, and the garment's body.
            RefuError: an unknown mode, margin or device.
        """
        if isinstance(garments, str):
            garments = [garments]
        if not garments:
            msg = "no garment was asked for: name at least one"
            raise GarmentError(msg)
        if sdf not in SDF_MODES:
            msg = f"no sdf mode {sdf!r}: wanted {', '.join(SDF_MODES)}"
            raise RefuError(msg)
        if margin is not None and not 0 <= margin <= 0.05:
            msg = f"the margin must be between 0 and 0.05 m, got {margin}"
            raise RefuError(msg)
        torch_device = checked_device(device)
        templates = {name: load_garment(name, device=torch_device) for name in dict.fromkeys(garments)}
        worn_by = {template.body for template in templates.values()}
        if len(worn_by) > 1:
            cut_for = ", ".join(f"{name} ({template.body})" for name, template in templates.items())
            msg = f"one person wears garments of one body: got {cut_for}"
            raise GarmentError(msg)
        body = load_body(worn_by.pop(), device=torch_device)
        rest = ExactSdf(body.faces, device=body.device)
        rest.update(body.v_template)
        wearables: dict[str, _Wearable] = {}
        for name, template in templates.items():
            folder = shipped_weights(name) if weights is None else Path(weights) / name
            network = load_backbone(
                backbone, template, mode=sdf, body_fingerprint=body.fingerprint, folder=folder, device=torch_device
            )
            refu = None
            if backbone != "skinned" and sdf != "none":
                refu = read_refu(folder / f"{backbone}-{sdf}", device=torch_device)
            wearables[name] = _Wearable(
                template,
                network,
                refu,
                Fabric.of(template, body, rest),
                template.faces.cpu().numpy(),
                DEFAULT_MARGIN if refu is None else float(refu.margin),
            )
        gamma = None if style is None else _style(style, torch_device)
        if gamma is not None:
            for template in templates.values():
                template.rest(gamma.new_zeros(1, 10), gamma)  # says now, not in the first frame, if it has no styles
        collisions = None if sdf == "none" else Collisions(body, is_accurate=sdf == "accurate")
        return cls(body, wearables, collisions=collisions, margin=margin, style=gamma)

    @property
    def garments(self) -> dict[str, GarmentTemplate]:
        """The loaded garments by name."""
        return {name: wearable.template for name, wearable in self._wearables.items()}

    @overload
    def __call__(self, frames: SmplFrame) -> PipelineOutput: ...

    @overload
    def __call__(self, frames: Sequence[SmplFrame]) -> list[PipelineOutput]: ...

    @torch.no_grad()
    def __call__(self, frames: SmplFrame | Sequence[SmplFrame]) -> PipelineOutput | list[PipelineOutput]:
        """Dresses one person, or a batch of persons (one frame each)."""
        if isinstance(frames, SmplFrame):
            return self._run([frames])[0]
        return self._run(frames) if len(frames) else []

    def _run(self, frames: Sequence[SmplFrame]) -> list[PipelineOutput]:
        clock = _StageClock()
        device = self.body.device
        pose = torch.as_tensor(np.stack([f.pose for f in frames]), device=device)
        betas = torch.as_tensor(np.stack([f.betas for f in frames]), device=device)
        posed = self.body(pose, betas)
        stages = {"body": clock.lap() / len(frames)}
        style = self._styles(frames)
        dressed: dict[str, _Dressed] = {}
        for name, wearable in self._wearables.items():
            dressed[name] = self._dress(wearable, pose, betas, style, posed.transforms, clock)
        stages["backbone"] = sum(one.ms for one in dressed.values())
        return [self._handle_collisions(i, frame, posed.vertices[i], dressed, stages) for i, frame in enumerate(frames)]

    def _dress(
        self,
        wearable: _Wearable,
        pose: Tensor,
        betas: Tensor,
        style: Tensor | None,
        transforms: RigidTransforms,
        clock: _StageClock,
    ) -> _Dressed:
        template, refu, n = wearable.template, wearable.refu, len(pose)
        unposed = template.rest(betas, style)
        predicted = wearable.backbone(betas, pose, style)
        if predicted.displacement is not None:
            unposed = unposed + predicted.displacement
        near = None if self._collisions is None else self._collisions.near(wearable.fabric, unposed, betas)
        scale: list[float | VertexScale] = [1.0] * n
        if refu is not None:
            z = refu.feature(betas, pose, style, predicted.feature)
            scale = [refu.of_body(None if z is None else z[i]) for i in range(n)]
        return _Dressed(template.pose(unposed, transforms), near, scale, clock.lap() / n)

    def _styles(self, frames: Sequence[SmplFrame]) -> Tensor | None:
        """γ of each frame, shape (B, 4): its own, else the pipeline's; None where nobody gave any."""
        if self._style is None and all(frame.style is None for frame in frames):
            return None
        usual = np.zeros(N_STYLES, np.float32) if self._style is None else self._style[0].cpu().numpy()
        own = [usual if frame.style is None else frame.style for frame in frames]
        return torch.as_tensor(np.stack(own), device=self.body.device)

    def _handle_collisions(
        self,
        person: int,
        frame: SmplFrame,
        body: Tensor,
        dressed: Mapping[str, _Dressed],
        stages: Mapping[str, float],
    ) -> PipelineOutput:
        clock = _StageClock()
        if self._collisions is not None:
            self._collisions.update(body)
        sdf_ms = clock.lap()
        meshes: dict[str, GarmentMesh] = {}
        stats: dict[str, GarmentStats] = {}
        refu_ms = 0.0
        for name, wearable in self._wearables.items():
            one, counts = dressed[name], GarmentStats()
            raw = vertices = one.posed[person]
            if self._collisions is not None:
                done = self._collisions.resolve(
                    wearable.fabric,
                    raw,
                    margin=wearable.margin if self.margin is None else self.margin,
                    scale=one.scale[person],
                    near=None if one.near is None else one.near[person],
                )
                vertices = done.vertices
                counts = GarmentStats(done.n_inside, done.n_pushed, done.n_unresolved, done.max_depth)
            meshes[name] = GarmentMesh(vertices.cpu().numpy(), raw.cpu().numpy(), wearable.faces, frame.transl)
            own_ms = clock.lap()
            refu_ms += own_ms
            stats[name] = replace(counts, ms=one.ms + own_ms)
        return PipelineOutput(meshes, body.cpu().numpy(), FrameStats({**stages, "sdf": sdf_ms, "refu": refu_ms}, stats))


def _style(value: ArrayLike, device: torch.device) -> Tensor:
    style = np.asarray(value, dtype=np.float32)
    if style.shape != (N_STYLES,) or not np.isfinite(style).all():
        msg = f"style must be {N_STYLES} finite numbers, got {np.array2string(style, threshold=8)}"
        raise GarmentError(msg)
    return torch.as_tensor(style, device=device)[None]


class _StageClock:
    """Wall time between laps."""

    def __init__(self) -> None:
        self._last = time.perf_counter()

    def lap(self) -> float:
        """Milliseconds since the last lap."""
        now = time.perf_counter()
        ms, self._last = 1e3 * (now - self._last), now
        return ms
