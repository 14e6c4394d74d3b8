#!/usr/bin/env python3
"""Draws the contact sheet of simulated sets for the documentation.

python scripts/make_contact_sheet.py data/tshirt-male data/skirt-female     # docs/images/dataset-<garment>.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image

from refu_core.simulation import GarmentDataset
from refu_lab.contact_sheet import contact_sheet


def main() -> None:
    """Writes a picture for each set, of 256 colours: less than half the bytes, and no difference to see."""
    images = Path(__file__).parents[1] / "docs" / "images"
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sets", nargs="+", type=Path)
    parser.add_argument("--output", type=Path, default=images)
    parser.add_argument("--seed", type=int, default=1, help="of the samples' choice (1)")
    arguments = parser.parse_args()
    for directory in arguments.sets:
        dataset = GarmentDataset(directory)
        path = arguments.output / f"dataset-{'-over-'.join(reversed(dataset.parts))}.png"
        sheet = Image.fromarray(contact_sheet(dataset, seed=arguments.seed))
        sheet.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
        print(path)


if __name__ == "__main__":
    main()
