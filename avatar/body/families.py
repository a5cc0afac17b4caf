"""Families of bodies: rest shape and joints as differentiable functions of a few shape parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

import torch
from torch import Tensor

from avatar.body.model import SMPL_JOINTS, BodyModel
from avatar.body.open import (
    Phenotype,
    anny_basis,
    anny_coefficients,
    anny_template,
    build_anny,
    t_pose_from_bind,
    t_pose_turns,
)
from avatar.body.smpl import smpl_body, smpl_shapes
from avatar.checks import AvatarError, check_shape
from avatar.geometry.surface import vertex_normals
from avatar.records import Template

PHENOTYPE_MEAN = {"gender": 0.5, "age": 2 / 3, "muscle": 0.5, "weight": 0.5, "height": 0.5, "proportions": 0.5}
PHENOTYPE_STD = {"gender": 0.5, "age": 0.05, "muscle": 0.2, "weight": 0.2, "height": 0.25, "proportions": 0.2}
NO_FACES = torch.zeros(0, 3, dtype=torch.long)
OLDEST = 2 / 3  # an adult; beyond, people shrink again, so that two ages would fit one height


@dataclass(frozen=True)
class BodyFamily:
    """All bodies of one topology: the rest shape is linear in coefficients that follow from shape parameters.

    ``names`` of the K shape parameters with the Gaussian prior ``mean``, ``std`` and the bounds ``low``, ``high``,
    ``(K,)``. ``bind`` is the bind-pose template of coefficients zero; ``directions (C, V, 3)`` and ``joint_directions
    (C, J, 3)`` are metres a coefficient. ``coefficients`` maps ``(B, K)`` to ``(B, C)``, differentiably; ``turns`` maps
    bind joints ``(B, J, 3)`` to the rotations ``(B, J, 3, 3)`` from the bind pose to the T-pose.
    """

    kind: str
    names: tuple[str, ...]
    mean: Tensor
    std: Tensor
    low: Tensor
    high: Tensor
    bind: Template
    directions: Tensor
    joint_directions: Tensor
    coefficients: Callable[[Tensor], Tensor]
    turns: Callable[[Tensor], Tensor]
    make: Callable[[Tensor], BodyModel]
    pose_directions: Tensor | None = None

    def rest(self, shape: Tensor) -> tuple[Tensor, Tensor]:
        """Bind vertices ``(B, V, 3)`` and joints ``(B, J, 3)`` of shapes ``(B, K)``.

        Differentiable in the shape. Raises `AvatarError` for another number of parameters.
        """
        check_shape("shape", shape, "B K", K=len(self.names))
        values = self.coefficients(shape)
        vertices = torch.einsum("bc,cvx->bvx", values, self.directions) + self.bind.vertices
        return vertices, torch.einsum("bc,cjx->bjx", values, self.joint_directions) + self.bind.joints

    def body(self, shape: Tensor) -> BodyModel:
        """The posable body of one shape ``(K,)``, exactly as its maker gives it."""
        check_shape("shape", shape, "K", K=len(self.names))
        return self.make(shape)

    def at(self, ids: Tensor) -> BodyFamily:
        """The same bodies with some vertices ``(N,)`` only, in this order, and no faces."""
        bind = replace(self.bind, vertices=self.bind.vertices[ids], weights=self.bind.weights[ids], faces=NO_FACES)
        poses = None if self.pose_directions is None else self.pose_directions[ids]
        return replace(self, bind=bind, directions=self.directions[:, ids], pose_directions=poses)

    @cached_property
    def normals(self) -> Tensor:
        """Unit normals ``(V, 3)`` of the mean shape's bind vertices."""
        return vertex_normals(self.rest(self.mean[None])[0][0], self.bind.faces)


@cache
def anny_family() -> BodyFamily:
    """The bodies of anny over its phenotypes, the shape of the open dataset's bodies included.

    The mean is an adult between male and female, and the prior keeps people adult. Construction takes seconds, and a
    minute once a machine; raises `AvatarError` when anny is missing.
    """
    model = build_anny()
    mean = torch.tensor([PHENOTYPE_MEAN[name] for name in model.phenotype_labels])
    values = Phenotype(**PHENOTYPE_MEAN)
    bind = anny_template(values)
    directions, joint_directions = anny_basis(model)

    def coefficients(shape: Tensor) -> Tensor:
        return anny_coefficients(model, shape).to(shape.dtype) - base

    def make(shape: Tensor) -> BodyModel:
        parts = dict(zip(model.phenotype_labels, shape.double().clamp(0, 1).tolist()))
        template = anny_template(Phenotype(**parts))
        return BodyModel(template, t_pose_from_bind(template))

    base = anny_coefficients(model, mean[None]).float()
    return BodyFamily(
        kind="anny",
        names=tuple(model.phenotype_labels),
        mean=mean,
        std=torch.tensor([PHENOTYPE_STD[name] for name in model.phenotype_labels]),
        low=torch.zeros(len(mean)),
        high=torch.tensor([OLDEST if name == "age" else 1.0 for name in model.phenotype_labels]),
        bind=bind,
        directions=directions,
        joint_directions=joint_directions,
        coefficients=coefficients,
        turns=t_pose_turns,
        make=make,
    )


@cache
def smpl_family(path: Path, components: int = 10) -> BodyFamily:
    """The bodies of a converted SMPL, SMPL-H or SMPL-X file over its first shape components, hands and face at rest.

    Parameters are standard deviations, as the model has them; errors as in `smpl_body`.
    """
    directions, joint_directions = (torch.from_numpy(array) for array in smpl_shapes(path, components))
    body, count = smpl_body(path), len(directions)
    return BodyFamily(
        kind=f"smpl:{path}",
        names=tuple(f"beta{i}" for i in range(count)),
        mean=torch.zeros(count),
        std=torch.ones(count),
        low=torch.full((count,), -5.0),
        high=torch.full((count,), 5.0),
        bind=bind_template(body),
        directions=directions,
        joint_directions=joint_directions,
        coefficients=lambda shape: shape,
        turns=lambda joints: torch.eye(3, dtype=joints.dtype).expand(*joints.shape[:-1], 3, 3),
        make=lambda shape: smpl_body(path, shape.double().tolist()),
        pose_directions=body.pose_directions,
    )


def fixed_family(body: BodyModel) -> BodyFamily:
    """One body without shape parameters: only its pose is fitted. Raises `AvatarError` for other than 22 joints."""
    if len(body.parents) != len(SMPL_JOINTS):
        raise AvatarError(f"body: expected the {len(SMPL_JOINTS)} joints of SMPL's body, got {len(body.parents)}.")
    bind, none = bind_template(body), torch.zeros(0)
    rotations = body.zero_from_bind[:, :3, :3]
    return BodyFamily(
        kind="fixed",
        names=(),
        mean=none,
        std=none,
        low=none,
        high=none,
        bind=bind,
        directions=torch.zeros(0, *bind.vertices.shape),
        joint_directions=torch.zeros(0, *bind.joints.shape),
        coefficients=lambda shape: shape,
        turns=lambda joints: rotations.to(joints).expand(*joints.shape[:-1], 3, 3),
        make=lambda shape: body,
        pose_directions=body.pose_directions,
    )


def bind_template(body: BodyModel) -> Template:
    """A body's template in its bind pose."""
    return Template(body.bind_vertices, body.faces, body.weights, body.bind_joints, body.parents, body.joint_names)
