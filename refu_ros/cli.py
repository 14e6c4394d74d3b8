"""The command `refu`. Every subcommand has `--help` and `--json FILE`; bad input is one clear line and exit code 2."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from refu_core import RefuError, __version__

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from types import FrameType

EXIT_CHECK_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130
EVALUATION_TABLES = (
    *("comparison", "ablation", "gcnn", "sequence", "alpha", "sdf", "time", "laplacian", "unseen", "energy", "motion"),
)
"""As `refu_core.evaluation.reproduction.TABLES`, which isn't imported for every command."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """One line, as for every other kind of bad input."""
        self.exit(EXIT_BAD_INPUT, f"{self.prog}: error: {message} (see {self.prog} --help)\n")


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        msg = "wanted one name or several with commas between them"
        raise argparse.ArgumentTypeError(msg)
    return names


def _numbers(count: int) -> Callable[[str], tuple[float, ...]]:
    def parse(text: str) -> tuple[float, ...]:
        try:
            numbers = tuple(float(number) for number in text.split(","))
        except ValueError:
            numbers = ()
        if not 1 <= len(numbers) <= count or any(number != number or abs(number) == float("inf") for number in numbers):
            msg = f"wanted up to {count} finite numbers with commas between them, got {text!r}"
            raise argparse.ArgumentTypeError(msg)
        return numbers + (0.0,) * (count - len(numbers))

    return parse


def _positive(text: str) -> int:
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        msg = f"wanted a whole number above zero, got {text!r}"
        raise argparse.ArgumentTypeError(msg)
    return number


