"""Fit σ, how far a garment's network may be off, from bags with ground truth that it wasn't trained on.

    python scripts/fit_sigma.py bags/eval_tshirt_male --garment tshirt-male
    python scripts/fit_sigma.py my_bag --garment kilt --weights weights/ --output weights/

Half of the bag's style–shape pairs are fitted, and the other half say how often the 90 % interval holds: neighbouring
frames of one person are never on both sides. The file lies beside the weights, where `refu_core.outputs.Sigma` finds
it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from refu_core import RefuError
from refu_core.outputs import fit_sigma, save_sigma
from refu_lab.held_out import coverage, held_out


def main() -> None:
    """Fit, check, and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "bag", type=Path, help="SMPL parameters and /ground_truth, as bags/make_evaluation_bags.py writes"
    )
    parser.add_argument("--garment", required=True)
    parser.add_argument("--weights", type=Path, help="folder of weights of one's own; those that ship by default")
    parser.add_argument(
        "--output", type=Path, help="folder that has or gets the garment's folder; --weights by default"
    )
    arguments = parser.parse_args()
    try:
        first, second = (held_out(arguments.bag, arguments.garment, half=i, weights=arguments.weights) for i in (0, 1))
        found = fit_sigma(first.garment, first.errors, first.poses)
        share = coverage(found, second)
        card = {
            "fitted_on": f"{arguments.bag.name}: {len(first.poses)} samples, every other style-shape pair",
            "checked_on": f"the other {len(second.poses)} samples",
            "coverage_90": round(share, 4),
        }
        path = save_sigma(first.garment, found, card, folder=arguments.output or arguments.weights)
    except RefuError as error:
        parser.exit(2, f"{error}\n")
    print(
        f"{path}: σ {1e3 * float(np.mean(found.sigma)):.1f} mm, the 90 % interval holds {100 * share:.1f} % of the rest"
    )


if __name__ == "__main__":
    main()
