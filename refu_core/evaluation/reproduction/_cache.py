"""Runs that are kept on disk, and found again only while everything that made them is the same."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from refu_core.evaluation.reproduction._methods import Method

_CODE = (
    *("body/*.py", "garments/*.py", "sdf/*.py", "backbones/*.py", "repulsion/*.py", "realtime/*.py", "assets/*.npz"),
    *("evaluation/*.py", "evaluation/reproduction/_runs.py", "evaluation/reproduction/_predict.py"),
)
"""Files of refu_core that a run's figures depend on; those that only write tables aren't among them."""


class Cache:
    """A folder of runs, a JSON file each, named by garment, method and a hash of what they depend on."""

    def __init__(self, folder: Path) -> None:
        """Uses `folder`, made when the first run is kept."""
        self.folder = folder

    def find(self, garment: str, method: Method, key: str) -> dict[str, Any] | None:
        """The run that was kept under the same key by the same code; None if there is none."""
        try:
            data = json.loads(self._path(garment, method, key).read_bytes())
        except (OSError, ValueError):
            return None
        return data if isinstance(data, dict) else None

    def keep(self, garment: str, method: Method, key: str, run: Mapping[str, Any]) -> None:
        """Keeps a run. Raises `OSError` when the folder can't be written."""
        path = self._path(garment, method, key)
        self.folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}")
        part.write_text(json.dumps(run), encoding="utf-8")
        part.replace(path)

    def _path(self, garment: str, method: Method, key: str) -> Path:
        told = json.dumps([asdict(method), key, _code_hash()], sort_keys=True)
        return self.folder / f"{garment}-{method.name}-{hashlib.sha256(told.encode()).hexdigest()[:16]}.json"


@cache
def _code_hash() -> str:
    root = Path(__file__).parents[2]
    digest = hashlib.sha256()
    for pattern in _CODE:
        for file in sorted(root.glob(pattern)):
            digest.update(file.relative_to(root).as_posix().encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()
