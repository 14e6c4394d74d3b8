"""The loop that trains a stage: AdamW, a cosine schedule, checkpoints; the best weights by validation are kept."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from refu_core.errors import RefuError
from refu_core.training._record import TrainingLog, load_checkpoint, save_checkpoint


@dataclass(frozen=True)
class LoopSettings:
    """How a stage is trained."""

    batch_size: int = 64
    """Samples per step, over all processes."""
    learning_rate: float = 1e-3
    """The peak: the rate rises over the first twentieth of the steps and then falls to zero along a cosine."""
    weight_decay: float = 1.0
    """Decoupled from the gradient (AdamW): each step shrinks a weight by this times the learning rate."""
    check_every: int = 100
    """Steps between validations, which are also the checkpoints."""
    patience: int = 15
    """A stage ends early after this many validations without a better one."""
    seed: int = 0


class Objective(nn.Module):
    """Networks and their loss as one module: what a step calls, and what is wrapped for several GPUs."""

    def __init__(self, nets: Sequence[nn.Module], predict: Callable[..., Tensor], loss: Callable[..., Tensor]) -> None:
        super().__init__()
        self.nets = nn.ModuleList(nets)
        self._predict = predict
        self._loss = loss

    def forward(self, *batch: Tensor) -> Tensor:
        """Mean loss [mm] of a batch: all but the last tensor are the network's input, the last one is the target."""
        return self._loss(self._predict(*batch[:-1]), batch[-1])


@dataclass(frozen=True)
class TrainingStage:
    """What is trained on what."""

    name: str
    objective: nn.Module
    """An `Objective`, or another module from a batch to its loss."""
    steps: int
    train: tuple[Tensor, ...] = ()
    """Inputs and, last, targets; each of the shape (N, ...)."""
    validation: tuple[Tensor, ...] = ()
    """The same for the validation samples, of which there may be none."""
    _: KW_ONLY
    rate: float = 1.0
    """Learning rate, relative to the settings'."""
    draw: Callable[[int], Any] | None = None
    """Draws the batch of a step, for this process and on its device, where it isn't some rows of `train`."""
    learning_rate: Callable[[int], float] | None = None
    """Learning rate of a step, instead of the usual rise and fall."""
    watch: Callable[[], dict[str, float]] | None = None
    """What is recorded at checks, by name, instead of the loss."""


