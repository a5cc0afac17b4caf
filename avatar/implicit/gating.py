"""Which joints a place attends to (SCANimate 3.2): joint rotations, passed only where the skin is near in the tree."""

from __future__ import annotations

from enum import Enum

import torch
from torch import Tensor, nn

from avatar.body.skinning import tree_distances
from avatar.checks import AvatarError, check_shape
from avatar.geometry.precision import full_precision
from avatar.geometry.transforms import relative_quaternions


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
