"""The HTML report of a replay: the worst, a median and the best frame in 3D, and curves over all frames."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from refu_core import RefuError
from refu_core._files import replacing
from refu_core.metrics import CollisionChecker
from refu_core.recordings import upright_turn
from refu_lab.plots import new_axes, save_svg
from refu_lab.render import SKIN, RenderMesh, Viewpoint, collision_mesh, render, save_png
from refu_lab.replay import Findings, FrameResult, ReplayResult, When
from refu_lab.tables import REPLAY_TITLE, html_page, html_table, meanings, replay_columns
from refu_lab.turntable import STYLE as TURNTABLE_STYLE
from refu_lab.turntable import Frame, turntable

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PICTURE = (420, 640)
STYLE = Path(__file__).with_suffix(".css").read_text(encoding="utf-8")


def write_report(result: ReplayResult, folder: Path, *, progress: bool = False) -> Path:
    """Writes `index.html` and its plots and pictures into `folder`, which is made if it isn't there.

    Returns the path of the page, which refers only to files in its own folder. Raises `RefuError`: the folder can't be
    written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _plot(result, folder)
        frames, turned = _draw_frames(result, folder, progress=progress)
        page = folder / "index.html"
        with replacing(page) as file:
            file.write(_page(result, frames, turned).encode(errors="backslashreplace"))
    except OSError as error:
        raise RefuError(f"{folder}: the report can't be written: {error.strerror or error}") from error
    return page


def _plot(result: ReplayResult, folder: Path) -> None:
    start = result.frames[0].frame.stamp_ns
    times = np.array([1e-9 * (f.frame.stamp_ns - start) for f in result.frames])
    drawn, axes = new_axes(3, size=(10.8, 7.5), sharex=True)
    axes[-1].set_xlabel("time [s]")
    inside, pairs, depth = axes
    for name in result.after:
        records = [f.garments[name] for f in result.frames]
        colour = result.pipeline.garments[name].card.color
        for when, alpha, width in (("before", 0.45, 1.2), ("after", 1.0, 1.8)):
            found = np.array([getattr(record, when) for record in records]) * (1, 1, 1e3)
            for ax, values in zip((inside, pairs, depth), found.T, strict=True):
                ax.plot(times, values, color=colour, alpha=alpha, lw=width, label=f"{name}, {when}")
    inside.set_ylabel("vertices inside")
    pairs.set_ylabel("intersecting pairs")
    depth.set_ylabel("deepest [mm]")
    for ax in (inside, pairs):
        ax.set_yscale("symlog", linthresh=1)
        ax.set_ylim(bottom=0)
    _legend(inside, columns=len(result.after))
    save_svg(drawn, folder / "penetration.svg")

    drawn, (latency,) = new_axes(size=(10.8, 2.5))
    stages = list(result.frames[0].stage_ms)
    spent = [[f.stage_ms[stage] for f in result.frames] for stage in stages]
    rest = [f.latency_ms - sum(f.stage_ms.values()) for f in result.frames]
    latency.stackplot(times, [*spent, rest], labels=[*stages, "decode and encode"], alpha=0.75, lw=0)
    latency.set(xlabel="time [s]", ylabel="latency [ms]")
    latency.set_ylim(0, 1.3 * float(np.percentile([f.latency_ms for f in result.frames], 99)))
    _legend(latency, columns=len(stages) + 1)
    save_svg(drawn, folder / "latency.svg")


def _legend(axes: Axes, *, columns: int) -> None:
    """Puts the legend above the axes, where it covers no curve."""
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2, fontsize=8, ncols=columns, frameon=False
    )


