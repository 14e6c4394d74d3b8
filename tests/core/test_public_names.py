"""What a stranger sees first: the names of `refu_core`, and what it says to a wrong type."""

from __future__ import annotations

import pydoc
import re
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import refu_core
from refu_core import ExactSdf, GarmentPipeline, PoseHistory, RefuError, Resolver, SmplFrame, load_body
from refu_core.backbones import PoseFeatures
from refu_core.keypoints import KeypointTracker, Proportions, Skeleton, keypoint_layout
from refu_core.metrics import SheetChecker
from refu_core.outputs import PinholeCamera
from refu_core.refu import Refu, repulse
from refu_core.sdf import SdfSample, query_batch


def test_dir_and_star_show_all_public_names() -> None:
    assert set(refu_core.__all__) <= set(dir(refu_core))
    assert refu_core.__all__ == sorted(refu_core.__all__)
    names: dict[str, Any] = {}
    exec("from refu_core import *", names)
    assert set(refu_core.__all__) <= set(names)


def test_packages_are_attributes_and_nothing_else_is_shown() -> None:
    """In an interpreter that has imported nothing but `refu_core`."""
    code = "import refu_core; print(*dir(refu_core)); refu_core.outputs.Clearance, refu_core.skeleton.JOINT_NAMES"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    names = {name for name in shown.split() if not name.startswith("__")}
    assert {"outputs", "simulation", "skeleton"} <= names
    assert not names & {"Any", "TYPE_CHECKING", "import_module", "annotations"}
    assert not any(name.startswith("_") for name in names)


def test_help_shows_all_public_names() -> None:
    text = pydoc.render_doc(refu_core, renderer=pydoc.plaintext)
    assert "GarmentPipeline.load" in text
    for name in refu_core.__all__:
        assert re.search(rf"^    (class )?{name}\b", text, flags=re.MULTILINE), name


def test_a_name_is_where_its_package_has_it() -> None:
    for name, package in refu_core._LAZY.items():
        assert getattr(refu_core, name).__module__.startswith(f"refu_core.{package}")
    with pytest.raises(AttributeError, match="no attribute 'Garment'"):
        refu_core.Garment  # noqa: B018


TETRAHEDRON = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
CORNERS = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


def posed() -> ExactSdf:
    sdf = ExactSdf(TETRAHEDRON)
    sdf.update(CORNERS)
    return sdf


def pipeline() -> GarmentPipeline:
    return GarmentPipeline.load(["short-pant-male"], backbone="skinned", sdf="none")


def resolver() -> Resolver:
    return Resolver(torch.tensor([[0, 1, 2]]), 3)


def skeleton() -> Skeleton:
    return Skeleton(keypoint_layout("coco17"), Proportions.builtin("male"))


