"""Write bags with ground truth from simulated sets: `eval_<garment>` and `eval_<garment>_sequence`.

    python bags/make_evaluation_bags.py data/tshirt-male data/skirt-female       # 96 unseen test samples of each
    python bags/make_evaluation_bags.py data/tshirt-male-sequences-5             # ten seconds of unseen sequences
    python bags/make_evaluation_bags.py data/outfit                              # eval_<outer>_over_<inner>

A bag carries SMPL parameters with the style on /smpl_params and the simulated garments on /ground_truth, so
`refu replay BAG --garments GARMENT,GARMENT` says how far off a prediction is (MPVE). A garment is a marker of points:
its triangles would take more than three times the space.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from msg_adapters import INPUT_TYPES, MARKER_ARRAY, POINTS, BagWriter, encoder_for, vertices_ros_from_smpl
from msg_adapters.markers import encode_lists
from refu_core import SmplFrame, load_body, load_garment
from refu_core.simulation import GarmentDataset, GarmentSequences, SequencePlan, open_dataset
from refu_core.simulation._plan import TEST
from refu_lab.truth import TOPIC as TRUTH_TOPIC

START_NS = 1_700_000_000_000_000_000
TOPIC = "/smpl_params"
SAMPLES_A_SECOND = 2
TRUTH_EVERY = 3
"""In a sequence every third frame has ground truth: 10 a second."""
SEQUENCE_SECONDS = 10.0
PAUSE_NS = 2 * 10**9
"""Pause between two sequences."""
MOST_BYTES = 8_000_000
FrameAndTruth = tuple[SmplFrame, NDArray[np.float32] | None]
"""A frame and its ground truth, if any: the vertices of all garments at zero translation [m], shape (N, 3)."""


def spread_samples(dataset: GarmentDataset, count: int, seed: int) -> NDArray[np.intp]:
    """Test samples in which recorded and drawn poses and all style-shape pairs keep their proportions.

    They are evenly spaced in an ordered list, from a random start.
    """
    test = np.flatnonzero(dataset.test)
    recorded = dataset.column("clip")[test] >= 0
    ordered = test[np.lexsort((dataset.column("slot")[test], dataset.column("pair")[test], recorded))]
    count = min(count, len(ordered))
    first = np.random.default_rng(seed).random()
    return ordered[((np.arange(count) + first) * len(ordered) / count).astype(np.intp)]


def sample_moments(dataset: GarmentDataset, count: int, seed: int) -> Iterator[FrameAndTruth]:
    """Unrelated frames, each standing on the floor."""
    body = load_body(load_garment(next(iter(dataset.parts))).body)
    quantum = dataset.card["quantum_m"]
    for k, index in enumerate(spread_samples(dataset, count, seed)):
        sample = dataset.sample(int(index))
        posed = body(sample.pose[None], torch.from_numpy(sample.betas)[None]).vertices[0]
        # Rounded like the garment's own numbers: unrounded ones hardly compress.
        height = np.round(-float(posed[:, 1].min()) / quantum) * quantum
        stamp = START_NS + k * 10**9 // SAMPLES_A_SECOND
        frame = SmplFrame(sample.pose, sample.betas, np.array([0, height, 0]), style=sample.style, stamp_ns=stamp)
        yield frame, sample.vertices


def sequence_moments(sequences: GarmentSequences, *, seconds: float = SEQUENCE_SECONDS) -> Iterator[FrameAndTruth]:
    """About `seconds` of the test sequences that are simulated first (one at least), with pauses in between.

    Every third frame has ground truth, if that frame is in the set.
    """
    plan = SequencePlan(**sequences.card["plan"])
    numbers = [number for block in plan.blocks() for number in block if plan.split_of(number) == TEST]
    quantum, stamp = sequences.card["quantum_m"], START_NS
    for number in numbers[: max(1, round(seconds / plan.seconds))]:
        (index,) = np.flatnonzero(sequences.column("slot") == number)
        sequence = sequences.sequence(int(index))
        for t in range(len(sequence)):
            transl = np.round(sequence.transl[t].astype(np.float64) / quantum) * quantum
            now = stamp + round(t * 1e9 / sequence.fps)
            frame = SmplFrame(sequence.pose[t], sequence.betas, transl, style=sequence.style, stamp_ns=now)
            yield frame, sequence.vertices(t) if t % TRUTH_EVERY == 0 and sequence.kept[t] else None
        stamp = now + PAUSE_NS


def write_bag(path: Path, parts: Mapping[str, slice], moments: Iterator[FrameAndTruth]) -> tuple[int, int]:
    """Write one bag, a rosbag2 directory; returns the number of frames and of those with ground truth."""
    encode = encoder_for("multiarray")
    colors = {garment: (*load_garment(garment).card.color, 1.0) for garment in parts}
    frames = truths = 0
    with BagWriter(path, overwrite=True) as bag:
        bag.add_topic(TOPIC, INPUT_TYPES["multiarray"])
        bag.add_topic(TRUTH_TOPIC, MARKER_ARRAY)
        for frame, vertices in moments:
            frames += 1
            bag.write(TOPIC, encode(frame), log_time_ns=frame.stamp_ns)
            if vertices is not None:
                truths += 1
                points = vertices_ros_from_smpl(vertices.astype(np.float64) + frame.transl)
                for garment, part in parts.items():
                    cloud = (garment, frame.stamp_ns, (0, 0, 0, 0, 0, 0, 1), points[part])
                    data = encode_lists(POINTS, [cloud], frame_id="map", color=colors[garment], size=0.004)
                    bag.write(TRUTH_TOPIC, data, log_time_ns=frame.stamp_ns)
    return frames, truths


def main() -> None:
    """Write a bag for each set."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "sets", nargs="+", type=Path, help="folders that refu simulate made, with or without --sequences"
    )
    parser.add_argument("--output", type=Path, default=Path(__file__).parent)
    parser.add_argument("--count", type=int, default=96, help="test samples of each set (96)")
    parser.add_argument("--seed", type=int, default=0, help="of their choice (0)")
    arguments = parser.parse_args()
    for directory in arguments.sets:
        rows = open_dataset(directory)
        path = arguments.output / f"eval_{'_over_'.join(reversed(rows.parts)).replace('-', '_')}"
        if isinstance(rows, GarmentSequences):
            path = path.with_name(path.name + "_sequence")
            moments = sequence_moments(rows)
        else:
            moments = sample_moments(rows, arguments.count, arguments.seed)
        frames, truths = write_bag(path, rows.parts, moments)
        size = sum(file.stat().st_size for file in path.iterdir())
        print(f"{path}: {frames} frames, {truths} with ground truth, {size / 1e6:.1f} MB")
        if size > MOST_BYTES:
            parser.exit(1, f"{path}: larger than {MOST_BYTES / 1e6:g} MB, give a smaller --count\n")


if __name__ == "__main__":
    main()
