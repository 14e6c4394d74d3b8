"""What is tried: a pipeline and its references, trials, and how a worst case is saved to be tried again."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from refu_core._files import replacing
from refu_core._npz import read_npz
from refu_core.errors import RefuError
from refu_core.frames import N_STYLES, SmplFrame, pasts_of
from refu_core.metrics import CollisionChecker
from refu_core.modes import SdfMode
from refu_core.realtime import ContactStage, GarmentPipeline, Outfit, Wearer, dress
from refu_core.sdf import ApproxSdf, BandSdf, BodySdf, ExactSdf
from refu_lab.stress._frames import on_the_move


@dataclass(frozen=True, kw_only=True)
class Wardrobe:
    """Garments for one body, and how they are predicted."""

    garments: tuple[str, ...]
    backbone: str = "skinned"
    sdf: str = "accurate"

    @property
    def mode(self) -> str:
        return f"{self.backbone}/{self.sdf}"


class Subject:
    """One wardrobe's pipeline and its references, each made at first use."""

    def __init__(self, wardrobe: Wardrobe, *, weights: Path | None = None, collider: bool = True) -> None:
        """Loads the pipeline; raises what `GarmentPipeline.load` raises."""
        self.wardrobe = wardrobe
        self._weights, self._collider = weights, collider
        self.pipeline = self.load()

    @cached_property
    def on_skin(self) -> Subject:
        """The same wardrobe on the skin, without a collider."""
        return Subject(self.wardrobe, weights=self._weights, collider=False)

    def load(self, *garments: str) -> GarmentPipeline:
        """A pipeline that has never seen a frame, for these garments or all."""
        return GarmentPipeline.load(
            garments or self.wardrobe.garments,
            backbone=self.wardrobe.backbone,
            sdf=self.wardrobe.sdf,
            weights=self._weights,
            collider=self._collider,
        )

    @property
    def one_by_one(self) -> dict[str, GarmentPipeline]:
        """A pipeline for each garment alone: worn together, they would also be lifted off each other."""
        names = self.wardrobe.garments
        return self._alone if len(names) > 1 else {names[0]: self.pipeline}

    @cached_property
    def _alone(self) -> dict[str, GarmentPipeline]:
        return {name: self.load(name) for name in self.wardrobe.garments}

    @cached_property
    def checker(self) -> CollisionChecker:
        """Exact collisions, by winding number."""
        return CollisionChecker(self.pipeline.body.faces)

    @cached_property
    def distances(self) -> dict[str, BodySdf]:
        """The exact signed distance by tree and by cells, and the approximate one."""
        body = self.pipeline.body
        return {"exact": ExactSdf(body.faces), "band": BandSdf(body.faces), "approx": ApproxSdf(body)}

    @cached_property
    def contact_stage(self) -> ContactStage:
        """Collision handling as in the pipeline; with the exact distance if the pipeline has none."""
        mode = SdfMode(self.wardrobe.sdf)
        return ContactStage(self.pipeline.outfit, sdf=SdfMode.ACCURATE if mode is SdfMode.NONE else mode)

    @cached_property
    def outfit64(self) -> Outfit:
        """What the pipeline wears in float64, with its own copy of the networks: the reference for float32."""
        return self.pipeline.outfit.to(torch.float64)


@torch.no_grad()
def predicted(
    outfit: Outfit, frames: Sequence[SmplFrame], *, up: ArrayLike = (0.0, 1.0, 0.0)
) -> list[NDArray[np.floating]]:
    """Bodies, then garments before collision handling, in the outfit's precision: B frames [m], (B, V, 3) each.

    `up` is what `dress` takes, for every person.
    """
    none = np.zeros(N_STYLES, np.float32)
    columns = zip(*((f.pose, f.betas, none if f.style is None else f.style) for f in frames), strict=True)
    pose, betas, style = (torch.as_tensor(np.stack(one)).to(outfit.body.v_template.dtype) for one in columns)
    wearer = Wearer.of(outfit, betas, style if any(frame.style is not None for frame in frames) else None)
    past = torch.as_tensor(pasts_of(frames)).to(pose.dtype)
    dressed = dress(pose, wearer, past=past, up=torch.as_tensor(np.tile(up, (len(pose), 1))).to(pose.dtype))
    return [
        torch.stack([turn(one) for turn, one in zip(dressed.turns, found, strict=True)]).numpy()
        for found in (dressed.body, *(drape.vertices for drape in dressed.drapes.values()))
    ]


