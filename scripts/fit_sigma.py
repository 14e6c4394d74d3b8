"""Fit σ, how far a garment's network may be off, from bags with ground truth that it wasn't trained on.

    python scripts/fit_sigma.py bags/eval_tshirt_male --garment tshirt-male
    python scripts/fit_sigma.py my_bag --garment kilt --weights weights/ --output weights/

How often the 90 % interval holds is measured on each of the bag's style–shape pairs with σ fitted to the others:
neighbouring frames of one person are never on both sides. The σ that is written is fitted to all. The file lies beside
the weights, where `refu_core.outputs.Sigma` finds it.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from refu_core import RefuError
from refu_core.outputs import fit_sigma, save_sigma
from refu_lab.truth import cross_checked, held_out


def main() -> None:
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
        samples = held_out(arguments.bag, arguments.garment, weights=arguments.weights)
        found, share = fit_sigma(samples.garment, samples.errors, samples.poses), cross_checked(samples)
        card = {
            "fitted_on": f"{arguments.bag.name}: {len(samples.poses)} samples",
            "checked_on": "each style-shape pair, with the others fitted",
            "coverage_90": round(share, 4),
        }
        path = save_sigma(samples.garment, found, card, folder=arguments.output or arguments.weights)
    except RefuError as error:
        parser.exit(2, f"{error}\n")
    print(
        f"{path}: σ {1e3 * float(np.mean(found.sigma)):.1f} mm, the 90 % interval holds {100 * share:.1f} % of the rest"
    )


if __name__ == "__main__":
    main()
