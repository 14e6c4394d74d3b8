"""Training of the paper's network for the body's signed distance (supplement, Sec. A)."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from refu_core.body import SmplBody
from refu_core.errors import RefuError
from refu_core.garments import GarmentTemplate
from refu_core.sdf import SDF_PRESETS, ExactSdf, SdfNetwork, body_frame, query_batch, save_sdf_network, with_gradient
from refu_core.simulation import GarmentDataset
from refu_core.training._data import check_set, drawn_pairs
from refu_core.training._loop import Loop, LoopSettings, TrainingStage, cosine, is_writer, ranks, seeded, start_parallel

VALUE_WEIGHT, NORMAL_WEIGHT, EIKONAL_WEIGHT = 2.0, 1.0, 0.1
"""λ_a, λ_b and λ_c of the paper's loss."""
BOX = 4.0
"""Edge length of the box around the origin that points are drawn in [m]."""
_SHARES = (0.25, 0.25, 0.125, 0.125)
"""Shares of a body's points on its surface, near it, on the garment and near that; the rest are anywhere in the box."""
_NEAR = 0.02  # [m]; points closer than this to the skin count as near it


@dataclass(frozen=True)
class SdfSettings:
    """How the network is trained; the defaults are the paper's, as far as it says."""

    preset: str = "paper"
    steps: int = 200_000
    batch_size: int = 32
    """Bodies per step, over all processes."""
    points: int = 4000
    """Points per body."""
    learning_rate: float = 1e-5
    noise: float = 0.02
    """Standard deviation of the noise added to each coordinate of surface points [m]."""
    check_every: int = 1000
    """Steps between validations, which are also the checkpoints."""
    validation_share: float = 0.05
    """Share of the training split that is held out, as whole style-shape pairs."""
    seed: int = 0
    is_annealed: bool = False
    """Whether the learning rate falls to zero along a cosine; the paper names only one rate."""

    @classmethod
    def of(cls, preset: str) -> SdfSettings:
        """The settings of a preset: the paper's, or ones that a CPU gets through in half an hour."""
        if preset == "paper":
            return cls()
        return cls(preset, 4000, batch_size=8, points=512, learning_rate=1e-3, check_every=250, is_annealed=True)

    def rate(self, step: int) -> float:
        """Learning rate of a step."""
        return self.learning_rate * (cosine(step, self.steps) if self.is_annealed else 1.0)

    def __post_init__(self) -> None:
        """Raises `RefuError` for an unknown preset and for invalid numbers."""
        if self.preset not in SDF_PRESETS:
            raise RefuError(f"no preset {self.preset!r} of the distance network: wanted {', '.join(SDF_PRESETS)}")
        if min(self.steps, self.batch_size, self.check_every) < 1 or self.points < 8 or not self.learning_rate > 0:
            raise RefuError(f"steps, batch_size, points (8 or more) and rates must be positive, got {asdict(self)}")


@dataclass(frozen=True, eq=False)
class SdfBatch:
    """Points around B bodies whose roots aren't turned, and their true distances; all [m]."""

    betas: Tensor
    """Shape (B, 10)."""
    pose: Tensor
    """Rotation vectors of all joints but the root [rad], shape (B, 23, 3)."""
    points: Tensor
    """Shape (B, N, 3); the first S of each body are on its surface (the paper's I_S, the others I_E)."""
    distance: Tensor
    """Shape (B, N)."""
    normals: Tensor
    """The body's normals at the first S points, shape (B, S, 3)."""

    def to(self, device: torch.device) -> SdfBatch:
        """The same on another device."""
        return SdfBatch(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))


