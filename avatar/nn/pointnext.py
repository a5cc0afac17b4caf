"""PointNeXt (NeurIPS 2022) on a constant template: PointNet++ with radius-normalised positions and residual blocks."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn.functional import relu

from avatar.geometry.neighbours import ball_query
from avatar.nn.hierarchy import Grouping, build_levels
from avatar.nn.pointnet2 import PointNet2Config, PointNorm, SetAbstraction, SurfaceEncoder, point_mlp
from avatar.nn.wide import WideLinear
from avatar.records import Template


class Neighbourhoods(nn.Module):
    """Groups of points around centres with positions in units of the groups' radius, so that all scales look alike.

    Buffers as a `Level` has them: ``positions (S, 3)``, ``finer_positions (N, 3)``, ``groups (S, K)``; and ``group``.
    """

    def __init__(self, centres: Tensor, points: Tensor, groups: Tensor, radius: float):
        super().__init__()
        self.register_buffer("positions", centres / radius, persistent=False)
        self.register_buffer("finer_positions", points / radius, persistent=False)
        self.register_buffer("groups", groups.clone(), persistent=False)
        self.group = Grouping(self.groups, len(points))


class InvertedResidual(nn.Module):
    """InvResMLP: a layer on the neighbours, their maximum, two point layers with a wide middle, added to the input."""

    def __init__(self, around: Neighbourhoods, width: int, inner: int):
        super().__init__()
        self.aggregation = SetAbstraction(around, width, (width,))
        self.mixing = nn.Sequential(
            nn.Linear(width, inner), PointNorm(inner), nn.ReLU(), nn.Linear(inner, width), PointNorm(width)
        )

    def forward(self, features: Tensor) -> Tensor:
        """``(B, S, C)`` to ``(B, S, C)``."""
        return relu(features + self.mixing(self.aggregation(features)))


class PointNeXt(SurfaceEncoder):
    """PointNeXt in the place of PointNet++: features on the template's vertices to one vector for each of them.

    It takes the settings of PointNet++ and reads a level's channels as the inner widths of its inverted residual
    blocks (the paper: four times the width) followed by its width. A stem of the first level's width comes before
    all; the blocks look twice as far as the set abstraction before them, as the radius doubles with each level.
    """

    def __init__(self, template: Template, channels: int, config: PointNet2Config):
        """Builds the encoder for one template and ``channels`` input features a vertex."""
        sizes = config.hierarchy
        levels = build_levels(template.vertices, sizes)
        first = config.abstraction[0][-1]
        stem = point_mlp((channels, first), WideLinear)
        stages, incoming = [], first
        for level, radius, (*inner, width) in zip(levels, sizes.radii, config.abstraction):
            down = Neighbourhoods(level.positions, level.finer_positions, level.groups, radius)
            groups = ball_query(level.positions, level.positions, 2 * radius, min(sizes.neighbours, len(level.groups)))
            around = Neighbourhoods(level.positions, level.positions, groups, 2 * radius)
            blocks = (InvertedResidual(around, width, wide) for wide in inner)
            stages.append(nn.Sequential(SetAbstraction(down, incoming, (width,)), *blocks))
            incoming = width
        super().__init__(channels, levels, config, stages, stem)
