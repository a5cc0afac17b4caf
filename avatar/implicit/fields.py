"""Frozen skinning fields in canonical space, and the pose features that they gate (SCANimate 3.2, eq. 18)."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from itertools import product

import torch
from torch import Tensor, nn

from avatar.body.skinning import tree_distances
from avatar.checks import AvatarError, check_shape
from avatar.geometry.neighbours import FixedPoints
from avatar.geometry.precision import full_precision
from avatar.geometry.transforms import relative_quaternions
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


MAX_NODES = 1 << 24
CHUNK = 65_536  # nodes evaluated at once


class FieldLattice(nn.Module):
    """A frozen field ``(B, N, 3) -> (B, N, C)`` as trilinear look-ups: a hundredth of a network's work a point.

    For fields that hardly change over a few centimetres, as skinning weights do. Differentiable in the points;
    outside its box the value at the border is given.
    """

    def __init__(self, field: Callable[[Tensor], Tensor], box: Tensor, spacing: float):
        """Evaluates the field.

        Args:
            field: what to tabulate, called with ``(1, N, 3)`` points.
            box: ``(2, 3)`` lowest and highest corner, metres.
            spacing: metres between nodes.
        """
        super().__init__()
        check_shape("box", box, "2 3")
        if spacing <= 0:
            raise AvatarError(f"spacing: expected above 0 metres, got {spacing}.")
        cells = ((box[1] - box[0]) / spacing).ceil().long().clamp(min=1)
        if (cells + 1).double().prod() > MAX_NODES:
            raise AvatarError(f"spacing: expected at most {MAX_NODES} nodes, {spacing} m makes more of this box.")
        steps = [spacing * torch.arange(int(count) + 1, dtype=box.dtype, device=box.device) for count in cells]
        nodes = torch.stack(torch.meshgrid(*steps, indexing="ij"), dim=-1).reshape(-1, 3) + box[0]
        with torch.no_grad():
            values = torch.cat([field(chunk[None])[0] for chunk in nodes.split(CHUNK)])
        self.spacing = spacing
        self.register_buffer("cells", cells, persistent=False)
        self.register_buffer("origin", box[0].clone(), persistent=False)
        self.register_buffer("values", values, persistent=False)

    def forward(self, points: Tensor) -> Tensor:
        """Interpolated values ``(B, N, C)`` at points ``(B, N, 3)``; where a point is NaN, so are its values."""
        check_shape("points", points, "B N 3")
        place = ((points - self.origin) / self.spacing).clamp(min=0).minimum(self.cells.to(points.dtype))
        low = place.detach().nan_to_num().floor().long().minimum(self.cells - 1)
        share = place - low
        sides = (1 - share, share)
        blended = 0
        for corner in product((0, 1), repeat=3):
            x, y, z = (low[..., axis] + corner[axis] for axis in range(3))
            row = (x * (self.cells[1] + 1) + y) * (self.cells[2] + 1) + z
            weight = sides[corner[0]][..., 0] * sides[corner[1]][..., 1] * sides[corner[2]][..., 2]
            blended = blended + weight.unsqueeze(-1) * self.values[row]
        return blended


class Attention(Enum):
    """Which joints count as near in the kinematic tree."""

    neighbours = "neighbours"  # up and down the tree: the paper
    ancestors = "ancestors"  # up the tree alone: the paper's code


def attention_map(parents: tuple[int, ...], rings: int, attention: Attention, normalised: bool) -> Tensor:
    """W of SCANimate eq. 18: row m, column n says how much a point skinned to joint n attends to joint m.

    Args:
        parents: the kinematic tree.
        rings: how many edges apart joints may be.
        attention: neighbours both ways, or a joint with its ancestors alone.
        normalised: columns sum to 1 (the paper's code) instead of being 0 and 1 (the paper).

    Returns:
        ``(J, J)``, one for every joint with itself before normalising.
    """
    if rings < 0:
        raise AvatarError(f"rings: expected at least 0, got {rings}.")
    near = tree_distances(parents) <= rings
    if attention is Attention.ancestors:
        above = torch.eye(len(parents), dtype=torch.bool)
        for joint, parent in enumerate(parents[1:], start=1):
            above[:, joint] |= above[:, parent]
        near &= above
    weights = near.float()
    return weights / weights.sum(dim=0) if normalised else weights


def joint_quaternions(joint_transforms: Tensor, parents: tuple[int, ...]) -> Tensor:
    """`relative_quaternions` in the order (w, x, y, z), ``(B, J, 4, 4)`` to ``(B, J - 1, 4)``."""
    return relative_quaternions(joint_transforms, parents).roll(1, dims=-1)


class PoseGate(nn.Module):
    """Pose features of a point: (W g(x)) o theta, each joint's quaternion times how much the point attends to it."""

    def __init__(
        self,
        parents: tuple[int, ...],
        rings: int = 4,
        attention: Attention = Attention.neighbours,
        normalised: bool = False,
    ):
        """Prepares the gate of a kinematic tree; see `attention_map`."""
        super().__init__()
        self.parents = tuple(parents)
        self.channels = 4 * (len(parents) - 1)
        self.register_buffer("attention", attention_map(parents, rings, attention, normalised)[1:], persistent=False)

    @full_precision
    def forward(self, weights: Tensor, joint_transforms: Tensor) -> Tensor:
        """``(B, N, J)`` skinning weights and ``(B, J, 4, 4)`` posed_from_canonical to ``(B, N, 4 (J - 1))``."""
        dims = check_shape("weights", weights, "B N J", J=len(self.parents))
        check_shape("joint_transforms", joint_transforms, "B J 4 4", B=dims["B"], J=dims["J"])
        gates = weights @ self.attention.T
        quaternions = joint_quaternions(joint_transforms, self.parents)
        return (gates.unsqueeze(-1) * quaternions[:, None]).flatten(-2)
