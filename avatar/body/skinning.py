"""Linear blend skinning and its inverse, for any kinematic tree."""

from __future__ import annotations

import torch
from torch import Tensor

from avatar.checks import AvatarError, check_shape
from avatar.geometry.transforms import assemble_transform, invert_affine, rotation_from_axis_angle


def check_parents(parents: tuple[int, ...]) -> None:
    """Refuses a kinematic tree whose first joint is not the only root or whose parents do not come first."""
    if not parents or parents[0] != -1 or any(not 0 <= p < j for j, p in enumerate(parents) if j):
        raise AvatarError(f"parents: expected -1 first and every parent before its child, got {tuple(parents)}.")


def tree_distances(parents: tuple[int, ...]) -> Tensor:
    """Edges between any two joints of a kinematic tree: ``(J, J)`` int64."""
    check_parents(parents)
    distances = torch.zeros(len(parents), len(parents), dtype=torch.long)
    for joint, parent in enumerate(parents[1:], start=1):
        distances[joint, :joint] = distances[parent, :joint] + 1
        distances[:joint, joint] = distances[joint, :joint]
    return distances


def chain_transforms(pose: Tensor, joints: Tensor, parents: tuple[int, ...]) -> Tensor:
    """Rigid motions ``(B, J, 4, 4)`` posed_from_rest of each joint's bone, along the kinematic tree.

    Joint frames are aligned with the world at rest, as in SMPL: each joint turns its whole subtree about itself, by
    ``pose (B, J, 3)`` axis-angle, radians, relative to the parent. ``joints (J, 3)`` are positions at rest, metres.
    """
    dims = check_shape("pose", pose, "B J 3")
    check_shape("joints", joints, "J 3", J=dims["J"])
    check_parents(parents)
    rotations = rotation_from_axis_angle(pose)
    pivots = joints - (rotations @ joints.unsqueeze(-1)).squeeze(-1)
    local = assemble_transform(rotations, pivots)
    chain = [local[:, 0]]
    for joint in range(1, dims["J"]):
        chain.append(chain[parents[joint]] @ local[:, joint])
    return torch.stack(chain, dim=1)


def blend_transforms(weights: Tensor, joint_transforms: Tensor) -> Tensor:
    """Linear blend of joint transforms: ``(..., V, J)`` weights and ``(B, J, 4, 4)`` to ``(B, V, 4, 4)``."""
    return (weights @ joint_transforms.flatten(-2)).unflatten(-1, (4, 4))


def skin_transforms(weights: Tensor, joint_transforms: Tensor, canonical_from_bind: Tensor | None = None) -> Tensor:
    """The blended posed_from_canonical transform of points with any skinning weights, exact on the body's own.

    Weights blend motions from the pose they were painted in: a point goes back there and on to the pose with the same
    weights, T(w) = (sum_j w_j P_j C_j) (sum_j w_j C_j)^-1, for P posed_from_canonical and C canonical_from_bind.
    Without ``canonical_from_bind (J, 4, 4)`` this is plain LBS (SCANimate eq. 1), whose inverse poses scans back (eq.
    2). Weights ``(B, N, J)`` or ``(N, J)`` with rows summing to 1 and joint transforms ``(B, J, 4, 4)`` to ``(B, N, 4,
    4)``, differentiable in all of them.
    """
    if canonical_from_bind is None:
        return blend_transforms(weights, joint_transforms)
    posed_from_bind = blend_transforms(weights, joint_transforms @ canonical_from_bind)
    return posed_from_bind @ invert_affine(blend_transforms(weights, canonical_from_bind))