def distance_to_mesh(
    points: NDArray[np.floating], vertices: NDArray[np.floating], faces: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Distance of `points` [m], shape (N, 3), to a mesh, shape (N,), over all triangles, in float64.

    A triangle without area counts by its edges.
    """
    corners = torch.as_tensor(np.asarray(vertices, np.float64)[faces])
    best = []
    for chunk in torch.split(torch.as_tensor(np.asarray(points, np.float64)), 16):  # bounds memory: N × F × 3 numbers
        squared = torch.full((len(chunk),), torch.inf, dtype=torch.float64)
        for k in range(3):
            squared = torch.minimum(squared, _to_segments(chunk, corners[:, k], corners[:, (k + 1) % 3]))
        best.append(torch.minimum(squared, _to_planes(chunk, corners)).sqrt())
    return torch.cat(best).numpy() if best else np.zeros(0)


def _to_segments(points: torch.Tensor, start: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
    """Squared distance of each point (N, 3) to the closest of F segments."""
    along = end - start
    length2 = along.square().sum(-1)
    away = points[:, None] - start
    t = ((away * along).sum(-1) / length2.clamp_min(1e-300)).clamp(0, 1)
    return (away - t[..., None] * along).square().sum(-1).amin(1)


def _to_planes(points: torch.Tensor, corners: torch.Tensor) -> torch.Tensor:
    """Squared distance of each point (N, 3) to the closest of F triangles (F, 3, 3) that it projects into."""
    a, b, c = corners.unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    area = torch.linalg.vector_norm(normal, dim=-1)
    unit = normal / area.clamp_min(1e-300)[:, None]
    above = torch.ones(len(points), len(a), dtype=torch.bool)
    for p, q in ((a, b), (b, c), (c, a)):
        above &= ((points[:, None] - p) * torch.linalg.cross(unit, q - p)).sum(-1) >= 0
    height2 = ((points[:, None] - a) * unit).sum(-1).square()
    return torch.where(above & (area > 0), height2, torch.inf).amin(1)


_KEYS = ("check", "garments", "backbone", "sdf", "pose", "betas", "transl", "past", "style", "has_style", "seed")


class StressError(RefuError, ValueError):
    """There is nothing to try, or a trial's file can't be read."""


@dataclass(frozen=True, eq=False)
class Trial:
    """Everything needed to repeat a check."""

    frames: tuple[SmplFrame, ...]
    seed: int = 0
    """Seed of whatever else the check draws."""
    refused: int = 0
    """Number of frames that were drawn but refused by `SmplFrame` itself."""


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """What one trial, or a part of it, showed."""

    runs: int = 1
    refused: int = 0
    """How many of them were refused with an error that says why."""
    nan: int = 0
    """Numbers in the output that aren't finite."""
    deviation: float = 0.0
    """Deviation from the right output [m]."""
    limit: float = math.inf
    """The largest acceptable deviation [m], above zero."""
    faults: tuple[str, ...] = ()
    culprit: int | None = None
    """Index of the frame that showed this, if that frame alone reproduces it."""

    @property
    def badness(self) -> float:
        """How close this is to failing: 1 is at the limit."""
        if self.faults or self.nan or math.isnan(self.deviation):
            return math.inf
        return self.deviation / self.limit

    @property
    def is_failure(self) -> bool:
        return self.badness > 1


@dataclass(frozen=True)
class Check:
    """One way in which something may go wrong, and how to notice it."""

    name: str
    """`<part>: <what is tried>`."""
    draw: Callable[[np.random.Generator], Trial]
    measure: Callable[[Subject, Trial], Iterator[Measurement]]
    """Yields what it finds, part by part; the worst part counts."""
    trials: int = 1
    """Trials in one round."""
    repeats: int = 0
    """Frames that a trial runs in addition to those drawn."""
    needs_sdf: bool = False
    """Whether the mode `none` doesn't promise it."""

    def trial(self, rng: np.random.Generator) -> Trial:
        """A trial; people in frames that aren't of a motion were on the move, each in a way of their own."""
        trial = self.draw(rng)
        frames = (one if one.past is not None else on_the_move(one, rng) for one in trial.frames)
        return replace(trial, frames=tuple(frames))

    @property
    def part(self) -> str:
        """The part it belongs to: numbers, guarantees or invariance."""
        return self.name.partition(":")[0]

    def holds_for(self, wardrobe: Wardrobe) -> bool:
        return not self.needs_sdf or wardrobe.sdf != "none"

    def run(self, subject: Subject, trial: Trial) -> Measurement:
        """Measures a trial; a refusal is counted, any other error is a failure."""
        n = len(trial.frames) + trial.refused
        try:
            found = list(self.measure(subject, trial)) if trial.frames else []
        except RefuError as error:
            return Measurement(runs=n, refused=n) if str(error) else Measurement(runs=n, faults=("refused in silence",))
        except Exception as error:  # any other error is a bug
            return Measurement(runs=n, faults=(f"{type(error).__name__}: {error}",))
        if not found:
            return Measurement(runs=n, refused=n)
        return replace(
            max(found, key=lambda one: replace(one, nan=0).badness),
            runs=n + self.repeats,
            refused=trial.refused,
            nan=sum(one.nan for one in found),
            faults=tuple(fault for one in found for fault in one.faults),
        )


@dataclass(eq=False)
class Tally:
    """What all trials of a check in one mode showed."""

    case: str
    mode: str
    runs: int = 0
    refused: int = 0
    failures: int = 0
    nan: int = 0
    max_deviation: float = 0.0
    """Largest deviation of all trials [m]. If limits depend on the frame, it isn't always that of the worst trial."""
    faults: list[str] = field(default_factory=list)
    """The first few."""
    worst: Measurement | None = None
    worst_trial: tuple[Wardrobe, Trial] | None = None
    """The worst trial, and what was worn in it."""

    def add(self, wardrobe: Wardrobe, trial: Trial, measured: Measurement) -> None:
        self.runs += measured.runs
        self.refused += measured.refused
        self.failures += measured.is_failure
        self.nan += measured.nan
        if math.isfinite(measured.deviation):
            self.max_deviation = max(self.max_deviation, measured.deviation)
        if len(self.faults) < 3:
            self.faults += [fault for fault in measured.faults if fault not in self.faults]
        if self.worst is None or measured.badness > self.worst.badness:
            if measured.culprit is not None:
                trial = replace(trial, frames=(trial.frames[measured.culprit],))
            self.worst, self.worst_trial = measured, (wardrobe, trial)

    def as_dict(self) -> dict[str, Any]:
        """A row of the results, ready for JSON; lengths are in metres, None if they aren't finite."""
        worst = self.worst or Measurement()
        figures = {"deviation_m": worst.deviation, "limit_m": worst.limit, "worst_share_of_limit": worst.badness}
        return {
            **{name: getattr(self, name) for name in ("case", "mode", "runs", "failures", "nan", "refused")},
            "max_deviation_m": self.max_deviation,
            **{name: value if math.isfinite(value) else None for name, value in figures.items()},
            "faults": self.faults,
        }


def save_trial(path: Path, check: str, wardrobe: Wardrobe, trial: Trial) -> Path:
    """Writes a trial to `path`, an npz that `load_trial` reads."""
    frames = trial.frames
    styles = [np.zeros(N_STYLES, np.float32) if frame.style is None else frame.style for frame in frames]
    told = {"check": check, "seed": np.int64(trial.seed), "style": styles, "past": pasts_of(frames), **asdict(wardrobe)}
    told |= {name: [getattr(frame, name) for frame in frames] for name in ("pose", "betas", "transl")}
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        np.savez_compressed(file, has_style=np.array([frame.style is not None for frame in frames]), **told)
    return path


def load_trial(path: Path) -> tuple[str, Wardrobe, Trial]:
    """The check's name, the wardrobe and the trial in a file that `save_trial` wrote.

    Raises `StressError`: the file is missing, damaged or something else.
    """
    data = read_npz(path, keys=_KEYS, error=StressError, wanted="a trial that refu stress has written")
    missing = [key for key in _KEYS if key not in data]
    if missing:
        raise StressError(f"{path}: not a trial that refu stress has written, it lacks {', '.join(missing)}")
    garments = tuple(map(str, np.atleast_1d(data["garments"])))
    wardrobe = Wardrobe(garments=garments, backbone=str(data["backbone"]), sdf=str(data["sdf"]))
    try:
        columns = zip(*(data[key] for key in ("pose", "betas", "transl", "past", "style", "has_style")), strict=True)
        frames = tuple(
            SmplFrame(p, b, t, style=style if has_style else None, past=past)
            for p, b, t, past, style, has_style in columns
        )
        return str(data["check"]), wardrobe, Trial(frames, int(data["seed"]))
    except (RefuError, TypeError, ValueError) as error:
        raise StressError(f"{path}: its frames can't be used: {error}") from error
