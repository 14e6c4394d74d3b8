#!/usr/bin/env python3
"""Draws docs/images/wardrobe.jpg: garments that ship, worn.

python scripts/make_wardrobe_picture.py
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from refu_lab.garment import picture

OUTFITS = (
    ("tshirt-male", "trousers-male"),
    ("longsleeve-female", "trousers-female"),
    ("dress-female",),
    ("tshirt-neutral", "trousers-neutral"),
    ("tshirt-female", "skirt-female"),
    ("shirt-neutral", "trousers-neutral"),
)
"""Worn together; two in a row."""


def main() -> None:
    """Writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path(__file__).parents[1] / "docs" / "images" / "wardrobe.jpg")
    arguments = parser.parse_args()
    views = [picture(outfit, size=(170, 280), samples=9) for outfit in OUTFITS]
    rows = [np.concatenate(views[k : k + 2], axis=1) for k in range(0, len(views), 2)]
    Image.fromarray(np.concatenate(rows)).save(arguments.output, quality=88, optimize=True)
    print(arguments.output)


if __name__ == "__main__":
    main()
