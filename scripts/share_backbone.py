"""Store the modes of a garment's weights as differences from the default mode's, like those that ship.

    refu train tshirt-male --data data/tshirt-male --mode hybrid      # and none, approx, accurate
    python scripts/share_backbone.py weights/tshirt-male --share approx accurate --measured figures.json

A mode under --share gives up its own backbone for hybrid's and keeps its ReFU layer; the others keep both. The figures
under --measured, a JSON file of {mode: figures}, go into each mode's card.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from refu_core.weights import load_weights, save_weights

BASE = "tailornet-hybrid"
MODES = ("none", "approx", "accurate")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="a garment's weights, as refu train writes them")
    parser.add_argument("--share", nargs="*", default=[], choices=MODES, help="modes that take hybrid's backbone")
    parser.add_argument("--measured", type=Path, help="JSON: figures of each mode with its own backbone and hybrid's")
    arguments = parser.parse_args()
    measured = {} if arguments.measured is None else json.loads(arguments.measured.read_text(encoding="utf-8"))
    for mode in MODES:
        stem = arguments.folder / f"tailornet-{mode}"
        weights = load_weights(stem)
        if "base" in weights.card:
            parser.exit(1, f"{stem}: a difference already\n")
        own = ("refu.",) if mode in arguments.share else ("refu.", "backbone.")
        tensors = {name: tensor for name, tensor in weights.tensors.items() if name.startswith(own)}
        card = {
            **weights.card,
            "trained": {key: weights.card[key] for key in ("sha256", "versions")},
            "shares_backbone": mode in arguments.share,
            **({"measured": measured[mode]} if mode in measured else {}),
        }
        before = weights.path.stat().st_size
        path = save_weights(stem, tensors, card, base=BASE)
        print(f"{path}: {before / 1e6:.2f} MB, now {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
