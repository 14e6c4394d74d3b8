"""`refu benchmark`: run time against error."""

from __future__ import annotations

import argparse
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from refu_core import RefuError
from refu_core.modes import PAPER_GARMENTS
from refu_core.options import setting
from refu_lab.commands import _common as cli

if TYPE_CHECKING:
    from refu_core import GarmentPipeline, GarmentTemplate, SmplBody


@dataclass(frozen=True, kw_only=True)
class BenchmarkSizes:
    """How much is measured; the defaults are those of a full run, whose figures are kept."""

    rounds: int
    windows: int = 8
    """Number of stretches of motion."""
    frames: int = 9
    """Frames in a stretch, at 30 Hz; the first isn't counted."""
    persons: tuple[int, ...] = (1, 2, 4, 8)
    test_frames: int | None = None
    """Most frames with ground truth for each garment; None for all."""
    has_network: bool = True
    """Whether the paper's networks are measured at the paper's sizes."""
    modes: tuple[str, ...] = ("none", "approx", "hybrid", "accurate")
    starts: tuple[str, ...] = ("hybrid", "accurate")
    """Modes whose start is measured in a new process."""


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


MAIN_GARMENT = "tshirt-male"


@dataclass(frozen=True, kw_only=True)
class BenchmarkOptions:
    garments: tuple[str, ...] | None = setting(
        None, "garments to wear, the main one first (default: all)", parse=cli.names, metavar="A,B"
    )
    motions: Path | None = setting(
        None, "folder of AMASS-style .npz files (default: the bags)", parse=cli.in_path, metavar="DIR"
    )
    bags: Path = setting(Path("bags"), "the repository's bags", parse=cli.in_path, metavar="DIR")
    rounds: int = setting(3, "how many times to run all motion", parse=cli.positive, metavar="N")
    quick: bool = setting(False, "a tiny round of one garment, as continuous integration runs it")
    output: Path = setting(Path("docs/results"), "where page, data and plot go", parse=cli.out_folder, metavar="DIR")
    weights: Path | None = setting(
        None, "folder of your own weights, one subfolder per garment", parse=cli.in_path, metavar="DIR"
    )
    body: str | None = cli.worn_by()
    collider: bool = cli.off_collider()
    device: str | None = setting(None, "cpu, or cuda for both (default: cuda where there is one)")

    def __post_init__(self) -> None:
        """Raises `RefuError` for options with which nothing can be measured."""
        unknown = [name for name in self.garments or () if name not in PAPER_GARMENTS]
        if unknown:
            raise RefuError(f"no garment {unknown[0]!r}: wanted some of {', '.join(PAPER_GARMENTS)}")
        if self.device not in (None, "cpu", "cuda"):
            raise RefuError(f"no device {self.device!r}: wanted cpu or cuda")
        if self.weights is not None and not self.weights.is_dir():
            raise RefuError(f"{self.weights}: not a folder; wanted one with a folder a garment, as of refu train")

    @property
    def worn(self) -> tuple[str, ...]:
        """The garments that are measured, the main one first."""
        if self.garments is not None:
            return self.garments
        others = () if self.quick else tuple(name for name in PAPER_GARMENTS if name != MAIN_GARMENT)
        return (MAIN_GARMENT, *others)

    @property
    def devices(self) -> tuple[str, ...]:
        """Devices that compute frames, the CPU first."""
        import torch

        from refu_core._device import checked_device

        with_gpu = torch.cuda.is_available() if self.device is None else checked_device(self.device).type == "cuda"
        return ("cpu", "cuda") if with_gpu else ("cpu",)

    @property
    def sizes(self) -> BenchmarkSizes:
        return _QUICK if self.quick else BenchmarkSizes(rounds=self.rounds)

    def on_body(self, garment: str, *, device: str = "cpu") -> tuple[GarmentTemplate, SmplBody]:
        """A garment and the body that wears it. Raises `RefuError` if there is no such body."""
        from refu_core.body import load_fit
        from refu_core.garments import load_garment, worn_on

        template = load_garment(garment, device=device)
        fit = load_fit(template.body if self.body is None else self.body, device=device)
        return worn_on(template, fit), fit.body

    def load_pipeline(
        self, garment: str, *, mode: str, backbone: str, device: str, graph: bool = True
    ) -> GarmentPipeline:
        """A pipeline with one garment. Raises `WeightsError` if the backbone has no weights for it."""
        from refu_core import GarmentPipeline

        how: dict[str, Any] = {"body": self.body, "weights": self.weights, "collider": self.collider}
        return GarmentPipeline.load([garment], sdf=mode, backbone=backbone, device=device, graph=graph, **how)

    @property
    def command(self) -> str:
        """The command that measures the same again, with folder names in place of full paths."""
        parts = ["refu", "benchmark"]
        parts += ["--garments", ",".join(self.garments)] if self.garments is not None else []
        parts += ["--motions", f"{self.motions.resolve().name}/"] if self.motions is not None else []
        parts += ["--weights", f"{self.weights.resolve().name}/"] if self.weights is not None else []
        parts += ["--body", Path(self.body).name] if self.body is not None else []
        parts += ["--device", self.device] if self.device is not None else []
        parts += [] if self.collider else ["--no-collider"]
        parts += ["--quick"] if self.quick else ["--rounds", str(self.rounds)]
        return shlex.join(parts)


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "benchmark",
        help="measure run time against error of every mode and signed distance",
        description="Measure stages, signed distances, modes, persons, memory and errors side by side "
        "in one process on one core, and write a page, a JSON file and a plot.",
    )
    cli.add_options(parser, BenchmarkOptions)
    cli.add_common(parser, run)


def run(args: argparse.Namespace) -> int:
    from refu_lab.benchmark import benchmark, benchmark_text, write_results

    options = BenchmarkOptions(**cli.given(args, BenchmarkOptions))
    cli.check_writable(options.output)
    result = benchmark(options, progress=not args.quiet)
    print(benchmark_text(result))
    written = ", ".join(map(str, write_results(result, options.output)))
    return cli.tell(args, f"\nwrote {written}", result.as_dict())