def _shard(text: str) -> tuple[int, int]:
    index, _, count = text.partition("/")
    if not (index.isdigit() and count.isdigit() and int(index) < int(count)):
        msg = f"wanted I/N with 0 <= I < N, such as 0/4, got {text!r}"
        raise argparse.ArgumentTypeError(msg)
    return int(index), int(count)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="refu", description="Garments on SMPL bodies, free of body-garment collisions.")
    parser.add_argument("--version", action="version", version=f"refu {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)
    _add_replay(commands)
    _add_simulate(commands)
    _add_train(commands)
    _add_evaluate(commands)
    _add_benchmark(commands)
    _add_stress(commands)
    _add_info(commands)
    _add_fuzz(commands)
    return parser


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results as JSON")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def _add_replay(commands: Any) -> None:
    parser = commands.add_parser(
        "replay",
        help="run recorded motion through the pipeline and measure it",
        description="Run every frame of a bag or motion file through the pipeline, write the garments as a bag, and "
        "evaluate them with exact collision checks.",
    )
    parser.add_argument(
        "input", type=Path, metavar="INPUT", help="an .mcap, a rosbag2 directory, or an AMASS-style .npz"
    )
    parser.add_argument("--output", type=Path, metavar="OUT", help="bag to write: OUT.mcap, or a directory for rosbag2")
    parser.add_argument("--report", type=Path, metavar="DIR", help="write DIR/index.html with plots and pictures")
    parser.add_argument(
        "--garments",
        type=_names,
        default=("tshirt-male", "short-pant-male"),
        metavar="A,B",
        help="garments of one body (default: tshirt-male,short-pant-male)",
    )
    parser.add_argument(
        "--backbone", default="tailornet", metavar="NAME", help="tailornet (default), mlp, gcnn, or skinned: no network"
    )
    parser.add_argument(
        "--sdf", default="hybrid", metavar="MODE", help="hybrid (default), approx, accurate, or none for no ReFU"
    )
    parser.add_argument(
        "--weights", type=Path, metavar="DIR", help="folder with a folder a garment of weights of one's own"
    )
    parser.add_argument("--margin", type=float, default=0.004, metavar="M", help="clearance from the skin [m] (0.004)")
    parser.add_argument("--betas", type=_numbers(10), metavar="B0,…", help="shape to use instead of the recorded one")
    parser.add_argument("--style", type=_numbers(4), metavar="G0,…", help="garment style γ")
    parser.add_argument(
        "--speed", choices=("max", "real"), default="max", help="as fast as possible (default), or paced"
    )
    parser.add_argument("--topic", metavar="NAME", help="input topic, where a bag has several of SMPL parameters")
    parser.add_argument("--input-type", metavar="TYPE", help="multiarray, joint_state, pose_array or smpl_msgs")
    parser.add_argument(
        "--input-axes",
        choices=("smpl", "frame"),
        default="smpl",
        help="axes of the recorded root: SMPL's world, y up (default), or those of the frame itself",
    )
    parser.add_argument("--frame-id", default="map", metavar="ID", help="frame_id of the markers (map)")
    parser.add_argument("--device", default="cpu", metavar="DEVICE", help="cpu (default) or cuda")
    parser.add_argument("--max-frames", type=_positive, metavar="N", help="stop after N frames")
    parser.add_argument("--overwrite", action="store_true", help="replace an output that is there already")
    _add_common(parser)
    parser.set_defaults(run=_replay)


def _add_simulate(commands: Any) -> None:
    parser = commands.add_parser(
        "simulate",
        help="make a data set of simulated garments",
        description="Simulate collision-free garments on bodies of many poses, shapes and styles. An interrupted run "
        "goes on when the same command is given again.",
    )
    parser.add_argument("garment", metavar="GARMENT", help="tshirt-male or another built-in garment")
    parser.add_argument(
        "--count", type=_positive, required=True, metavar="N", help="samples (or sequences), training and test together"
    )
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder of the data set")
    parser.add_argument(
        "--motions",
        type=Path,
        metavar="DIR",
        help="folder of AMASS-style .npz files, two at least (default: drawn poses alone)",
    )
    parser.add_argument(
        "--body", metavar="BODY", help="a body's name or file (default: the one the garment is cut for)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of everything that is drawn (0)")
    parser.add_argument("--processes", type=_positive, default=1, metavar="P", help="processes, a thread each (1)")
    parser.add_argument("--shard", type=_shard, default=(0, 1), metavar="I/N", help="make the I-th of N parts, from 0")
    parser.add_argument(
        "--sequences", action="store_true", help="continuous motions at 30 Hz with dynamics, instead of poses at rest"
    )
    parser.add_argument("--shapes", type=_positive, default=5, metavar="K", help="body shapes of the sequences (5)")
    parser.add_argument("--seconds", type=float, default=10.0, metavar="T", help="length of each sequence [s] (10)")
    _add_common(parser)
    parser.set_defaults(run=_simulate)


def _add_train(commands: Any) -> None:
    parser = commands.add_parser(
        "train",
        help="train a garment's networks on a data set",
        description="Train a backbone on a data set of refu simulate, alone or together with ReFU. An interrupted run "
        "goes on when the same command is given again; torchrun shares it among GPUs.",
    )
    parser.add_argument("garment", metavar="GARMENT", help="tshirt-male or another built-in garment")
    parser.add_argument("--data", type=Path, required=True, metavar="DIR", help="the garment's data set")
    parser.add_argument(
        "--mode",
        default="hybrid",
        metavar="MODE",
        help="hybrid (default), approx or accurate: with ReFU; none: the backbone alone; collision-approx or "
        "collision-accurate: a collision loss without ReFU, the paper's baseline",
    )
    parser.add_argument("--backbone", default="tailornet", metavar="NAME", help="tailornet (default), mlp or gcnn")
    parser.add_argument("--preset", default="realtime", metavar="NAME", help="realtime (default) or paper")
    parser.add_argument("--output", type=Path, metavar="DIR", help="folder of the weights (default: weights/GARMENT)")
    parser.add_argument(
        "--network",
        default="garment",
        metavar="NAME",
        help="garment (default), or sdf: the paper's network for the body's distance (preset paper or small)",
    )
    parser.add_argument(
        "--scale",
        default="vertex",
        metavar="KIND",
        help="what ReFU's scale is predicted from: vertex (default, the paper's), shared (Alt. 1), distance (Alt. 2), "
        "or fixed at 1",
    )
    parser.add_argument("--margin", type=float, metavar="M", help="clearance that ReFU is trained to keep [m] (0.004)")
    parser.add_argument("--unblended", action="store_true", help="pushed vertices don't take their neighbours along")
    parser.add_argument(
        "--body", metavar="BODY", help="a body's name or file (default: the one the garment is cut for)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of everything that is drawn (0)")
    parser.add_argument("--steps", type=_positive, metavar="N", help="steps of each stage (default: the preset's)")
    parser.add_argument("--device", default="cpu", metavar="DEVICE", help="cpu (default) or cuda")
    _add_common(parser)
    parser.set_defaults(run=_train)


def _add_evaluate(commands: Any) -> None:
    parser = commands.add_parser(
        "evaluate",
        help="make the paper's tables and figures on own data, beside the paper's figures",
        description="Run every method on the test samples of data sets, and write a page and a JSON file a table. "
        "A method whose networks aren't trained stays in its table, with the command that trains it.",
    )
    parser.add_argument(
        "--data", type=Path, nargs="+", default=[], metavar="DIR", help="data sets of refu simulate, one a garment"
    )
    parser.add_argument("--table", choices=(*EVALUATION_TABLES, "all"), default="all", help="one table (default: all)")
    parser.add_argument(
        "--weights",
        type=Path,
        nargs="+",
        default=[],
        metavar="DIR",
        help="folders with GARMENT/NAME.safetensors that are looked at before the weights that ship",
    )
    parser.add_argument("--motions", type=Path, metavar="DIR", help="folder of AMASS-style .npz files, for motion")
    parser.add_argument("--output", type=Path, metavar="DIR", help="where the pages go (docs/results)")
    parser.add_argument("--cache", type=Path, metavar="DIR", help="keep what was measured, and use it again")
    parser.add_argument("--every", type=_positive, default=1, metavar="N", help="every N-th test sample (1)")
    parser.add_argument(
        "--motion-every", type=_positive, default=10, metavar="N", help="every N-th frame of a motion (10)"
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="measure the bags of --data (default: bags) instead, and exit with 1 where a figure has fallen",
    )
    parser.add_argument(
        "--reference",
        type=Path,
        metavar="FILE",
        help="figures that --quick holds its own against (docs/results/quick.json)",
    )
    parser.add_argument("--set-reference", action="store_true", help="write that file instead of comparing with it")
    _add_common(parser)
    parser.set_defaults(run=_evaluate)


def _add_benchmark(commands: Any) -> None:
    parser = commands.add_parser(
        "benchmark",
        help="measure run time against error of every mode and signed distance",
        description="Measure stages, signed distances, modes, persons, growth, skips, memory and errors side by side "
        "in one process on one core, and write a page, a JSON file and a plot.",
    )
    parser.add_argument("--garments", type=_names, metavar="A,B", help="what is worn, the main one first (all)")
    parser.add_argument("--motions", type=Path, metavar="DIR", help="folder of AMASS-style .npz files (the bags)")
    parser.add_argument("--bags", type=Path, default=Path("bags"), metavar="DIR", help="the repository's bags (bags)")
    parser.add_argument("--rounds", type=_positive, default=3, metavar="N", help="times that all motion is run (3)")
    parser.add_argument(
        "--quick", action="store_true", help="a tiny round of one garment, as continuous integration runs it"
    )
    parser.add_argument(
        "--no-skip", action="append", default=[], metavar="NAME", help="compute what would be skipped; may be repeated"
    )
    parser.add_argument(
        "--weights", type=Path, metavar="DIR", help="folder with a folder a garment of one's own weights"
    )
    parser.add_argument("--device", metavar="DEVICE", help="cpu, or cuda for both (default: cuda where there is one)")
    parser.add_argument("--output", type=Path, metavar="DIR", help="where page, data and plot go (docs/results)")
    _add_common(parser)
    parser.set_defaults(run=_benchmark)


def _add_stress(commands: Any) -> None:
    parser = commands.add_parser(
        "stress",
        help="try to break the pipeline: numbers, guarantees, invariance, endurance",
        description="Run random and adversarial frames through the pipeline and hold the results against float64 and "
        "against what is promised; the worst trial of each check is kept as a file. Exits with 1 where one failed.",
    )
    parser.add_argument(
        "--parts",
        type=_names,
        default=("numbers", "guarantees", "invariance", "soak"),
        metavar="A,B",
        help="numbers, guarantees, invariance, soak (default: all)",
    )
    parser.add_argument(
        "--garments",
        type=_names,
        default=("shirt-male", "tshirt-male", "short-pant-male", "skirt-female"),
        metavar="A,B",
        help="garments of any body (default: all four)",
    )
    parser.add_argument("--backbone", metavar="NAME", help="one mode (default: skinned accurate and tailornet hybrid)")
    parser.add_argument("--sdf", metavar="MODE", help="accurate, hybrid, approx or none, with --backbone")
    parser.add_argument(
        "--weights", type=Path, metavar="DIR", help="folder with a folder a garment of weights of one's own"
    )
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--quick", action="store_true", help="each check once: for CI")
    length.add_argument("--hours", type=float, metavar="H", help="go on for so long (default: some minutes)")
    parser.add_argument("--frames", type=_positive, metavar="N", help="frames of each soak (3000)")
    parser.add_argument(
        "--persons", type=_positive, default=1, metavar="P", help="persons of a soak, each one's frame counting (1)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of everything that is drawn (0)")
    parser.add_argument(
        "--output", type=Path, default=Path("stress"), metavar="DIR", help="where the worst trials go (stress)"
    )
    parser.add_argument("--replay", type=Path, metavar="FILE", help="try one of them again, and nothing else")
    parser.add_argument(
        "--node", action="store_true", help="instead, the live node at 30 Hz, recording to OUTPUT/node (needs rclpy)"
    )
    _add_common(parser)
    parser.set_defaults(run=_stress)


def _add_info(commands: Any) -> None:
    parser = commands.add_parser(
        "info", help="what is installed, built in and usable", description="What is installed."
    )
    parser.add_argument("--body", metavar="FILE", help="say what a body model (.npz or official .pkl) holds instead")
    _add_common(parser)
    parser.set_defaults(run=_info)


def _add_fuzz(commands: Any) -> None:
    parser = commands.add_parser(
        "fuzz",
        help="give every reader damaged and hostile input",
        description="Mutate messages, bags, motions, bodies, weights, data sets and parameters, and read them: what "
        "ends in anything but a result or a clear refusal is a finding, and the exit code 1.",
    )
    parser.add_argument("--target", type=_names, default=(), metavar="A,B", help="what to fuzz (default: everything)")
    parser.add_argument("--executions", type=_positive, metavar="N", help="of each target (default: its own number)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of all mutations (0)")
    parser.add_argument("--hours", type=float, metavar="T", help="go on with other seeds for so long [h]")
    parser.add_argument("--output", type=Path, metavar="DIR", help="keep the input of each finding")
    _add_common(parser)
    parser.set_defaults(run=_fuzz)


def _replay(args: argparse.Namespace) -> int:
    from refu_ros.replay import ReplayOptions, replay
    from refu_ros.tables import replay_table

    for path in (args.json, args.report):
        _check_writable(path)
    given = {key: value for key, value in vars(args).items() if key in ReplayOptions.__dataclass_fields__}
    result = replay(ReplayOptions(**given), progress=not args.quiet)
    print(replay_table(result))
    _write_json(args.json, result.as_dict())
    if args.report is not None and result.frames:
        from refu_ros.report import write_report

        print(f"report: {write_report(result, args.report, progress=not args.quiet)}")
    return EXIT_INTERRUPTED if result.interrupted else 0


def _simulate(args: argparse.Namespace) -> int:
    from refu_ros.simulate import simulate, simulation_table

    _check_writable(args.json)
    card = simulate(
        args.garment,
        args.count,
        args.output,
        motions=args.motions,
        body=args.body,
        seed=args.seed,
        processes=args.processes,
        shard=args.shard,
        sequences=args.sequences,
        shapes=args.shapes,
        seconds=args.seconds,
        progress=not args.quiet,
    )
    print(simulation_table(card, args.output))
    _write_json(args.json, card)
    return 0


def _train(args: argparse.Namespace) -> int:
    from refu_ros.train import TrainOptions, train, training_table

    for path in (args.json, args.output):
        _check_writable(path)
    options = TrainOptions(
        **{key: value for key, value in vars(args).items() if key in TrainOptions.__dataclass_fields__}
    )
    card = train(options, progress=not args.quiet)
    print(training_table(card, options))
    _write_json(args.json, card)
    return 0


def _evaluate(args: argparse.Namespace) -> int:
    for path in (args.json, args.output, args.cache):
        _check_writable(path)
    if args.quick:
        from refu_ros.quick import quick_check, quick_table

        result = quick_check(args.data, reference=args.reference, renew=args.set_reference, progress=not args.quiet)
        print(quick_table(result))
        _write_json(args.json, result.as_dict())
        return 0 if result.is_passed else EXIT_CHECK_FAILED
    from refu_ros.evaluate import OUTPUT, EvaluateOptions, evaluate, results_dict, results_text

    output = args.output or OUTPUT
    options = EvaluateOptions(
        data=tuple(args.data),
        table=args.table,
        weights=tuple(args.weights),
        motions=args.motions,
        output=output,
        cache=args.cache,
        every=args.every,
        motion_every=args.motion_every,
    )
    tables = evaluate(options, progress=not args.quiet)
    print(results_text(tables, output))
    _write_json(args.json, results_dict(tables))
    return 0


def _benchmark(args: argparse.Namespace) -> int:
    from refu_ros.benchmark import OUTPUT, BenchmarkOptions, benchmark, benchmark_text, write_results

    given = {key: value for key, value in vars(args).items() if key in BenchmarkOptions.__dataclass_fields__}
    options = BenchmarkOptions(**{**given, "no_skip": tuple(args.no_skip), "output": args.output or OUTPUT})
    for path in (args.json, options.output):
        _check_writable(path)
    result = benchmark(options, progress=not args.quiet)
    print(benchmark_text(result))
    print(f"\nwrote {', '.join(map(str, write_results(result, options.output)))}")
    _write_json(args.json, result.as_dict())
    return EXIT_INTERRUPTED if result.interrupted else 0


def _info(args: argparse.Namespace) -> int:
    from refu_ros.info import collect, describe_body

    facts = collect() if args.body is None else describe_body(args.body)
    for name, value in facts.items():
        print(f"{name:>12}  {value}")
    _write_json(args.json, facts)
    return 0


def _stress(args: argparse.Namespace) -> int:
    from refu_ros.stress import StressOptions, replay_worst, run_stress, stress_table

    for path in (args.json, args.output):
        _check_writable(path)
    options = StressOptions(
        **{key: value for key, value in vars(args).items() if key in StressOptions.__dataclass_fields__}
    )
    if args.node:
        from refu_ros.stress_node import node_options, node_table, soak_node

        soak = soak_node(args.output / "node", **node_options(options), progress=not args.quiet)
        print(node_table(soak))
        _write_json(args.json, soak.as_dict())
        return EXIT_CHECK_FAILED if soak.failures else 0
    if args.replay is not None:
        result = replay_worst(args.replay, options)
    else:
        result = run_stress(
            options, progress=not args.quiet, report=lambda so_far: _write_json(args.json, so_far.as_dict())
        )
    print(stress_table(result))
    _write_json(args.json, result.as_dict())
    return EXIT_CHECK_FAILED if result.failures else 0


def _fuzz(args: argparse.Namespace) -> int:
    from refu_ros.fuzz import FuzzOptions, fuzz, fuzz_dict, fuzz_progress, fuzz_table

    for path in (args.json, args.output):
        _check_writable(path)
    options = FuzzOptions(
        targets=args.target, executions=args.executions, seed=args.seed, hours=args.hours, output=args.output
    )
    with fuzz_progress(quiet=args.quiet) as report:
        rows = fuzz(options, report=report)
    print(fuzz_table(rows))
    _write_json(args.json, fuzz_dict(rows))
    return EXIT_CHECK_FAILED if any(row.failures for row in rows) else 0


def _check_writable(path: Path | None) -> None:
    """Says so before the work is done, not after it."""
    if path is None:
        return
    existing = path.absolute()
    while not existing.exists():
        existing = existing.parent
    if not os.access(existing, os.W_OK) or (existing != path.absolute() and not existing.is_dir()):
        msg = f"{path}: can't be written, {existing} is not a writable folder"
        raise RefuError(msg)


def _write_json(path: Path | None, content: dict[str, Any]) -> None:
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; returns the exit code."""
    signal.signal(signal.SIGTERM, _interrupt)  # a terminated replay closes its bag like an interrupted one
    try:
        args = _parser().parse_args(arguments)
        code: int = args.run(args)
    except RefuError as error:
        print(f"refu: error: {' '.join(str(error).split())}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except OSError as error:
        print(f"refu: error: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except ModuleNotFoundError as error:  # an extra's package; those of the core are imported by every command
        print(f'refu: error: {error.name} is not installed: pip install "refu-ros[train]"', file=sys.stderr)
        return EXIT_BAD_INPUT
    except RuntimeError as error:
        from refu_core._device import is_device_loss

        if not is_device_loss(error):
            raise
        reason = str(error).splitlines()[0]
        print(f"refu: error: the device has failed: {reason}; run it again, or on the cpu", file=sys.stderr)
        return EXIT_CHECK_FAILED
    except KeyboardInterrupt:
        print("refu: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    return code


if __name__ == "__main__":
    sys.exit(main())
