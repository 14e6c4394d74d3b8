"""Checkpoints that training resumes from, bit for bit."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from refu_core._files import open_file, replacing
from refu_core.errors import RefuError, WeightsError

_MAX_BYTES = 16 << 30
"""Weights of the paper's sizes, and the two moments of each that Adam keeps, are 8 GB."""


def save_checkpoint(path: Path, state: Mapping[str, Any]) -> None:
    """Writes tensors and plain values; the file is never half written.

    Raises `WeightsError`: the disk can't be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Through memory: on a full disk torch's own writer raises errors of its own instead of `OSError`.
        buffer = io.BytesIO()
        torch.save(dict(state), buffer)
        with replacing(path, sync=True) as file:
            file.write(buffer.getbuffer())
    except OSError as error:
        msg = f"{path}: the checkpoint can't be written: {error}"
        raise WeightsError(msg) from error


def load_checkpoint(path: Path, identity: str | None = None) -> dict[str, Any] | None:
    """What `save_checkpoint` wrote; None where there is nothing. No pickled code is run.

    Raises:
        RefuError: the state's "identity" is another one: the checkpoint is of another training.
        WeightsError: the file is damaged.
    """
    if not os.path.lexists(path):
        return None
    try:
        state = torch.load(_as_saved(path), map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises whatever its readers do
        msg = f"{path}: a damaged checkpoint; delete it to start anew: {error}"
        raise WeightsError(msg) from error
    if not isinstance(state, dict):
        msg = f"{path}: a checkpoint holds a dictionary, this one a {type(state).__name__}; delete it to start anew"
        raise WeightsError(msg)
    if identity is not None and state.get("identity") != identity:
        msg = f"{path}: of a training with other settings or data; delete it to start anew"
        raise RefuError(msg)
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
            msg = "it has compressed records"
            raise zipfile.BadZipFile(msg)
        if sum(entry.file_size for entry in entries) > file.size:
            msg = "its records are larger than the file"
            raise zipfile.BadZipFile(msg)
        for entry in entries:
            copy.writestr(entry.filename, archive.read(entry))
    buffer.seek(0)
    return buffer
