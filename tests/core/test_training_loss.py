"""What networks learn by: the mean distance between vertices."""

from __future__ import annotations

import torch

from refu_core.backbones import BasisDecoder
from refu_core.backbones._decoder import DenseDecoder
from refu_core.training import _loss as loss_module
from refu_core.training._loss import VertexError, vertex_loss

N, RANK = 40, 6


def a_basis(n: int = N) -> BasisDecoder:
    random = torch.Generator().manual_seed(0)
    components = torch.linalg.qr(torch.randn(3 * n, RANK, generator=random)).Q.T
    return BasisDecoder(0.1 * torch.randn(n, 3, generator=random), components)


def test_the_error_is_the_mean_distance_of_vertices_in_millimetres() -> None:
    basis, random = a_basis(), torch.Generator().manual_seed(1)
    codes, truth = torch.randn(5, RANK, generator=random), torch.randn(5, N, 3, generator=random)
    found = VertexError(basis)
    slow = (
        sum(1e3 * (basis(code[None])[0] - one).norm(dim=1).mean() for code, one in zip(codes, truth, strict=True)) / 5
    )
    torch.testing.assert_close(found(codes, found.targets(truth)), slow, rtol=1e-5, atol=0)


def test_large_garments_are_compared_at_some_vertices_spread_over_all_of_them() -> None:
    n = 20 * loss_module._COMPARED
    basis = BasisDecoder(torch.zeros(n, 3), torch.eye(1, 3 * n))
    error = VertexError(basis)
    displacement = torch.zeros(1, n, 3)
    displacement[0, :, 0] = torch.linspace(0, 1, n)  # its mean distance from nothing is half a metre
    targets = error.targets(displacement)
    assert targets.shape == (1, 3 * loss_module._COMPARED)
    assert abs(float(error(torch.zeros(1, 1), targets)) - 500) < 30


def test_what_it_asks_for_is_the_median_of_what_cloth_may_do_and_not_the_mean() -> None:
    basis, random = a_basis(), torch.Generator().manual_seed(2)
    usual, rare = torch.randn(2, RANK, generator=random)
    truth = basis(torch.stack((usual, usual, usual, rare))).detach()
    error, code = VertexError(basis), torch.zeros(1, RANK, requires_grad=True)
    optimiser = torch.optim.Adam([code], lr=0.02)
    for step in range(1500):
        for group in optimiser.param_groups:
            group["lr"] = 0.02 * (1 - step / 1500)
        optimiser.zero_grad()
        error(code.expand(4, -1), error.targets(truth)).backward()
        optimiser.step()
    assert (code.detach()[0] - usual).norm() < 0.01 * (rare - usual).norm()


def test_nothing_is_wrong_with_a_network_that_is_right() -> None:
    basis, code = a_basis(), torch.zeros(1, RANK, requires_grad=True)
    error = VertexError(basis)
    found = error(code, error.targets(basis(code.detach())))
    found.backward()
    assert found.item() < 1e-3
    assert code.grad is not None
    assert bool(code.grad.isfinite().all())


def test_dense_codes_are_compared_coordinate_by_coordinate() -> None:
    truth = torch.tensor([[[0.001, 0.002, -0.003]]])
    torch.testing.assert_close(vertex_loss(torch.zeros(1, 3), DenseDecoder(1).encode(truth)), torch.tensor(2.0))
