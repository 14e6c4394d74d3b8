"""The garment pipeline: frame → body → backbone → posed garment → signed distance → ReFU → vertices."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, overload

import numpy as np
import torch
from torch import Tensor

from refu_core.backbones import Backbone, load_backbone
from refu_core.body import RigidTransforms, SmplBody, load_body
from refu_core.errors import GarmentError, RefuError
from refu_core.frames import SmplFrame
from refu_core.garments import N_STYLES, GarmentTemplate, load_garment
from refu_core.repulsion import DEFAULT_MARGIN, Limbs, resolve
from refu_core.sdf import ExactSdf

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

SDF_MODES: tuple[str, ...] = ("accurate", "none")
"""How collisions are found: with the exact signed distance, or not at all (the raw backbone)."""


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
    """Wall time of each stage, all garments together [ms]: body, backbone, sdf (refit), refu."""
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
    """A loaded garment and its network."""

    template: GarmentTemplate
    backbone: Backbone
    limbs: Limbs
    faces: NDArray[np.int64]


class GarmentPipeline:
    """Predicts garments on SMPL bodies, frame by frame, and pushes them out of the body (paper, Fig. "pipeline").

    Example:
        >>> pipeline = GarmentPipeline.load(["tshirt-male"])
        >>> out = pipeline(SmplFrame(pose=np.zeros((24, 3))))
        >>> out["tshirt-male"].vertices.shape[1]
        3
    """

    def __init__(
        self, body: SmplBody, wearables: Mapping[str, _Wearable], *, sdf: str, margin: float, style: Tensor | None
    ) -> None:
        self.body = body
        self.sdf_mode = sdf
        self.margin = margin
        self._wearables = wearables
        self._style = style
        self._sdf = ExactSdf(body.faces, device=str(body.device)) if sdf == "accurate" else None

    @classmethod
    def load(
        cls,
        garments: Sequence[str],
        *,
        sdf: str = "accurate",
        backbone: str = "skinned",
        style: ArrayLike | None = None,
        margin: float = DEFAULT_MARGIN,
        device: str = "cpu",
    ) -> GarmentPipeline:
        """Loads garments and what they need.

        Args:
            garments: names of built-in garments of one body.
            sdf: `accurate` or `none`.
            backbone: `skinned`.
            style: γ of all garments, shape (4,); the mean style if not given.
            margin: clearance ε that is kept from the skin [m].
            device: torch device, `cpu` or `cuda`.

        Raises:
            GarmentError: no garment, an unknown one, garments of two bodies, or a bad style.
            WeightsError: no such backbone for a garment.
            RefuError: an unknown mode, margin or device.
        """
        if isinstance(garments, str):
            garments = [garments]
        if not garments:
            msg = "no garment was asked for: name at least one"
            raise GarmentError(msg)
        if sdf not in SDF_MODES:
            msg = f"no sdf mode {sdf!r}: wanted {' or '.join(SDF_MODES)}"
            raise RefuError(msg)
        if not 0 <= margin <= 0.05:
            msg = f"the margin must be between 0 and 0.05 m, got {margin}"
            raise RefuError(msg)
        torch_device = _device(device)
        templates = {name: load_garment(name, device=torch_device) for name in dict.fromkeys(garments)}
        worn_by = {template.body for template in templates.values()}
        if len(worn_by) > 1:
            cut_for = ", ".join(f"{name} ({template.body})" for name, template in templates.items())
            msg = f"one person wears garments of one body: got {cut_for}"
            raise GarmentError(msg)
        body = load_body(worn_by.pop(), device=torch_device)
        rest = ExactSdf(body.faces, device=body.device)
        rest.update(body.v_template)
        wearables = {
            name: _Wearable(
                t, load_backbone(backbone, name, device=torch_device), _limbs(body, rest, t), t.faces.cpu().numpy()
            )
            for name, t in templates.items()
        }
        gamma = None if style is None else _style(style, torch_device)
        if gamma is not None:
            for template in templates.values():
                template.rest(gamma.new_zeros(1, 10), gamma)  # says now, not in the first frame, if it has no styles
        return cls(body, wearables, sdf=sdf, margin=margin, style=gamma)

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
        raw: dict[str, Tensor] = {}
        dress_ms: dict[str, float] = {}
        for name, wearable in self._wearables.items():
            raw[name] = _dress(wearable, pose, betas, style, posed.transforms)
            dress_ms[name] = clock.lap() / len(frames)
        stages["backbone"] = sum(dress_ms.values())
        return [
            self._handle_collisions(frame, posed.vertices[i], {name: x[i] for name, x in raw.items()}, stages, dress_ms)
            for i, frame in enumerate(frames)
        ]

    def _styles(self, frames: Sequence[SmplFrame]) -> Tensor | None:
        """γ of each frame, shape (B, 4): its own, else the pipeline's; None where nobody gave any."""
        if self._style is None and all(frame.style is None for frame in frames):
            return None
        usual = np.zeros(N_STYLES, np.float32) if self._style is None else self._style[0].cpu().numpy()
        own = [usual if frame.style is None else frame.style for frame in frames]
        return torch.as_tensor(np.stack(own), device=self.body.device)

    def _handle_collisions(
        self,
        frame: SmplFrame,
        body: Tensor,
        raw: Mapping[str, Tensor],
        stages: Mapping[str, float],
        dress_ms: Mapping[str, float],
    ) -> PipelineOutput:
        clock = _StageClock()
        if self._sdf is not None:
            self._sdf.update(body)
        sdf_ms = clock.lap()
        meshes: dict[str, GarmentMesh] = {}
        stats: dict[str, GarmentStats] = {}
        refu_ms = 0.0
        for name, wearable in self._wearables.items():
            vertices, counts = raw[name], GarmentStats()
            if self._sdf is not None:
                done = resolve(
                    vertices, self._sdf, margin=self.margin, edges=wearable.template.edges, limbs=wearable.limbs
                )
                vertices = done.vertices
                counts = GarmentStats(done.n_inside, done.n_pushed, done.n_unresolved, done.max_depth)
            meshes[name] = GarmentMesh(vertices.cpu().numpy(), raw[name].cpu().numpy(), wearable.faces, frame.transl)
            own_ms = clock.lap()
            refu_ms += own_ms
            stats[name] = replace(counts, ms=dress_ms[name] + own_ms)
        return PipelineOutput(meshes, body.cpu().numpy(), FrameStats({**stages, "sdf": sdf_ms, "refu": refu_ms}, stats))


def _dress(
    wearable: _Wearable, pose: Tensor, betas: Tensor, style: Tensor | None, transforms: RigidTransforms
) -> Tensor:
    """Posed garments before collision handling [m], shape (B, V, 3)."""
    template = wearable.template
    unposed = template.rest(betas, style)
    displacement = wearable.backbone(betas, pose, style).displacement
    if displacement is not None:
        unposed = unposed + displacement
    return template.pose(unposed, transforms)


def _limbs(body: SmplBody, rest: ExactSdf, garment: GarmentTemplate) -> Limbs:
    """The limbs of a garment on a body, whose rest pose `rest` was updated with."""
    clearance = rest.query(garment.v_template).distance
    return Limbs.of(body.weights, body.faces, garment.weights, garment.faces, clearance=clearance)


def _device(name: str) -> torch.device:
    try:
        device = torch.device(name)
    except RuntimeError as error:
        msg = f"no device {name!r}: wanted cpu or cuda"
        raise RefuError(msg) from error
    if device.type == "cuda" and not torch.cuda.is_available():
        msg = f"no device {name!r}: this torch build or machine has no CUDA; use cpu"
        raise RefuError(msg)
    return device


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