class SdfSampler:
    """Draws points of the paper's three kinds around bodies of a data set: body, garment, box."""

    def __init__(self, dataset: GarmentDataset, body: SmplBody, garment: GarmentTemplate, rows: Tensor) -> None:
        """For the samples `rows` of a set of `garment`."""
        self.rows, self._dataset, self._body, self._garment = rows, dataset, body, garment
        self._part = dataset.parts[garment.name]
        self._exact = ExactSdf(body.faces, device=body.device)

    def draw(self, generator: torch.Generator, *, bodies: int, points: int, noise: float) -> SdfBatch:
        """`points` around each of `bodies` bodies, all drawn by the generator."""
        chosen = self.rows[torch.randint(len(self.rows), (bodies,), generator=generator)]
        return self.around(chosen, generator, points=points, noise=noise)

    @torch.no_grad()
    def around(self, rows: Tensor, generator: torch.Generator, *, points: int, noise: float) -> SdfBatch:
        """`points` around the bodies of these samples."""
        samples = [self._dataset.sample(int(row)) for row in rows]
        kinds = [(sample.betas, sample.pose, sample.vertices[self._part]) for sample in samples]
        betas, pose, worn = (torch.from_numpy(np.stack(one)) for one in zip(*kinds, strict=True))
        rotation, root = body_frame(self._body, pose, betas)
        worn = (worn - root[:, None]) @ rotation + root[:, None]
        pose = torch.cat((torch.zeros_like(pose[:, :1]), pose[:, 1:]), 1)
        skins = self._body(pose, betas).vertices
        counts = [int(share * points) for share in _SHARES]
        drawn, normals = [], []
        for skin, cloth in zip(skins, worn, strict=True):
            surfaces = [(skin, self._body.faces)] * 2 + [(cloth, self._garment.faces)] * 2
            places = [_on_surface(*surface, n, generator) for surface, n in zip(surfaces, counts, strict=True)]
            (on_skin, normal), (near_skin, _), (on_cloth, _), (near_cloth, _) = places
            disturbed = torch.cat((near_skin, near_cloth))
            disturbed = disturbed + noise * torch.randn(disturbed.shape, generator=generator)
            anywhere = BOX * (torch.rand(points - sum(counts), 3, generator=generator) - 0.5)
            drawn.append(torch.cat((on_skin, disturbed, on_cloth, anywhere)))
            normals.append(normal)
        where = torch.stack(drawn)
        distance = query_batch(self._exact, skins, where).distance
        distance[:, : counts[0]] = 0.0  # rounding leaves it slightly off
        return SdfBatch(betas, pose[:, 1:], where, distance, torch.stack(normals))


