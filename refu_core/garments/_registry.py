"""Where garments live: those that ship, those of this user, and files anywhere."""

from __future__ import annotations

import os
from pathlib import Path

from refu_core.modes import BUILTIN_GARMENTS, GARMENT_FILE

_BUILTIN = Path(__file__).parents[1] / "assets"


def garments_folder() -> Path:
    """The user's garments: $REFU_GARMENTS, or refu/garments in $XDG_DATA_HOME (~/.local/share); it needs not exist."""
    if os.environ.get("REFU_GARMENTS"):
        return Path(os.environ["REFU_GARMENTS"]).expanduser()
    shared = os.environ.get("XDG_DATA_HOME")
    return (Path(shared) if shared else Path("~/.local/share").expanduser()) / "refu" / "garments"


def garment_files() -> dict[str, Path]:
    """The file of each garment that has a name: those that ship, then the user's. Of one name, the one that ships."""
    found = {name: _BUILTIN / GARMENT_FILE.format(name) for name in BUILTIN_GARMENTS}
    try:
        own = sorted(garments_folder().glob("*.npz"))
    except (OSError, RuntimeError):  # no home, no permission: nobody's garments
        own = []
    for path in own:
        found.setdefault(path.stem.removeprefix("garment_"), path)
    return found
