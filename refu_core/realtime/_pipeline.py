"""The garment pipeline: frame → body → backbone → posed garment → signed distance → ReFU → vertices."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, lru_cache, partial
from numbers import Integral, Real
from os import PathLike
from types import NoneType
from typing import NoReturn, overload

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from refu_core._device import checked_device, own_settings
from refu_core.backbones import Skinned
from refu_core.body import SmplBody
from refu_core.contact import DEFAULT_CONTACT, ContactSettings
from refu_core.errors import FrameError, GarmentError, RefuError, require_type
from refu_core.frames import MAX_COEFFICIENT, N_BETAS, N_STYLES, SmplFrame, checked_numbers, pasts_of
from refu_core.garments import GarmentTemplate
from refu_core.modes import MAX_MARGIN, BackboneName, SdfMode
from refu_core.realtime._contact import ContactStage
from refu_core.realtime._crew import Crew
from refu_core.realtime._frame import Adjust, FrameStep, Person, StageClock, packed_by
from refu_core.realtime._graph import StepGraphs
from refu_core.realtime._load import load_outfit
from refu_core.realtime._outputs import FrameStats, GarmentMesh, GarmentStats, PipelineOutput, SkinShift
from refu_core.realtime._promise import within_promise
from refu_core.realtime._wearer import Wearer
from refu_core.sdf import require_outward

_MOST_WEARERS = 64
"""How many persons' (β, γ) are remembered, those seen last; each takes about half a megabyte per garment."""
_MOST_THREADS = 256
"""Each has memory of its own from the start; a million would end the process."""


