"""Bodies of any shape from `anny` (Apache-2.0 code, CC0 MakeHuman data), reduced to the 22 SMPL-order joints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from avatar.body.atlas import toeless_atlas
from avatar.body.model import SMPL_JOINTS, SMPL_PARENTS, BodyModel
from avatar.body.skinning import chain_transforms
from avatar.checks import AvatarError, require
from avatar.geometry.transforms import axis_angle_from_rotation, rotation_between
from avatar.records import Template

OPEN_TOPOLOGIES = ("notoes", "notoes_collapse10pc", "anny", "makehuman")
MIXAMO_NAMES = (  # noqa: SIM905
    "Hips LeftUpLeg RightUpLeg Spine LeftLeg RightLeg Spine1 LeftFoot RightFoot Spine2 LeftToeBase RightToeBase "
    "Neck LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm LeftHand RightHand"
).split()


@dataclass
class Phenotype:
    """anny's shape parameters, each in [0, 1]; ``gender`` 0 is male and 1 female, ``age`` 2/3 is an adult."""

    gender: float = 1.0
    age: float = 2 / 3
    muscle: float = 0.5
    weight: float = 0.5
    height: float = 0.5
    proportions: float = 0.5

    def __post_init__(self):
        for name, value in vars(self).items():
            if not 0 <= value <= 1:
                raise AvatarError(f"{name}: expected a number in [0, 1], got {value}.")


def anny_template(phenotype: Phenotype, topology: str = "notoes") -> Template:
    """The bind-pose (A-pose) template of an anny body: y up, facing +z, metres, fingers merged into the hands.

    The first construction on a machine parses anny's blendshapes (about a minute, 0.8 GB in ``~/.cache/anny``).

    Raises:
        AvatarError: for a topology that would download anny's non-commercial archive, or when anny is missing.
    """
    if topology not in OPEN_TOPOLOGIES:
        raise AvatarError(
            f"topology: expected one of {', '.join(OPEN_TOPOLOGIES)}, got {topology!r}. anny downloads a "
            "non-commercial archive for other topologies, which this project never does; for SMPL or SMPL-X use "
            "your own model file (tools/convert_body.py)."
        )
    model = require("anny").Anny(
        rig="mixamo", topology=topology, local_changes="none", facial_actions="none", skinning_method="lbs"
    )
    values = {key: torch.tensor([value], dtype=torch.float64) for key, value in vars(phenotype).items()}
    rest = model(phenotype_kwargs=values)
    labels = [label.removeprefix("mixamorig:") for label in model.bone_labels]
    weights = torch.zeros(len(rest["rest_vertices"][0]), len(SMPL_JOINTS), dtype=torch.float64)
    for bone in range(len(labels)):
        ancestor = bone
        while labels[ancestor] not in MIXAMO_NAMES:
            ancestor = model.bone_parents[ancestor]
        influence = torch.where(model.vertex_bone_indices == bone, model.vertex_bone_weights, 0).sum(dim=1)
        weights[:, MIXAMO_NAMES.index(labels[ancestor])] += influence
    uv, uv_faces = anny_atlas(model, topology)
    y_up = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)
    heads = rest["rest_bone_heads"][0, [labels.index(name) for name in MIXAMO_NAMES]]
    return Template(
        vertices=(rest["rest_vertices"][0] @ y_up.T).float(),
        faces=model.faces.long(),
        weights=(weights / weights.sum(dim=1, keepdim=True)).float(),
        joints=(heads @ y_up.T).float(),
        parents=SMPL_PARENTS,
        joint_names=tuple(SMPL_JOINTS),
        uv=uv,
        uv_faces=uv_faces,
    )


def anny_atlas(model: Any, topology: str) -> tuple[Tensor, Tensor] | tuple[None, None]:
    """UV coordinates ``(U, 2)`` and corner indices ``(F, 3)`` of an anny model; None for a decimated topology."""
    if model.texture_coordinates is not None:
        return model.texture_coordinates.float(), model.face_texture_coordinate_indices.long()
    if topology != "notoes":
        return None, None
    uv, uv_faces = toeless_atlas(model.faces.numpy())
    return torch.from_numpy(uv).float(), torch.from_numpy(uv_faces)


def t_pose_from_bind(bind: Template) -> Tensor:
    """Rigid joint motions ``(J, 4, 4)`` that stretch the arms of an A-pose template sideways into the T-pose."""
    pose = torch.zeros(len(bind.parents), 3, dtype=torch.float64)
    joints = bind.joints.double()
    for side, axis in (("left", 1.0), ("right", -1.0)):
        shoulder, elbow, wrist = (bind.joint_names.index(f"{side}_{j}") for j in ("shoulder", "elbow", "wrist"))
        sideways = torch.tensor([axis, 0, 0], dtype=torch.float64)
        upper = rotation_between(joints[elbow] - joints[shoulder], sideways)
        lower = rotation_between(upper @ (joints[wrist] - joints[elbow]), sideways)
        pose[shoulder] = axis_angle_from_rotation(upper)
        pose[elbow] = axis_angle_from_rotation(upper.T @ lower @ upper)
    return chain_transforms(pose[None], joints, bind.parents)[0].to(bind.joints.dtype)


def anny_body(phenotype: Phenotype, canonical_pose: Tensor | None = None) -> BodyModel:
    """A posable anny body of any shape."""
    bind = anny_template(phenotype)
    return BodyModel(bind, t_pose_from_bind(bind), canonical_pose)
