#!/usr/bin/env python3
"""Judges every stored garment of a simulated set anew, by libraries that had no part in making it.

Body and garment: python-fcl (pairs of triangles) and libigl (signed distance, its sign by winding number). The garment
itself: python-fcl. Stretch: edges of the stored garment against its cut.

    python scripts/verify_dataset.py data/tshirt-male --processes 2 > report.json

The set's files are read as docs/guide/data.md describes them, not through the project's own reader. Exit code 1 where a
sample isn't what it should be.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import fcl
import igl
import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from refu_core.body import Collider, ColliderSettings, load_body
from refu_core.garments import load_garment
from refu_core.simulation import colliders
from refu_core.simulation._drape import COMFORT_POSES
from refu_core.simulation._joined import JoinedGarments

F64 = NDArray[np.float64]
MOST_EASE = 1.15
"""How much longer an edge may be cut where raised arms need it."""
Place = tuple[Path, int, int]
"""Shard, row, and frame of a sequence (-1 in a set of samples)."""


@dataclass(frozen=True)
class Verdict:
    """What was found in one garment."""

    place: str
    slot: int
    body_pairs: int
    """Pairs of intersecting triangles of garment and body, by fcl."""
    inside: int
    """Vertices inside the body, by libigl."""
    clearance_mm: float
    """Smallest signed distance of a vertex to the skin."""
    self_pairs: int
    """Pairs of the garment's triangles, without a common vertex, that intersect."""
    stretch: float
    """Length over rest length, 99.9th percentile over the edges."""
    most_stretch: float
    """The `stretch` that the set's card allows."""

    @property
    def is_good(self) -> bool:
        return not (self.body_pairs or self.inside or self.self_pairs) and not self.is_stretched

    @property
    def is_stretched(self) -> bool:
        return self.stretch > self.most_stretch


class Judge:
    """Judges garments of one kind, or of several worn together, on one body."""

    def __init__(self, garment: str, body: str, gap: float, most_stretch: float) -> None:
        self._garment = JoinedGarments([load_garment(name) for name in garment.split("+")]).joined
        self._body = load_body(body)
        self._collider = Collider(self._body, settings=ColliderSettings(gap=gap))
        self._faces = self._garment.faces.numpy().astype(np.int64)
        self._body_faces = self._body.faces.numpy().astype(np.int64)
        self._edges = self._garment.mesh.edges
        self._lengths: tuple[bytes, F64] | None = None
        self._most_stretch = most_stretch

    def judge(self, place: str, slot: int, vertices: F64, pose: Any, betas: Any, style: Any) -> Verdict:
        """Judges one garment (N, 3) [m] on the collider of this pose (24, 3), shape (10,) and style (4,)."""
        shape = torch.from_numpy(np.array(betas))[None]
        body = colliders(self._body, self._collider, np.array(pose)[None], np.array(betas))[0].astype(np.float64)
        distance = igl.signed_distance(vertices, body, self._body_faces, igl.SIGNED_DISTANCE_TYPE_FAST_WINDING_NUMBER)
        length = np.linalg.norm(vertices[self._edges[:, 0]] - vertices[self._edges[:, 1]], axis=1)
        return Verdict(
            place,
            slot,
            body_pairs=len(intersecting_pairs(vertices, self._faces, body, self._body_faces)),
            inside=int((distance[0] <= 0).sum()),
            clearance_mm=float(1e3 * distance[0].min()),
            self_pairs=self_intersections(vertices, self._faces),
            stretch=float(np.percentile(length / self._rest_lengths(shape, np.array(style)), 99.9)),
            most_stretch=self._most_stretch,
        )

    def _rest_lengths(self, shape: torch.Tensor, style: NDArray[np.float32]) -> F64:
        """Edge lengths of the cut [m], with up to 15 % of room for raised arms and bent elbows; shape (E,)."""
        key = shape.numpy().tobytes() + style.tobytes()
        if self._lengths is None or self._lengths[0] != key:
            rest = self._garment.rest(shape, self._garment.own(torch.from_numpy(style)[None]))
            poses = COMFORT_POSES
            eased = self._garment.pose(rest.expand(len(poses), -1, -1), self._body(poses, shape).transforms)
            both = torch.cat((rest, eased)).numpy().astype(np.float64)
            length = np.linalg.norm(both[:, self._edges[:, 0]] - both[:, self._edges[:, 1]], axis=-1)
            self._lengths = key, np.clip(length.max(0), length[0], MOST_EASE * length[0])
        return self._lengths[1]


