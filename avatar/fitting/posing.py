"""Posed vertices of a batch of bodies with their derivatives by pose, place and shape, in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from avatar.body.families import BodyFamily
from avatar.geometry.transforms import rotation_from_axis_angle

SHAPE_STEP = 1e-2  # of a shape parameter, for its finite difference


@dataclass
class Fit:
    """Estimates of B bodies: pose ``(B, J, 3)`` axis-angle, translation ``(B, 3)`` metres, shape ``(B, K)``."""

    pose: Tensor
    translation: Tensor
    shape: Tensor

    def __getitem__(self, which: Tensor | slice | list[int]) -> Fit:
        return Fit(self.pose[which], self.translation[which], self.shape[which])

    def __len__(self) -> int:
        return len(self.pose)


def join_fits(fits: Sequence[Fit]) -> Fit:
    """One batch of several."""
    return Fit(*(torch.cat([getattr(fit, name) for fit in fits]) for name in ("pose", "translation", "shape")))


@dataclass
class Bones:
    """Rigid motions posed_from_bind of the joints: rotations ``(B, J, 3, 3)``, places ``(B, J, 3)`` and shifts."""

    turns: Tensor  # of the bones, from the bind pose
    shifts: Tensor
    places: Tensor  # of the joints, posed
    frames: Tensor  # (B, J, 3, 3) world rotations of the joints from the T-pose


def pose_bones(rotations: Tensor, translation: Tensor, joints: Tensor, turns: Tensor, parents: Sequence[int]) -> Bones:
    """The chain of joints ``(B, J, 3)`` in bind, turned to the T-pose by ``turns`` and posed by local ``rotations``."""
    frames, places, zero = [rotations[:, 0]], [joints[:, 0] + translation], [joints[:, 0]]
    for joint, parent in enumerate(parents[1:], start=1):
        bone = (turns[:, parent] @ (joints[:, joint] - joints[:, parent]).unsqueeze(-1)).squeeze(-1)
        zero.append(zero[parent] + bone)
        places.append(places[parent] + (frames[parent] @ bone.unsqueeze(-1)).squeeze(-1))
        frames.append(frames[parent] @ rotations[:, joint])
    frames, places = torch.stack(frames, dim=1), torch.stack(places, dim=1)
    bones = frames @ turns
    return Bones(bones, places - (bones @ joints.unsqueeze(-1)).squeeze(-1), places, frames)


def left_jacobian(axis_angle: Tensor) -> Tensor:
    """How a change of an axis-angle vector turns the rotation in the world: ``(..., 3)`` to ``(..., 3, 3)``.

    exp(v + dv) = exp(J dv) exp(v) to first order (the left Jacobian of SO(3)).
    """
    angle = axis_angle.norm(dim=-1)[..., None, None].clamp(min=1e-4)
    x, y, z = axis_angle.unbind(dim=-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    identity = torch.eye(3, dtype=axis_angle.dtype)
    first, second = (1 - angle.cos()) / angle**2, (angle - angle.sin()) / angle**3
    second = torch.where(angle < 1e-2, 1 / 6, second)
    return identity + first * cross + second * cross @ cross


class PosedFamily:
    """A batch of bodies of a family in their poses: points, normals and Jacobians of vertices."""

    def __init__(self, family: BodyFamily, fit: Fit):
        self.family, self.fit = family, fit
        self.rotations = rotation_from_axis_angle(fit.pose)
        self.rest, joints = family.rest(fit.shape)
        self.corrections: Tensor | float = 0.0
        if family.pose_directions is not None:
            features = (self.rotations[:, 1:] - torch.eye(3)).flatten(1)
            self.corrections = torch.einsum("bp,vxp->bvx", features, family.pose_directions)
            self.rest = self.rest + self.corrections
        self.bones = self._bones(joints)

    def _bones(self, joints: Tensor) -> Bones:
        family = self.family
        return pose_bones(self.rotations, self.fit.translation, joints, family.turns(joints), family.bind.parents)

    def points(self) -> Tensor:
        """All posed vertices ``(B, V, 3)``."""
        return skin(self.family.bind.weights, self.bones, self.rest)

    def points_of(self, ids: Tensor) -> Tensor:
        """Posed vertices ``(B, N, 3)`` of ``ids (B, N)``."""
        return skin(self.family.bind.weights[ids], self.bones, chosen(self.rest, ids))

    def normals(self, rest_normals: Tensor) -> Tensor:
        """Unit normals ``(B, V, 3)`` of posed vertices, from those at rest ``(V, 3)``."""
        blended = (self.family.bind.weights @ self.bones.turns.flatten(-2)).unflatten(-1, (3, 3))
        return torch.nn.functional.normalize((blended @ rest_normals.unsqueeze(-1)).squeeze(-1), dim=-1)

    def jacobian(self, ids: Tensor, with_shape: bool = True) -> Tensor:
        """Derivatives ``(B, N, 3, P)`` of posed vertices ``ids (B, N)`` by P = 3 J pose, 3 place and K shape numbers.

        A joint turns what hangs on it about itself: the exact derivative of linear blend skinning. That of pose
        blendshapes is left out.
        """
        bones, parents = self.bones, self.family.bind.parents
        weights, rest = self.family.bind.weights[ids], chosen(self.rest, ids)
        descendants = joint_descendants(parents)
        posed = torch.einsum("bjxy,bny->bnjx", bones.turns, rest) + bones.shifts.unsqueeze(1)
        below = torch.einsum("jk,bnkx->bnjx", descendants, posed * weights.unsqueeze(-1))
        levers = below - (weights @ descendants.T).unsqueeze(-1) * bones.places.unsqueeze(1)  # (B, N, J, 3)
        above = bones.frames[:, [max(parent, 0) for parent in parents]].clone()
        above[:, 0] = torch.eye(3)
        axes = (above @ left_jacobian(self.fit.pose)).transpose(-1, -2)  # (B, J, 3 pose numbers, 3)
        turned = torch.linalg.cross(axes.unsqueeze(1), levers.unsqueeze(3), dim=-1)  # (B, N, J, 3 pose numbers, 3)
        parts = [turned.flatten(2, 3).transpose(-1, -2), torch.eye(3).expand(*ids.shape, 3, 3)]
        if with_shape and self.family.names:
            parts.append(self._shape_jacobian(ids, weights))
        return torch.cat(parts, dim=-1)

    def _shape_jacobian(self, ids: Tensor, weights: Tensor) -> Tensor:
        """Derivatives ``(B, N, 3, K)`` by shape, as differences over `SHAPE_STEP`, inward at the upper bounds."""
        family, here, columns = self.family, self.points_of(ids), []
        for number in range(len(family.names)):
            step = torch.where(self.fit.shape[:, number] + SHAPE_STEP > family.high[number], -SHAPE_STEP, SHAPE_STEP)
            shape = self.fit.shape.clone()
            shape[:, number] += step
            rest, joints = family.rest(shape)
            there = skin(weights, self._bones(joints), chosen(rest + self.corrections, ids))
            columns.append((there - here) / step[:, None, None])
        return torch.stack(columns, dim=-1)


def chosen(values: Tensor, ids: Tensor) -> Tensor:
    """The rows ``ids (B, N)`` of values ``(B, V, 3)``."""
    return torch.gather(values, 1, ids.unsqueeze(-1).expand(-1, -1, 3))


def skin(weights: Tensor, bones: Bones, rest: Tensor) -> Tensor:
    """Linear blend skinning of bind points ``(B, N, 3)`` with weights ``(N, J)`` or ``(B, N, J)``."""
    turns = (weights @ bones.turns.flatten(-2)).unflatten(-1, (3, 3))
    return (turns @ rest.unsqueeze(-1)).squeeze(-1) + weights @ bones.shifts


@cache
def joint_descendants(parents: tuple[int, ...]) -> Tensor:
    """Which joints hang on which, itself included: ``(J, J)``, 1 where the column's is the row's or below it."""
    below = torch.eye(len(parents))
    for joint in range(len(parents) - 1, 0, -1):
        below[parents[joint]] += below[joint]
    return below
