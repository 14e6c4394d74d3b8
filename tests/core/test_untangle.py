"""Cloth that has come to rest through itself is levelled, and other cloth isn't touched."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch

from refu_core.body import load_body
from refu_core.garments import load_garment
from refu_core.metrics import CollisionChecker, SheetChecker
from refu_core.simulation._drape import Draper, Untangle

if TYPE_CHECKING:
    from numpy.typing import NDArray

MARGIN = 0.004


class Crook:
    """A shirt skinned to an elbow that is bent so far that the sleeve's folds run through each other."""

    def __init__(self) -> None:
        body, self.garment = load_body("male"), load_garment("shirt-male")
        draper = Draper(self.garment, body)
        pose, betas = np.zeros((24, 3), np.float32), np.zeros(10, np.float32)
        pose[18, 1] = -2.2
        self.body: NDArray[np.float32] = draper.bodies(pose[None], betas)[0]
        self.faces = body.faces.numpy()
        transforms = body(torch.from_numpy(pose)[None], torch.zeros(1, 10)).transforms
        rest = torch.from_numpy(draper.rest(betas, np.zeros(4)))
        self.shirt: NDArray[np.float32] = self.garment.pose(rest[None], transforms)[0].numpy()
        self.untangle = Untangle(self.garment.mesh, draper._sdf, margin=MARGIN)

    def crossings(self, vertices: NDArray[np.float32]) -> NDArray[np.int32]:
        sheet = SheetChecker(self.garment.faces)
        sheet.update(vertices)
        return sheet.with_itself()


@pytest.fixture(scope="module")
def crook() -> Crook:
    return Crook()


def test_faces_that_intersect_no_longer_do_and_cloth_stays_off_the_skin(crook: Crook) -> None:
    level = crook.untangle(crook.shirt, crook.body)
    assert len(crook.crossings(crook.shirt)) > 0
    assert len(crook.crossings(level)) == 0
    moved = np.linalg.norm(level - crook.shirt, axis=1) > 0
    arm = crook.garment.weights.numpy()[:, [16, 18]].sum(1) > 0.1
    assert moved.any()
    assert not moved[~arm].any()
    checker = CollisionChecker(crook.faces)
    checker.update(crook.body)
    found = checker.check(level, crook.garment.faces.numpy())
    assert not found.inside[moved].any()


def test_cloth_without_intersections_is_the_very_same(crook: Crook) -> None:
    level = crook.untangle(crook.shirt, crook.body)
    assert crook.untangle(level, crook.body) is level