class Loop:
    """Runs stages one after another; if interrupted, it goes on from the last checkpoint to the same weights."""

    def __init__(
        self, model: nn.Module, settings: LoopSettings, stem: Path, identity: Any, device: torch.device, *, quiet: bool
    ) -> None:
        """Keeps a checkpoint and loss curves, `stem` with suffixes of their own.

        `identity` says what is trained how and on what. Raises as `load_checkpoint` does.
        """
        self.checkpoint = stem.with_name(f"{stem.name}.checkpoint")
        self._model, self._settings, self._device = model, settings, device
        self._log = TrainingLog(stem.parent, name=stem.name, quiet=quiet, is_writer=is_writer())
        self._identity = json.dumps(identity, sort_keys=True, default=str)
        self._done: list[str] = []
        self._resumed: dict[str, Any] | None = None
        saved = load_checkpoint(self.checkpoint, self._identity)
        if saved is not None:
            model.load_state_dict(saved["model"])
            self._done = list(saved["done"])
            self._resumed = saved["stage"]

    def run(self, stage: TrainingStage) -> None:
        """Trains a stage, or what is left of it, on the device, where the model stays.

        The model ends with the stage's best weights by validation, or with its last ones where no samples are held out.
        """
        self._model.to(self._device)
        if stage.name in self._done:
            return
        rank, world = ranks()
        cuda = [self._device] if self._device.type == "cuda" else []
        with seeded(self._settings.seed * 1000 + 10 * len(self._done) + rank, *cuda):
            self._train(stage, rank, world)
        self._done.append(stage.name)
        self._save(None)

    def _train(self, stage: TrainingStage, rank: int, world: int) -> None:
        settings, objective = self._settings, stage.objective
        parameters = [p for p in objective.parameters() if p.requires_grad]
        optimiser = torch.optim.AdamW(parameters, lr=settings.learning_rate, weight_decay=settings.weight_decay)
        order = torch.Generator().manual_seed(settings.seed * 1000 + len(self._done))
        step, best, best_state, since = 0, math.inf, None, 0
        if self._resumed is not None and self._resumed["name"] == stage.name:
            saved, self._resumed = self._resumed, None
            optimiser.load_state_dict(saved["optimiser"])
            order.set_state(saved["order"])
            torch.set_rng_state(saved["rng"])
            if rank == 0:  # whose state it is: with the same on every GPU, dropout would leave out the same numbers
                _set_gpu_state(self._device, saved.get("gpu_rng"))
            step, best, best_state, since = saved["step"], saved["best"], saved["best_state"], saved["since"]
        self._log.begin(stage.name, step=step, steps=stage.steps)
        stepper: nn.Module = objective
        if world > 1:
            stepper = nn.parallel.DistributedDataParallel(objective, find_unused_parameters=True)
        losses = []
        while step < stage.steps and since < settings.patience:
            objective.train()
            usual = settings.learning_rate * stage.rate * _schedule(step, stage.steps)
            for group in optimiser.param_groups:
                group["lr"] = usual if stage.learning_rate is None else stage.learning_rate(step)
            if stage.draw is None:
                rows = torch.randint(len(stage.train[0]), (settings.batch_size,), generator=order)[rank::world]
                batch = [t[rows.to(t.device)].to(self._device) for t in stage.train]
            else:
                batch = [stage.draw(step)]
            with torch.autocast(self._device.type, torch.bfloat16, enabled=self._device.type == "cuda"):
                loss = stepper(*batch)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
            losses.append(loss.detach())
            step += 1
            self._log.step(step)
            if step % settings.check_every == 0 or step == stage.steps:
                mean_loss = torch.stack(losses).mean()
                losses.clear()
                if world > 1:  # each process has seen its share of the batches
                    dist.all_reduce(mean_loss)
                    mean_loss /= world
                train_loss = float(mean_loss)
                if not math.isfinite(train_loss):
                    raise RefuError(f"the loss of {stage.name} is {train_loss} at step {step}: lower the learning rate")
                held_out = self._validate(stage)
                since = 0 if held_out is None else since + 1
                if held_out is not None and held_out < best:
                    best, since = held_out, 0
                    best_state = {k: v.detach().clone() for k, v in objective.state_dict().items()}
                shown = {"train": train_loss} if held_out is None else {"train": train_loss, "validation": held_out}
                if stage.watch is not None and is_writer():
                    shown = stage.watch()
                self._log.check(stage.name, step, **shown)
                self._save(
                    {
                        "name": stage.name,
                        "step": step,
                        "best": best,
                        "best_state": best_state,
                        "since": since,
                        "optimiser": optimiser.state_dict(),
                        "order": order.get_state(),
                        "rng": torch.get_rng_state(),
                        **_gpu_state(self._device),
                    }
                )
        if best_state is not None:
            objective.load_state_dict(best_state)
        self._log.end()

    @torch.no_grad()
    def _validate(self, stage: TrainingStage) -> float | None:
        n = len(stage.validation[0]) if stage.validation else 0
        if n == 0:
            return None
        stage.objective.eval()
        size, total = 256, 0.0
        for start in range(0, n, size):
            batch = [t[start : start + size].to(self._device) for t in stage.validation]
            total += float(stage.objective(*batch)) * len(batch[0])
        return total / n

    def _save(self, stage: dict[str, Any] | None) -> None:
        # One process's state is enough: after a step all have the same weights. Each has its own random state, though,
        # so a resumed parallel run is sound but not the same bit for bit.
        if is_writer():
            state = {"identity": self._identity, "done": self._done, "stage": stage, "model": self._model.state_dict()}
            save_checkpoint(self.checkpoint, state)


@contextmanager
def seeded(seed: int, *gpus: torch.device) -> Iterator[None]:
    """Torch's random numbers from this seed on, also on these GPUs; the caller's stay as they were."""
    with torch.random.fork_rng(devices=gpus):
        torch.manual_seed(seed)
        yield


def _gpu_state(device: torch.device) -> dict[str, Tensor]:
    """The state of a GPU's random numbers, which dropout there draws from; nothing for a CPU."""
    return {"gpu_rng": torch.cuda.get_rng_state(device)} if device.type == "cuda" else {}


def _set_gpu_state(device: torch.device, state: Tensor | None) -> None:
    if device.type == "cuda" and state is not None:  # a checkpoint may be of a CPU, or of an earlier version
        torch.cuda.set_rng_state(state, device)


def start_parallel(device: str) -> torch.device:
    """Joins the other processes of a `torchrun`; returns this process's own device."""
    own = torch.device(device)
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return own
    if own.type == "cuda":
        own = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
        torch.cuda.set_device(own)
    if not dist.is_initialized():
        dist.init_process_group("nccl" if own.type == "cuda" else "gloo")
    return own


def is_writer() -> bool:
    """Whether this process is the one that writes files."""
    return ranks()[0] == 0


def ranks() -> tuple[int, int]:
    """Number of this process, and how many there are."""
    return (dist.get_rank(), dist.get_world_size()) if dist.is_available() and dist.is_initialized() else (0, 1)


def _schedule(step: int, steps: int) -> float:
    warm = max(1, steps // 20)
    return (step + 1) / warm if step < warm else cosine(step - warm, steps - warm)


def cosine(step: int, steps: int) -> float:
    """A learning rate that falls to zero along a cosine, as a share of the highest one."""
    return 0.5 * (1 + math.cos(math.pi * step / max(1, steps)))
