"""Skinning weights as a function of space: a small network (SCANimate eq. 2), or those of the body nearby (4.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from avatar.checks import AvatarError, check_finite, check_range, check_shape
from avatar.geometry.neighbours import FixedPoints
from avatar.geometry.precision import full_precision
from avatar.geometry.transforms import fourier_features
from avatar.records import Frame, Template

BOX_MARGIN = 0.1  # of the box's longest side, added on every side: space for clothes around the body
KNN = 6  # the paper's number of neighbours
CHUNK = 20_000  # points whose neighbours' weights are held at once


@dataclass
class SkinningFieldConfig:
    """Size of a skinning field; the defaults are the paper's forward net (appendix A.1)."""

    width: int = 256
    layers: int = 3  # hidden layers
    skip: int = 2  # the hidden layer, counted from 0, that gets the features again
    orders: int = 6  # Fourier features sin, cos(2^k x) for k below this; the inverse net has 8
    latent: int = 0  # length of the code that tells frames apart; the inverse net has 64

    def __post_init__(self):
        check_range(self, "width", low=1)
        check_range(self, "layers", low=2)
        check_range(self, "skip", low=1, high=self.layers - 1)
        check_range(self, "orders", low=0, high=16)
        check_range(self, "latent", low=0)


class SkinningField(nn.Module):
    """Skinning weights of any point in space, positive and summing to 1; differentiable in the points."""

    def __init__(self, joints: int, config: SkinningFieldConfig, box: Tensor):
        """Builds an untrained field of ``joints`` weights about a box ``(2, 3)``, metres, and the space around it."""
        super().__init__()
        check_shape("box", box, "2 3")
        self.joints, self.config = joints, config
        self.register_buffer("box", box.detach().clone())
        features = 3 * (1 + 2 * config.orders) + config.latent
        incoming = [features, *[config.width] * (config.layers - 1)]
        incoming[config.skip] += features
        self.layers = nn.ModuleList(nn.Linear(channels, config.width) for channels in incoming)
        self.head = nn.Linear(config.width, joints)

    @full_precision
    def forward(self, points: Tensor, latent: Tensor | None = None, box: Tensor | None = None) -> Tensor:
        """Weights ``(B, N, J)`` of points ``(B, N, 3)``, metres.

        ``latent (B, L)`` are the frames' codes, for a field that has them; ``box (B, 2, 3)`` the boxes of each frame's
        points, the field's own where None.
        """
        dims = check_shape("points", points, "B N 3")
        features = fourier_features(normalise(points, self.box if box is None else box), self.config.orders)
        if self.config.latent:
            check_shape("latent", latent, "B L", B=dims["B"], L=self.config.latent)
            features = torch.cat([features, latent[:, None].expand(-1, dims["N"], -1)], dim=-1)
        hidden = features
        for place, layer in enumerate(self.layers):
            hidden = torch.cat([hidden, features], dim=-1) if place == self.config.skip else hidden
            hidden = nn.functional.leaky_relu(layer(hidden))
        return self.head(hidden).softmax(dim=-1)

    @torch.no_grad()
    def with_latent(self, latent: Tensor) -> SkinningField:
        """The field of one code ``(L,)`` as a field without codes: what they add to a layer becomes its bias."""
        check_shape("latent", latent, "L", L=self.config.latent)
        field = SkinningField(self.joints, replace(self.config, latent=0), self.box).to(latent)
        field.head.load_state_dict(self.head.state_dict())
        for place, (layer, bare) in enumerate(zip(self.layers, field.layers)):
            coded = place in (0, self.config.skip)  # there the code's columns stand last
            kept, added = layer.weight.split([bare.in_features, layer.in_features - bare.in_features], dim=1)
            bare.weight.copy_(kept)
            bare.bias.copy_(layer.bias + added @ latent if coded else layer.bias)
        return field


class BodyField(nn.Module):
    """Weights of the nearest body vertices, by inverse distance: SCANimate 4.1's baselines of learned fields.

    In canonical space they are differentiable in the points but for changes of neighbours.
    """

    def __init__(self, template: Template, neighbours: int = KNN):
        """Takes a body's weights. Raises `AvatarError` for fewer than one neighbour or more than vertices."""
        super().__init__()
        if not 1 <= neighbours <= len(template.vertices):
            raise AvatarError(f"neighbours: expected 1 to {len(template.vertices)}, got {neighbours}.")
        self.template, self.neighbours = template, neighbours
        self.register_buffer("vertices", template.vertices.clone(), persistent=False)
        self.search = FixedPoints(self.vertices)
        self.register_buffer("weights", template.weights.clone(), persistent=False)

    def forward(self, points: Tensor) -> Tensor:
        """Weights ``(B, N, J)``, rows summing to 1, of canonical points ``(B, N, 3)``."""
        check_shape("points", points, "B N 3")
        return self.blend(points, self.vertices, self.search, 1e-12)

    def weights_of(self, points: np.ndarray, frame: Frame) -> np.ndarray:
        """Weights ``(M, J)`` of posed points ``(M, 3)`` in the frame's world, metres."""
        check_shape("points", points, "M 3")
        vertices, places = (torch.as_tensor(array).double() for array in (frame.body.vertices, points))
        search = FixedPoints(vertices)
        parts = [self.blend(part[None], vertices, search, 1e-18)[0].float() for part in places.split(CHUNK)]
        return torch.cat(parts).numpy()

    def blend(self, points: Tensor, vertices: Tensor, search: FixedPoints, least: float) -> Tensor:
        """Weights of points beside the body at ``vertices (V, 3)``; squared distances count as ``least`` or more."""
        ids = search.k_nearest(points.detach(), self.neighbours)
        if self.neighbours == 1:
            return self.weights[ids[..., 0]].to(points)
        squares = (points.unsqueeze(2) - vertices[ids]).square().sum(dim=-1)
        closeness = squares.clamp(min=least).rsqrt()
        closeness = closeness / closeness.sum(dim=-1, keepdim=True)
        return torch.einsum("bnk,bnkj->bnj", closeness, self.weights[ids].to(points))


def normalise(points: Tensor, box: Tensor) -> Tensor:
    """Points ``(B, N, 3)`` with their box, ``(2, 3)`` or ``(B, 2, 3)``, stretched to [-1, 1]."""
    low, high = box[..., :1, :], box[..., 1:, :]
    return (2 * points - low - high) / (high - low)


def bounding_box(points: Tensor, margin: float = BOX_MARGIN) -> Tensor:
    """The box ``(..., 2, 3)`` of points ``(..., N, 3)``, with a share of its longest side added on every side."""
    check_finite("points", points)
    low, high = points.amin(dim=-2), points.amax(dim=-2)
    pad = margin * (high - low).amax(dim=-1, keepdim=True)
    return torch.stack([low - pad, high + pad], dim=-2)
