"""What `refu simulate` does: makes a data set of simulated garments, shows progress, and summarises its card."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import Any

from tqdm import tqdm

from refu_core._engine import Engine
from refu_core.errors import SimulationError
from refu_core.simulation import GarmentDataset, Progress, SamplePlan, load_clips, simulate_dataset, simulate_sequences
from refu_lab.commands.simulate import SimulateOptions
from refu_lab.contact_sheet import contact_sheet
from refu_lab.render import save_png
from refu_lab.tables import format_table

SHEET = "samples.png"
"""Picture of random samples of a finished set, to look at before anything is trained on it."""


def simulate(options: SimulateOptions, *, engine: Engine | None = None, progress: bool) -> dict[str, Any]:
    """Simulates with a progress bar that shows what was dropped; returns the set's card.

    A finished set of samples also gets a picture of some of them, `samples.png`.

    Raises `RefuError`.
    """
    clips = None
    if options.motions is not None:
        clips = load_clips(options.motions, axes=options.input_axes, fps=options.fps)
    for note, count in Counter(note for clip in clips or () for note in clip.notes).most_common():
        print(f"motions: {note} ({count} of {len(clips or ())} files)", file=sys.stderr)
    what = options.garments, options.count, options.output
    unit = "sequence" if options.sequences else "sample"
    with tqdm(total=None, unit=unit, disable=None if progress else True) as bar:

        def show(state: Progress) -> None:
            bar.total = state.total
            bar.set_postfix(state.dropped, refresh=False)
            bar.update(state.done - bar.n)

        how: dict[str, Any] = {"motions": clips, "body": options.body, "seed": options.seed, "progress": show}
        how["engine"] = engine
        if options.sequences:
            how |= {"shapes": options.shapes, "seconds": options.seconds, "synthetic_share": options.synthetic}
            return simulate_sequences(*what, **how)
        recorded = SamplePlan.recorded_share * (1 - options.postures)
        card = simulate_dataset(*what, recorded_share=recorded, posture_share=options.postures, **how)
    if not card["counts"]["to_do"]:
        if card["counts"]["given_up"] == options.count:
            causes = ", ".join(f"{n} {cause.replace('_', ' ')}" for cause, n in card["yield"]["dropped"].items() if n)
            hint = "look at how it lies on the body and what `refu garment add` says of its mesh, or simulate more"
            raise SimulationError(f"all {options.count} samples were given up: {causes}; {hint}")
        sheet = contact_sheet(GarmentDataset(options.output), body=options.body, garments=options.garments)
        save_png(sheet, options.output / SHEET)
    return card


def simulation_table(card: dict[str, Any], output: Path) -> str:
    counts, share, figures = card["counts"], card["yield"], card.get("figures", {})
    rows = [(name.replace("_", " "), str(number)) for name, number in counts.items()]
    rows += [("yield", f"{100 * share['kept_share']:.1f} %")]
    rows += [(f"  dropped: {cause.replace('_', ' ')}", str(n)) for cause, n in share["dropped"].items() if n]
    rows += [(name.replace("_", " "), f"{value:.3f}") for name, value in figures.items()]
    return format_table((f"{card['garment']} on {card['body']}", str(output)), rows)
