#!/usr/bin/env python3
"""Draws docs/images/collider.jpg: poses in which the body touches itself, before and after, and dressed.

python scripts/make_collider_picture.py
"""

from __future__ import annotations

import argparse
from pathlib import Path

from PIL import Image

from refu_core.modes import DEFAULT_GARMENTS
from refu_lab.touching_poses import TOUCHING_POSES, collider_sheet


def main() -> None:
    """Writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path(__file__).parents[1] / "docs" / "images" / "collider.jpg")
    parser.add_argument("--garments", nargs="+", default=DEFAULT_GARMENTS, help="worn together")
    parser.add_argument("--poses", nargs="+", default=tuple(TOUCHING_POSES), choices=TOUCHING_POSES, metavar="POSE")
    parser.add_argument("--size", type=int, nargs=2, default=(230, 270), help="of one picture [pixels]")
    parser.add_argument("--yaw", type=float, default=25.0, help="of the camera, from the front [degrees]")
    arguments = parser.parse_args()
    sheet = collider_sheet(
        garments=arguments.garments, poses=arguments.poses, size=tuple(arguments.size), yaw=arguments.yaw
    )
    Image.fromarray(sheet).save(arguments.output, quality=88, optimize=True)
    print(arguments.output)


if __name__ == "__main__":
    main()
