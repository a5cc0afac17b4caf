"""The canonicalizer of one outfit: skinning fields of canonical and posed space and their loss (SCANimate 3.1)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import torch
from torch import Tensor, nn

from avatar.body.skinning import skin_transforms
from avatar.canonical.fields import BodyField, SkinningField, SkinningFieldConfig, bounding_box
from avatar.canonical.scans import ScanBatch
from avatar.checks import AvatarError, check_range
from avatar.geometry.sparse import pick
from avatar.geometry.transforms import invert_affine, transform_points
from avatar.records import LossTerms, Template

TERMS = ("body", "nearest", "cycle_weights", "cycle_points", "sparsity", "smoothness", "latent")
SMALLEST_WEIGHT = 1e-8  # below it the sparsity term has no gradient: its slope at zero is infinite
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

    ``codes (frames, L)`` are the frames' codes, in the order of training; without use where the model is not ``coded``.
    """

    def __init__(self, template: Template, frames: int, config: CanonicalizerConfig):
        """Builds untrained fields for a body and a number of frames to learn from."""
        super().__init__()
        self.config, joints, box = config, len(template.parents), bounding_box(template.vertices)
        self.coded = config.latent is Latent.auto_decoded
        length = config.inverse.latent if self.coded else 3 * (joints - 1)
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
        return pick(self.codes, batch.frames) if self.coded else batch.poses

    def transforms(self, weights: Tensor, joint_transforms: Tensor) -> Tensor:
        """LBS: posed_from_canonical ``(B, N, 4, 4)`` of points with weights ``(B, N, J)``."""
        return skin_transforms(weights, joint_transforms, self.canonical_from_bind)

    def forward(self, batch: ScanBatch, codes: Tensor, together: bool) -> Cycle:
        """Unposes a batch to canonical space, and poses it again; ``codes (B, L)`` are those of `batch_codes`.

        With ``together`` both fields learn at once (the second stage): gradients pass from one to the other, points are
        posed again and edges looked at. Apart, the inverse field learns nothing from the forward one.
        """
        places = [batch.points, batch.body, batch.edges.flatten(1, 2)] if together else [batch.points, batch.body]
        counts = [place.shape[1] for place in places]
        weights = self.inverse(torch.cat(places, dim=1), codes, batch.boxes)
        scan_weights, body_weights, *edges = weights.split(counts, dim=1)
        back = invert_affine(self.transforms(scan_weights, batch.joint_transforms))
        canonical = transform_points(back, batch.points)
        canonical = canonical if together else canonical.detach()
        weights = self.canonical_weights(torch.cat([canonical, batch.canonical_body], dim=1))
        canonical_weights, canonical_body = weights.split(counts[:2], dim=1)
        codes = codes if self.coded else None
        reposed = ends = None
        if together:
            reposed = transform_points(self.transforms(canonical_weights, batch.joint_transforms), canonical)
            ends = edges[0].unflatten(1, (-1, 2))
        return Cycle(scan_weights, canonical, canonical_weights, body_weights, canonical_body, codes, reposed, ends)


@dataclass
class CanonicalLossConfig:
    """Weights of the terms, the paper's (appendix A.2). Those of the cycle and of smoothness count in stage 2 only."""

    body: float = 10.0  # E_B: the body's own weights on its surface, in both spaces
    nearest: float = 1.0  # E_S: those of the nearest body vertex on the scan, in both spaces
    cycle_weights: float = 1.0  # E_C': the same weights before and after
    cycle_points: float = 1.0  # E_C'': the same place before and after, metres
    cycle_late: float = 10.0  # factor on cycle_points in the second half of stage 2
    sparsity: float = 1e-3  # E_Sp
    beta: float = 0.8  # exponent of the sparsity term
    smoothness: float = 0.1  # E_Sm: the same weights at both ends of an edge
    latent: float = 0.01  # E_Z

    def __post_init__(self):
        check_range(self, *vars(self), low=0)
        check_range(self, "beta", above=0, high=1)


def cycle_loss(
    cycle: Cycle, batch: ScanBatch, nearest: BodyField, config: CanonicalLossConfig, progress: float = 0.0
) -> LossTerms:
    """The objective of either stage, reduced to means over frames and points.

    Weights differ by the squared length of their difference, as in SCANimate's code: with plain lengths, which the
    paper writes, the nearest body's weights keep the upper hand (docs/paper_map.md). Places differ by the plain length.

    Terms of stage 2 are there where the cycle came back. ``nearest`` gives the weights of the nearest vertex of the
    canonical body; ``progress`` is the share of stage 2 that is done, in [0, 1].
    """
    raw = {
        "body": squared_distance(cycle.body_weights, batch.body_weights)
        + squared_distance(cycle.canonical_body_weights, batch.body_weights),
        "nearest": squared_distance(cycle.scan_weights, batch.nearest_weights)
        + squared_distance(cycle.canonical_weights, nearest(cycle.canonical.detach())),
        "sparsity": cycle.scan_weights.clamp(min=SMALLEST_WEIGHT).pow(config.beta).sum(dim=-1).mean(),
    }
    if cycle.reposed is not None:
        raw["cycle_weights"] = squared_distance(cycle.scan_weights, cycle.canonical_weights)
        raw["cycle_points"] = (cycle.reposed - batch.points).norm(dim=-1).mean()
        raw["smoothness"] = squared_distance(cycle.edge_weights[:, :, 0], cycle.edge_weights[:, :, 1])
    if cycle.codes is not None:
        raw["latent"] = cycle.codes.square().sum(dim=-1).mean()
    weights = {name: getattr(config, name) for name in raw}
    if progress >= 0.5 and "cycle_points" in weights:
        weights["cycle_points"] *= config.cycle_late
    return LossTerms(raw, {name: value * weights[name] for name, value in raw.items() if weights[name]})


def squared_distance(ones: Tensor, others: Tensor) -> Tensor:
    """Mean squared Euclidean distance between rows of ``(..., C)``."""
    return (ones - others).square().sum(dim=-1).mean()
