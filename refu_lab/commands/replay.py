"""`refu replay`: recorded motion through the pipeline, measured."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from refu_core.keypoints import LAYOUTS
from refu_core.modes import DEFAULT_GARMENTS, DEFAULT_MARGIN, BackboneName
from refu_lab.commands._common import (
    EXIT_INTERRUPTED,
    add_axes,
    add_body,
    add_collider,
    add_common,
    check_writable,
    given,
    in_path,
    names,
    numbers,
    out_bag,
    out_folder,
    positive,
    word,
    write_json,
)

if TYPE_CHECKING:
    import argparse


def add(commands: Any) -> None:
    """The command's parser."""
    parser = commands.add_parser(
        "replay",
        help="run recorded motion through the pipeline and measure it",
        description="Run every frame of a bag or motion file through the pipeline, write the garments as a bag, and "
        "evaluate them with exact collision checks.",
    )
    parser.add_argument(
        "input",
        type=in_path,
        metavar="INPUT",
        help="an .mcap, a rosbag2 directory, or a file of motion: AMASS, pose estimators', BVH (docs/guide/inputs.md)",
    )
    parser.add_argument(
        "--output", type=out_bag, metavar="OUT", help="bag to write: OUT.mcap, or a directory for rosbag2"
    )
    parser.add_argument("--report", type=out_folder, metavar="DIR", help="write DIR/index.html with plots and pictures")
    parser.add_argument(
        "--garments",
        type=names,
        default=DEFAULT_GARMENTS,
        metavar="A,B",
        help=f"garments of one body, by name or .npz (default: {','.join(DEFAULT_GARMENTS)})",
    )
    parser.add_argument(
        "--backbone",
        default=BackboneName.AUTO,
        metavar="NAME",
        help="tailornet, mlp, gcnn, or skinned: no network; auto (default): tailornet where its weights ship",
    )
    parser.add_argument(
        "--sdf", default="hybrid", metavar="MODE", help="hybrid (default), approx, accurate, or none for no ReFU"
    )
    parser.add_argument(
        "--weights", type=in_path, metavar="DIR", help="folder with a folder a garment of weights of one's own"
    )
    parser.add_argument(
        "--margin",
        type=float,
        default=DEFAULT_MARGIN,
        metavar="M",
        help=f"clearance from the skin [m] ({DEFAULT_MARGIN:g})",
    )
    parser.add_argument("--betas", type=numbers(10), metavar="B0,…", help="shape to use instead of the recorded one")
    parser.add_argument("--style", type=numbers(4), metavar="G0,…", help="garment style γ")
    parser.add_argument(
        "--speed", choices=("max", "real"), default="max", help="as fast as possible (default), or paced"
    )
    parser.add_argument(
        "--topic", type=word, metavar="NAME", help="input topic, where a bag has several of SMPL parameters"
    )
    parser.add_argument(
        "--input-type",
        type=word,
        metavar="TYPE",
        help="multiarray, joint_state, pose_array, smpl_msgs, keypoint_poses or keypoint_markers",
    )
    parser.add_argument(
        "--keypoints", default="zed38", choices=LAYOUTS, help="which points of the body, with keypoints as input"
    )
    parser.add_argument("--person", type=word, metavar="NAME", help="whose motion, where the input has several people")
    add_axes(parser, "recorded", "those of the frame itself, left as they are")
    parser.add_argument("--frame-id", type=word, default="map", metavar="ID", help="frame_id of the markers (map)")
    parser.add_argument("--device", default="cpu", metavar="DEVICE", help="cpu (default) or cuda")
    parser.add_argument("--max-frames", type=positive, metavar="N", help="stop after N frames")
    add_body(parser)
    parser.add_argument(
        "--betas-from",
        type=word,
        metavar="FILE",
        help="an SMPL file whose betas the recording has: the built-in mesh follows them",
    )
    parser.add_argument(
        "--betas-source",
        choices=("message", "builtin"),
        default="message",
        help="message (default): the recorded betas are those of --body or --betas-from, and without either of unknown "
        "meaning, which is warned of; builtin: the built-in body's own",
    )
    add_collider(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace an output that is there already")
    add_common(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Does what was asked; returns the exit code."""
    from refu_lab.replay import ReplayOptions, replay
    from refu_lab.tables import replay_table

    if args.report is not None:
        import matplotlib  # noqa: F401, ICN001  (what is missing is said before the replay, not after it)
    for path in (args.json, args.report):
        check_writable(path)
    result = replay(ReplayOptions(**given(args, ReplayOptions)), progress=not args.quiet)
    print(replay_table(result))
    write_json(args.json, result.as_dict())
    if args.report is not None and result.frames:
        from refu_lab.report import write_report

        print(f"report: {write_report(result, args.report, progress=not args.quiet)}")
    return EXIT_INTERRUPTED if result.interrupted else 0