class GarmentPipeline:
    """Predicts garments on SMPL bodies, frame by frame, and brings them off the body (paper, Sec. 3).

    Any thread may call a pipeline, and read what it has returned. As many calls run at the same time as the pipeline
    has `threads`, and others wait; a batch is shared out among the free ones. Load a pipeline in each process, after
    the fork: it can't be pickled.

    Example:
        >>> pipeline = GarmentPipeline.load(["tshirt-male"])
        >>> out = pipeline(SmplFrame(pose=np.zeros((24, 3))))
        >>> out["tshirt-male"].vertices.shape[1]
        3
    """

    def __init__(
        self,
        steps: Sequence[FrameStep] = (),
        *,
        margin: float | None = None,
        style: Tensor | None = None,
        graph: bool = True,
    ) -> None:
        """What `load` calls. Raises `RefuError` for anything but its steps."""
        given: object = steps
        if not isinstance(given, Sequence) or not given or not all(isinstance(one, FrameStep) for one in given):
            msg = "a pipeline isn't made of names: GarmentPipeline.load(['tshirt-male']) loads the garments, too"
            raise RefuError(msg)
        self._steps = steps
        self.outfit = outfit = steps[0].outfit
        """The body model, the garments and their networks."""
        self.body = outfit.body
        """The body model that the garments are worn on."""
        self.fit = outfit.fit
        """How well the built-in mesh lies on the body that was named; None if none was."""
        self.garments = {name: one.template for name, one in outfit.wearables.items()}
        """The loaded garments by name."""
        self.untrained = tuple(n for n, one in outfit.wearables.items() if isinstance(one.backbone, Skinned))
        """Names of the garments that no network drapes: they follow the skin."""
        self.heeds_past = any(one.backbone.heeds_past for one in outfit.wearables.values())
        """Whether frames should have their past (`PoseHistory`), as the backbone `dynamic` needs it."""
        self.threads = len(steps)
        """How many calls may run at the same time; on a GPU, how many parts of a batch."""
        self.margin = margin
        """Cloth nearer to the skin is pushed away [m]; None for what each garment's weights were trained with."""
        self._style = style
        on_gpu = outfit.body.device.type == "cuda"
        self._graphs = StepGraphs(partial(packed_by, steps), outfit.body.device) if graph and on_gpu else None
        contact = steps[0].contact
        self._is_certified = contact is not None and contact.way_out is not None
        self._crew = Crew(steps[:1] if on_gpu else steps, on_gpu=on_gpu)
        self._lock = threading.Lock()
        """Guards what is remembered."""
        self._faces = {name: one.template.faces.cpu().numpy().copy() for name, one in outfit.wearables.items()}
        for faces in self._faces.values():
            faces.flags.writeable = False  # all frames share them
        self._wearers: OrderedDict[bytes, Wearer] = OrderedDict()
        self._together = lru_cache(self.threads)(Wearer.together)
        """One wearer of all persons of a call; reused for the same persons as in one of the last calls."""
        self._last: tuple[float | None, dict[bytes, PipelineOutput]] = margin, {}

    @property
    def warnings(self) -> list[str]:
        """Warnings known before anything is dressed, for people to read."""
        return [] if self.fit is None else self.fit.warnings

    def __repr__(self) -> str:
        return f"GarmentPipeline({', '.join(self.garments)} on {self.body.name}, {self.body.device})"

    def __reduce__(self) -> NoReturn:
        """Raises `RefuError`: memory that kernels work in can't be moved elsewhere."""
        raise RefuError("a pipeline can't be pickled or copied: load one in each process, or call one from all threads")

    @classmethod
    @own_settings()
    def load(
        cls,
        garments: Sequence[str | PathLike[str] | GarmentTemplate],
        *,
        body: str | PathLike[str] | SmplBody | None = None,
        betas_from: str | PathLike[str] | SmplBody | None = None,
        sdf: str = "hybrid",
        backbone: str = BackboneName.AUTO,
        style: ArrayLike | None = None,
        margin: float | None = None,
        weights: str | PathLike[str] | None = None,
        device: str = "cpu",
        graph: bool = True,
        certify: bool = True,
        collider: bool = True,
        contact: ContactSettings = DEFAULT_CONTACT,
        threads: int = 1,
    ) -> GarmentPipeline:
        """Loads garments and what they need.

        Args:
            garments: names of built-in ones, paths of garment files, or templates; for one body, unless one is named.
            body: who wears them: the path of an SMPL file (`.npz` or official `.pkl`), a built-in name, or a loaded
                body. Garments and what their networks know are transferred to it, frames' betas are then its own, and
                weights trained on it are accepted, too. By default the built-in body that the garments were cut for.
            betas_from: the path of the SMPL file that frames' betas belong to, in place of `body`: the built-in mesh
                follows them, and the file's own mesh isn't used.
            sdf: `hybrid`, `approx`, `accurate` or `none`.
            backbone: `tailornet`, `dynamic` (which heeds `SmplFrame.past`), `mlp`, `gcnn`, or `skinned`, which needs no
                weights; by default (`auto`) the first of `dynamic` and `tailornet` that ships, `skinned` if neither.
            style: γ of all garments, shape (4,); the mean style if not given.
            margin: ε: cloth nearer to the skin than this is pushed away from it [m], to half of it at least, to a
                quarter where it lies over other cloth; by default what the weights were trained with.
            weights: folder of your own weights (`refu train`), a subfolder per garment; by default those that ship.
            device: torch device, `cpu` or `cuda`.
            graph: on CUDA, capture the whole of a frame as a CUDA graph; otherwise it is launched stage by stage.
            certify: compute every vertex's winding number at the end, bring vertices that are inside out, and count
                those without a way out (`n_unresolved`); this takes a twentieth of a frame's time. Otherwise the count
                relies on the distances that pushed the vertices, which may be wrong.
            collider: bring garments off a body whose overlaps were pulled apart (`PipelineOutput.body`); otherwise off
                the posed body itself as in the paper, where limbs that run through each other leave no room.
            contact: the tuned numbers of collision handling.
            threads: how many calls, or parts of a batch, may run at once, each in memory of its own; on a GPU calls
                take turns, and parts of a batch run at once in a graph.

        Raises:
            GarmentError: no garment, an unknown one, garments of two bodies, or a bad style.
            BodyError: no such body, or one that isn't in metres, upright, facing forward, in the T-pose and closed.
            WeightsError: no such backbone, or no weights of it for a garment, a mode, and the garment's body.
            RefuError: an unknown mode, margin or device, no such number of threads, or a switch that isn't a bool.
        """
        mode = SdfMode.of(sdf, "sdf mode")
        _check_margin(margin)
        require_type(contact, ContactSettings, "ContactSettings")
        require_type(threads, Integral, "a number of threads")
        for name, switch in (("graph", graph), ("certify", certify), ("collider", collider)):
            require_type(switch, (bool, np.bool_), f"{name} as True or False")  # "false" would switch it on
        if not 1 <= threads <= _MOST_THREADS:
            raise RefuError(f"wanted 1 to {_MOST_THREADS} threads, got {threads}")
        torch_device = checked_device(device)
        outfit = load_outfit(
            garments,
            body=body,
            betas_from=betas_from,
            backbone=backbone,
            mode=mode,
            weights=weights,
            device=torch_device,
            collider=collider,
        )
        gamma = None if style is None else _style(style, torch_device)
        if gamma is not None:
            for one in outfit.wearables.values():
                one.template.rest(gamma.new_zeros(1, N_BETAS), gamma)  # raises now if it has no styles
        steps = []
        for k in range(threads if torch_device.type == "cpu" or graph else 1):
            own = outfit.beside() if k else outfit
            stage = None
            if mode is not SdfMode.NONE:
                stage = ContactStage(own, sdf=mode, certify=certify, settings=contact)
            steps.append(FrameStep(own, stage))
        return cls(steps, margin=margin, style=gamma, graph=graph)

    @overload
    def __call__(self, frames: SmplFrame, *, margin: float | None = None) -> PipelineOutput: ...

    @overload
    def __call__(self, frames: Sequence[SmplFrame], *, margin: float | None = None) -> list[PipelineOutput]: ...

    def __call__(
        self, frames: SmplFrame | Sequence[SmplFrame], *, margin: float | None = None
    ) -> PipelineOutput | list[PipelineOutput]:
        """Dresses one person, or a batch of persons (one frame each).

        Arrays are read-only: persons with the same (β, θ, γ) share them, in a batch and with the last call. A
        `margin` [m] takes the place of the pipeline's.

        Raises:
            FrameError: `frames` isn't a frame or a sequence, or has anything but frames in it.
            RefuError: the margin isn't zero or more.
        """
        if not isinstance(frames, SmplFrame):
            require_type(frames, Sequence, "a SmplFrame or a sequence of them", error=FrameError)
            for one in frames:
                require_type(one, SmplFrame, "a SmplFrame in every place of the sequence", error=FrameError)
        margin = self.margin if margin is None else margin
        _check_margin(margin)
        batch = [frames] if isinstance(frames, SmplFrame) else frames
        outputs = self._crew.call(partial(self._dress_all, frames=batch, margin=margin))
        return outputs[0] if isinstance(frames, SmplFrame) else outputs

    def adjusted(self, frame: SmplFrame, adjust: Adjust) -> PipelineOutput:
        """Dresses one frame, and lets `adjust` change what was predicted before it is brought off the body.

        `adjust` is given a `Dressed` of one person in the root's axes, and returns one whose garments may be elsewhere.
        What it returns is handled like any prediction: nothing is inside the body afterwards. The result isn't
        remembered. On a GPU no graph is used.

        Raises:
            FrameError: not a `SmplFrame`.
            RefuError: as `__call__`, what `adjust` raises, and for garments that it drops, or whose tensors have
                another shape, or NaN in them.
        """
        require_type(frame, SmplFrame, "a SmplFrame", error=FrameError)
        given: object = adjust
        if not callable(given):
            raise FrameError(f"wanted a function of a Dressed, got {type(given).__name__}")
        return self._crew.call(partial(self._run, frames=[frame], margin=self.margin, adjust=adjust))[0]

    def _dress_all(self, step: FrameStep, frames: Sequence[SmplFrame], margin: float | None) -> list[PipelineOutput]:
        keys = [_key(frame) for frame in frames]
        of_margin, known = self._last
        if of_margin != margin:
            known = {}
        new = {key: frame for key, frame in zip(keys, frames, strict=True) if key not in known}
        outputs = {key: known[key] for key in keys if key in known}
        if new:
            run = partial(self._run, margin=margin)
            outputs |= zip(new, self._crew.share(step, run, list(new.values())), strict=True)
        self._last = margin, outputs
        return [
            outputs[key] if new.get(key) is frame else outputs[key].at(frame)
            for key, frame in zip(keys, frames, strict=True)
        ]

    @own_settings()  # each thread has its own
    def _run(
        self, step: FrameStep, frames: Sequence[SmplFrame], margin: float | None, adjust: Adjust | None = None
    ) -> list[PipelineOutput]:
        clocks = [StageClock() for _ in frames]
        with self._lock:
            found = [self._wearer(frame) for frame in frames]
            wearer = self._together(tuple(wearer for wearer, _ in found))
        pose = torch.from_numpy(np.array([f.pose for f in frames]))
        margins = tuple(one.margin if margin is None else margin for one in self.outfit.wearables.values())
        told = {}
        if self.heeds_past and any(frame.past is not None for frame in frames):
            told["past"] = torch.from_numpy(pasts_of(frames))
        if any(frame.up[1] != 1 for frame in frames):
            told["up"] = torch.as_tensor(np.stack([frame.up for frame in frames]))
        if self._graphs is not None and adjust is None:
            packed = self._graphs({"pose": pose, **told, **wearer.tensors()}, margins)
            persons = step.unpacked(packed)
            outputs = [self._output(frame, person, {}) for frame, person in zip(frames, persons, strict=True)]
            clocks[0].lap("step")
            took = {"step": clocks[0].stages["step"] / len(frames)}
            return [replace(one, stats=replace(one.stats, stage_ms=took)) for one in outputs]
        told = {name: tensor.to(self.body.device) for name, tensor in told.items()}
        outputs = []
        done = step(pose.to(self.body.device), wearer, margins, clocks, adjust, **told)
        for frame, person, clock, (_, skipped) in zip(frames, done, clocks, found, strict=True):
            n_clipped = sum(int(worn.n_clipped) for worn in person.garments.values())
            outputs.append(self._output(frame, person, {**skipped, "band": n_clipped}, clock))
        return outputs

    def _wearer(self, frame: SmplFrame) -> tuple[Wearer, dict[str, int]]:
        """What depends on the person's (β, γ), and how much of it was known."""
        key = _key(frame, of_pose=False)
        known = self._wearers.pop(key, None)
        if known is not None:
            self._wearers[key] = known
            return known, {"rest": 1 + len(self.outfit.wearables)}
        betas = torch.tensor(frame.betas, device=self.body.device)[None]
        style = self._style if frame.style is None else torch.tensor(frame.style, device=self.body.device)[None]
        wearer = Wearer.of(self.outfit, betas, style)
        if self._steps[0].contact is not None:  # every vertex would be inside a body that its β turn inside out
            require_outward(wearer.shape.vertices, self.body.faces)
        while len(self._wearers) >= _MOST_WEARERS:
            self._wearers.popitem(last=False)
        self._wearers[key] = wearer
        return wearer, {}

    def _output(
        self, frame: SmplFrame, person: Person, skipped: Mapping[str, int], clock: StageClock | None = None
    ) -> PipelineOutput:
        turn, meshes, stats = person.turn, {}, {}

        def later(points: Tensor) -> Callable[[], NDArray[np.float32]]:
            return cache(partial(_with_own_settings, turn, points))

        for name in self.outfit.wearables:
            vertices, raw, numbers, _ = person.garments[name]
            meshes[name] = GarmentMesh(_on_host(turn, vertices), later(raw), self._faces[name], frame.transl)
            stats[name] = GarmentStats.of(numbers.tolist(), ms=0.0 if clock is None else clock.garments[name])
        shift, stage_ms = SkinShift.of(person.shift.tolist()), {} if clock is None else clock.stages
        style = self._style[0].tolist() if frame.style is None and self._style is not None else frame.style
        promised = within_promise(frame, style) and not shift.n_held
        took = FrameStats(stage_ms, stats, self._is_certified, promised, skipped, shift)
        return PipelineOutput(meshes, later(person.body), later(person.skin), took)


