"""The paper's layer inside a network of your own: trained end to end, its predictions stay off the body.

python examples/refu_layer.py
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from refu_core import GarmentTemplate, SmplBody, load_body, load_garment
from refu_core.refu import Refu
from refu_core.sdf import ExactSdf, query_batch
from refu_core.training import refu_loss


class Clothes(nn.Module):
    """Any network from body parameters to vertices, with ReFU as its last layer."""

    def __init__(self, body: SmplBody, garment: GarmentTemplate) -> None:
        super().__init__()
        self.body, self.garment = body, garment
        self.offsets = nn.Linear(72, 3 * garment.n_vertices)  # stands for your network
        self.refu = Refu(garment.n_vertices, least=1.0)  # α ≥ 1: the distance is exact
        self.sdf = ExactSdf(body.faces)

    def forward(self, betas: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Garments (B, N, 3) and their signed distances (B, N) [m], for betas (B, 10) and pose (B, 24, 3) [rad]."""
        posed = self.body(pose, betas)
        offsets = 0.01 * self.offsets(pose.flatten(1)).view(len(pose), -1, 3)
        raw = self.garment.pose(self.garment.rest(betas) + offsets, posed.transforms)
        sample = query_batch(self.sdf, posed.vertices, raw)
        worn = self.refu(raw, sample, self.refu.feature(betas, pose, None))
        return worn, query_batch(self.sdf, posed.vertices, worn).distance


def main(steps: int = 15) -> tuple[float, float, float]:
    """Returns the loss of the first and of the last step, and the share of vertices inside the body at the end."""
    torch.manual_seed(0)
    garment = load_garment("short-pant-male")
    body = load_body(garment.body)
    betas, pose = 0.5 * torch.randn(4, 10), 0.1 * torch.randn(4, 24, 3)
    longer = torch.tensor([[1.5, 0.0, 0.0, 0.0]]).expand(4, 4)  # γ; stands for your ground truth
    truth = garment.pose(garment.rest(betas, longer), body(pose, betas).transforms)
    network, losses = Clothes(body, garment), []
    optimizer = torch.optim.Adam(network.parameters(), lr=0.1)
    for _ in range(steps):
        worn, distance = network(betas, pose)
        loss = refu_loss(worn, truth, distance)
        optimizer.zero_grad()
        loss.backward()
        losses.append(loss.item())
        optimizer.step()
    inside = float((network(betas, pose)[1] < 0).float().mean())
    print(f"loss {losses[0]:.2e} → {losses[-1]:.2e}; {100 * inside:.3f} % of the vertices are inside the body")
    return losses[0], losses[-1], inside


if __name__ == "__main__":
    main()
