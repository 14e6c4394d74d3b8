"""The paper's network for the signed distance to the body, conditioned on β and θ (supplement, Sec. A)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from refu_core.body import SmplBody, rotvec_to_rotmat
from refu_core.errors import MeshError, WeightsError
from refu_core.frames import N_BETAS, N_JOINTS
from refu_core.garments import GarmentTemplate
from refu_core.sdf._mesh import require_points
from refu_core.sdf._protocol import GarmentSdf, SdfSample, plain_garment_sdf
from refu_core.weights import build_for, config_of_card, load_weights, naming, save_weights

_CONDITION = N_BETAS + 3 * (N_JOINTS - 1)
_MOST_LAYERS = 64
_CHUNK = 4096  # points whose activations are held at a time without a graph: 150 MB for the paper's


@dataclass(frozen=True)
class SdfNetworkConfig:
    """Sizes of the network; the defaults are the paper's."""

    width: int = 1024
    hidden: int = 9
    """Hidden layers."""
    skip: int = 4
    """Layer whose input is joined by the query point."""
    sharpness: float = 100.0
    """β of the softplus, which nears a ReLU as β grows."""
    radius: float = 0.5
    """Radius of the sphere that an untrained network is the distance to [m]."""

    def __post_init__(self) -> None:
        """Raises `WeightsError` for sizes that make no network."""
        if self.width < 1 or not 0 < self.skip < self.hidden or not (self.sharpness > 0 and self.radius > 0):
            msg = f"wanted positive sizes and a skip among the hidden layers after the first, got {asdict(self)}"
            raise WeightsError(msg)


SDF_PRESETS: dict[str, SdfNetworkConfig] = {
    "paper": SdfNetworkConfig(),
    "small": SdfNetworkConfig(width=256, hidden=6, skip=3),
    "tiny": SdfNetworkConfig(width=64, hidden=4, skip=2),
}
"""The paper's network; one that a CPU can train; one for tests."""


