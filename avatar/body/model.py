"""The one interface to a posable body: rest template, skinning, canonical pose."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from avatar.body.skinning import blend_transforms, chain_transforms, check_parents
from avatar.checks import AvatarError, check_finite, check_shape
from avatar.geometry.transforms import invert_affine, invert_rigid, transform_points
from avatar.records import PosedBody, Template

SMPL_JOINTS = (
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
    A-pose keeps its good shoulders.
    """

    def __init__(
        self,
        bind: Template,
        zero_from_bind: Tensor | None = None,
        canonical_pose: Tensor | None = None,
    ):
        """Builds a body from its bind-pose template.

        Args:
            bind: vertices, joints and skinning weights in the bind pose.
            zero_from_bind: ``(J, 4, 4)`` rigid motion of each joint from bind to the T-pose; identity if None.
            canonical_pose: ``(J, 3)`` axis-angle pose of the canonical space, relative to the T-pose; zero if None.

        Raises:
            AvatarError: on shapes that do not fit, non-finite values, or weights whose rows do not sum to 1.
        """
        super().__init__()
        dims = check_shape("vertices", bind.vertices, "V 3")
        dims = check_shape("weights", bind.weights, "V J", **dims)
        check_shape("joints", bind.joints, "J 3", **dims)
        check_shape("faces", bind.faces, "F 3")
        check_parents(bind.parents)
        if len(bind.parents) != dims["J"] or len(bind.joint_names) != dims["J"]:
            raise AvatarError(
                f"parents, joint_names: expected {dims['J']}, got {len(bind.parents)} and {len(bind.joint_names)}."
            )
        for name in ("vertices", "weights", "joints"):
            check_finite(name, getattr(bind, name))
        off = (bind.weights.sum(dim=-1) - 1).abs().max()
        if off > 1e-3:
            raise AvatarError(f"weights: expected rows summing to 1, got a row off by {float(off):.3g}.")
        if int(bind.faces.min()) < 0 or int(bind.faces.max()) >= dims["V"]:
            raise AvatarError(f"faces: expected indices in [0, {dims['V']}), got {int(bind.faces.max())}.")

        self.parents, self.joint_names = tuple(bind.parents), tuple(bind.joint_names)
        if zero_from_bind is None:
            zero_from_bind = torch.eye(4, dtype=bind.vertices.dtype).expand(dims["J"], 4, 4)
        if canonical_pose is None:
            canonical_pose = torch.zeros(dims["J"], 3, dtype=bind.vertices.dtype)
        check_shape("zero_from_bind", zero_from_bind, "J 4 4", J=dims["J"])
        check_shape("canonical_pose", canonical_pose, "J 3", J=dims["J"])

        zero_joints = transform_points(zero_from_bind, bind.joints)
        canonical_from_zero = chain_transforms(canonical_pose[None], zero_joints, self.parents)[0]
        canonical_from_bind = canonical_from_zero @ zero_from_bind
        vertex_canonical_from_bind = blend_transforms(bind.weights, canonical_from_bind)
        for name, value in {
            "faces": bind.faces,
            "weights": bind.weights,
            "canonical_pose": canonical_pose,
            "bind_vertices": bind.vertices,
            "zero_joints": zero_joints,
            "zero_from_bind": zero_from_bind,
            "zero_from_canonical": invert_rigid(canonical_from_zero),
            "vertex_bind_from_canonical": invert_affine(vertex_canonical_from_bind),
            "canonical_vertices": transform_points(vertex_canonical_from_bind, bind.vertices),
            "canonical_joints": transform_points(canonical_from_bind, bind.joints),
        }.items():
            self.register_buffer(name, value.clone(), persistent=False)

    @property
    def template(self) -> Template:
        """The body at rest in its canonical pose."""
        return Template(
            self.canonical_vertices, self.faces, self.weights, self.canonical_joints, self.parents, self.joint_names
        )

    def forward(self, pose: Tensor, translation: Tensor | None = None) -> PosedBody:
        """Poses the body.

        Args:
            pose: ``(B, J, 3)`` axis-angle, radians, relative to the parent and to the T-pose.
            translation: ``(B, 3)`` metres, added last (SMPL's ``trans``); zero if None.

        Returns:
            `PosedBody`; differentiable in pose and translation.
        """
        dims = check_shape("pose", pose, "B J 3", J=len(self.parents))
        posed_from_zero = chain_transforms(pose, self.zero_joints, self.parents)
        if translation is not None:
            check_shape("translation", translation, "B 3", B=dims["B"])
            shift = torch.zeros_like(posed_from_zero)
            shift[..., :3, 3] = translation[:, None]
            posed_from_zero = posed_from_zero + shift
        posed_from_bind = blend_transforms(self.weights, posed_from_zero @ self.zero_from_bind)
        return PosedBody(
            vertices=transform_points(posed_from_bind, self.bind_vertices),
            joint_transforms=posed_from_zero @ self.zero_from_canonical,
            vertex_transforms=posed_from_bind @ self.vertex_bind_from_canonical,
        )