def _on_surface(vertices: Tensor, faces: Tensor, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """n points spread evenly over a surface, (n, 3), and the normals of their faces, (n, 3)."""
    a, b, c = vertices[faces].unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    face = torch.multinomial(normal.norm(dim=1), n, replacement=True, generator=generator)
    u, v = torch.rand(2, n, 1, generator=generator)
    root = u.sqrt()
    place = (1 - root) * a[face] + root * (1 - v) * b[face] + root * v * c[face]
    return place, nn.functional.normalize(normal[face], dim=1)


def sdf_loss(distance: Tensor, gradient: Tensor, batch: SdfBatch) -> Tensor:
    """L_SDF = λ_a L_v + λ_b L_sg + λ_c L_se of distances (B, N) and gradients (B, N, 3) at the batch's points."""
    on_surface = batch.normals.shape[1]
    value = (distance - batch.distance).abs().mean()
    normal = (gradient[:, :on_surface] - batch.normals).norm(dim=-1).mean()
    eikonal = (gradient[:, on_surface:].norm(dim=-1) - 1).square().mean()
    loss: Tensor = VALUE_WEIGHT * value + NORMAL_WEIGHT * normal + EIKONAL_WEIGHT * eikonal
    return loss


@torch.no_grad()
def sdf_figures(network: SdfNetwork, batch: SdfBatch) -> dict[str, float]:
    """The supplement's figures of a network: mean absolute error [mm] of all points, mean relative error [%] of those
    that aren't on the surface; and the mean absolute error within 2 cm of the skin [mm]."""
    bodies = zip(batch.points, batch.betas, batch.pose, strict=True)
    found = torch.cat([network(points[None], betas[None], pose[None]) for points, betas, pose in bodies])
    off = batch.normals.shape[1]
    error, truth = (found - batch.distance).abs(), batch.distance.abs()
    return {
        "absolute_mm": float(1e3 * error.mean()),
        "relative_percent": float(100 * (error[:, off:] / truth[:, off:].clamp_min(1e-6)).mean()),
        "near_mm": float(1e3 * error[truth < _NEAR].mean()),
    }


class _Step(nn.Module):
    """The network and its loss as one module, which is what is wrapped for several processes."""

    def __init__(self, network: SdfNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, batch: SdfBatch) -> Tensor:
        distance, gradient = with_gradient(self.network, batch.points, batch.betas, batch.pose, keep_graph=True)
        return sdf_loss(distance.float(), gradient.float(), batch)


def train_sdf(
    dataset: GarmentDataset,
    body: SmplBody,
    garment: GarmentTemplate,
    output: Path,
    *,
    settings: SdfSettings | None = None,
    device: str = "cpu",
    quiet: bool = False,
) -> dict[str, Any]:
    """Trains the network on the training split of a set; writes `output`/sdf-PRESET, a checkpoint, and loss curves.

    If interrupted, it goes on from the last checkpoint and ends with the same weights: what is drawn for a step depends
    only on the seed and the number of the step. Under `torchrun` every process takes its share of the bodies. On a GPU
    it computes in bfloat16, with weights in float32. Returns the card: settings and figures, on held-out pairs of the
    training split and on the test split.

    Raises `RefuError` for a set of another garment or body, a checkpoint of another training, a split without samples,
    or a loss that isn't finite; `WeightsError` for a damaged checkpoint, or a disk that can't be written.
    """
    check_set(dataset, body, garment)
    settings = settings or SdfSettings()
    name = f"sdf-{settings.preset}"
    where = start_parallel(device)
    rank, world = ranks()
    if settings.batch_size % world:
        raise RefuError(f"a batch of {settings.batch_size} bodies can't be shared evenly by {world} processes")
    splits = _split(dataset, settings)
    samplers = {part: SdfSampler(dataset, body, garment, rows) for part, rows in splits.items()}
    checks = {part: _fixed_batch(samplers[part], settings).to(where) for part in ("validation", "test")}

    with seeded(settings.seed):
        network = SdfNetwork(SDF_PRESETS[settings.preset])
    about = {"garment": garment.name, "samples": len(splits["train"])}
    identity = [asdict(settings), body.fingerprint, about]
    how = LoopSettings(settings.batch_size, settings.learning_rate, 0.0, settings.check_every, seed=settings.seed)
    loop = Loop(network, how, output / name, identity, where, quiet=quiet)

    def draw(step: int) -> SdfBatch:
        generator = torch.Generator().manual_seed((settings.seed * 1_000_003 + step) * world + rank)
        bodies = settings.batch_size // world
        batch = samplers["train"].draw(generator, bodies=bodies, points=settings.points, noise=settings.noise)
        return batch.to(where)

    def watch() -> dict[str, float]:
        found = sdf_figures(network, checks["validation"])
        return {"absolute": found["absolute_mm"], "near_skin": found["near_mm"]}

    hooks: dict[str, Any] = {"draw": draw, "learning_rate": settings.rate, "watch": watch}
    loop.run(TrainingStage("sdf", _Step(network), settings.steps, **hooks))
    card = {
        "kind": "sdf",
        "body_fingerprint": body.fingerprint,
        "dataset": about,
        "settings": asdict(settings),
        "figures": {part: sdf_figures(network, batch) for part, batch in checks.items()},
    }
    if is_writer():
        save_sdf_network(output / name, network, card)
        loop.checkpoint.unlink(missing_ok=True)
    return card


def _split(dataset: GarmentDataset, settings: SdfSettings) -> dict[str, Tensor]:
    """Rows to learn from, to validate on (whole style-shape pairs), and to test on."""
    pairs = torch.as_tensor(dataset.column("pair"))
    train, test = torch.from_numpy(dataset.train), torch.from_numpy(dataset.test)
    held_out = torch.zeros_like(train)
    held_out[train] = drawn_pairs(pairs[train], share=settings.validation_share, seed=settings.seed, fewest=2)
    splits = {"train": train & ~held_out, "validation": train & held_out, "test": test}
    for name, mask in splits.items():
        if not bool(mask.any()):
            raise RefuError(f"the set has no finished sample for its {name} part: finish it, or make a larger one")
    return {name: torch.nonzero(mask)[:, 0] for name, mask in splits.items()}


def _fixed_batch(sampler: SdfSampler, settings: SdfSettings) -> SdfBatch:
    """The same bodies and points at every check."""
    generator = torch.Generator().manual_seed(settings.seed + 1)
    rows = sampler.rows[torch.linspace(0, len(sampler.rows) - 1, min(32, len(sampler.rows))).long()]
    return sampler.around(rows, generator, points=settings.points, noise=settings.noise)
