"""Make the folds of a garment's networks as strong as those of simulated cloth, in the weights of all its modes.

    python scripts/sharpen_folds.py refu_core/weights/tshirt-male --data data/tshirt-male-validation

The samples should be of motions and shapes that the networks weren't trained on. Folds are measured in the pipeline's
output. A frame takes no longer than before: the change goes into the output basis.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from refu_core import GarmentPipeline, SmplFrame
from refu_core.backbones import BasisDecoder, load_basis, save_basis
from refu_core.metrics import FoldBands
from refu_core.simulation import GarmentDataset
from refu_core.weights import load_card, load_weights, save_weights

MODES = ("hybrid", "none", "approx", "accurate")
_LAST = ("low.layers", "style_shape.layers", "high.weights", "high.biases")
"""Parts that end in a code, by the beginning of their tensors' names."""


def sharpened(basis: BasisDecoder, bands: FoldBands, gains: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Mean [m], (V, 3), and components, (R, 3 V), whose bands are `gains` times as strong for the same codes.

    A band has one gain for the whole garment, so the change is a linear map of displacements. It is applied to the
    basis instead of to every frame.
    """
    louder = np.array([*gains, 1.0])
    rows = torch.cat((basis.mean[None], basis.components)).double().numpy()
    columns = rows.reshape(len(rows), -1, 3).transpose(1, 0, 2)
    made = torch.as_tensor(np.einsum("b,bvrc->rvc", louder, bands.split(columns)))
    return made[0].float(), made[1:].flatten(1).float()


def orthonormal(components: Tensor) -> tuple[Tensor, Tensor]:
    """An orthonormal basis (R, 3 V) of what `components` (R, 3 V) span, and the map (R, R) from old to new codes."""
    basis, upper = torch.linalg.qr(components.double().T)
    sign = upper.diagonal().sign()  # a component keeps its sign
    return (basis * sign).T.float(), (upper * sign[:, None]).T


def in_new_codes(tensors: Mapping[str, Tensor], to_new: Tensor) -> dict[str, Tensor]:
    """A TailorNet's `tensors`, changed to output codes of another basis: `to_new` (R, R) makes them of old ones."""
    last = {prefix: max(_number(name, prefix) for name in tensors if _number(name, prefix) >= 0) for prefix in _LAST}
    changed = dict(tensors)
    for name, tensor in tensors.items():
        if not any(_number(name, prefix) == number for prefix, number in last.items()):
            continue
        whole = tensor.double()
        is_linear = name.endswith(".weight")  # of nn.Linear: outputs before inputs
        changed[name] = (to_new.T @ whole if is_linear else whole @ to_new).to(tensor.dtype)
    return changed


def _number(name: str, prefix: str) -> int:
    """The number of the layer that a name belongs to; -1 if it doesn't begin with `prefix`."""
    _, found, rest = name.partition(f"{prefix}.")
    return int(rest.split(".")[0]) if found else -1


class Judge:
    """Compares what the pipeline makes of samples with what was simulated."""

    def __init__(self, folder: Path, data: Path, count: int | None) -> None:
        self.name = folder.name
        self.pipeline = GarmentPipeline.load([self.name], backbone="tailornet", weights=folder.parent)
        self.bands = FoldBands(self.pipeline.garments[self.name].mesh)
        dataset = GarmentDataset(data)
        self.samples = [dataset.sample(i) for i in range(len(dataset))][:count]
        self.true = sum(self.bands.energies(sample.vertices) for sample in self.samples)

    def __call__(self, basis: tuple[Tensor, Tensor] | None = None) -> tuple[NDArray[np.float64], float]:
        """Each band's energy over the true one's, finest first, and the mean error [mm]; `basis` replaces the last."""
        if basis is not None:
            mean, components = basis
            decoder = self.pipeline.outfit.wearables[self.name].backbone.decoder
            decoder.mean.copy_(mean.flatten())
            decoder.components.copy_(components)
        energy, error = np.zeros(4), []
        for sample in self.samples:
            frame = SmplFrame(pose=sample.pose, betas=sample.betas, style=sample.style)
            vertices = self.pipeline([frame])[0][self.name].local
            energy += self.bands.energies(vertices)
            error.append(np.linalg.norm(vertices - sample.vertices, axis=1).mean())
        return energy / self.true, 1e3 * float(np.mean(error))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="a garment's weights")
    parser.add_argument("--data", type=Path, required=True, help="simulated samples")
    parser.add_argument("--count", type=int, help="as many of them (all)")
    parser.add_argument("--rounds", type=int, default=10, help="tries until the gains are taken (10)")
    arguments = parser.parse_args()
    folder = arguments.folder
    judge = Judge(folder, arguments.data, arguments.count)
    basis, _ = load_basis(folder, judge.pipeline.garments[folder.name], expect={"garment": folder.name})
    gains = np.ones(4)
    print(f"{folder.name}, {len(judge.samples)} samples; bands finest first")
    for _ in range(arguments.rounds):
        ratios, error = judge(sharpened(basis, judge.bands, gains))
        print(f"gains {gains.round(3)}: energies {ratios.round(3)} of the true ones, error {error:.3f} mm", flush=True)
        # A step towards the gains that give bands their true energy.
        found, gains = gains, np.maximum(gains * ratios**-0.6, 1.0)
    rewrite(folder, basis, judge.bands, found)
    ratios, error = Judge(folder, arguments.data, arguments.count)()
    print(f"rewritten: energies {ratios.round(3)} of the true ones, error {error:.3f} mm")


def rewrite(folder: Path, basis: BasisDecoder, bands: FoldBands, gains: NDArray[np.float64]) -> None:
    """Rewrites the basis and all modes of a garment's weights so that folds are `gains` times as strong."""
    stems = [folder / f"tailornet-{mode}" for mode in MODES]
    modes = [load_weights(stem) for stem in stems]
    mean, components = sharpened(basis, bands, gains)
    components, to_new = orthonormal(components)
    card = load_card(folder / "basis")
    save_basis(folder, BasisDecoder(mean, components), {**card, "fold_gains": gains.round(4).tolist()})
    digest = load_card(folder / "basis")["sha256"]
    for stem, weights in zip(stems, modes, strict=True):
        tensors = in_new_codes(weights.tensors, to_new)
        if weights.card.get("shares_backbone"):
            tensors = {name: tensor for name, tensor in tensors.items() if not name.startswith("backbone.")}
        save_weights(stem, tensors, {**weights.card, "basis_sha256": digest}, base=weights.card.get("base"))


if __name__ == "__main__":
    main()
