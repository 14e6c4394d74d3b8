"""The garment pipeline: frame → body → backbone → posed garment → signed distance → ReFU → vertices."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, overload

import numpy as np
import torch
from torch import Tensor

from refu_core._device import checked_device
from refu_core.backbones import TailorNet, load_backbone
from refu_core.body import SmplBody, load_body
from refu_core.errors import GarmentError, RefuError
from refu_core.frames import SmplFrame
from refu_core.garments import N_STYLES, GarmentTemplate, load_garment
from refu_core.realtime._collisions import Collisions
from refu_core.realtime._graph import StepGraphs
from refu_core.realtime._outfit import Outfit
from refu_core.realtime._outputs import SDF_MODES, SKIPS, FrameStats, GarmentMesh, GarmentStats, PipelineOutput
from refu_core.realtime._step import Step
from refu_core.realtime._turn import RootTurn
from refu_core.realtime._wearable import Dressed, Figures, Wearable
from refu_core.repulsion import DEFAULT_MARGIN, read_refu
from refu_core.sdf import require_outward
from refu_core.weights import shipped_weights

if TYPE_CHECKING:
    from os import PathLike

    from numpy.typing import ArrayLike, NDArray


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
        wearables: Mapping[str, Wearable],
        *,
        collisions: Collisions | None,
        outfit: Outfit | None,
        margin: float | None,
        style: Tensor | None,
        no_skip: Collection[str] = (),
        graph: bool = True,
    ) -> None:
        self.body = body
        self._margin = margin
        self._wearables = wearables
        self._style = style
        self._collisions = collisions
        self._outfit = outfit
        self._skips = frozenset(SKIPS) - frozenset(no_skip)
        self._step = Step(body, wearables, collisions=collisions, outfit=outfit)
        self._graphs = StepGraphs(self._step, body.device) if graph and body.device.type == "cuda" else None
        self._figures: Figures | None = None
        self._last: dict[bytes, PipelineOutput] = {}

    @property
    def margin(self) -> float | None:
        """Clearance that is kept from the skin [m]; None for what each garment's weights were trained with."""
        return self._margin

    @margin.setter
    def margin(self, margin: float | None) -> None:
        self._margin = margin
        self._last = {}  # what nobody moved for is not what it would be now

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
        no_skip: Collection[str] = (),
        graph: bool = True,
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
            no_skip: names of `SKIPS` that are computed nevertheless, to see what skipping them is worth.
            graph: on CUDA, capture the whole of a frame as a CUDA graph; without, it is launched stage by stage.

        Raises:
            GarmentError: no garment, an unknown one, garments of two bodies, or a bad style.
            WeightsError: no such backbone, or no weights of it for a garment, a mode, and the garment's body.
            RefuError: an unknown mode, margin, device or skip.
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
        unknown = sorted({no_skip} if isinstance(no_skip, str) else set(no_skip) - set(SKIPS))
        if unknown:
            msg = f"nothing is skipped by the name {', '.join(unknown)}: wanted a collection of {', '.join(SKIPS)}"
            raise RefuError(msg)
        torch_device = checked_device(device)
        templates = {name: load_garment(name, device=torch_device) for name in dict.fromkeys(garments)}
        worn_by = {template.body for template in templates.values()}
        if len(worn_by) > 1:
            cut_for = ", ".join(f"{name} ({template.body})" for name, template in templates.items())
            msg = f"one person wears garments of one body: got {cut_for}"
            raise GarmentError(msg)
        body = load_body(worn_by.pop(), device=torch_device)
        collisions = None
        if sdf != "none":
            is_accurate, uses_band = sdf == "accurate", "band" not in no_skip
            collisions = Collisions(body, templates, is_accurate=is_accurate, uses_band=uses_band)
        wearables: dict[str, Wearable] = {}
        for name, template in templates.items():
            folder = shipped_weights(name) if weights is None else Path(weights) / name
            network = load_backbone(
                backbone, template, mode=sdf, body_fingerprint=body.fingerprint, folder=folder, device=torch_device
            )
            if "pivots" in no_skip and isinstance(network, TailorNet):
                network.skips_pivots = False
            refu = None
            if backbone != "skinned" and sdf != "none":
                refu = read_refu(folder / f"{backbone}-{sdf}", device=torch_device)
            wearables[name] = Wearable(
                template,
                network,
                refu,
                template.faces.cpu().numpy(),
                DEFAULT_MARGIN if refu is None else float(refu.margin),
            )
        gamma = None if style is None else _style(style, torch_device)
        if gamma is not None:
            for template in templates.values():
                template.rest(gamma.new_zeros(1, 10), gamma)  # says now, not in the first frame, if it has no styles
        outfit = Outfit(templates) if collisions is not None and len(templates) > 1 else None
        return cls(
            body,
            wearables,
            collisions=collisions,
            outfit=outfit,
            margin=margin,
            style=gamma,
            no_skip=no_skip,
            graph=graph,
        )

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
        """Dresses one person, or a batch of persons (one frame each).

        A person whose (β, θ, γ) are among those of the last call gets the arrays of that call: copy them to write in.
        """
        if isinstance(frames, SmplFrame):
            return self._dress_all([frames])[0]
        return self._dress_all(frames)

    def _dress_all(self, frames: Sequence[SmplFrame]) -> list[PipelineOutput]:
        keys = [_key(frame) for frame in frames]
        known = self._last if "unchanged" in self._skips else {}
        new = {key: frame for key, frame in zip(keys, frames, strict=True) if key not in known}
        outputs = {key: known[key] for key in keys if key in known}
        if new:
            outputs |= zip(new, self._run(list(new.values())), strict=True)
        self._last = outputs
        return [
            outputs[key] if new.get(key) is frame else _moved(outputs[key], frame)
            for key, frame in zip(keys, frames, strict=True)
        ]

    def _run(self, frames: Sequence[SmplFrame]) -> list[PipelineOutput]:
        if self._graphs is not None:
            return self._replay(frames, self._graphs)
        clock = _StageClock()
        figures, skipped = self._figures_of(frames)
        pose = torch.as_tensor(np.stack([f.pose for f in frames]), device=self.body.device)
        turns, at_root = RootTurn.taken_off(pose, figures.body.joints)
        posed = self.body.posed(at_root, figures.body)
        stages = {"body": clock.lap() / len(frames)}
        dressed: dict[str, tuple[Dressed, float]] = {}
        for name, wearable in self._wearables.items():
            worn = wearable.dress(pose, figures, posed.transforms, self._collisions)
            dressed[name] = worn, clock.lap() / len(frames)
            if isinstance(wearable.backbone, TailorNet):
                skipped["pivots"] = skipped.get("pivots", 0) + wearable.backbone.n_skipped
        stages["backbone"] = sum(ms for _, ms in dressed.values())
        return [
            self._handle_collisions(i, frame, posed.vertices[i], turns[i], dressed, stages, skipped)
            for i, frame in enumerate(frames)
        ]

    def _replay(self, frames: Sequence[SmplFrame], graphs: StepGraphs) -> list[PipelineOutput]:
        clock = _StageClock()
        figures, skipped = self._figures_of(frames)
        pose = torch.as_tensor(np.stack([f.pose for f in frames]))
        margins = tuple(one.margin if self.margin is None else self.margin for one in self._wearables.values())
        packed = graphs(self._step.inputs(pose, figures), margins)
        outputs = []
        for frame, (body, worn) in zip(frames, self._step.unpacked(packed), strict=True):
            meshes = {
                name: GarmentMesh(one.local, partial(_itself, one.raw), self._wearables[name].faces, frame.transl)
                for name, one in worn.items()
            }
            counts = {name: one.counts for name, one in worn.items()}
            outputs.append(PipelineOutput(meshes, partial(_itself, body), FrameStats({}, counts, skipped)))
        took = {"step": clock.lap() / len(frames)}
        return [replace(output, stats=replace(output.stats, stage_ms=took)) for output in outputs]

    def _figures_of(self, frames: Sequence[SmplFrame]) -> tuple[Figures, dict[str, int]]:
        """The bodies and garments of the persons' (β, γ), and what of that was known from the last frame."""
        key = b"".join(_key(frame, of_pose=False) for frame in frames)
        if self._figures is not None and self._figures.key == key and "rest" in self._skips:
            return self._figures, {"rest": 1 + len(self._wearables)}
        betas = torch.as_tensor(np.stack([f.betas for f in frames]), device=self.body.device)
        style = self._styles(frames)
        mean = betas.new_zeros(1, betas.shape[1])
        templates = self.garments.items()
        shape = self.body.shape(betas)
        if self._collisions is not None:  # of a body that its β turn inside out, every vertex would be inside
            require_outward(shape.vertices, self.body.faces)
        self._figures = Figures(
            key,
            betas,
            style,
            shape,
            {name: template.rest(betas, style) for name, template in templates},
            {name: template.rest(mean, style) for name, template in templates},
        )
        return self._figures, {}

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
        turn: RootTurn,
        dressed: Mapping[str, tuple[Dressed, float]],
        stages: Mapping[str, float],
        skipped: Mapping[str, int],
    ) -> PipelineOutput:
        clock = _StageClock()
        if self._collisions is not None:
            self._collisions.update(body)
        sdf_ms = clock.lap()
        meshes: dict[str, GarmentMesh] = {}
        stats: dict[str, GarmentStats] = {}
        worn: dict[str, Tensor] = {}
        layers_ms = refu_ms = 0.0
        n_clipped = 0
        # From the skin outwards. A garment is brought off those below it first: the body has the last word.
        for name in self._wearables if self._outfit is None else self._outfit.order:
            wearable, (one, dress_ms), counts, n_layered = self._wearables[name], dressed[name], GarmentStats(), 0
            raw = vertices = one.posed[person]
            if self._outfit is not None:
                vertices, n_layered = self._outfit.lift(name, vertices, worn)
            own_layers_ms = clock.lap()
            if self._collisions is not None:
                done, n_unasked = self._collisions.resolve(
                    name,
                    vertices,
                    margin=wearable.margin if self.margin is None else self.margin,
                    scale=one.scale[person],
                    near=None if one.near is None else one.near[person],
                )
                n_clipped += n_unasked
                vertices = done.vertices
                counts = GarmentStats(done.n_inside, done.n_pushed, done.n_unresolved, done.max_depth, n_layered)
            worn[name] = vertices
            meshes[name] = GarmentMesh(turn.to_host(vertices), turn.later(raw), wearable.faces, frame.transl)
            own_ms = clock.lap()
            layers_ms, refu_ms = layers_ms + own_layers_ms, refu_ms + own_ms
            stats[name] = replace(counts, ms=dress_ms + own_layers_ms + own_ms)
        stage_ms = {**stages, "sdf": sdf_ms, **({} if self._outfit is None else {"layers": layers_ms}), "refu": refu_ms}
        in_order = {name: meshes[name] for name in self._wearables}
        counts_in_order = {name: stats[name] for name in in_order}
        took = FrameStats(stage_ms, counts_in_order, {**skipped, "band": n_clipped})
        return PipelineOutput(in_order, turn.later(body), took)


def _key(frame: SmplFrame, *, of_pose: bool = True) -> bytes:
    """Tells apart what is different of two persons but where they are."""
    style = b"" if frame.style is None else b"s" + frame.style.tobytes()
    return frame.betas.tobytes() + (frame.pose.tobytes() if of_pose else b"") + style


def _moved(output: PipelineOutput, frame: SmplFrame) -> PipelineOutput:
    """What a person wore in the last frame, where it is now: the same arrays."""
    garments = {name: replace(mesh, transl=frame.transl) for name, mesh in output.items()}
    counts = {name: replace(one, ms=0.0) for name, one in output.stats.garments.items()}
    took = FrameStats(dict.fromkeys(output.stats.stage_ms, 0.0), counts, {"unchanged": 1})
    return PipelineOutput(garments, output.posed_body, took)


def _itself(array: NDArray[np.float32]) -> NDArray[np.float32]:
    return array


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
