#!/usr/bin/env python3
"""Adds styles to the built-in garments: run after `build_garments.py`, which writes them without.

    python scripts/build_styles.py [--assets refu_core/assets] [--output DIR] [GARMENT ...]

Replaces a garment's `v_template` by the mean cut and adds `styledirs` and `tailoring_from_style`; about a
minute a garment. See docs/guide/data.md, "Styles".
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from asset_tools.styles import build_styles

from refu_core.body import load_body
from refu_core.garments import BUILTIN_GARMENTS, load_garment


def main() -> int:
    assets = Path(__file__).parents[1] / "refu_core" / "assets"
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("garments", nargs="*", default=BUILTIN_GARMENTS, help="all of them if none is named")
    parser.add_argument("--output", type=Path, default=assets, help="folder for the files (default: where they are)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    for name in args.garments:
        garment = load_garment(name)
        if garment.styledirs is not None:
            print(f"{name}: has styles already; run build_garments.py first", file=sys.stderr)
            return 2
        with np.load(assets / f"garment_{name}.npz", allow_pickle=False) as data:
            arrays = {key: data[key] for key in data.files}
        arrays |= build_styles(garment, load_body(garment.body))
        args.output.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(args.output / f"garment_{name}.npz", **arrays)
        print(name, np.round(arrays["tailoring_from_style"].T, 2), [one.name for one in garment.card.tailoring])
    return 0


if __name__ == "__main__":
    sys.exit(main())
