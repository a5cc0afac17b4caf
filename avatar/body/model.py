"""The one interface to a posable body: rest template, skinning, canonical pose."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from avatar.body.skinning import blend_transforms, chain_transforms, check_parents
from avatar.checks import AvatarError, check_faces, check_finite, check_shape
from avatar.geometry.transforms import (
    assemble_transform,
    invert_affine,
    invert_rigid,
    rotation_from_axis_angle,
    transform_directions,
    transform_points,
)
from avatar.geometry.uv import check_atlas
from avatar.records import PosedBody, Template

SMPL_JOINTS = (  # noqa: SIM905
    "pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot right_foot "
    "neck left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist"
).split()
SMPL_PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)


class BodyModel(nn.Module):
    """A skinned body in a canonical pose, posed by linear blend skinning.

    Three poses matter. *Bind* is where skinning weights were painted (an A-pose for the open body, the T-pose for
    SMPL). *Zero* is the T-pose in which all pose parameters are zero, whatever the body. *Canonical* is the space
    of templates and garments: zero by default, or any other pose (legs apart, for skirts). Every transform given
    out is posed_from_canonical, and the skinned bind shape is what lies under all of them, so a body bound in an
    A-pose keeps its good shoulders. Vertex transforms are therefore not the joint transforms blended by the weights,
    unless bind and canonical pose are one.

    A body has ``zero_from_bind (J, 4, 4)``, the rigid motion of each joint from bind to the T-pose (identity if None),
    a ``canonical_pose (J, 3)``, axis-angle relative to the T-pose (zero if None), and maybe ``pose_directions (V, 3,
    9 (J - 1))``, pose blendshapes: the displacement of the bind vertices, metres, for each entry of ``R - I`` of each
    joint but the root (SMPL's ``posedirs``). Raises `AvatarError` on shapes that do not fit, non-finite values, or
    weights whose rows do not sum to 1.
    """

    def __init__(
        self,
        bind: Template,
        zero_from_bind: Tensor | None = None,
        canonical_pose: Tensor | None = None,
        pose_directions: Tensor | None = None,
    ):
        super().__init__()
        dims = check_bind(bind)
        like, joints = bind.vertices, dims["J"]
        if zero_from_bind is None:
            zero_from_bind = torch.eye(4, dtype=like.dtype, device=like.device).expand(joints, 4, 4)
        canonical_pose = like.new_zeros(joints, 3) if canonical_pose is None else canonical_pose.to(like)
        check_shape("zero_from_bind", zero_from_bind, "J 4 4", J=joints)
        check_shape("canonical_pose", canonical_pose, "J 3", J=joints)
        if pose_directions is not None:
            check_shape("pose_directions", pose_directions, "V 3 P", V=dims["V"], P=9 * (joints - 1))
            check_finite("pose_directions", pose_directions)
            pose_directions = pose_directions.clone()
        self.parents, self.joint_names = tuple(bind.parents), tuple(bind.joint_names)
        self.register_buffer("pose_directions", pose_directions, persistent=False)
        zero_joints = transform_points(zero_from_bind, bind.joints)
        canonical_from_zero = chain_transforms(canonical_pose[None], zero_joints, self.parents)[0]
        canonical_from_bind = canonical_from_zero @ zero_from_bind
        vertex_canonical_from_bind = blend_transforms(bind.weights, canonical_from_bind)
        corrected = bind.vertices + self.pose_displacements(canonical_pose[None])[0]
        for name, value in {
            **{name: getattr(bind, name) for name in ("faces", "weights", "uv", "uv_faces")},
            "canonical_pose": canonical_pose,
            "bind_vertices": bind.vertices,
            "bind_joints": bind.joints,
            "zero_joints": zero_joints,
            "zero_from_bind": zero_from_bind,
            "zero_from_canonical": invert_rigid(canonical_from_zero),
            "vertex_bind_from_canonical": invert_affine(vertex_canonical_from_bind),
            "corrected_bind_vertices": corrected,
            "canonical_vertices": transform_points(vertex_canonical_from_bind, corrected),
            "canonical_joints": transform_points(canonical_from_bind, bind.joints),
            "canonical_from_bind": canonical_from_bind,
        }.items():
            self.register_buffer(name, None if value is None else value.clone(), persistent=False)

    @property
    def template(self) -> Template:
        """The body at rest in its canonical pose."""
        names = ("faces", "weights", "parents", "joint_names", "canonical_from_bind", "uv", "uv_faces")
        kept = {name: getattr(self, name) for name in names}
        return Template(vertices=self.canonical_vertices, joints=self.canonical_joints, **kept)

    def with_canonical_pose(self, canonical_pose: Tensor) -> BodyModel:
        """The same body with another canonical space, ``(J, 3)`` axis-angle relative to the T-pose."""
        bind = replace(self.template, vertices=self.bind_vertices, joints=self.bind_joints, canonical_from_bind=None)
        return BodyModel(bind, self.zero_from_bind, canonical_pose, self.pose_directions)

    def pose_displacements(self, pose: Tensor) -> Tensor:
        """Pose-dependent displacement of the bind vertices, metres: ``(B, J, 3)`` to ``(B, V, 3)``.

        Zero ``(B, 1, 1)`` for a body without pose blendshapes.
        """
        if self.pose_directions is None:
            return pose.new_zeros(len(pose), 1, 1)
        rotations = rotation_from_axis_angle(pose[:, 1:])
        features = (rotations - torch.eye(3, dtype=pose.dtype, device=pose.device)).flatten(1)
        return (features @ self.pose_directions.flatten(0, 1).T).unflatten(-1, (-1, 3))

    def forward(self, pose: Tensor, translation: Tensor | None = None) -> PosedBody:
        """Poses the body, differentiably in pose and translation.

        ``pose (B, J, 3)`` is axis-angle, radians, relative to the parent and to the T-pose; ``translation (B, 3)``
        metres is added last (SMPL's ``trans``). A vertex transform poses the canonical vertex, pose blendshapes
        included: what they add since the canonical pose lies in its translation.
        """
        dims = check_shape("pose", pose, "B J 3", J=len(self.parents))
        posed_from_zero = chain_transforms(pose, self.zero_joints, self.parents)
        if translation is not None:
            check_shape("translation", translation, "B 3", B=dims["B"])
            shift = torch.zeros_like(posed_from_zero)
            shift[..., :3, 3] = translation[:, None]
            posed_from_zero = posed_from_zero + shift
        posed_from_bind = blend_transforms(self.weights, posed_from_zero @ self.zero_from_bind)
        vertex_transforms = posed_from_bind @ self.vertex_bind_from_canonical
        vertices = self.bind_vertices
        if self.pose_directions is not None:
            vertices = self.bind_vertices + self.pose_displacements(pose)
            added = transform_directions(posed_from_bind, vertices - self.corrected_bind_vertices)
            shift = vertex_transforms[..., :3, 3] + added
            vertex_transforms = assemble_transform(vertex_transforms[..., :3, :3], shift)
        joint_transforms = posed_from_zero @ self.zero_from_canonical
        return PosedBody(transform_points(posed_from_bind, vertices), joint_transforms, vertex_transforms)


def check_bind(bind: Template) -> dict[str, int]:
    """Sizes V and J of a template; raises `AvatarError`, naming the field, for one that cannot be posed."""
    dims = check_shape("vertices", bind.vertices, "V 3")
    dims = check_shape("weights", bind.weights, "V J", **dims)
    check_shape("joints", bind.joints, "J 3", **dims)
    check_parents(bind.parents)
    if twice := [name for name in bind.joint_names if bind.joint_names.count(name) > 1]:
        raise AvatarError(
            f"joint_names: expected each once, {twice[0]!r} is there {bind.joint_names.count(twice[0])} times."
        )
    for name, count in (("parents", len(bind.parents)), ("joint_names", len(bind.joint_names))):
        if count != dims["J"]:
            raise AvatarError(f"{name}: expected {dims['J']} entries, as many as weights has columns, got {count}.")
    for name in ("vertices", "weights", "joints"):
        check_finite(name, getattr(bind, name))
    off = float((bind.weights.sum(dim=-1) - 1).abs().max())
    if off > 1e-3 or float(bind.weights.min()) < -1e-6:
        raise AvatarError(f"weights: expected no negative value and rows summing to 1, got a row off by {off:.3g}.")
    check_faces(bind.faces.cpu().numpy(), dims["V"])
    if bind.uv is not None or bind.uv_faces is not None:
        check_atlas(bind.uv, bind.uv_faces, len(bind.faces))
    return dims
