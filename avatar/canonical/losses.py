"""What canonicalization is learned from (SCANimate eqs. 4-13): every term named, weighted and ablated by weight 0."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from avatar.canonical.canonicalizer import Cycle
from avatar.canonical.posed import ScanBatch
from avatar.checks import AvatarError
from avatar.geometry.neighbours import FixedPoints
from avatar.records import LossTerms, Template

TERMS = ("body", "nearest", "cycle_weights", "cycle_points", "sparsity", "smoothness", "latent")
SMALLEST_WEIGHT = 1e-8  # below it the sparsity term has no gradient: its slope at zero is infinite


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
        wrong = {name: value for name, value in vars(self).items() if value < 0}
        if wrong or not 0 < self.beta <= 1:
            raise AvatarError(f"loss: expected weights of at least 0 and beta in (0, 1], got {wrong or self.beta}.")


class NearestWeights:
    """The skinning weights of the canonical body's nearest vertex: what E_S compares weights in canonical space with.

    The search structure over the body is built once.
    """

    def __init__(self, template: Template, device: torch.device | str = "cpu"):
        """Takes the body at rest to a device."""
        self.weights, self.vertices = template.weights.to(device), FixedPoints(template.vertices.to(device))

    def __call__(self, points: Tensor) -> Tensor:
        """Weights ``(B, N, J)`` at points ``(B, N, 3)`` of canonical space; without gradient."""
        return self.weights[self.vertices.k_nearest(points.detach(), 1)[..., 0]]


def canonicalization_loss(
    cycle: Cycle, batch: ScanBatch, nearest: NearestWeights, config: CanonicalLossConfig, progress: float = 0.0
) -> LossTerms:
    """The objective of either stage, reduced to means over frames and points.

    Weights differ by the squared length of their difference, as in SCANimate's code: with plain lengths, which the
    paper writes, the nearest body's weights keep the upper hand (docs/paper_map.md). Places differ by the plain length.

    Args:
        cycle: what the canonicalizer gave for the batch; its stage 2 terms are there where it came back.
        batch: the points.
        nearest: the body's weights in canonical space.
        config: weights.
        progress: share of stage 2 that is done, in [0, 1].
    """
    raw = {
        "body": squared_distance(cycle.body_weights, batch.body_weights)
        + squared_distance(cycle.canonical_body_weights, batch.body_weights),
        "nearest": squared_distance(cycle.scan_weights, batch.nearest_weights)
        + squared_distance(cycle.canonical_weights, nearest(cycle.canonical)),
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
