"""`refu stress`: tries to break the pipeline."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from refu_core.modes import PAPER_GARMENTS
from refu_core.options import SettingsError, setting
from refu_lab.commands import _common as cli

PARTS = ("numbers", "guarantees", "invariance", "soak")
MODES: tuple[tuple[str, str], ...] = (("skinned", "accurate"), ("auto", "accurate"), ("auto", "hybrid"))
"""Backbone and signed distance of the modes that are tried by default."""


@dataclass(frozen=True, kw_only=True)
class StressOptions:
    parts: tuple[str, ...] = setting(PARTS, "what is tried", metavar="A,B")
    garments: tuple[str, ...] = setting(PAPER_GARMENTS, "garments of any body", metavar="A,B")
    backbone: str | None = setting(None, f"one mode (default: {', '.join(map(' '.join, MODES))})", metavar="NAME")
    sdf: str | None = setting(None, "accurate, hybrid, approx or none, with --backbone", metavar="MODE")
    weights: Path | None = setting(
        None, "folder of your own weights, one subfolder per garment", parse=cli.in_path, metavar="DIR"
    )
    frames: int | None = setting(None, "frames of each soak (3000)", parse=cli.positive, metavar="N")
    persons: int = setting(1, "persons in a soak; the frame of each counts", parse=cli.positive, metavar="P")
    rounds: int | None = setting(None, "turns of each check (3)", parse=cli.positive, metavar="N")
    hours: float | None = None
    quick: bool = False
    seed: int = cli.seeded()
    output: Path | None = setting(None, "where the worst trials go (stress)", parse=cli.out_folder, metavar="DIR")
    collider: bool = cli.off_collider()

    def __post_init__(self) -> None:
        unknown = [part for part in self.parts if part not in PARTS]
        if unknown:
            raise SettingsError(f"no part {unknown[0]!r}: wanted {', '.join(PARTS)}")
        if self.hours is not None and not 0 < self.hours < math.inf:
            raise SettingsError(f"hours must be above zero, got {self.hours:g}")

    @property
    def modes(self) -> Sequence[tuple[str, str]]:
        """Backbone and signed distance of each mode."""
        if self.backbone is None and self.sdf is None:
            return MODES
        backbone = self.backbone or "skinned"
        return [(backbone, self.sdf or ("accurate" if backbone == "skinned" else "hybrid"))]

    @property
    def n_rounds(self) -> int:
        return self.rounds or (1 if self.quick or self.hours is not None else 3)

    @property
    def n_frames(self) -> int:
        return self.frames or (10_000_000 if self.hours is not None else 200 if self.quick else 3_000)


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "stress",
        help="try to break the pipeline: numbers, guarantees, invariance, endurance",
        description="Run random and adversarial frames through the pipeline and compare the results with float64 and "
        "with what is promised; the worst trial of each check is kept as a file. Exits with 1 where one failed.",
    )
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--quick", action="store_true", help="each check once: for CI")
    length.add_argument(
        "--hours", type=cli.between(0, 10_000), metavar="H", help="run for this long (default: some minutes)"
    )
    cli.add_options(parser, StressOptions)
    parser.add_argument(
        "--replay", type=cli.in_path, metavar="FILE", help="run one saved trial again, and nothing else"
    )
    cli.add_common(parser, run)


def run(args: argparse.Namespace) -> int:
    from refu_lab.stress import StressResult, replay_trial, run_stress, stress_table

    options = StressOptions(**{"output": Path("stress")} | cli.given(args, StressOptions))
    if args.replay is not None:
        result = StressResult(tallies=[replay_trial(args.replay, weights=options.weights, collider=options.collider)])
    else:
        result = run_stress(options, progress=not args.quiet)
    return cli.tell(args, stress_table(result), result.as_dict(), code=cli.EXIT_CHECK_FAILED if result.failures else 0)
