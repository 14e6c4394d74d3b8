"""Poses in which a body touches itself: that they do, and the picture of what becomes of them."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from refu_core import GarmentPipeline, SmplFrame
from refu_core.body import JOINT_NAMES
from refu_core.metrics import SelfContactDetector
from refu_core.simulation import SELF_TOUCHING, posture


@pytest.fixture(scope="module")
def pipeline() -> GarmentPipeline:
    return GarmentPipeline.load(["short-pant-male"], backbone="skinned", sdf="none")


@pytest.mark.parametrize("name", SELF_TOUCHING)
def test_skin_runs_through_itself_and_the_collider_by_far_less(name: str, pipeline: GarmentPipeline) -> None:
    """Between fingers, where nothing is worn, anything may happen."""
    out = pipeline(SmplFrame(pose=posture(name)))
    body = pipeline.body
    detector = SelfContactDetector(body.faces, body.v_template)
    hands = [JOINT_NAMES.index(f"{side}_{name}") for side in ("left", "right") for name in ("wrist", "hand")]
    is_hand = np.isin(body.weights.argmax(1), hands)
    of_hand = is_hand[body.faces].any(1)
    skin, collider = (
        int((~of_hand[detector.detect(vertices).pairs].any(1)).sum()) for vertices in (out.skin, out.body)
    )
    assert skin > 50
    assert collider < 0.5 * skin


@pytest.mark.usefixtures("little_light")
def test_sheet_has_a_column_a_pose() -> None:
    script = runpy.run_path(str(Path(__file__).parents[2] / "scripts" / "make_pictures.py"))
    sheet = script["collider_sheet"](garments=["short-pant-male"], poses=["prayer", "squat"], size=(30, 40), samples=1)
    assert sheet.shape == (120, 60, 3)
    skin, collider, dressed = sheet[:40].astype(int), sheet[40:80].astype(int), sheet[80:].astype(int)
    assert 0 < np.abs(skin - collider).max(2).astype(bool).mean() < 0.5  # what was moved is red
    assert (np.abs(dressed - skin).max(2) > 30).mean() > 0.01  # and here are the pants
