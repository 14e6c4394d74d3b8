"""Predictions beside truth that their network hasn't seen: what σ is fitted to, and checked against."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

import msg_adapters as adapters
from refu_core import GarmentPipeline, GarmentTemplate
from refu_core.errors import GarmentError
from refu_core.outputs import RADIUS_90, SigmaMap, bend_of
from refu_lab.truth import GroundTruth

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


class HeldOut(NamedTuple):
    """N samples of one garment."""

    garment: GarmentTemplate
    errors: NDArray[np.float64]
    """Distance of each predicted vertex to the true one [m], shape (N, V)."""
    poses: NDArray[np.float32]
    """[rad], shape (N, 24, 3)."""
    pairs: NDArray[np.intp]
    """Number of each sample's style-shape pair, shape (N,)."""

    def rows(self, which: NDArray[np.bool_]) -> HeldOut:
        """Some of the samples, bool (N,)."""
        return HeldOut(self.garment, self.errors[which], self.poses[which], self.pairs[which])


def held_out(bag: Path, garment: str, *, weights: Path | None = None) -> HeldOut:
    """Predicts every frame of a bag that has its truth.

    Raises:
        RefuError: the bag can't be read or has no truth of this garment, or there is no such garment.
    """
    pipeline = GarmentPipeline.load([garment], weights=weights)
    (template,) = pipeline.garments.values()
    truth = GroundTruth.of_bag(bag, {template.name: template.faces.cpu().numpy()})
    errors, poses, keys = [], [], []
    with adapters.open_smpl_bag(bag) as opened:
        for record in opened:
            frame = record.frame
            true = None if frame is None else truth.of(template.name, frame)
            if frame is None or true is None:
                continue
            errors.append(np.linalg.norm(pipeline(frame)[template.name].local - true, axis=1))
            poses.append(frame.pose)
            keys.append(np.concatenate((frame.betas, np.zeros(4) if frame.style is None else frame.style)))
    if not errors:
        msg = f"{bag}: no ground truth of {template.name} in it"
        raise GarmentError(msg)
    _, pairs = np.unique(np.round(keys, 4), axis=0, return_inverse=True)
    return HeldOut(template, np.stack(errors), np.stack(poses), pairs.reshape(-1).astype(np.intp))


def halves(samples: HeldOut) -> tuple[HeldOut, HeldOut]:
    """Every other style-shape pair, and the rest."""
    return samples.rows(samples.pairs % 2 == 0), samples.rows(samples.pairs % 2 == 1)


def coverage(garment: GarmentTemplate, found: SigmaMap, samples: HeldOut) -> float:
    """Share of the true vertices that are within the 90 % interval."""
    held = [
        np.mean(errors <= RADIUS_90 * found.at(float(bend)))
        for errors, bend in zip(samples.errors, bend_of(garment, samples.poses), strict=True)
    ]
    return float(np.mean(held))