def _on_host(turn: Callable[[Tensor], Tensor], points: Tensor) -> NDArray[np.float32]:
    made: NDArray[np.float32] = turn(points).cpu().numpy()
    made.flags.writeable = False  # others in the same pose get it, too
    return made


_with_own_settings = own_settings()(_on_host)


def _key(frame: SmplFrame, *, of_pose: bool = True) -> bytes:
    """Equal for two persons who differ in their place alone."""
    style = b"" if frame.style is None else b"s" + frame.style.tobytes()
    past = b"" if frame.past is None else b"p" + frame.past.tobytes()
    return frame.betas.tobytes() + (frame.pose.tobytes() + frame.up.tobytes() + past if of_pose else b"") + style


def _check_margin(margin: float | None) -> None:
    require_type(margin, (Real, NoneType), "a margin in metres, or None")
    if margin is not None and not 0 <= margin <= MAX_MARGIN:
        raise RefuError(f"the margin must be between 0 and {MAX_MARGIN} m, got {margin}")


def _style(value: ArrayLike, device: torch.device) -> Tensor:
    try:
        with torch.enable_grad():  # refuses a tensor that tracks gradients, as none are computed here
            style = checked_numbers("style", value, (N_STYLES,), np.float32, MAX_COEFFICIENT)
    except FrameError as error:
        raise GarmentError(*error.args) from error
    return torch.tensor(style, device=device)[None]
