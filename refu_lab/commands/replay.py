"""`refu replay`: runs recorded motion through the pipeline and measures it."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from msg_adapters import INPUT_TYPES, KEYPOINT_TYPES, InputAxes
from refu_core import RefuError
from refu_core.keypoints import LAYOUTS
from refu_core.options import DressOptions, check, setting
from refu_core.recordings import Axes
from refu_lab.commands import _common as cli
from refu_lab.tables import REPLAY_TITLE

if TYPE_CHECKING:
    from refu_core import GarmentPipeline


@dataclass(frozen=True, kw_only=True)
class RecordingOptions(DressOptions):
    """A recording, how it is read, and how the person in it is dressed."""

    input: Path
    topic: str | None = setting(None, "input topic, where a bag has several with SMPL parameters", metavar="NAME")
    input_type: str | None = setting(None, "type of the topic's messages", choices=(*INPUT_TYPES, *KEYPOINT_TYPES))
    keypoints: str | None = setting(None, "which points of the body, with keypoints as input (zed38)", choices=LAYOUTS)
    person: str | None = setting(None, "person to dress, where the input has several", metavar="NAME")
    input_axes: Axes = cli.axes_of("recorded", "those of the frame itself, left as they are")
    frame_id: str = setting(
        "",
        "frame of the garments (default: map, or the input's own with --input-axes frame: its name then says what is "
        "up, -y with optical in it, else z)",
        metavar="ID",
    )
    fps: float | None = cli.rate_of_files()

    def __post_init__(self) -> None:
        check(self)

    @property
    def axes(self) -> InputAxes:
        """The axes that the frames' roots, and so the garments, are in."""
        return "frame" if self.input_axes == "frame" or self.input_type in KEYPOINT_TYPES else "smpl"

    def load_pipeline(self) -> GarmentPipeline:
        """The pipeline that these options ask for. Raises `RefuError` for invalid options."""
        from refu_core._device import one_thread

        with one_thread():
            return self.load(margin=self.margin, style=self.style if any(self.style) else None)


@dataclass(frozen=True, kw_only=True)
class ReplayOptions(RecordingOptions):
    output: Path | None = None
    speed: Literal["max", "real"] = setting("max", "as fast as possible, or paced (real)", choices=("max", "real"))
    max_frames: int | None = setting(None, "stop after N frames", parse=cli.positive, metavar="N")
    overwrite: bool = setting(False, "replace an existing output")
    evaluate: bool = setting(True, "check every frame for collisions; if not, only its latency is kept")
    with_body: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.output is not None:
            cli.require_apart(self.input, self.output)


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "replay",
        help="run recorded motion through the pipeline and measure it",
        description="Run every frame of a bag or motion file through the pipeline, write the garments as a bag, and "
        "evaluate them with exact collision checks.",
    )
    parser.add_argument(
        "input",
        type=cli.place,
        nargs="+",
        metavar="INPUT",
        help="an .mcap or .db3, a rosbag2 directory, or a file of motion: AMASS, pose estimators', BVH "
        "(docs/guide/inputs.md); several of them, folders, globs, URLs",
    )
    parser.add_argument(
        "--output",
        type=cli.place_for(cli.out_bag),
        metavar="OUT",
        help="bag to write: OUT.mcap, or a directory for rosbag2; of several inputs: a folder or URL for NAME.mcap",
    )
    parser.add_argument(
        "--report",
        type=cli.place_for(cli.out_folder),
        metavar="DIR",
        help="write DIR/index.html with plots and pictures; with several inputs, a row and a page for each",
    )
    cli.add_options(parser, ReplayOptions)
    parser.add_argument(
        "--no-body",
        dest="with_body",
        action="store_false",
        help="leave the body out of the output, which makes it 40 %% smaller",
    )
    parser.add_argument(
        "--progress",
        choices=("bar", "lines"),
        default="bar",
        help="bar (default), or lines `progress DONE TOTAL` on the standard output, for programs; TOTAL 0: unknown",
    )
    parser.add_argument("--again", action="store_true", help="with several inputs: run finished ones again")
    cli.add_cluster(parser)
    cli.add_common(parser, run)


def run(args: argparse.Namespace) -> int:
    from refu_lab.fleet import is_plain

    if args.report is not None:
        if args.evaluate is False:
            raise RefuError("a report is of evaluated frames: leave out --report or --no-evaluate")
        page = Path(args.report) / "index.html"
        if not args.overwrite and page.is_file() and f"<title>{REPLAY_TITLE}".encode() not in page.read_bytes():
            msg = f"{page}: is there already, and no report of refu replay; name another folder, or --overwrite it"
            raise RefuError(msg)
        import matplotlib  # noqa: F401, ICN001  (what is missing is said before the replay, not after it)
    urls = [text for text in (args.output, args.report) if text is not None and "://" in text]
    if is_plain(args.input) and not urls and args.jobs is None and args.scheduler is None:
        return _replay_one(args)
    return _replay_many(args)


def _replay_one(args: argparse.Namespace) -> int:
    from refu_lab.sources import open_source
    from refu_lab.tables import replay_table

    report = None if args.report is None else Path(args.report)
    output = None if args.output is None else Path(args.output)
    options = ReplayOptions(**cli.given(args, ReplayOptions) | {"input": Path(args.input[0]), "output": output})
    source = open_source(options)  # a bad bag is reported before torch is imported

    from refu_lab.replay import replay

    told = partial(print, "progress", flush=True) if args.progress == "lines" else None
    result = replay(options, source=source, progress=not args.quiet, told=told)
    cli.tell(args, replay_table(result), result.as_dict())
    if report is not None and result.frames:
        from refu_lab.report import write_report

        print(f"report: {write_report(result, report, progress=not args.quiet)}")
    return cli.EXIT_INTERRUPTED if result.interrupted else 0


def _replay_many(args: argparse.Namespace) -> int:
    from refu_lab.fleet import find_recordings, fleet_table, open_engine
    from refu_lab.fleet.replay import FleetOptions, replay_fleet

    if args.output is not None and args.output.endswith(".mcap"):
        msg = f"--output {args.output}: of several inputs that is a folder, which gets a bag of each; name one"
        raise RefuError(msg)
    recordings = find_recordings(args.input, results=(args.output, args.report))
    each = ReplayOptions(**cli.given(args, ReplayOptions) | {"input": Path(), "output": None})
    options = FleetOptions(replay=each, output=args.output, report=args.report, again=args.again or args.overwrite)
    with open_engine(args.jobs, args.scheduler) as engine:
        result = replay_fleet(recordings, options, engine=engine, progress=not args.quiet)
    cli.tell(args, fleet_table(result), result.as_dict())
    if args.output is not None and len(result.failed) < len(result.rows):
        print(f"bags: {args.output.rstrip('/')}/NAME.mcap")
    if args.report is not None:
        print(f"report: {args.report.rstrip('/')}/index.html")
    return cli.EXIT_INTERRUPTED if result.interrupted else cli.EXIT_BAD_INPUT if result.failed else 0
