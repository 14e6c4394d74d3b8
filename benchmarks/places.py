"""How many meshes of unknown origin `refu_core.fitting` puts where they belong.

    python benchmarks/places.py              # each mesh that isn't, and how many are
    python benchmarks/places.py --numbers    # the same with each of its numbers halved and doubled, in hours

Meshes are built-in garments as somebody else may have modelled them: on arms that hang, spread legs or bent elbows, for
a taller or shorter wearer, in any unit, axes and place. A place is right if it is the first of
`find_places` with the unit, the way up, the front and the arms that the mesh was made with.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from types import ModuleType
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from refu_core import GarmentError, load_body, load_garment
from refu_core.body import SmplBody, apply_transforms, blend_transforms
from refu_core.fitting import UNITS, Placing, SurfaceMesh, _found, _place, _surround, _ways, standing_pose
from refu_core.fitting._found import Place
from refu_core.fitting._place import find_places
from refu_core.garments import BUILTIN_GARMENTS

F64 = NDArray[np.float64]
MODULES = (_found, _place, _surround, _ways)
"""Where the numbers are; some are known to several of them."""
SCALES = (1.0, 1.0, 0.93, 1.07)
"""How tall the wearer is, as shares of the body's height."""


class Case(NamedTuple):
    """A mesh, and how it was made."""

    mesh: SurfaceMesh
    body: SmplBody
    unit: float
    """Metres of its unit."""
    turn: F64
    """What brings it upright, shape (3, 3)."""
    arms: float | None
    """How far they hang [rad]; None for a garment without sleeves."""
    is_of_size_one: bool
    scale: float
    """How tall its wearer is, as a share of the body's height."""

    def is_right(self, place: Place) -> bool:
        """Whether a place is where the mesh belongs; clothes of another wearer may be made as large as the body's."""
        off = np.abs(place.unit / self.unit / np.array([1, 1 / self.scale]) - 1).min() < (
            0.1 if self.is_of_size_one else 0.03
        )
        arms = -place.pose[17, 2] if self.arms is not None else 0.0
        return bool(off and np.allclose(place.turn, self.turn, atol=0.2)) and abs(abs(arms) - (self.arms or 0)) < 0.175


def cases(n: int, seed: int) -> Iterator[Case]:
    """Meshes drawn at random."""
    rng = np.random.default_rng(seed)
    for k in range(n):
        garment = load_garment(BUILTIN_GARMENTS[k % len(BUILTIN_GARMENTS)])
        body = load_body(garment.body)
        kind = rng.integers(4)
        arms = 0.0 if kind == 0 else float(rng.uniform(0.2, 1.1))
        legs, elbows = (float(rng.uniform(0.05, 0.3)), 0.0) if kind == 2 else (0.0, 0.4 * float(kind == 3))
        pose = torch.as_tensor(standing_pose(arms, legs, elbows), dtype=torch.float32)
        transforms = body(pose[None]).transforms
        posed = apply_transforms(garment.v_template[None], blend_transforms(garment.weights, transforms))
        scale = float(rng.choice(SCALES))
        v = scale * posed[0].double().numpy()
        floor = np.array([0, scale * float(body(pose[None]).vertices[0, :, 1].min()), 0])
        middle = (v.min(0) + v.max(0)) / 2
        is_of_size_one = bool(rng.random() < 0.15)  # as in data sets of shapes, which are centred
        v = v - (middle if is_of_size_one else [np.zeros(3), floor, middle][rng.integers(3)])
        z_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # from the file to the body
        half = np.diag([-1.0, 1, -1])
        turn = (half if rng.random() < 0.25 else np.eye(3)) @ (z_up if rng.random() < 0.5 else np.eye(3))
        unit = float(np.ptp(v, axis=0).max() if is_of_size_one else rng.choice([*UNITS.values()]))
        has_sleeves = bool((garment.weights[:, [18, 19]] > 0.3).any())
        yield Case(
            SurfaceMesh(v @ turn / unit, garment.faces.long().numpy()),
            body, unit, turn, arms if has_sleeves else None, is_of_size_one, scale,
        )  # fmt: skip


def measure(meshes: list[Case]) -> list[str]:
    """What is found for each mesh that isn't put where it belongs."""
    wrong = []
    for k, case in enumerate(tqdm(meshes, leave=False)):
        try:
            place = next(find_places(case.mesh, case.body, Placing()))
        except GarmentError as error:
            wrong.append(f"{k}: {error}")
            continue
        if not case.is_right(place):
            wrong.append(f"{k}: a unit of {case.unit:.4g} m, taken for {place.unit:.4g}; {', '.join(place.notes)}")
    return wrong


def numbers() -> Iterator[tuple[str, list[ModuleType], float]]:
    """Each number of the modules: its name, who knows it, and its value."""
    seen = {name: value for module in MODULES for name, value in vars(module).items() if name.isupper()}
    for name, value in seen.items():
        if isinstance(value, float) or name.startswith("_N_"):
            yield name, [module for module in MODULES if hasattr(module, name)], value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--numbers", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    meshes = list(cases(args.count, args.seed))
    wrong = measure(meshes)
    print(*wrong, f"{args.count - len(wrong)} of {args.count} are right", sep="\n")
    for name, modules, value in numbers() if args.numbers else ():
        for factor in (0.5, 2):
            other = type(value)(factor * value)
            for module in modules:
                setattr(module, name, other)
            print(f"{name} {value:g} -> {other:g}: {args.count - len(measure(meshes))} are right")
        for module in modules:
            setattr(module, name, value)


if __name__ == "__main__":
    main()
