"""Progress of a training: a bar, a line of figures per check, and a picture of the loss curves."""

from __future__ import annotations

import contextlib
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

from refu_core._files import MAX_JSON_BYTES, parse_json, read_file, replacing
from refu_core.errors import RefuError


class TrainingLog:
    """Loss curves of the stages of a training, as a JSON lines file and a picture."""

    def __init__(self, folder: Path, *, name: str, quiet: bool = False, is_writer: bool = True) -> None:
        """Writes `folder`/`name`.jsonl and `folder`/`name`.png; what an earlier run wrote is continued.

        Of the processes of a parallel training one `is_writer`; the others write and show nothing.
        """
        self._lines = folder / f"{name}.jsonl"
        self.picture = folder / f"{name}.png"
        """Where the picture is."""
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
        """The stage is done: the bar is closed and the picture drawn."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None
        self.draw()

    def draw(self) -> None:
        """Draws all curves so far, one panel per stage."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        stages: dict[str, list[dict[str, Any]]] = defaultdict(list)
        for entry in self._entries:
            stages[entry["stage"]].append(entry)
        if not stages or not self._is_writer:
            return
        figure = Figure(figsize=(4.2 * len(stages), 3.2), layout="constrained")
        FigureCanvasAgg(figure)
        for axes, (stage, entries) in zip(
            figure.subplots(1, len(stages), squeeze=False)[0], stages.items(), strict=True
        ):
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
            if not isinstance(entry, dict) or "step" not in entry or not isinstance(entry.get("stage"), str):
                continue
            if all(isinstance(value, (int, float)) for name, value in entry.items() if name != "stage"):
                entries.append(entry)
    return entries
