"""The canonicalizer of one outfit: skinning fields of canonical and posed space and what tells its frames apart."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import torch
from torch import Tensor, nn

from avatar.body.skinning import skin_transforms
from avatar.canonical.fields import SkinningField, SkinningFieldConfig, bounding_box
from avatar.canonical.posed import ScanBatch
from avatar.checks import AvatarError
from avatar.geometry.sparse import pick
from avatar.geometry.transforms import invert_affine, transform_points
from avatar.records import Template

CODE_SPREAD = 1 / 8  # standard deviation of the codes at the start


class Latent(Enum):
    """What tells the inverse field which frame it is asked about (appendix B.1)."""

    auto_decoded = "auto_decoded"  # a code a frame, learned with the networks
    pose = "pose"  # the body's pose


@dataclass
class CanonicalizerConfig:
    """Both skinning fields; the defaults are the paper's."""

    forward: SkinningFieldConfig = field(default_factory=SkinningFieldConfig)
    inverse: SkinningFieldConfig = field(default_factory=lambda: SkinningFieldConfig(orders=8, latent=64))
    latent: Latent = Latent.auto_decoded
    shared: bool = False  # one network, the inverse one, with a code of its own for canonical space (appendix B.3)

    def __post_init__(self):
        if self.forward.latent:
            raise AvatarError(f"forward.latent: expected 0, canonical space is one; got {self.forward.latent}.")
        if self.inverse.latent < 1:
            raise AvatarError(f"inverse.latent: expected at least 1, got {self.inverse.latent}.")


@dataclass(frozen=True)
class Cycle:
    """A batch gone from posed to canonical space, and back where both fields are learned together.

    ``scan_weights (B, M, J)`` g^s(x^s); ``canonical (B, M, 3)`` x^c; ``canonical_weights (B, M, J)`` g^c(x^c);
    ``body_weights`` and ``canonical_body_weights (B, K, J)``; ``codes (B, L)``, None where the pose stands for them;
    ``reposed (B, M, 3)`` x^p and ``edge_weights (B, E, 2, J)``, None where the fields are learned apart.
    """

    scan_weights: Tensor
    canonical: Tensor
    canonical_weights: Tensor
    body_weights: Tensor
    canonical_body_weights: Tensor
    codes: Tensor | None = None
    reposed: Tensor | None = None
    edge_weights: Tensor | None = None


class Canonicalizer(nn.Module):
    """Forward and inverse skinning fields of one outfit's frames (SCANimate 3.1).

    ``codes (frames, L)`` are the frames' codes, in the order of training; without use where the pose stands for them.
    """

    def __init__(self, template: Template, frames: int, config: CanonicalizerConfig):
        """Builds untrained fields for a body and a number of frames to learn from."""
        super().__init__()
        self.config, joints, box = config, len(template.parents), bounding_box(template.vertices)
        length = config.inverse.latent if config.latent is Latent.auto_decoded else 3 * (joints - 1)
        self.inverse = SkinningField(joints, replace(config.inverse, latent=length), box)
        self.codes = nn.Parameter(CODE_SPREAD * torch.randn(frames, length))
        if config.shared:
            self.canonical_code = nn.Parameter(CODE_SPREAD * torch.randn(length))
        else:
            self.separate = SkinningField(joints, config.forward, box)
        self.register_buffer("canonical_from_bind", template.canonical_from_bind, persistent=False)

    @property
    def forward_field(self) -> SkinningField:
        """g^c: the skinning weights of canonical space, frozen as they are now where the network is shared."""
        return self.inverse.with_latent(self.canonical_code) if self.config.shared else self.separate

    def canonical_weights(self, points: Tensor) -> Tensor:
        """g^c of canonical points, ``(B, N, 3)`` to ``(B, N, J)``, with gradients to the network."""
        if self.config.shared:
            return self.inverse(points, self.canonical_code.expand(len(points), -1))
        return self.separate(points)

    def batch_codes(self, batch: ScanBatch) -> Tensor:
        """Conditioning of the inverse field on each frame of a batch, ``(B, L)``."""
        return batch.poses if self.config.latent is Latent.pose else pick(self.codes, batch.frames)

    def transforms(self, weights: Tensor, joint_transforms: Tensor) -> Tensor:
        """LBS: posed_from_canonical ``(B, N, 4, 4)`` of points with weights ``(B, N, J)``."""
        return skin_transforms(weights, joint_transforms, self.canonical_from_bind)

    def forward(self, batch: ScanBatch, codes: Tensor, together: bool) -> Cycle:
        """Unposes a batch to canonical space, and poses it again.

        Args:
            batch: posed points in their root frames.
            codes: ``(B, L)`` of its frames, see `batch_codes`.
            together: learn both fields at once (the second stage): gradients pass from one to the other, points are
                posed again and edges looked at. Apart, the inverse field learns nothing from the forward one.
        """
        counts = [batch.points.shape[1], batch.body.shape[1]]
        places = [batch.points, batch.body, batch.edges.flatten(1, 2)] if together else [batch.points, batch.body]
        scan_weights, body_weights, *edges = self.inverse(torch.cat(places, dim=1), codes, batch.boxes).split(
            [place.shape[1] for place in places], dim=1
        )
        back = invert_affine(self.transforms(scan_weights, batch.joint_transforms))
        canonical = transform_points(back, batch.points)
        canonical = canonical if together else canonical.detach()
        weights = self.canonical_weights(torch.cat([canonical, batch.canonical_body], dim=1))
        canonical_weights, canonical_body_weights = weights.split(counts, dim=1)
        cycle = Cycle(
            scan_weights=scan_weights,
            canonical=canonical,
            canonical_weights=canonical_weights,
            body_weights=body_weights,
            canonical_body_weights=canonical_body_weights,
            codes=codes if self.config.latent is Latent.auto_decoded else None,
        )
        if not together:
            return cycle
        reposed = transform_points(self.transforms(canonical_weights, batch.joint_transforms), canonical)
        return replace(cycle, reposed=reposed, edge_weights=edges[0].unflatten(1, (-1, 2)))
