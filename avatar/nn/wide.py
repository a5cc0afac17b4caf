"""Layers that see positions: in float32 whatever precision the rest of a network runs in."""

from __future__ import annotations

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
