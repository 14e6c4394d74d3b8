"""`refu train`: trains a garment's networks on a data set."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from refu_core.modes import DEFAULT_MARGIN, MAX_MARGIN
from refu_core.options import setting
from refu_core.recordings import Axes
from refu_lab.commands import _common as cli

BEYOND = ("lying", "legs", "heels")
"""`refu_core.backbones.KINDS`, named without importing torch."""
TRAIN_MODES = ("none", "hybrid", "approx", "accurate", "collision-approx", "collision-accurate")


@dataclass(frozen=True, kw_only=True)
class TrainOptions:
    garment: str
    data: tuple[Path, ...]
    network: str = setting(
        "garment",
        "sdf: the paper's network for the body's distance (preset paper or small); dynamics: what moving cloth does "
        "beyond the tailornet of --mode in --output, from sequences; lying, legs (apart or drawn up or back), heels "
        "(raised behind): what cloth does beyond it in such postures",
        choices=("garment", "sdf", "dynamics", *BEYOND),
    )
    mode: str = setting(
        "hybrid",
        "hybrid, approx or accurate: with ReFU; none: the backbone alone; collision-approx or collision-accurate: a "
        "collision loss without ReFU, the paper's baseline",
        choices=TRAIN_MODES,
    )
    backbone: str = setting("tailornet", "tailornet, mlp or gcnn", metavar="NAME")
    preset: str = setting("realtime", "realtime or paper", metavar="NAME")
    output: Path | None = setting(
        None, "folder of the weights (default: weights/GARMENT)", parse=cli.out_folder, metavar="DIR"
    )
    scale: str = setting(
        "vertex",
        "what ReFU's scale is predicted from: vertex (the paper's), shared (Alt. 1), distance (Alt. 2), or fixed at 1",
        choices=("vertex", "shared", "distance", "fixed"),
    )
    margin: float | None = setting(
        None,
        f"clearance that ReFU is trained to keep [m] ({DEFAULT_MARGIN:g})",
        parse=cli.between(0.0, MAX_MARGIN),
        metavar="M",
    )
    unblended: bool = setting(False, "pushed vertices don't take their neighbours along")
    body: str | None = cli.worn_by()
    like: str | None = setting(
        None,
        "carry the shipped networks of this related garment over: for sets of a hundred samples; writes all modes. "
        "With --network dynamics: learning starts from that garment's",
        metavar="GARMENT",
    )
    start: Path | None = setting(
        None,
        "the backbone goes on learning from a garment's weights in this folder, those that ship "
        "(refu_core/weights/GARMENT) or your own; a ReFU layer stays as it is",
        parse=cli.in_path,
        metavar="DIR",
    )
    joints: tuple[str, ...] = setting(
        (),
        "joints that those weights are told of from now on, too, as spine1,left_shoulder",
        parse=cli.names,
        metavar="A,B",
    )
    rehearse: int | None = setting(
        None,
        "ask those weights for so many bodies of the plans that they were trained on, too, lest they forget",
        parse=cli.positive,
        metavar="N",
    )
    further: int = setting(
        0,
        "ask about so many further bodies, drawn as those plans draw theirs",
        parse=cli.positive,
        metavar="N",
    )
    motions: Path | None = setting(None, "the motions of those plans", parse=cli.in_path, metavar="DIR")
    input_axes: Axes = cli.axes_of("motions'", "z up, as ROS has it")
    fps: float | None = cli.rate_of_files()
    seed: int = cli.seeded()
    steps: int | None = setting(None, "steps of each stage (default: the preset's)", parse=cli.positive, metavar="N")
    device: str = setting("cpu", "cpu or cuda")

    @property
    def folder(self) -> Path:
        """Where the weights go; `GarmentPipeline.load(weights="weights")` finds those in weights/."""
        from refu_core import load_garment

        return Path("weights") / load_garment(self.garment).name if self.output is None else self.output


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "train",
        help="train a garment's networks on a data set",
        description="Train a backbone on a data set of refu simulate, alone or together with ReFU. An interrupted run "
        "continues when the same command is given again; torchrun shares it among GPUs.",
    )
    parser.add_argument("garment", metavar="GARMENT", help="a garment's name (refu garment list), or its .npz")
    parser.add_argument(
        "--data",
        type=cli.in_path,
        nargs="+",
        default=(),
        metavar="DIR",
        help="the garment's data set, or several of plans with different seeds; none to learn from --rehearse alone",
    )
    cli.add_options(parser, TrainOptions)
    cli.add_common(parser, run)


def run(args: argparse.Namespace) -> int:
    from refu_lab.train import train, training_table

    needed = {} if args.network in BEYOND else {"motions": "rehearse", "rehearse": "start"}
    needed |= {"fps": "motions", "joints": "start", "further": "rehearse"}
    cli.require_use(args, needed)
    options = TrainOptions(**cli.given(args, TrainOptions))
    card = train(options, progress=not args.quiet)
    return cli.tell(args, training_table(card, options), card)
