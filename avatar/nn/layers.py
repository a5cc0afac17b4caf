"""Layers of point networks, and layers that see positions: in float32 whatever the rest of a network runs in."""

from __future__ import annotations

import itertools

from torch import Tensor, nn
from torch.nn.functional import linear

from avatar.geometry.precision import full_precision

wide_linear = full_precision(linear)


class WideLinear(nn.Linear):
    """A linear layer in full precision: ``(..., C)`` to ``(..., C')``."""

    @full_precision
    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features)


class WideConv2d(nn.Conv2d):
    """A convolution in full precision: ``(B, C, H, W)`` to ``(B, C', H', W')``."""

    @full_precision
    def forward(self, image: Tensor) -> Tensor:
        return super().forward(image)


class PointNorm(nn.BatchNorm1d):
    """Batch normalisation over every dimension but the last: ``(..., C)`` to ``(..., C)``."""

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features.flatten(0, -2)).view_as(features)


def point_mlp(
    widths: tuple[int, ...], first: type[nn.Linear] = nn.Linear, activation: type[nn.Module] = nn.ReLU
) -> nn.Sequential:
    """Linear, normalisation, activation for each consecutive pair of widths; acts on the last dimension.

    ``first`` is the kind of the first layer: `WideLinear` where it sees positions.
    """
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(widths):
        kind = nn.Linear if layers else first
        layers += [kind(fan_in, fan_out), PointNorm(fan_out), activation()]
    return nn.Sequential(*layers)