class SdfNetwork(nn.Module):
    """f(x, β, θ): fully connected, softplus between the layers, the point joined again at the layer `skip`.

    It starts as the distance to a sphere (Atzmon and Lipman 2020).
    """

    def __init__(self, config: SdfNetworkConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or SdfNetworkConfig()
        # The first layer's weights of point and condition are kept apart: a body's share is computed once for all
        # its points.
        self.point = nn.Linear(3, config.width)
        self.condition = nn.Linear(_CONDITION, config.width, bias=False)
        layers = [
            nn.Linear(config.width + 3 * (layer == config.skip), config.width) for layer in range(1, config.hidden)
        ]
        self.layers = nn.ModuleList(layers)
        self.last = nn.Linear(config.width, 1)
        self.activation = nn.Softplus(beta=config.sharpness)
        with torch.no_grad():
            for layer in (self.point, *layers):
                nn.init.normal_(layer.weight, 0.0, math.sqrt(2 / config.width))
                nn.init.zeros_(layer.bias)
            nn.init.zeros_(layers[config.skip - 1].weight[:, config.width :])
            nn.init.zeros_(self.condition.weight)
            nn.init.normal_(self.last.weight, math.sqrt(math.pi / config.width), 1e-5)
            nn.init.constant_(self.last.bias, -config.radius)

    def forward(self, points: Tensor, betas: Tensor, pose: Tensor) -> Tensor:
        """Distances [m], shape (B, N), of points [m], shape (B, N, 3), to bodies of `betas` (B, 10) and `pose`.

        `pose`, shape (B, 23, 3) [rad], is without the root's rotation, which is to be undone in the points.
        """
        h = self.activation(self.point(points) + self.condition(torch.cat((betas, pose.flatten(1)), 1))[:, None])
        for number, layer in enumerate(self.layers, start=1):
            h = self.activation(layer(torch.cat((h, points.to(h.dtype)), -1) if number == self.config.skip else h))
        distance: Tensor = self.last(h)[..., 0]
        return distance


def with_gradient(
    network: SdfNetwork, points: Tensor, betas: Tensor, pose: Tensor, *, keep_graph: bool
) -> tuple[Tensor, Tensor]:
    """The network's distances (B, N) and their gradients (B, N, 3), which aren't normalised; arguments as `forward`'s.

    `keep_graph` keeps what derivatives of both are computed from; without it neither has any.
    """
    with torch.enable_grad():
        if not (keep_graph and points.requires_grad):
            points = points.detach().requires_grad_()
        distance = network(points, betas, pose)
        (gradient,) = torch.autograd.grad(distance.sum(), points, create_graph=keep_graph)
    return (distance, gradient) if keep_graph else (distance.detach(), gradient)


class NeuralSdf:
    """Signed distance by a trained `SdfNetwork` (the paper's "Approx. SDF"): it stands for the body, faces and all.

    The gradient is the network's own, by backpropagation, normalised (paper, Eq. 3). Both are differentiable with
    respect to the points and the network's weights.
    """

    def __init__(self, network: SdfNetwork, body: SmplBody) -> None:
        """For bodies of the model that the network was trained on."""
        self.network = network
        self._body = body
        self._posed: tuple[Tensor, Tensor, Tensor, Tensor] | None = None

    def update(self, vertices: Tensor, *, pose: Tensor | None = None, betas: Tensor | None = None) -> None:
        """Takes over a new body: `pose` (24, 3) [rad] and `betas` (10,); its vertices aren't looked at.

        Raises `MeshError` when one of the two is missing or of another shape.
        """
        del vertices
        if pose is None or betas is None or pose.shape != (N_JOINTS, 3) or betas.shape != (N_BETAS,):
            got = " and ".join(str(None if value is None else tuple(value.shape)) for value in (pose, betas))
            raise MeshError(f"a neural distance needs pose (24, 3) and betas (10,) of the body, got {got}")
        rotation, root = body_frame(self._body, pose[None], betas[None])
        self._posed = rotation[0], root[0], betas, pose[1:]

    def query(self, points: Tensor, *, near: Tensor | None = None) -> SdfSample:
        """Distance and unit gradient at `points` [m], shape (N, 3); `near` is of no use here.

        Raises `MeshError` for a wrong shape, values that aren't finite, or when no body was set with `update`.
        """
        del near
        if self._posed is None:
            raise MeshError("no body yet: call update(vertices, pose=..., betas=...) before asking for distances")
        require_points(points)
        rotation, root, betas, pose = (value.to(points) for value in self._posed)
        own = (points - root) @ rotation + root
        weights_learn = next(self.network.parameters()).requires_grad
        tracked = torch.is_grad_enabled() and (points.requires_grad or weights_learn)
        parts = [
            with_gradient(self.network, chunk[None], betas[None], pose[None], keep_graph=tracked)
            for chunk in ([own] if tracked else torch.split(own, _CHUNK))
        ]
        distance = torch.cat([part[0][0] for part in parts])
        gradient = torch.cat([part[1][0] for part in parts]) @ rotation.T
        return SdfSample(distance, torch.nn.functional.normalize(gradient, dim=-1))

    def of_garment(self, garment: GarmentTemplate) -> GarmentSdf:  # noqa: ARG002
        """As `BodySdf.of_garment`."""
        return plain_garment_sdf(self)


def body_frame(body: SmplBody, pose: Tensor, betas: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations (B, 3, 3) of the roots of bodies of `pose` (B, 24, 3) and `betas` (B, 10), and the roots [m], (B, 3).

    (x - root) @ rotation + root undoes a rotation. A distance doesn't depend on it, so no network need learn it.
    """
    return rotvec_to_rotmat(pose[:, 0]), body.rest_joints(betas.to(body.dtype))[:, 0].to(pose)


def save_sdf_network(stem: Path, network: SdfNetwork, card: Mapping[str, Any]) -> None:
    """Writes `stem`.safetensors and `stem`.json. Raises `WeightsError` when a weight isn't finite or the disk fails."""
    save_weights(stem, network.state_dict(), {**card, "network": asdict(network.config)})


def load_sdf_network(stem: Path, body: SmplBody) -> SdfNetwork:
    """The network that `save_sdf_network` wrote, for a body with the fingerprint it was trained on.

    Raises `WeightsError` where there is none, it is damaged, or trained on another body.
    """
    weights = load_weights(stem)
    trained_on, this = weights.card.get("body_fingerprint"), body.fingerprint
    if trained_on != this:
        raise WeightsError(f"{stem}: trained on the body {trained_on}, this one is {this}: train one for it")
    with naming(f"{stem}: not the weights of a distance network"):
        config = config_of_card(SdfNetworkConfig, weights.card.get("network"))
        if config.hidden > _MOST_LAYERS:
            raise WeightsError(f"wanted at most {_MOST_LAYERS} hidden layers, got {config.hidden}")
        network = build_for(weights.tensors, lambda: SdfNetwork(config))
    return network.to(device=body.device, dtype=body.dtype)
