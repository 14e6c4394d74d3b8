"""Bodies of any size, from infants to giants: as well registered and dressed as adults of the same proportions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from smpl_file import smpl_arrays

from refu_core import GarmentPipeline, SmplFrame, load_body, load_garment
from refu_core.body import BodyFit, SmplBody, load_fit
from refu_core.garments import worn_on
from refu_core.metrics import CollisionChecker

MM = 1e-3


def sized(tall: float) -> SmplBody:
    """A body of a file's proportions that is so tall [m]."""
    arrays = smpl_arrays("female")
    scale = tall / np.ptp(arrays["v_template"][:, 1])
    scaled = {key: scale * arrays[key] for key in ("v_template", "shapedirs", "posedirs")}
    return SmplBody(type(load_body("male").arrays).from_mapping({**arrays, **scaled}, source="test"), name="sized")


@pytest.mark.parametrize("tall", [0.58, 2.4])
def test_a_body_of_any_size_is_registered_as_one_of_usual_height(tall: float) -> None:
    """Its garments are as large as it is; cloth stays as far off its skin as it is off an adult's."""
    usual, other = load_fit(sized(min(max(tall, 1.5), 2.0))), load_fit(sized(tall))
    assert usual.size == 1
    assert other.size == pytest.approx(tall / np.clip(tall, 1.5, 2), rel=1e-6)
    assert not other.warnings
    for name in ("mean_distance", "far_distance"):
        expected = other.size * getattr(usual.registration, name)
        assert getattr(other.registration, name) == pytest.approx(expected, rel=0.02)
    gap = np.linalg.norm(other.registration.vertices / other.size - usual.registration.vertices, axis=1)
    assert gap.mean() < 0.05 * MM  # rounding may decide which points are the closest
    assert gap.max() < 5 * MM
    garment = load_garment("tshirt-male")
    betas = torch.cat((torch.zeros(1, 10), 2 * torch.eye(10)))
    worn, cut = worn_on(garment, other), worn_on(garment, usual)
    assert (worn.rest(betas) - other.size * cut.rest(betas)).norm(dim=-1).max() < 5 * MM
    assert worn.styledirs is not None
    assert garment.styledirs is not None
    torch.testing.assert_close(worn.styledirs, other.size * garment.styledirs)
    checker = CollisionChecker(other.body.faces.numpy())
    checker.update(other.body.v_template.numpy())
    assert checker.check(worn.v_template.numpy(), worn.faces.numpy()).n_inside == 0


def test_folds_are_as_large_as_the_body() -> None:
    """Networks have learnt them from adults."""
    frame = SmplFrame(0.3 * np.sin(np.arange(72.0)).reshape(24, 3))
    draped = []
    for tall in (0.58, 1.5):  # which other tests have registered, too
        pipeline = GarmentPipeline.load(["tshirt-male"], body=sized(tall), sdf="none", collider=False)
        garment, posed = pipeline.garments["tshirt-male"], pipeline.body(frame.pose[None])
        skinned = garment.pose(garment.rest(torch.zeros(1, 10)), posed.transforms)[0]
        draped.append(pipeline(frame)["tshirt-male"].raw - skinned.numpy())
    assert np.abs(draped[1]).max() > 20 * MM
    assert np.abs(draped[0] - 0.58 / 1.5 * draped[1]).max() < 3 * MM


@pytest.mark.parametrize("tall", [0.58, 1.5])
@pytest.mark.parametrize(("mean", "far", "poor"), [(1.0, 9.0, False), (1.0, 11.0, True), (3.1, 5.0, True)])
def test_how_well_it_lies_is_judged_by_the_bodys_size(tall: float, mean: float, far: float, poor: bool) -> None:
    """And by the farthest points, too [mm on an adult]."""
    fit = load_fit(sized(tall))
    mean, far = mean * fit.size, far * fit.size
    found = BodyFit(fit.body, replace(fit.registration, mean_distance=mean * MM, far_distance=far * MM))
    assert found.is_poor == poor
    assert len(found.warnings) == poor
    if poor:
        assert f"{mean:.1f} mm on average, {far:.1f} mm at the 99th" in found.warnings[0]
        assert f"wanted {3 * fit.size:.2g} mm at most, and {10 * fit.size:.2g} mm" in found.warnings[0]
