"""Folds made stronger in a network's output basis: the same network, with other bands."""

from __future__ import annotations

import runpy
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from small_set import write_set

from refu_core import load_body, load_garment
from refu_core.backbones import BasisDecoder, TailorNetConfig, build_backbone
from refu_core.garments import GarmentTemplate
from refu_core.metrics import FoldBands
from refu_core.weights import load_card, weights_folder

SCRIPT = Path(__file__).parents[2] / "scripts" / "sharpen_folds.py"
GAINS = (2.0, 1.5, 1.2, 1.0)
SMALL = TailorNetConfig((0, 1, 2, 4, 5), low=(24, 16), high=(8, 6), style_shape=(8,))


@pytest.fixture(scope="module")
def garment() -> GarmentTemplate:
    return load_garment("short-pant-male")


def random_basis(garment: GarmentTemplate) -> BasisDecoder:
    torch.manual_seed(0)
    rows = torch.linalg.qr(torch.randn(3 * garment.n_vertices, 8)).Q.T
    return BasisDecoder(0.01 * torch.randn(garment.n_vertices, 3), rows)


def test_bands_add_up_and_a_plane_has_none() -> None:
    garment = load_garment("short-pant-male")
    bands = FoldBands(garment.mesh)
    split = bands.split(garment.v_template)
    assert np.allclose(split.sum(axis=0), garment.v_template.numpy(), atol=1e-12)
    assert bands.energies(np.full((garment.n_vertices, 3), 0.3)) == pytest.approx(np.zeros(4), abs=1e-20)


def test_a_network_in_other_codes_says_the_same_but_louder(garment: GarmentTemplate) -> None:
    basis, bands = random_basis(garment), FoldBands(garment.mesh)
    net = build_backbone(SMALL, garment, basis=basis, pivots=torch.randn(3, 14)).eval()
    script = runpy.run_path(str(SCRIPT))
    mean, components = script["sharpened"](basis, bands, GAINS)
    rows, to_new = script["orthonormal"](components)
    assert torch.allclose(rows @ rows.T, torch.eye(8), atol=1e-5)
    assert bool((torch.einsum("rc,rc->r", rows, components) > 0).all())
    louder = build_backbone(SMALL, garment, basis=BasisDecoder(mean, rows), pivots=net.pivots).eval()
    state = {name: tensor for name, tensor in net.state_dict().items() if not name.startswith("decoder.")}
    louder.load_state_dict(script["in_new_codes"](state, to_new), strict=False)
    betas, pose, style = torch.randn(2, 10), 0.5 * torch.randn(2, 24, 3), torch.randn(2, 4)
    code = net.wearer_code(betas, style)
    with torch.no_grad():
        before = net(betas, pose, style, wearer_code=code)
        after = louder(betas, pose, style, wearer_code=code)
    for one, other in zip(before, after, strict=True):
        wanted = np.einsum("b,bvc->vc", [*GAINS, 1.0], bands.split(one))
        error = np.abs(other.numpy() - wanted).max()
        assert error < 2e-3 * np.abs(wanted).max()  # the basis is stored in half precision


def test_the_script_rewrites_all_modes(
    garment: GarmentTemplate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / garment.name
    shutil.copytree(weights_folder(garment.name), folder)
    write_set(tmp_path / "data", garment, load_body(garment.body), pairs=2, poses=1, test_pairs=1)
    arguments = [str(folder), "--data", str(tmp_path / "data"), "--count", "1", "--rounds", "2"]
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *arguments])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    said = capsys.readouterr().out.splitlines()
    tried, rewritten = ([float(one) for one in line.split("[")[-1].split("]")[0].split()] for line in said[-2:])
    assert rewritten == pytest.approx(tried, abs=0.01)
    digests = {load_card(folder / f"tailornet-{mode}")["basis_sha256"] for mode in ("hybrid", "none", "approx")}
    assert digests == {load_card(folder / "basis")["sha256"]}
