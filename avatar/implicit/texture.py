"""Colours of the dressed surface as a field (SCANimate appendix A.3)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from avatar.checks import check_shape
from avatar.implicit.networks import MlpConfig, SkipMlp


class TextureField(nn.Module):
    """Colour of a point from what the signed distance network sees of it and the features it makes of that."""

    def __init__(self, inputs: int, features: int, config: MlpConfig):
        """Builds the network for ``inputs`` input channels and ``features`` geometry features."""
        super().__init__()
        self.inputs, self.channels = inputs, features
        self.mlp = SkipMlp(inputs + features, 3, config)

    def forward(self, inputs: Tensor, features: Tensor) -> Tensor:
        """Colours ``(B, N, 3)`` in [0, 1] of ``PosedSdf.inputs`` ``(B, N, I)`` and ``.features`` ``(B, N, C)``."""
        dims = check_shape("inputs", inputs, "B N I", I=self.inputs)
        check_shape("features", features, "B N C", B=dims["B"], N=dims["N"], C=self.channels)
        return torch.sigmoid(self.mlp(torch.cat([inputs, features], dim=-1)))
