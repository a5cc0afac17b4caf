"""Rigid and affine transforms as (..., 4, 4) matrices, named destination_from_source; Fourier features of points.

RoMa is imported where it is used: it loads torch's compiler, which takes as long as torch itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from avatar.checks import AvatarError, check_shape


def rotation_from_axis_angle(axis_angle: Tensor) -> Tensor:
    """Rotation matrices of axis-angle vectors. ``(..., 3)`` radians to ``(..., 3, 3)``; smooth at zero."""
    import roma

    check_shape("axis_angle", axis_angle, "... 3")
    return roma.rotvec_to_rotmat(axis_angle)


def axis_angle_from_rotation(rotation: Tensor) -> Tensor:
    """Axis-angle vectors of rotation matrices. ``(..., 3, 3)`` to ``(..., 3)`` radians, angles in [0, pi]."""
    import roma

    check_shape("rotation", rotation, "... 3 3")
    return roma.rotmat_to_rotvec(rotation)


def relative_quaternions(joint_transforms: Tensor, parents: Sequence[int]) -> Tensor:
    """Rotations of joints but the root against their parents, unit quaternions ``(B, J - 1, 4)`` as x, y, z, w >= 0.

    From ``(B, J, 4, 4)`` posed_from_canonical and J parents, so they do not change with the body's place and heading.
    """
    import roma

    check_shape("joint_transforms", joint_transforms, "B J 4 4", J=len(parents))
    rotations = joint_transforms[..., :3, :3]
    quaternions = roma.rotmat_to_unitquat(rotations[:, list(parents[1:])].transpose(-1, -2) @ rotations[:, 1:])
    return torch.where(quaternions[..., 3:] < 0, -quaternions, quaternions)


def assemble_transform(linear: Tensor, shift: Tensor) -> Tensor:
    """``(..., 4, 4)`` transforms from linear parts ``(..., 3, 3)`` and shifts ``(..., 3)``."""
    check_shape("linear", linear, "... 3 3")
    check_shape("shift", shift, "... 3")
    top = torch.cat([linear, shift.unsqueeze(-1)], dim=-1)
    bottom = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def transform_points(transforms: Tensor, points: Tensor) -> Tensor:
    """Applies one transform to each point. ``(..., 4, 4)`` and ``(..., 3)``, broadcast over leading dimensions."""
    return transform_directions(transforms, points) + transforms[..., :3, 3]


def transform_directions(transforms: Tensor, directions: Tensor) -> Tensor:
    """Applies the linear parts alone: offsets and (unnormalised) normals. Shapes as `transform_points`."""
    return (transforms[..., :3, :3] @ directions.unsqueeze(-1)).squeeze(-1)


def invert_rigid(transforms: Tensor) -> Tensor:
    """Inverse of rigid transforms ``(..., 4, 4)``, exact and without a matrix inversion."""
    inverse_rotation = transforms[..., :3, :3].transpose(-1, -2)
    return assemble_transform(inverse_rotation, -(inverse_rotation @ transforms[..., :3, 3:]).squeeze(-1))


def invert_affine(transforms: Tensor) -> Tensor:
    """Inverse of affine transforms ``(..., 4, 4)`` (blended skinning transforms are affine, not rigid)."""
    inverse_linear = torch.linalg.inv(transforms[..., :3, :3])
    return assemble_transform(inverse_linear, -(inverse_linear @ transforms[..., :3, 3:]).squeeze(-1))


def tilt_rotations(rotations: Tensor) -> Tensor:
    """What is left of rotations ``(..., 3, 3)`` when the nearest rotation about the vertical (y) is taken away first.

    R = Y tilt, with Y the rotation about y that differs least from R. Upside down, where all are as near, Y is 0.
    """
    sine, cosine = rotations[..., 0, 2] - rotations[..., 2, 0], rotations[..., 0, 0] + rotations[..., 2, 2]
    yaw = torch.atan2(sine, cosine)
    zero, one = torch.zeros_like(yaw), torch.ones_like(yaw)
    rows = [yaw.cos(), zero, -yaw.sin(), zero, one, zero, yaw.sin(), zero, yaw.cos()]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3)) @ rotations


def rotation_between(source: Tensor, target: Tensor) -> Tensor:
    """The smallest rotations that turn directions onto others, ``(..., 3)`` to ``(..., 3, 3)``; worked out in float64.

    Of the half turns between opposite directions, that about a perpendicular nearest a coordinate axis. Raises
    `AvatarError` for a direction of no length.
    """
    check_shape("source", source, "... 3")
    check_shape("target", target, "... 3")
    dtype = source.dtype
    source, target = torch.broadcast_tensors(source.double(), target.double())
    lengths = source.norm(dim=-1, keepdim=True), target.norm(dim=-1, keepdim=True)
    if any((length == 0).any() for length in lengths):
        raise AvatarError("source, target: expected two directions, got a zero vector.")
    source, target = source / lengths[0], target / lengths[1]
    axis = torch.linalg.cross(source, target)
    angle = torch.atan2(axis.norm(dim=-1), (source * target).sum(dim=-1))
    parallel = axis.norm(dim=-1, keepdim=True) < 1e-8  # (anti)parallel: the cross product no longer tells the axis
    aside = torch.eye(3, dtype=source.dtype, device=source.device)[source.abs().argmin(dim=-1)]
    axis = torch.where(parallel, torch.linalg.cross(source, aside), axis)
    return rotation_from_axis_angle(axis / axis.norm(dim=-1, keepdim=True) * angle.unsqueeze(-1)).to(dtype)


def fourier_features(points: Tensor, orders: int, base: float = 1.0) -> Tensor:
    """Points ``(..., 3)``, then sin and cos of ``base`` 2^k of them for k below ``orders``, to ``(..., 3 + 6 orders)``.

    The base is pi in NeRF and 1 in SCANimate.
    """
    waves = [wave(base * 2**order * points) for order in range(orders) for wave in (torch.sin, torch.cos)]
    return torch.cat([points, *waves], dim=-1)
