"""Skinning weights as a function of space (SCANimate eq. 2): a small network on Fourier features of a point."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from avatar.checks import AvatarError, check_finite, check_shape
from avatar.geometry.precision import full_precision

BOX_MARGIN = 0.1  # of the box's longest side, added on every side: space for clothes around the body


@dataclass
class SkinningFieldConfig:
    """Size of a skinning field; the defaults are the paper's forward net (appendix A.1)."""

    width: int = 256
    layers: int = 3  # hidden layers
    skip: int = 2  # the hidden layer, counted from 0, that gets the features again
    orders: int = 6  # Fourier features sin, cos(2^k x) for k below this; the inverse net has 8
    latent: int = 0  # length of the code that tells frames apart; the inverse net has 64

    def __post_init__(self):
        if self.width < 1 or self.layers < 2 or not 0 < self.skip < self.layers:
            raise AvatarError(
                f"width, layers, skip: expected at least 1 and 2 and a skip in (0, layers), "
                f"got {self.width}, {self.layers} and {self.skip}."
            )
        if not 0 <= self.orders <= 16 or self.latent < 0:
            raise AvatarError(f"orders: expected 0 to 16, got {self.orders}; latent: at least 0, got {self.latent}.")


class SkinningField(nn.Module):
    """Skinning weights of any point in space, positive and summing to 1; differentiable in the points."""

    def __init__(self, joints: int, config: SkinningFieldConfig, box: Tensor):
        """Builds an untrained field.

        Args:
            joints: how many weights a point has.
            config: size of the network.
            box: ``(2, 3)`` lowest and highest corner of the space it is about, metres (`bounding_box`). Points
                outside are answered as well.
        """
        super().__init__()
        check_shape("box", box, "2 3")
        self.joints, self.config = joints, config
        self.register_buffer("box", box.detach().clone())
        features = 3 * (1 + 2 * config.orders) + config.latent
        self.layers = nn.ModuleList()
        incoming = features
        for place in range(config.layers):
            self.layers.append(nn.Linear(incoming + (features if place == config.skip else 0), config.width))
            incoming = config.width
        self.head = nn.Linear(incoming, joints)

    @full_precision
    def forward(self, points: Tensor, latent: Tensor | None = None, box: Tensor | None = None) -> Tensor:
        """Weights ``(B, N, J)`` of points ``(B, N, 3)``.

        Args:
            points: metres.
            latent: ``(B, L)`` code of each frame, for a field that has one.
            box: ``(B, 2, 3)`` box of each frame's points; the field's own where None.
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


def normalise(points: Tensor, box: Tensor) -> Tensor:
    """Points ``(B, N, 3)`` with their box, ``(2, 3)`` or ``(B, 2, 3)``, stretched to [-1, 1]."""
    low, high = box[..., :1, :], box[..., 1:, :]
    return (2 * points - low - high) / (high - low)


def fourier_features(points: Tensor, orders: int) -> Tensor:
    """``(..., 3)`` to ``(..., 3 (1 + 2 orders))``: the points, then sin and cos of 2^k of them (NeRF, without pi)."""
    waves = [wave(2**order * points) for order in range(orders) for wave in (torch.sin, torch.cos)]
    return torch.cat([points, *waves], dim=-1)


def bounding_box(points: Tensor, margin: float = BOX_MARGIN) -> Tensor:
    """The box ``(..., 2, 3)`` of points ``(..., N, 3)``, with a share of its longest side added on every side."""
    check_finite("points", points)
    low, high = points.amin(dim=-2), points.amax(dim=-2)
    pad = margin * (high - low).amax(dim=-1, keepdim=True)
    return torch.stack([low - pad, high + pad], dim=-2)
