"""`refu simulate`: makes data sets of simulated garments."""

from __future__ import annotations

import argparse
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from refu_core.options import setting
from refu_core.recordings import Axes
from refu_lab.commands import _common as cli

if TYPE_CHECKING:
    from refu_core._engine import Engine


@dataclass(frozen=True, kw_only=True)
class SimulateOptions:
    garments: list[str]
    count: int
    output: Path
    motions: Path | None = setting(
        None,
        "folder of at least two motion files; without one, poses are drawn at random",
        parse=cli.in_path,
        metavar="DIR",
    )
    input_axes: Axes = cli.axes_of("motions'", "z up, as ROS has it")
    fps: float | None = cli.rate_of_files()
    body: str | None = cli.worn_by()
    seed: int = cli.seeded()
    postures: float = setting(
        0.0,
        "share of poses that are everyday postures which recordings lack: arms crossed, overhead, sitting, kneeling, "
        "lying, kicks, lunges",
        parse=cli.between(0.0, 1.0),
        metavar="SHARE",
    )
    sequences: bool = setting(False, "continuous motions at 30 Hz with dynamics, instead of poses at rest")
    shapes: int = setting(5, "body shapes of the sequences", parse=cli.positive, metavar="K")
    seconds: float = setting(10.0, "length of each sequence [s]", within=(0.1, 3600.0), metavar="T")
    synthetic: float = setting(
        0.0,
        "share of the training sequences whose motions go from one drawn pose to the next",
        parse=cli.between(0.0, 1.0),
        metavar="SHARE",
    )


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "simulate",
        help="make a data set of simulated garments",
        description="Simulate collision-free garments on bodies of many poses, shapes and styles. An interrupted run "
        "continues when the same command is given again.",
    )
    parser.add_argument(
        "garments",
        nargs="+",
        metavar="GARMENT",
        help="a garment's name (refu garment list), or its .npz; several are worn together",
    )
    parser.add_argument(
        "--count",
        type=cli.positive,
        required=True,
        metavar="N",
        help="samples (or sequences), training and test together",
    )
    parser.add_argument("--output", type=cli.out_folder, required=True, metavar="DIR", help="folder of the data set")
    cli.add_options(parser, SimulateOptions)
    parser.add_argument("--device", type=cli.word, metavar="cuda", help="simulate many samples at a time on a GPU")
    cli.add_cluster(parser)
    cli.add_common(parser, run)


def run(args: argparse.Namespace) -> int:
    from refu_core import RefuError
    from refu_lab.simulate import simulate, simulation_table

    if args.sequences and args.postures:
        raise RefuError("--postures are for poses at rest: leave --sequences out")
    cli.require_use(
        args,
        dict.fromkeys(("shapes", "seconds", "synthetic"), "sequences") | {"input_axes": "motions", "fps": "motions"},
    )
    on_gpu = args.device not in (None, "cpu")
    if on_gpu and args.sequences:
        raise RefuError("a GPU simulates poses at rest alone: leave --device or --sequences out")
    if on_gpu and args.scheduler:
        raise RefuError("a GPU is this machine's: leave --device or --scheduler out")
    if find_spec("numba") is None:  # said before the work begins, which imports it
        raise ModuleNotFoundError(name="numba")
    with _engine_of(args) as engine:
        options = SimulateOptions(**cli.given(args, SimulateOptions))
        card = simulate(options, engine=engine, progress=not args.quiet)
    return cli.tell(args, simulation_table(card, args.output), card)


def _engine_of(args: argparse.Namespace) -> AbstractContextManager[Engine]:
    from refu_core._device import checked_device
    from refu_core.simulation import LaneEngine
    from refu_lab.fleet import open_engine

    if args.device and checked_device(args.device).type == "cuda":
        return nullcontext(LaneEngine(args.device, jobs=args.jobs))
    return open_engine(args.jobs, args.scheduler)
