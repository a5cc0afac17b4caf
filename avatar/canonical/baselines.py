"""Canonicalization without learning: every scan point takes the weights of the body near it (SCANimate 4.1)."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from avatar.canonical.edges import nearest_ids
from avatar.checks import AvatarError, check_shape
from avatar.records import Frame, Template

KNN = 6  # the paper's number of neighbours


class SkinningSource(Protocol):
    """What gives posed points their skinning weights."""

    def weights_of(self, points: np.ndarray, frame: Frame) -> np.ndarray:
        """Weights ``(M, J)``, rows summing to 1, of posed points ``(M, 3)`` in the frame's world, metres."""
        ...


class NearestBody:
    """Weights of the nearest posed body vertices, by inverse distance; of the nearest alone for one neighbour."""

    def __init__(self, template: Template, neighbours: int = 1):
        """Takes the body's weights. Raises `AvatarError` for fewer than one neighbour or more than vertices."""
        if not 1 <= neighbours <= len(template.vertices):
            raise AvatarError(f"neighbours: expected 1 to {len(template.vertices)}, got {neighbours}.")
        self.template, self.weights, self.neighbours = template, template.weights.numpy(), neighbours

    def weights_of(self, points: np.ndarray, frame: Frame) -> np.ndarray:
        """Weights ``(M, J)`` of posed points ``(M, 3)`` in the frame's world, metres."""
        return self.blend_weights(points, frame.body.vertices)

    def blend_weights(self, points: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """Weights ``(M, J)`` of points ``(M, 3)`` beside the body at ``vertices (V, 3)``, posed or at rest, metres."""
        check_shape("points", points, "M 3")
        distances, ids = nearest_ids(vertices, points, self.neighbours)
        closeness = 1 / np.maximum(distances, 1e-9)
        closeness /= closeness.sum(axis=1, keepdims=True)
        return np.einsum("mk,mkj->mj", closeness, self.weights[ids]).astype(np.float32)
