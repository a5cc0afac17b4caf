"""The best that skinning can do for simulated clothes: fixed weights of every cloth vertex, fitted to its true motion.

What these weights leave (in least squares, as posed) is the cloth's own motion, out of reach of every
canonicalization whose weights do not change from pose to pose. The weights of the nearest part of the body are no such
bound: a skirt does not hang on the nearest leg.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import torch

from avatar.body.skinning import blend_transforms
from avatar.checks import AvatarError, check_shape
from avatar.data.scanner import DressedSurface
from avatar.evaluation.canonical_truth import Canonicalized, unpose_with
from avatar.geometry.transforms import invert_affine, transform_points
from avatar.geometry.trees import build_tree
from avatar.records import BodyFit, Frame, Template

ROUNDS = 3  # bind positions depend on the weights a little; both are found in turn
STEPS = 300  # of accelerated projected gradient a round; the error no longer changes in the fourth digit
NEIGHBOURS = 3  # vertices between which weights are interpolated
LABEL_SPACING = 10.0  # metres between labels in the fourth dimension, so that neighbours have the same


class SimulatedOutfit(Protocol):
    """What is asked of a simulated outfit."""

    template: Template

    def load_body(self, split: str, name: str) -> BodyFit:
        """The body under a frame."""

    def load_surface(self, split: str, name: str) -> DressedSurface:
        """Skin and clothes of a frame, with their places at rest."""


class BestSkinning:
    """The best fixed weights of an outfit's clothes; called with a frame, it canonicalizes it with them.

    ``weights (V, J)`` of the vertices of skin and clothes; skin has the body's own.
    """

    def __init__(self, outfit: SimulatedOutfit, split: str, names: Sequence[str]):
        """Fits the weights to the cloth's motion over some frames.

        Raises:
            AvatarError: without frames.
        """
        if not names:
            raise AvatarError("names: expected at least one frame to fit weights to, got none.")
        self.template = outfit.template
        surfaces = [outfit.load_surface(split, name) for name in names]
        joints = torch.stack([torch.from_numpy(outfit.load_body(split, name).joint_transforms) for name in names])
        first = surfaces[0]
        cloth, rest = first.labels > 0, first.canonical
        nearest = build_tree(self.template.vertices.numpy()).query(rest.numpy())[1]
        weights = self.template.weights[torch.from_numpy(nearest)].clone()
        posed = torch.stack([surface.vertices[cloth] for surface in surfaces])
        bind = self.template.canonical_from_bind
        weights[cloth] = fit_weights(rest[cloth], posed, joints, weights[cloth], bind).to(weights)
        self.weights = weights.numpy()
        self._tree = build_tree(_labelled(rest.numpy(), first.labels.numpy()))

    def weights_at(self, canonical: np.ndarray, labels: np.ndarray) -> np.ndarray:
        """Weights ``(M, J)`` at places at rest ``(M, 3)`` on the surfaces of some labels ``(M,)``."""
        distances, ids = self._tree.query(_labelled(canonical, labels), k=NEIGHBOURS)
        closeness = 1 / np.maximum(distances, 1e-6)
        closeness /= closeness.sum(axis=1, keepdims=True)
        return np.einsum("mk,mkj->mj", closeness, self.weights[ids]).astype(np.float32)

    def __call__(self, frame: Frame) -> Canonicalized:
        """The frame's scan unposed to the canonical pose with the weights of each point's true place."""
        scan = frame.scan
        if scan.canonical is None or scan.labels is None:
            raise AvatarError("scan: expected labels and canonical positions; only simulated data has the truth.")
        carried = unpose_with(self.weights_at(scan.canonical, scan.labels), frame, self.template)
        return Canonicalized(carried, self.weights_at(carried.points, scan.labels))


def fit_weights(
    rest: torch.Tensor,
    posed: torch.Tensor,
    joint_transforms: torch.Tensor,
    start: torch.Tensor,
    canonical_from_bind: torch.Tensor | None = None,
) -> torch.Tensor:
    """Fixed skinning weights, at least 0 and summing to 1, that carry points at rest nearest to where they were seen.

    Args:
        rest: ``(V, 3)`` canonical.
        posed: ``(F, V, 3)`` in each frame.
        joint_transforms: ``(F, J, 4, 4)`` posed_from_canonical.
        start: ``(V, J)`` weights to begin from.
        canonical_from_bind: ``(J, 4, 4)`` of the `Template`, or None.

    Returns:
        ``(V, J)`` float64.
    """
    dims = check_shape("posed", posed, "F V 3")
    dims = check_shape("joint_transforms", joint_transforms, "F J 4 4", F=dims["F"], V=dims["V"])
    check_shape("start", start, "V J", **dims)
    rest, weights, transforms = rest.double(), start.double(), joint_transforms.double()
    bind = torch.eye(4, dtype=torch.float64).expand(dims["J"], 4, 4)
    bind = bind if canonical_from_bind is None else canonical_from_bind.double()
    for _ in range(ROUNDS):
        at_bind = transform_points(invert_affine(blend_transforms(weights, bind)), rest)
        gram = torch.zeros(dims["V"], dims["J"], dims["J"], dtype=torch.float64)
        for frame, seen in zip(transforms @ bind, posed.double()):
            carried = torch.einsum("jxy,vy->vjx", frame[:, :3, :3], at_bind) + frame[:, :3, 3]
            off = carried - seen[:, None]  # weights sum to 1, so the blend is off by the blend of these
            gram += off @ off.transpose(1, 2)
        weights = _minimise(gram, weights)
    return weights


def _minimise(gram: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
    """Weights on the simplex with the least ``w G w``: accelerated projected gradient, ``(V, J, J)`` to ``(V, J)``."""
    pace = 1 / torch.linalg.eigvalsh(gram)[:, -1:].clamp(min=1e-12)
    weights, ahead, momentum = start, start, 1.0
    for _ in range(STEPS):
        stepped = project_to_simplex(ahead - pace * (gram @ ahead.unsqueeze(-1)).squeeze(-1))
        grown = (1 + (1 + 4 * momentum**2) ** 0.5) / 2
        ahead = stepped + (momentum - 1) / grown * (stepped - weights)
        weights, momentum = stepped, grown
    return weights


def project_to_simplex(values: torch.Tensor) -> torch.Tensor:
    """The nearest rows of weights, at least 0 and summing to 1, to rows of numbers ``(V, J)`` (Duchi et al. 2008)."""
    falling = values.sort(dim=-1, descending=True).values
    ranks = torch.arange(1, values.shape[-1] + 1, dtype=values.dtype)
    excess = (falling.cumsum(dim=-1) - 1) / ranks
    last = (falling > excess).sum(dim=-1, keepdim=True) - 1
    return (values - excess.gather(-1, last)).clamp(min=0)


def _labelled(points: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Points with their label as a fourth coordinate, ``(M, 4)``."""
    return np.concatenate([points, LABEL_SPACING * labels[:, None].astype(np.float64)], axis=1)
