"""What a training keeps on disk: checkpoints that it resumes from, bit for bit, and loss curves."""

from __future__ import annotations

import contextlib
import io
import json
import os
import zipfile
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from refu_core._files import MAX_JSON_BYTES, open_file, parse_json, read_file, replacing, write_file
from refu_core.errors import RefuError, WeightsError

_MAX_BYTES = 16 << 30
"""Weights of the paper's sizes, and the two moments of each that Adam keeps, are 8 GB."""


def save_checkpoint(path: Path, state: Mapping[str, Any]) -> None:
    """Writes tensors and plain values; the file is never half written. Raises `WeightsError` if it can't be written."""
    # Through memory: on a full disk torch's own writer raises errors of its own instead of `OSError`.
    buffer = io.BytesIO()
    torch.save(dict(state), buffer)
    write_file(path, buffer.getbuffer(), error=WeightsError, what="the checkpoint")


def load_checkpoint(path: Path, identity: str | None = None) -> dict[str, Any] | None:
    """What `save_checkpoint` wrote; None where there is nothing. No pickled code is run.

    Raises `RefuError` for another "identity" in the state, of another training, and `WeightsError` for a damaged file.
    """
    if not os.path.lexists(path):
        return None
    try:
        state = torch.load(_as_saved(path), map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever its readers do
        raise WeightsError(f"{path}: a damaged checkpoint; delete it to start anew: {error}") from error
    if not isinstance(state, dict):
        raise WeightsError(f"{path}: a {type(state).__name__}, wanted a checkpoint; delete it to start anew")
    if identity is not None and state.get("identity") != identity:
        raise RefuError(f"{path}: of a training with other settings or data; delete it to start anew")
    return state


def _as_saved(path: Path) -> io.BytesIO:
    """The archive as `torch.save` would have written it: the same records, none of them compressed.

    Torch's own reader allocates whatever size a damaged record claims. So it gets an archive that was made here.
    """
    buffer = io.BytesIO()
    with (
        open_file(path, most=_MAX_BYTES, error=WeightsError, wanted="a checkpoint of refu train") as file,
        zipfile.ZipFile(file) as archive,
        zipfile.ZipFile(buffer, "w") as copy,
    ):
        entries = archive.infolist()
        if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
            raise zipfile.BadZipFile("it has compressed records")
        if sum(entry.file_size for entry in entries) > file.size:
            raise zipfile.BadZipFile("its records are larger than the file")
        for entry in entries:
            copy.writestr(entry.filename, archive.read(entry))
    buffer.seek(0)
    return buffer


class TrainingLog:
    """Loss curves of the stages of a training, as a JSON lines file and a picture."""

    def __init__(self, folder: Path, *, name: str, quiet: bool = False, is_writer: bool = True) -> None:
        """Writes `folder`/`name`.jsonl and `folder`/`name`.png; what an earlier run wrote is continued.

        Of the processes of a parallel training one `is_writer`; the others write and show nothing.
        """
        self._lines, self.picture = folder / f"{name}.jsonl", folder / f"{name}.png"
        self._is_writer, self._is_shown = is_writer, is_writer and not quiet
        self._bar: Any = None
        folder.mkdir(parents=True, exist_ok=True)
        self._entries = _entries(self._lines)

    def begin(self, stage: str, *, step: int, steps: int) -> None:
        """A stage of `steps` steps goes on at `step`; later entries are from an interrupted run and are dropped."""
        self._entries = [e for e in self._entries if e["stage"] != stage or e["step"] <= step]
        if self._is_shown:
            from tqdm import tqdm

            self._bar = tqdm(total=steps, initial=step, desc=stage, unit="step", leave=True)

    def step(self, done: int) -> None:
        """`done` steps of the stage are done."""
        if self._bar is not None:
            self._bar.update(done - self._bar.n)

    def check(self, stage: str, step: int, **values: float) -> None:
        """Records losses at a step, by name [mm]."""
        if not self._is_writer:
            return
        self._entries.append({"stage": stage, "step": step, **{k: round(v, 5) for k, v in values.items()}})
        # Under another name first: a training that is killed leaves the previous check's curves, and no half line.
        with replacing(self._lines) as file:
            file.write("".join(json.dumps(entry) + "\n" for entry in self._entries).encode())
        if self._bar is not None:
            self._bar.set_postfix({k: f"{v:.2f}" for k, v in values.items()})

    def end(self) -> None:
        """Closes the bar and draws the picture."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None
        self.draw()

    def draw(self) -> None:
        """Draws all curves so far, one panel per stage."""
        from matplotlib.figure import Figure

        stages: dict[str, list[dict[str, Any]]] = defaultdict(list)
        for entry in self._entries:
            stages[entry["stage"]].append(entry)
        if not stages or not self._is_writer:
            return
        figure = Figure(figsize=(4.2 * len(stages), 3.2), layout="constrained")
        panels = figure.subplots(1, len(stages), squeeze=False)[0]
        for axes, (stage, entries) in zip(panels, stages.items(), strict=True):
            for name in sorted({key for entry in entries for key in entry} - {"stage", "step"}):
                points = [(entry["step"], entry[name]) for entry in entries if name in entry]
                axes.plot(*zip(*points, strict=True), label=name, linewidth=1.4)
            axes.set(title=stage, xlabel="step", ylabel="loss [mm]", yscale="log")
            axes.grid(visible=True, which="both", alpha=0.25)
            axes.legend(frameon=False)
        figure.savefig(self.picture, dpi=120)


def _entries(path: Path) -> list[dict[str, Any]]:
    """The entries of an earlier run; a damaged log is no reason to stop, so invalid lines are left out."""
    entries = []
    try:
        lines = read_file(path, most=MAX_JSON_BYTES, error=RefuError, wanted="the log of a training").splitlines()
    except RefuError:
        return []
    for line in lines:
        with contextlib.suppress(ValueError, RecursionError):
            entry = parse_json(line)
            is_entry = isinstance(entry, dict) and "step" in entry and isinstance(entry.get("stage"), str)
            if is_entry and all(isinstance(entry[name], (int, float)) for name in entry if name != "stage"):
                entries.append(entry)
    return entries
