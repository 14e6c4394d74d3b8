"""Signed distance to any closed mesh, exact, with gradients: no body and no garment needed.

python examples/signed_distance.py
"""

from __future__ import annotations

import torch
import trimesh

from refu_core.sdf import ExactSdf


def rounded(vector: torch.Tensor) -> list[float]:
    """The components, rounded to three decimals."""
    return [round(x, 3) for x in vector.tolist()]


def main() -> tuple[float, float]:
    """Returns how far the gradient is from the derivative, and how fast the distance falls as the mesh grows."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.5)  # [m]; any closed surface, faces counter-clockwise
    vertices = torch.tensor(ball.vertices, dtype=torch.float32, requires_grad=True)
    sdf = ExactSdf(torch.tensor(ball.faces))
    sdf.update(vertices)  # again for each new pose: the search tree is refitted, not built anew

    points = torch.tensor([[0.8, 0.0, 0.0], [0.1, 0.2, 0.0], [0.0, 0.0, -0.6]], requires_grad=True)
    sample = sdf.query(points)
    for point, distance, gradient in zip(points, sample.distance, sample.gradient, strict=True):
        print(f"{rounded(point)}: {distance.item():+.3f} m, grows towards {rounded(gradient)}")

    along_points, along_vertices = torch.autograd.grad(sample.distance.sum(), (points, vertices))
    off = float((along_points - sample.gradient.detach()).abs().max())
    # Moving the whole surface outwards by a millimetre brings each of the points a millimetre deeper.
    outward = torch.nn.functional.normalize(vertices.detach(), dim=1)
    slope = float((along_vertices * outward).sum()) / len(points)
    print(f"the gradient is the derivative to {off:.0e}; distance per outward motion of the surface: {slope:+.2f}")
    return off, slope


if __name__ == "__main__":
    main()