def _draw_frames(result: ReplayResult, folder: Path, *, progress: bool) -> tuple[list[Frame], str]:
    """Renders the worst, a median and the best frame, before and after; returns the frames and their HTML turntable."""
    pipeline = result.pipeline
    order = sorted(range(len(result.frames)), key=lambda i: result.frames[i].badness)
    chosen = {"worst": order[-1], "median": order[len(order) // 2], "best": order[0]}
    body_faces = pipeline.body.faces.cpu().numpy()
    checker = CollisionChecker(body_faces)
    colours = {"body": SKIN, **{name: one.card.color for name, one in pipeline.garments.items()}}
    frames = []
    start = result.frames[0].frame.stamp_ns
    # Frames may come in axes of their own (a camera's, or z up); the pictures have y up.
    roots = np.array([one.frame.pose[0] for one in result.frames], np.float64)
    turn = (upright_turn(roots) if result.options.axes == "frame" else np.eye(3)).astype(np.float32)
    with tqdm(total=2 * len(chosen), desc="pictures", unit="picture", disable=None if progress else True) as bar:
        for name, index in chosen.items():
            frame = result.frames[index]
            output = pipeline(frame.frame)
            checker.update(output.body)
            body, yaw = output.body @ turn.T, _front(frame, turn)
            camera = Viewpoint.framing(body, size=_PICTURE, yaw=yaw)
            title = f"{name.capitalize()} frame, number {index}, {1e-9 * (frame.frame.stamp_ns - start):.2f} s"
            poses = []
            for when in ("before", "after"):
                drawn = [RenderMesh(body, body_faces)]
                for garment, mesh in output.items():
                    vertices = mesh.raw if when == "before" else mesh.local
                    found = checker.check(vertices, mesh.faces)
                    drawn.append(collision_mesh(vertices @ turn.T, mesh.faces, found, colour=colours[garment]))
                save_png(render(drawn, camera=camera, size=_PICTURE), folder / f"{name}_{when}.png")
                poses.append(drawn)
                bar.update()
            captions = _caption(frame, "before"), _caption(frame, "after")
            frames.append(Frame(name, title, poses[0], poses[1], *captions, yaw))
    return frames, turntable(colours, frames)


def _front(frame: FrameResult, turn: NDArray[np.float32]) -> float:
    """Yaw of the camera that looks at the person's front, a little from the side [degrees]."""
    forward = turn @ Rotation.from_rotvec(frame.frame.pose[0]).apply([0.0, 0.0, 1.0])
    return float(np.degrees(np.arctan2(forward[0], forward[2]))) + 25.0


def _caption(frame: FrameResult, when: When) -> str:
    found: dict[str, Findings] = {name: getattr(record, when) for name, record in frame.garments.items()}
    return "; ".join(
        f"{name}: {one.n_inside} vertices inside, {one.n_pairs} intersecting pairs" for name, one in found.items()
    )


def _page(result: ReplayResult, frames: Sequence[Frame], turned: str) -> str:
    data = result.as_dict()
    notes = [f"{count} messages skipped: {reason}" for reason, count in result.skips.most_common()]
    notes += result.warnings + (["The replay was interrupted."] if result.interrupted else [])
    warning = "".join(f'<p class="warn">{html.escape(note)}</p>' for note in notes)
    figures = "".join(map(_figure, frames))
    frame, shift = data["latency_ms"], data["skin_shift_mm"]
    header, rows = replay_columns(data["garments"])
    body = f"""<p class="note">{html.escape(result.source)}; backbone {html.escape(data["backbone"])}, signed distance
{html.escape(data["sdf"])}, margin {1e3 * data["margin_m"]:g} mm, {html.escape(data["device"])}.
{data["frames"]} frames; skin moved to be free of itself: {shift["mean"]:.2f} mm on average,
{shift["largest"]:.1f} mm at most.
A whole frame, bytes to bytes: p50 {frame["p50"]:.1f}, p95 {frame["p95"]:.1f}, p99 {frame["p99"]:.1f} ms.</p>{warning}
<h2>Figures</h2><div class='wide'>{html_table(header, rows)}</div>
<p class="note">{meanings(header)}. Collisions, of vertices and of triangles, are found by exact checks of every frame,
against the collider: the posed body with its overlaps (an arm in the flank, thighs in a squat) pulled apart. A - is a
figure that the recording doesn't give.</p>
<h2>Worst, median and best frame</h2>{turned}
<p class="note">The worst frame has the most vertices inside and intersecting pairs of triangles after collision
handling; of those with equally many, or none, the one with the deepest vertex, then with the most pairs before.
Drag to turn; click, then the wheel to come nearer; a double click goes back. Red: colliding triangles
and vertices inside the body.</p>
<h2>Penetration over time</h2>
<div class="wide"><img class="plot" src="penetration.svg" alt="penetration over time"></div>
<h2>Latency</h2>
<div class="wide"><img class="plot" src="latency.svg" alt="latency over time"></div>
<h2>Pictures</h2><div class="pictures">{figures}</div>"""
    return html_page(f"{REPLAY_TITLE}{result.options.input.name}", body, style=STYLE + TURNTABLE_STYLE)


def _figure(frame: Frame) -> str:
    """A frame before and after, side by side, under one caption."""
    before, after = map(html.escape, (frame.before_caption, frame.after_caption))
    images = "".join(
        f'<span title="{when}"><img src="{frame.name}_{when}.png" alt="{when}: {caption}"></span>'
        for when, caption in (("before", before), ("after", after))
    )
    return f"""<figure><div class="pair">{images}</div><figcaption><b>{html.escape(frame.title)}</b><br>
Before: {before}.<br>After: {after}.</figcaption></figure>"""
