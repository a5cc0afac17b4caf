"""PointMLP (ICLR 2022) on a constant template: residual point networks on neighbourhoods in a common scale."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import relu

from avatar.geometry.neighbours import k_nearest
from avatar.geometry.precision import widen
from avatar.geometry.sparse import SparseRows
from avatar.nn.hierarchy import FixedRows, Level, build_levels
from avatar.nn.pointnet2 import PointNet2Config, PointNorm, SurfaceEncoder
from avatar.nn.wide import WideLinear
from avatar.records import Template


class GeometricAffine(nn.Module):
    """Brings all neighbourhoods of a cloud to one scale: a (f_ij - f_i) / (sigma + e) + b, a and b learned (eq. 5).

    sigma is one number a cloud: the root mean square of all its neighbours' differences.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.alpha = nn.Parameter(torch.ones(channels))
        self.beta = nn.Parameter(torch.zeros(channels))

    def forward(self, grouped: Tensor, centres: Tensor) -> Tensor:
        """``(B, S, K, C)`` neighbours and ``(B, S, C)`` centres to ``(B, S, K, C)``."""
        difference = grouped - centres.unsqueeze(2)
        sigma = (difference.float().square().mean(dim=(1, 2, 3), keepdim=True) + 1e-12).sqrt()
        return self.alpha * difference / (sigma + 1e-5) + self.beta


class ResidualPointMLP(nn.Module):
    """Two layers around a narrow middle, added to what came in (eq. 4's residual blocks); on the last dimension."""

    def __init__(self, width: int, inner: int):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(width, inner), PointNorm(inner), nn.ReLU(), nn.Linear(inner, width), PointNorm(width)
        )

    def forward(self, features: Tensor) -> Tensor:
        """``(..., C)`` to ``(..., C)``."""
        return relu(features + self.layers(features))


class PointMLPLevel(nn.Module):
    """One stage: affine neighbourhoods, residual blocks, maximum over the neighbours, residual blocks (eq. 4).

    The neighbours' differences alone would not tell what is at the centre, so its own feature is joined to them; the
    layer that takes both is linear, and applied to a centre once. Differences are taken, and centres seen, in float32.
    """

    def __init__(self, level: Level, channels: int, widths: tuple[int, ...]):
        """Builds the stage; ``widths`` are the inner widths of its residual blocks, then its own width."""
        super().__init__()
        *inner, width = widths
        self.level = level
        own = k_nearest(level.positions[None], level.finer_positions[None], 1)[0, :, 0]
        self.own = FixedRows(SparseRows.of_table(own[:, None], len(level.finer_positions)))  # centres
        self.affine = GeometricAffine(channels + 3)
        self.difference_layer = nn.Linear(channels + 3, width, bias=False)
        self.centre_layer = WideLinear(channels + 3, width)
        self.norm = PointNorm(width)
        self.before = nn.Sequential(*(ResidualPointMLP(width, narrow) for narrow in inner))
        self.after = nn.Sequential(*(ResidualPointMLP(width, narrow) for narrow in inner))

    def forward(self, features: Tensor) -> Tensor:
        """``(B, N, C)`` features of the finer level to ``(B, S, C')`` of the coarser."""
        positions = self.level.finer_positions.expand(len(features), -1, -1)
        joined = torch.cat([widen(features), positions], dim=-1)
        centres = self.own(joined)
        grouped = self.difference_layer(self.affine(self.level.group(joined), centres))
        lifted = relu(self.norm(grouped + self.centre_layer(centres).unsqueeze(2)))
        return self.after(self.before(lifted).amax(dim=2))


class PointMLP(SurfaceEncoder):
    """PointMLP in the place of PointNet++: features on the template's vertices to one vector for each of them.

    It takes the settings of PointNet++ and reads a level's channels as the inner widths of its residual blocks
    (before and after the maximum alike) followed by its width. Neighbours are PointNet++'s balls, not the paper's k
    nearest, and the way back up is PointNet++'s feature propagation.
    """

    def __init__(self, template: Template, channels: int, config: PointNet2Config):
        """Builds the encoder for one template and ``channels`` input features a vertex."""
        levels = build_levels(template.vertices, config.hierarchy)
        incoming = [channels, *(widths[-1] for widths in config.abstraction)]
        super().__init__(channels, levels, config, map(PointMLPLevel, levels, incoming, config.abstraction))
