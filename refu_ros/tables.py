"""Results as text for a terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from refu_core.evaluation import Figures
    from refu_ros.replay import ReplayResult


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A plain table: the first column left-aligned, the others right-aligned."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    lines = []
    for row in (header, tuple("-" * width for width in widths), *rows):
        cells = [row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))]
        lines.append("  ".join(cells).rstrip())
    return "\n".join(lines)


def _change(before: float | None, after: float | None, digits: int) -> str:
    if before is None or after is None:
        return "-"
    return f"{before:.{digits}f} → {after:.{digits}f}"


def replay_table(result: ReplayResult) -> str:
    """What `refu replay` prints."""
    header = ("garment", "frames", "p50 ms", "p95 ms", "p99 ms", "VFCP %", "CFMP %", "depth mm", "MPVE mm")
    rows = []
    for name, after in result.after.items():
        before = result.before[name]
        latency = result.latency_ms(name)
        rows.append((name, *_row(before.all, after.all, latency)))
        if after.n_contact_frames:
            rows.append(
                ("  away from self-contact", *_row(before.contact_free_vertices, after.contact_free_vertices, None))
            )
        if 0 < after.contact_free_frames.n_frames < after.n_frames:
            rows.append(("  frames without any", *_row(before.contact_free_frames, after.contact_free_frames, None)))
    lines = [f"{result.options.input}: {result.source}", "", format_table(header, rows), ""]
    whole = result.latency_ms()
    lines.append(
        f"frame, bytes to bytes: p50 {whole['p50']:.1f} ms, p95 {whole['p95']:.1f} ms, p99 {whole['p99']:.1f} ms"
        f" ({result.options.backbone} backbone, {result.options.sdf} signed distance, {result.options.device})"
    )
    lines += [f"skipped {count} x {reason}" for reason, count in result.skips.most_common()]
    lines += [f"warning: {text}" for text in result.warnings]
    if result.interrupted:
        lines.append("interrupted: the figures are those of the frames so far")
    if result.options.output is not None:
        lines.append(f"wrote {result.options.output}")
    return "\n".join(lines)


def _row(before: Figures, after: Figures, latency: dict[str, float] | None) -> tuple[str, ...]:
    times = ("", "", "") if latency is None else tuple(f"{latency[p]:.2f}" for p in ("p50", "p95", "p99"))
    return (
        str(after.n_frames),
        *times,
        _change(before.vfcp_percent, after.vfcp_percent, 3),
        _change(before.cfmp_percent, after.cfmp_percent, 1),
        _change(before.max_depth_mm, after.max_depth_mm, 1),
        _change(before.mpve_mm, after.mpve_mm, 2),
    )
