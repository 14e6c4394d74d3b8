"""What `refu benchmark` is asked for, and how much of it is measured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from refu_core import GarmentPipeline, GarmentTemplate, RefuError, SmplBody, load_garment
from refu_core.body import load_fit
from refu_core.garments import PAPER_GARMENTS, worn_on

OUTPUT = Path("docs/results")
BAGS = Path("bags")
MAIN_GARMENT = "tshirt-male"


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    """What to measure and how; the fields are the options of `refu benchmark`."""

    garments: tuple[str, ...] | None = None
    """None for all, or in a quick run for the first; what is measured of one garment alone is of the first."""
    motions: Path | None = None
    """Folder of AMASS-style .npz files; None for the bags."""
    bags: Path = BAGS
    """Folder of the repository's bags."""
    rounds: int = 3
    quick: bool = False
    output: Path = OUTPUT
    weights: Path | None = None
    body: str | None = None
    """Who wears them, a body's name or file; None for the one that each is cut for."""
    collider: bool = True
    device: str | None = None
    """`cuda` adds its rows to those of the CPU; None adds them where there is a GPU."""

    def __post_init__(self) -> None:
        """Raises `RefuError` for options of which nothing can be measured."""
        unknown = [name for name in self.garments or () if name not in PAPER_GARMENTS]
        if unknown:
            msg = f"no garment {unknown[0]!r}: wanted some of {', '.join(PAPER_GARMENTS)}"
            raise RefuError(msg)
        if self.device not in (None, "cpu", "cuda"):
            msg = f"no device {self.device!r}: wanted cpu or cuda"
            raise RefuError(msg)
        if self.device == "cuda" and not torch.cuda.is_available():
            msg = "no device 'cuda': this torch build or machine has no CUDA; use cpu"
            raise RefuError(msg)
        if self.weights is not None and not self.weights.is_dir():
            msg = f"{self.weights}: not a folder; wanted one with a folder a garment, as refu train writes them"
            raise RefuError(msg)

    @property
    def worn(self) -> tuple[str, ...]:
        """The garments that are measured, the main one first."""
        if self.garments is not None:
            return self.garments
        others = () if self.quick else tuple(name for name in PAPER_GARMENTS if name != MAIN_GARMENT)
        return (MAIN_GARMENT, *others)

    @property
    def devices(self) -> tuple[str, ...]:
        """Where frames are computed, the CPU first."""
        with_gpu = torch.cuda.is_available() if self.device is None else self.device == "cuda"
        return ("cpu", "cuda") if with_gpu else ("cpu",)

    @property
    def sizes(self) -> BenchmarkSizes:
        """How much is measured."""
        return _QUICK if self.quick else BenchmarkSizes(rounds=self.rounds)

    def on_body(self, garment: str, *, device: str = "cpu") -> tuple[GarmentTemplate, SmplBody]:
        """A garment, and who wears it. Raises `RefuError` where there is no such body."""
        template = load_garment(garment, device=device)
        fit = load_fit(template.body if self.body is None else self.body, device=device)
        return worn_on(template, fit), fit.body

    def load_pipeline(
        self, garment: str, *, mode: str, backbone: str, device: str, graph: bool = True
    ) -> GarmentPipeline:
        """A pipeline of one garment. Raises `WeightsError` where there are no weights of the backbone for it."""
        return GarmentPipeline.load(
            [garment],
            body=self.body,
            sdf=mode,
            backbone=backbone,
            weights=self.weights,
            device=device,
            graph=graph,
            collider=self.collider,
        )

    @property
    def command(self) -> str:
        """The command that measures the same again, with the names of folders alone."""
        parts = ["refu benchmark"]
        parts += [f"--garments {','.join(self.garments)}"] if self.garments is not None else []
        parts += [f"--motions {self.motions.resolve().name}/"] if self.motions is not None else []
        parts += [f"--weights {self.weights.resolve().name}/"] if self.weights is not None else []
        parts += [f"--body {Path(self.body).name}"] if self.body is not None else []
        parts += [] if self.collider else ["--no-collider"]
        parts += ["--quick"] if self.quick else [f"--rounds {self.rounds}"]
        return " ".join(parts)


@dataclass(frozen=True, kw_only=True)
class BenchmarkSizes:
    """How much is measured; the defaults are those of a run whose figures are kept."""

    rounds: int
    windows: int = 8
    """Stretches of motion."""
    frames: int = 9
    """Frames of a stretch, at 30 Hz, the first of which isn't counted."""
    persons: tuple[int, ...] = (1, 2, 4, 8)
    test_frames: int | None = None
    """Frames with ground truth of a garment; None for all there are."""
    has_network: bool = True
    """Whether the paper's networks are measured at the paper's sizes."""
    modes: tuple[str, ...] = ("none", "approx", "hybrid", "accurate")
    starts: tuple[str, ...] = ("hybrid", "accurate")
    """Modes of which a process of its own is started."""


_QUICK = BenchmarkSizes(
    rounds=1,
    windows=2,
    frames=4,
    persons=(1, 2),
    test_frames=3,
    has_network=False,
    modes=("hybrid", "accurate"),
    starts=("hybrid",),
)
