"""Posing by learned skinning: canonical points are skinned with a field's weights at their place, not the body's."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from avatar.body.skinning import skin_transforms
from avatar.checks import AvatarError
from avatar.geometry.sparse import pick
from avatar.geometry.surface import interpolate
from avatar.records import SurfaceSamples, Template


class LearnedSkinning(nn.Module):
    """Forward skinning with one field an outfit (SCANimate 3.1), evaluated at the offset points themselves.

    With the body's weights a skirt's points would follow the skin they hang from and tear between the legs. A run's
    template is the mean of its outfits' bodies, so each subject's own is kept in the state saved with the weights.
    """

    def __init__(self, fields: Sequence[nn.Module], subjects: Sequence[Template], trainable: bool = False):
        """Takes one field and one body at rest an outfit, of one topology; ``trainable`` fields are trained too.

        A field is called as ``field(points (B, N, 3)) -> weights (B, N, J)`` on canonical points. Raises `AvatarError`
        when there is not one an outfit.
        """
        super().__init__()
        if not subjects or len(fields) != len(subjects):
            raise AvatarError(f"fields: expected one for each of {len(subjects)} outfits, got {len(fields)}.")
        self.fields = nn.ModuleList(fields).requires_grad_(trainable)
        binds = [body.canonical_from_bind for body in subjects]
        still = torch.eye(4).to(subjects[0].vertices).expand(len(subjects[0].parents), 4, 4)
        self.register_buffer("vertices", torch.stack([body.vertices for body in subjects]))
        self.register_buffer("binds", torch.stack([still if bind is None else bind for bind in binds]))

    def skin(self, outfit_ids: Tensor, samples: SurfaceSamples) -> Tensor:
        """The subjects' bodies at rest at the sampled template points, ``(B,)`` to ``(B, N, 3)``."""
        return interpolate(self.vertices[outfit_ids], samples)

    def forward(self, points: Tensor, joint_transforms: Tensor, outfit_ids: Tensor) -> Tensor:
        """posed_from_canonical ``(B, N, 4, 4)`` of points ``(B, N, 3)``; differentiable in the points.

        ``joint_transforms (B, J, 4, 4)`` are each frame's, ``outfit_ids (B,)`` choose its field and body.
        """
        frames = {outfit: (outfit_ids == outfit).nonzero()[:, 0] for outfit in outfit_ids.unique().tolist()}
        weights = torch.cat([self.fields[outfit](pick(points, rows)) for outfit, rows in frames.items()])
        weights = pick(weights, torch.cat(list(frames.values())).argsort())
        return skin_transforms(weights, joint_transforms, self.binds[outfit_ids])