FRAME = SmplFrame(pose=np.zeros(72))
SAMPLE = SdfSample(torch.zeros(3), torch.zeros(3, 3))


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: pipeline()("x"), "wanted a SmplFrame in every place of the sequence, got str"),
        (lambda: pipeline()(np.zeros((24, 3))), "wanted a SmplFrame or a sequence of them, got ndarray"),
        (lambda: pipeline()([FRAME, np.zeros(72)]), "wanted a SmplFrame in every place .*, got ndarray"),
        (lambda: pipeline()({"pose": 0}), "wanted a SmplFrame or a sequence of them, got dict"),
        (lambda: GarmentPipeline.load(5), "wanted names of garments, got int"),
        *(
            (lambda given=given: GarmentPipeline(*given), r"GarmentPipeline\.load\(\['tshirt-male'\]\) loads")
            for given in ((), (["tshirt-male"],), ("tshirt-male",), (5,))
        ),
        (
            lambda: GarmentPipeline.load(["short-pant-male"], margin="4 mm"),
            "wanted a margin in metres, or None, got str",
        ),
        (lambda: GarmentPipeline.load(["short-pant-male"], style="slim"), r"style must be \(4,\) numbers, got str"),
        (lambda: pipeline()(FRAME, margin=-1.0), "the margin must be between 0 and 0.05 m, got -1.0"),
        (lambda: load_body(5), "wanted a body's name or path, got int"),
        (lambda: load_body("male")(pose="standing"), "pose must be an array or tensor of numbers, got str"),
        (lambda: SmplFrame(pose="standing"), "pose must be .* numbers, got str"),
        (lambda: SmplFrame(pose=np.zeros(72), stamp_ns="now"), "stamp_ns must be a whole number .*, got 'now'"),
        (lambda: SmplFrame(pose=np.zeros(72), stamp_ns=0.033), "stamp_ns must be a whole number .*, got 0.033"),
        (lambda: posed().query(np.zeros((1, 3))), "points must be a floating-point torch.Tensor, got ndarray"),
        (lambda: posed().query(torch.zeros(1, 3, dtype=torch.long)), "floating-point torch.Tensor, got torch.int64"),
        (lambda: posed().query(torch.zeros(1, 3), near=[0]), "near must be integers .* got list"),
        (lambda: posed().update(CORNERS.numpy()), "the body's vertices must be a .*torch.Tensor, got ndarray"),
        (lambda: repulse(np.zeros((3, 3)), SAMPLE), "points must be a floating-point torch.Tensor, got ndarray"),
        (lambda: Refu(3, least=1.0)(np.zeros((1, 3, 3)), SAMPLE), "points must be .*torch.Tensor, got ndarray"),
        (lambda: resolver()(np.zeros((3, 3)), posed(), SAMPLE), "points must be .*torch.Tensor, got ndarray"),
        (lambda: resolver()(torch.zeros(1, 3), posed(), SAMPLE), r"wanted 3 points .* shapes \(1, 3\)"),
        (lambda: resolver()(torch.zeros(3, 3), posed(), SAMPLE), "start must name the closest faces"),
        (lambda: Refu(-1, least=1.0), "wanted a garment of at least one vertex, got -1"),
        (lambda: Refu("3", least=1.0), "wanted a number of vertices, got str"),
        (lambda: Refu(3, least=1.0, margin="4 mm"), "wanted a margin in metres, got str"),
        (lambda: Refu(3, least=1.0)(torch.zeros(1, 3, 3), 5), "wanted an SdfSample.*, got int"),
        (
            lambda: query_batch(posed(), CORNERS[None], CORNERS),
            r"wanted points of 1 bodies, .*, got the shape \(4, 3\)",
        ),
        (lambda: query_batch(posed(), CORNERS[None][:0], CORNERS[:0]), r"wanted points \(0, N, 3\) .* shape \(0, 3\)"),
        (lambda: Refu(3, least="1"), "wanted a least scale of 0 to 1, got str"),
        (lambda: Refu(3, least=np.nan), "a least scale of 0 to 1, got 0.004 m and nan"),
        *(
            (lambda given=given: Refu(3, least=1.0).feature(*given), said)
            for given, said in (
                ((np.zeros((1, 10)), torch.zeros(1, 24, 3), None), "wanted betas as a torch.Tensor.*, got ndarray"),
                ((torch.zeros(1, 10), torch.zeros(1, 72), None), r"pose must .* shape \(1, 24, 3\), got .* \(1, 72\)"),
                ((torch.zeros(2, 10), torch.zeros(1, 24, 3), None), r"pose must be .* shape \(2, 24, 3\)"),
                ((torch.zeros(1, 10), torch.zeros(1, 24, 3), torch.zeros(1, 3)), r"style must .* shape \(1, 4\)"),
            )
        ),
        (lambda: repulse(CORNERS, SAMPLE[:2]), "wanted an SdfSample.*, got tuple"),
        (lambda: repulse(CORNERS, SAMPLE, margin="4 mm"), "wanted a margin in metres, got str"),
        (lambda: resolver()(torch.zeros(3, 3), posed(), SAMPLE, margin=None), "a margin in metres, got NoneType"),
        (lambda: resolver()(torch.zeros(3, 3), None, SAMPLE), "wanted a distance to faces.*, got NoneType"),
        (lambda: ExactSdf(TETRAHEDRON, device="meta"), "no device 'meta': wanted cpu or cuda"),
        (lambda: load_body("male").rest_vertices(torch.zeros(1, 16)), r"betas must .* shape \(B, 10\), got .*16"),
        (lambda: load_body("male").rest_joints(torch.zeros(10)), r"betas must be .* shape \(B, 10\)"),
        (lambda: PoseFeatures((1, 20), "matrix")(torch.zeros(2, 10, 3)), r"pose must be .* shape \(B, 24, 3\)"),
        (lambda: pipeline().adjusted(FRAME, 3), "wanted a function of a Dressed, got int"),
        (lambda: pipeline().adjusted(FRAME, lambda _: None), "wanted a Dressed from what adjusts it, got NoneType"),
        (lambda: SheetChecker([[0, 1, 2]]).with_itself(), r"no garment yet: call update\(vertices\)"),
        (lambda: SheetChecker([[0, 1, 2]]).with_other(CORNERS, [[0, 1, 2]]), "no garment yet"),
        (lambda: PoseHistory()(FRAME, []), "wanted a person's name, got list"),
        (lambda: KeypointTracker(skeleton()).update("x", 0), "wanted 17 keypoints of coco17 as numbers: "),
        (lambda: KeypointTracker(skeleton()).update(np.zeros((17, 3)), "now"), "whole number of nanoseconds, got str"),
        (lambda: PinholeCamera.looking_at([0, 0], [0, 0, 1]), r"target must have the shape \(3,\), got \(2,\)"),
        (lambda: PinholeCamera.looking_at([0, 0, 0], "x"), r"eye must be \(3,\) numbers, got str"),
        (lambda: PinholeCamera.looking_at([0, 0, 0], [0, 0, 1], fov=4.0), "an angle below 180 degrees, got 640 pixels"),
    ],
)
def test_a_wrong_type_gets_a_sentence(call: Callable[[], object], said: str) -> None:
    with pytest.raises(RefuError, match=said):
        call()
