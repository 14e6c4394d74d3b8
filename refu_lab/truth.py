"""Ground truth that a bag carries beside its body parameters: garments as markers on a topic of their own.

Also predictions for its frames, which the networks weren't trained on: σ is fitted to their errors and checked against
them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import msg_adapters as adapters
from refu_core import GarmentPipeline, GarmentTemplate, SmplFrame
from refu_core.errors import GarmentError
from refu_core.history import PoseHistory
from refu_core.outputs import RADIUS_90, SigmaMap, bend_of, fit_sigma

TOPIC = "/ground_truth"
"""Topic of a MarkerArray a frame, with the stamp of its body parameters; a marker's `ns` is the garment's name.

Its points are the garment's vertices (type POINTS), or the corners of its triangles (TRIANGLE_LIST).
"""


@dataclass(frozen=True, eq=False)
class GroundTruth:
    """Ground-truth garments by name and stamp."""

    garments: Mapping[str, Mapping[int, NDArray[np.float64]]] = field(default_factory=dict)
    """Vertices in SMPL axes with the translation [m], shape (V, 3), by stamp [ns]."""

    @classmethod
    def of_bag(
        cls, path: Path, faces: Mapping[str, NDArray[np.int64]], *, axes: adapters.InputAxes = "smpl"
    ) -> GroundTruth:
        """The ground truth in the bag at `path` of the garments whose faces (F, 3) are given.

        Raises `AdapterError`: the bag can't be read, or a garment in it has another topology.
        """
        garments: dict[str, dict[int, NDArray[np.float64]]] = {name: {} for name in faces}
        with adapters.BagReader(path) as reader:
            if TOPIC not in {topic.name for topic in reader.topics}:
                return cls()
            for message in reader.messages([TOPIC]):
                for marker in adapters.decode_marker_array(message.data):
                    if marker.ns in faces:
                        vertices = _vertices(marker, faces[marker.ns])
                        if axes == "smpl":
                            vertices = adapters.vertices_smpl_from_ros(vertices)
                        garments[marker.ns][marker.stamp_ns] = np.ascontiguousarray(vertices)
        return cls(garments)

    def of(self, garment: str, frame: SmplFrame) -> NDArray[np.float64] | None:
        """The true garment without the translation [m], shape (V, 3); None if the bag has none at the frame's stamp."""
        vertices = self.garments.get(garment, {}).get(frame.stamp_ns)
        return None if vertices is None else vertices - frame.transl


def _vertices(marker: adapters.Marker, faces: NDArray[np.int64]) -> NDArray[np.float64]:
    if marker.type != adapters.POINTS:
        return adapters.vertices_from_points(marker.points, faces)
    count = int(faces.max()) + 1
    if marker.points.shape != (count, 3):
        raise adapters.DecodeError(f"{TOPIC}: wanted the {count} vertices of {marker.ns}, got {marker.points.shape}")
    return marker.points


def garments_of(bag: Path) -> list[str]:
    """Sorted names of the garments whose truth a bag holds. Raises `AdapterError` for a bag that can't be read."""
    with adapters.BagReader(bag) as reader:
        if TOPIC not in {topic.name for topic in reader.topics}:
            return []
        return sorted({m.ns for found in reader.messages([TOPIC]) for m in adapters.decode_marker_array(found.data)})


class TrueFrame(NamedTuple):
    """One frame with its ground truth."""

    frame: SmplFrame
    truth: NDArray[np.float64]
    """The garment without the translation [m], shape (V, 3)."""
    pair: int
    """Number of the frame's style-shape pair."""


def moments_of(bag: Path, garment: GarmentTemplate) -> list[TrueFrame]:
    """The frames of a bag that come with the garment's truth.

    Raises `RefuError`: the bag can't be read, or there is none of this garment.
    """
    truth = GroundTruth.of_bag(bag, {garment.name: garment.faces.cpu().numpy()})
    found, history = [], PoseHistory()
    for record in adapters.iter_smpl_frames(bag):
        if record.frame is not None:
            frame, true = history(record.frame), truth.of(garment.name, record.frame)
            if true is not None:
                found.append((frame, true))
    if not found:
        raise GarmentError(f"{bag}: no ground truth of {garment.name} in it")
    keys = [np.concatenate((one.betas, np.zeros(4) if one.style is None else one.style)) for one, _ in found]
    _, pairs = np.unique(np.round(np.stack(keys), 4), axis=0, return_inverse=True)
    return [TrueFrame(*one, int(pair)) for one, pair in zip(found, pairs.reshape(-1), strict=True)]


class HeldOut(NamedTuple):
    """N samples of one garment."""

    garment: GarmentTemplate
    errors: NDArray[np.float64]
    """Distance of each predicted vertex to the true one [m], shape (N, V)."""
    poses: NDArray[np.float32]
    """[rad], shape (N, 24, 3)."""
    pairs: NDArray[np.intp]
    """Number of each sample's style-shape pair, shape (N,)."""


def held_out(bag: Path, garment: str, *, every: int = 1, weights: Path | None = None) -> HeldOut:
    """Predicts a garment in one of `every` so many frames of a bag that come with its truth.

    `weights` is a folder of your own weights, in place of those that ship. Raises `RefuError` for a bag that can't be
    read or has no truth of this garment, and where there is no such garment.
    """
    pipeline = GarmentPipeline.load([garment], weights=weights)
    (template,) = pipeline.garments.values()
    moments = moments_of(bag, template)[::every]
    errors = [np.linalg.norm(pipeline(one.frame)[template.name].local - one.truth, axis=1) for one in moments]
    pairs = np.array([one.pair for one in moments])
    return HeldOut(template, np.stack(errors), np.stack([one.frame.pose for one in moments]), pairs)


def coverage(found: SigmaMap, samples: HeldOut) -> float:
    """Share of the true vertices within the 90 % interval."""
    held = [
        np.mean(errors <= RADIUS_90 * found.at(float(bend)))
        for errors, bend in zip(samples.errors, bend_of(samples.garment, samples.poses), strict=True)
    ]
    return float(np.mean(held))


def cross_checked(samples: HeldOut) -> float:
    """Share of the true vertices within the 90 % interval, for each style-shape pair with σ fitted to the others."""
    shares: list[float] = []
    for pair in np.unique(samples.pairs):
        is_out = samples.pairs == pair
        found = fit_sigma(samples.garment, samples.errors[~is_out], samples.poses[~is_out])
        out = HeldOut(samples.garment, samples.errors[is_out], samples.poses[is_out], samples.pairs[is_out])
        shares += [coverage(found, out)] * int(is_out.sum())
    return float(np.mean(shares))
