"""Posed vertices of a batch of bodies with their derivatives by pose, place and shape, in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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


def where(better: Tensor, first: Fit, second: Fit) -> Fit:
    """The first fits where a condition ``(B,)`` holds, and the second elsewhere."""
    return Fit(
        torch.where(better[:, None, None], first.pose, second.pose),
        torch.where(better[:, None], first.translation, second.translation),
        torch.where(better[:, None], first.shape, second.shape),
    )


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
    """A batch of bodies of a family in their poses: points, normals and Jacobians of chosen vertices."""

    def __init__(self, family: BodyFamily, fit: Fit, descendants: Tensor):
        self.family, self.fit, self.descendants = family, fit, descendants
        self.rotations = rotation_from_axis_angle(fit.pose)
        self.rest, joints = family.rest(fit.shape)
        if family.pose_directions is not None:
            features = (self.rotations[:, 1:] - torch.eye(3)).flatten(1)
            self.rest = self.rest + torch.einsum("bp,vxp->bvx", features, family.pose_directions)
        self.bones = pose_bones(self.rotations, fit.translation, joints, family.turns(joints), family.bind.parents)

    def points(self, ids: Tensor | slice = slice(None)) -> Tensor:
        """Posed vertices ``(B, N, 3)``, those of ``ids (N,)`` if given."""
        weights = self.family.bind.weights[ids]
        return skin(weights, self.bones, self.rest[:, ids])

    def normals(self, rest_normals: Tensor, ids: Tensor | slice = slice(None)) -> Tensor:
        """Unit normals ``(B, N, 3)`` of posed vertices, from those at rest ``(V, 3)``."""
        blended = torch.einsum("nj,bjxy->bnxy", self.family.bind.weights[ids], self.bones.turns)
        turned = (blended @ rest_normals[ids].unsqueeze(-1)).squeeze(-1)
        return torch.nn.functional.normalize(turned, dim=-1)

    def jacobian(self, ids: Tensor, with_shape: bool = True) -> Tensor:
        """Derivatives ``(B, N, 3, P)`` of posed vertices ``ids (B, N)`` by P = 3 J pose, 3 translation, K shape numbers.

        A joint turns what hangs on it about itself: the exact derivative of linear blend skinning. That of pose
        blendshapes is left out.
        """
        bones, count = self.bones, ids.shape[1]
        weights = self.family.bind.weights[ids]  # (B, N, J)
        rest = torch.gather(self.rest, 1, ids.unsqueeze(-1).expand(-1, -1, 3))
        carried = torch.einsum("bjxy,bny->bnjx", bones.turns, rest) + bones.shifts.unsqueeze(1)
        carried = carried * weights.unsqueeze(-1)
        below = torch.einsum("jk,bnkx->bnjx", self.descendants, carried)
        share = weights @ self.descendants.T
        levers = below - share.unsqueeze(-1) * bones.places.unsqueeze(1)  # (B, N, J, 3)
        parents = [max(parent, 0) for parent in self.family.bind.parents]
        above = bones.frames[:, parents].clone()
        above[:, 0] = torch.eye(3)
        axes = above @ left_jacobian(self.fit.pose)  # (B, J, 3, 3): world axis of each pose number, in columns
        columns = axes.transpose(-1, -2).unsqueeze(1)  # (B, 1, J, 3 numbers, 3)
        turned = torch.linalg.cross(columns, levers.unsqueeze(3), dim=-1)  # (B, N, J, 3 numbers, 3)
        by_pose = turned.flatten(2, 3).transpose(-1, -2)
        by_place = torch.eye(3).expand(len(ids), count, 3, 3)
        parts = [by_pose, by_place]
        if with_shape and len(self.family.names):
            parts.append(self._shape_jacobian(ids, weights))
        return torch.cat(parts, dim=-1)

    def _shape_jacobian(self, ids: Tensor, weights: Tensor) -> Tensor:
        """Derivatives ``(B, N, 3, K)`` by shape, as finite differences of the whole chain."""
        family, fit = self.family, self.fit
        here = skin(weights, self.bones, torch.gather(self.rest, 1, ids.unsqueeze(-1).expand(-1, -1, 3)))
        columns = []
        for number in range(len(family.names)):
            inward = torch.where(fit.shape[:, number] + SHAPE_STEP > family.high[number], -SHAPE_STEP, SHAPE_STEP)
            shape = fit.shape.clone()
            shape[:, number] += inward
            change, joints = family.rest(shape)
            change = change + (self.rest - family.rest(fit.shape)[0]) if family.pose_directions is not None else change
            bones = pose_bones(self.rotations, fit.translation, joints, family.turns(joints), family.bind.parents)
            there = skin(weights, bones, torch.gather(change, 1, ids.unsqueeze(-1).expand(-1, -1, 3)))
            columns.append((there - here) / inward[:, None, None])
        return torch.stack(columns, dim=-1)


def skin(weights: Tensor, bones: Bones, rest: Tensor) -> Tensor:
    """Linear blend skinning of bind points ``(B, N, 3)`` with weights ``(N, J)`` or ``(B, N, J)``."""
    turns = (weights @ bones.turns.flatten(-2)).unflatten(-1, (3, 3))
    return (turns @ rest.unsqueeze(-1)).squeeze(-1) + weights @ bones.shifts


def joint_descendants(parents: Sequence[int]) -> Tensor:
    """Which joints hang on which, itself included: ``(J, J)``, 1 where the column's is the row's or below it."""
    below = torch.eye(len(parents))
    for joint in range(len(parents) - 1, 0, -1):
        below[parents[joint]] += below[joint]
    return below
