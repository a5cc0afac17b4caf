"""The body's own skinning weights as a field: what poses an avatar whose canonicalization was not learned."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from avatar.checks import AvatarError, check_shape
from avatar.geometry.neighbours import FixedPoints
from avatar.records import Template


class BodyField(nn.Module):
    """Weights of the nearest vertices of the canonical body, by inverse distance (SCANimate 4.1's baselines).

    Stands where a learned forward skinning field would. Differentiable in the points but for changes of neighbours.
    """

    def __init__(self, template: Template, neighbours: int = 6):
        """Takes a body's weights; one neighbour gives those of the nearest vertex alone."""
        super().__init__()
        if not 1 <= neighbours <= len(template.vertices):
            raise AvatarError(f"neighbours: expected 1 to {len(template.vertices)}, got {neighbours}.")
        self.neighbours = neighbours
        self.register_buffer("vertices", template.vertices.clone(), persistent=False)
        self.search = FixedPoints(self.vertices)
        self.register_buffer("weights", template.weights.clone(), persistent=False)

    def forward(self, points: Tensor) -> Tensor:
        """Weights ``(B, N, J)``, rows summing to 1, of canonical points ``(B, N, 3)``."""
        check_shape("points", points, "B N 3")
        ids = self.search.k_nearest(points.detach(), self.neighbours)
        squares = (points.unsqueeze(2) - self.vertices[ids]).square().sum(dim=-1)
        closeness = squares.clamp(min=1e-12).rsqrt()
        closeness = closeness / closeness.sum(dim=-1, keepdim=True)
        return torch.einsum("bnk,bnkj->bnj", closeness, self.weights[ids])