def intersecting_pairs(first: F64, first_faces: Any, second: F64, second_faces: Any) -> NDArray[np.int64]:
    """Pairs of triangles of two meshes that intersect, by fcl, shape (K, 2)."""

    def model(vertices: F64, faces: Any) -> Any:
        bvh = fcl.BVHModel()
        bvh.beginModel(len(vertices), len(faces))
        bvh.addSubModel(vertices, faces)
        bvh.endModel()
        return fcl.CollisionObject(bvh, fcl.Transform())

    request = fcl.CollisionRequest(num_max_contacts=1_000_000, enable_contact=True)  # the default stops counting early
    result = fcl.CollisionResult()
    fcl.collide(model(first, first_faces), model(second, second_faces), request, result)
    pairs = [(contact.b1, contact.b2) for contact in result.contacts]
    return np.unique(np.array(pairs, np.int64).reshape(-1, 2), axis=0)


def self_intersections(vertices: F64, faces: NDArray[np.int64]) -> int:
    """Pairs of triangles without a common vertex that intersect."""
    pairs = np.unique(np.sort(intersecting_pairs(vertices, faces, vertices, faces), axis=1), axis=0)
    return int((~(faces[pairs[:, 0]][:, :, None] == faces[pairs[:, 1]][:, None]).any((1, 2))).sum())


def places(directory: Path, card: dict[str, Any]) -> list[Place]:
    """All garments that are in the set."""
    found: list[Place] = []
    for shard in sorted(directory.glob("shard-*-of-*")):
        done = np.load(shard / "state.npy", mmap_mode="r") == 1
        if card["format"] == "refu-sequences-2":
            kept = (np.load(shard / "cause.npy", mmap_mode="r") == 0) & done[:, None]
            found += [(shard, int(row), int(frame)) for row, frame in np.argwhere(kept)]
        else:
            found += [(shard, int(row), -1) for row in np.flatnonzero(done)]
    return found


@cache
def _judge(garment: str, body: str, gap: float, most_stretch: float) -> Judge:
    torch.set_num_threads(1)
    return Judge(garment, body, gap, most_stretch)


@cache
def _columns(shard: Path) -> dict[str, Any]:
    return {
        name: np.load(shard / f"{name}.npy", mmap_mode="r") for name in ("slot", "vertices", "pose", "betas", "style")
    }


def _verdict(task: tuple[Place, tuple[str, str, float, float], float]) -> Verdict:
    (shard, row, frame), judged_by, quantum = task
    column = _columns(shard)
    at = (row,) if frame < 0 else (row, frame)
    place = f"{shard.name} row {row}" + ("" if frame < 0 else f" frame {frame}")
    vertices = column["vertices"][at].astype(np.float64) * quantum
    slot = int(column["slot"][row])
    return _judge(*judged_by).judge(
        place, slot, vertices, column["pose"][at], column["betas"][row], column["style"][row]
    )


def verdicts(directory: Path, *, body: str | None = None, processes: int = 1, every: int = 1) -> Iterator[Verdict]:
    """Judges every `every`-th garment of a set."""
    card = json.loads((directory / "card.json").read_text())
    body = body or load_garment(card["garment"].split("+")[0]).body
    if load_body(body).fingerprint != card["body_fingerprint"]:
        sys.exit(f"{directory}: made for another body than {body!r}: name its file as --body")
    settings = card["settings"]
    judged_by = (card["garment"], body, float(settings["drape"]["gap"]), float(settings["selection"]["stretch"]))
    tasks = [(place, judged_by, float(card["quantum_m"])) for place in places(directory, card)[::every]]
    with nullcontext() if processes == 1 else ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        found = map(_verdict, tasks) if pool is None else pool.map(_verdict, tasks, chunksize=16)
        yield from tqdm(found, total=len(tasks), unit="garment", disable=None)


def summary(found: list[Verdict]) -> dict[str, Any]:
    """Counts, extremes, and each garment that isn't good."""
    return {
        "garments": len(found),
        "with_body_pairs": sum(v.body_pairs > 0 for v in found),
        "with_vertices_inside": sum(v.inside > 0 for v in found),
        "with_self_intersections": sum(v.self_pairs > 0 for v in found),
        "stretched": sum(v.is_stretched for v in found),
        "smallest_clearance_mm": min((v.clearance_mm for v in found), default=None),
        "stretch_p999_median": float(np.median([v.stretch for v in found])) if found else None,
        "stretch_p999_largest": max((v.stretch for v in found), default=None),
        "bad": [asdict(v) for v in found if not v.is_good],
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("directory", type=Path)
    parser.add_argument("--body", help="name or file of the body, where it isn't the garment's own")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--every", type=int, default=1, metavar="K", help="only every K-th garment")
    arguments = parser.parse_args()
    options = {"body": arguments.body, "processes": arguments.processes, "every": arguments.every}
    report = {"set": arguments.directory.name, **summary(list(verdicts(arguments.directory, **options)))}
    print(json.dumps(report, indent=1))
    return int(bool(report["bad"]))


if __name__ == "__main__":
    sys.exit(main())
