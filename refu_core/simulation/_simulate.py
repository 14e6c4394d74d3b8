"""Making a data set of samples."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from refu_core._engine import Engine
from refu_core.simulation._plan import SamplePlan
from refu_core.simulation._poses import Clip, as_clips, split_clips
from refu_core.simulation._produce import Progress, produce
from refu_core.simulation._summary import summarise
from refu_core.simulation._worker import SimulationSettings, SlotSimulator


def simulate_dataset(
    garment: str,
    count: int,
    output: str | Path,
    *,
    motions: str | Path | Sequence[Clip] | None = None,
    body: str | Path | None = None,
    seed: int = 0,
    engine: Engine | None = None,
    test_share: float = 1 / 6,
    recorded_share: float = SamplePlan.recorded_share,
    pivots: int = SamplePlan.pivots,
    settings: SimulationSettings | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> dict[str, Any]:
    """Simulates a data set of `count` samples of a built-in garment, or goes on with one that was interrupted.

    The same arguments give the same samples, whatever `engine` is and however often the work was interrupted. Finished
    samples are on disk at any time and can be read while others are made.

    Args:
        garment: `tshirt-male` or another built-in garment.
        count: samples in the set, training and test together.
        output: directory of the set; it is made, or must hold the beginning of the same set.
        motions: a folder of motion files, or what `load_clips` has read, two at least; None for drawn poses alone.
        body: name or file of a body; None for the one the garment was cut for.
        seed: of everything that is drawn.
        engine: what shares the work among processes (`refu_lab.fleet.open_engine`); None for this one alone.
        test_share: share of the samples that is kept for the test.
        recorded_share: share of the poses that are frames of the motions; the others are drawn.
        pivots: style-shape pairs that half of the training samples share.
        settings: of simulation and selection.
        progress: called in this process after each slot.

    Returns:
        The card of the set, as it stands in `card.json`.

    Raises:
        SimulationError: motions of another layout, a full disk, a directory that holds another set, one that
            another run is writing, or processes that were killed again and again (what is finished is kept; run again
            to go on).
        MeshError: the body isn't watertight.
        BodyError, GarmentError: no such body or garment.
    """
    output = Path(output)
    clips: tuple[list[Clip], list[Clip]] = ([], [])
    recorded_share = 0.0 if motions is None else recorded_share
    plan = SamplePlan(garment, count, seed=seed, test_share=test_share, recorded_share=recorded_share, pivots=pivots)
    if motions is not None:
        clips = split_clips(as_clips(motions))
    make = partial(SlotSimulator, plan, clips, settings or SimulationSettings(), body)
    produce(make, output, engine=engine, progress=progress)
    return summarise(output)
