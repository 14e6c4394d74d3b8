"""What is of another kind than was wanted, or belongs to something else, gets a sentence."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import msg_adapters as adapters
from refu_core import (
    ApproxSdf,
    ExactSdf,
    GarmentPipeline,
    MeshError,
    RefuError,
    Resolver,
    SmplFrame,
    Wearer,
    load_body,
    load_garment,
)
from refu_core.garments import worn_on
from refu_core.keypoints import KeypointTracker, Proportions, Skeleton, keypoint_layout
from refu_core.mesh import Connectivity
from refu_core.metrics import FoldBands
from refu_core.outputs import Clearance, LimbContacts, PinholeCamera, PlannerMesh, Sigma, all_visible
from refu_core.refu import repulse
from refu_core.sdf import SdfSample
from refu_lab.export import meshes_of

WORN = "short-pant-male"
FRAME = SmplFrame(np.zeros((24, 3)))
FACES = np.array([[0, 1, 2], [0, 2, 3]])


@functools.cache
def pipeline(garment: str = WORN) -> GarmentPipeline:
    return GarmentPipeline.load([garment], backbone="skinned", sdf="none")


def _wide(width: Any) -> Any:
    camera = PinholeCamera.looking_at([0, 0, 0], [0, 0, 3])
    return all_visible([(np.eye(4)[:, :3], FACES)], camera, buffer_width=width)


def _pushed(kind: torch.dtype) -> Any:
    sample = SdfSample(torch.full((2,), -0.01), torch.ones(2, 3))
    return repulse(torch.zeros(2, 3, dtype=kind), sample, margin=0.004)


WRONG: list[tuple[Callable[[], Any], str]] = [
    (lambda: SmplFrame(FRAME.pose, betas=None), "betas must be .* numbers, got NoneType: nothing"),  # type: ignore[arg-type]
    (lambda: adapters.decoder_for(None), "wanted an input type, got None"),  # type: ignore[arg-type]
    (lambda: Clearance.of(pipeline())({}), "a pipeline's output of one person, got dict"),  # type: ignore[arg-type]
    (lambda: LimbContacts.of(pipeline())({}), "a pipeline's output of one person, got dict"),  # type: ignore[arg-type]
    (lambda: Sigma(pipeline())(None, pipeline()(FRAME)), "wanted a SmplFrame, got NoneType"),  # type: ignore[arg-type]
    (lambda: KeypointTracker(None), "wanted a Skeleton, got NoneType"),  # type: ignore[arg-type]
    (lambda: Skeleton("coco17", Proportions.builtin("male")), "wanted a layout"),  # type: ignore[arg-type]
    (lambda: Skeleton(keypoint_layout("coco17"), None), "wanted a body's Proportions"),  # type: ignore[arg-type]
    (
        lambda: KeypointTracker(Skeleton(keypoint_layout("coco17"), Proportions.builtin("male"))).at(0.5),  # type: ignore[arg-type]
        "whole number of nanoseconds, got float",
    ),
    (lambda: meshes_of(pipeline(), pipeline("tshirt-male")(FRAME)), "got one with tshirt-male"),
    (lambda: meshes_of(pipeline(), []), "got none"),
    (lambda: meshes_of(pipeline(), [None]), "got NoneType"),  # type: ignore[list-item]
    (lambda: _pushed(torch.float64), "must be of one type, got torch.float64 and torch.float32"),
    *(
        (lambda n=n: Connectivity.of(FACES, n), "wanted a number of vertices")
        for n in (math.nan, 4.5, "4", 10**30, [4])
    ),
    (lambda: Connectivity.of(np.ma.masked_equal(FACES, 3)), "faces must be integers"),
    (lambda: FoldBands(Connectivity.of(FACES)).split(np.ones((5, 3))), r"shape \(4, \.\.\.\), got \(5, 3\)"),
    (lambda: Resolver(FACES, "4"), "wanted a number of vertices"),  # type: ignore[arg-type]
    *(
        (lambda n=n: adapters.MarkerMesh("a", FACES, n), "a: wanted a number of vertices")
        for n in (math.nan, None, "x")
    ),
    (lambda: adapters.MarkerMesh(5, FACES, 4), "wanted a marker's namespace, got int"),  # type: ignore[arg-type]
    (lambda: worn_on(load_garment(WORN), load_body("male")), "wanted a body's fit .*, got SmplBody"),  # type: ignore[arg-type]
    (lambda: worn_on(WORN, None), "wanted a garment .*, got str"),  # type: ignore[arg-type]
    (lambda: Wearer.of(pipeline(), torch.zeros(1, 10)), "a pipeline's outfit, got GarmentPipeline"),  # type: ignore[arg-type]
    (lambda: ApproxSdf("male"), "wanted a body .*, got str"),  # type: ignore[arg-type]
    (lambda: Proportions.of_body("male"), "wanted a body .*, got str"),
    (lambda: meshes_of(FRAME, pipeline()(FRAME)), "wanted a GarmentPipeline, got SmplFrame"),  # type: ignore[arg-type]
    (lambda: ExactSdf(torch.zeros(4, 3, requires_grad=True)), "faces must be integers"),
    *(
        (lambda n=n: GarmentPipeline.load([WORN], **{n: "false"}), f"wanted {n} as True or False, got str")  # type: ignore[arg-type]
        for n in ("graph", "certify", "collider")
    ),
    *((lambda n=n: PlannerMesh(load_garment(WORN), n), "triangles or more") for n in (math.nan, math.inf)),
    *((lambda n=n: _wide(n), "width.*number of pixels") for n in (None, math.nan, math.inf, 0, np.ones(2))),
]


@pytest.mark.parametrize(("do", "said"), WRONG)
def test_it_gets_a_sentence(do: Callable[[], Any], said: str) -> None:
    with pytest.raises(RefuError, match=said) as error:
        do()
    assert len(str(error.value)) <= 300


def test_what_is_whole_is_a_count_in_any_type() -> None:
    for n in (4, 4.0, np.int64(4), np.uint8(4)):
        assert Connectivity.of(FACES, n).n_vertices == 4  # type: ignore[arg-type]
    with pytest.raises(MeshError, match="index vertices 0 to 2, got 0 to 3"):
        Connectivity.of(FACES, 3)
