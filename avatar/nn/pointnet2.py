"""PointNet++ on a constant template: set abstraction, feature propagation, and their surface encoder."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from torch import Tensor, nn
from torch.nn.functional import linear

from avatar.checks import AvatarError, check_shape
from avatar.nn.hierarchy import HierarchyConfig, Level, build_levels
from avatar.nn.wide import WideLinear, wide_linear
from avatar.records import Template


@dataclass
class PointNet2Config:
    """Channels of a PointNet++ encoder; defaults are the full pose encoder, about 10.2 M parameters."""

    hierarchy: HierarchyConfig = field(default_factory=HierarchyConfig)
    abstraction: tuple[tuple[int, ...], ...] = (
        (64, 64, 128),
        (128, 128, 256),
        (256, 256, 512),
        (512, 512, 512),
        (512, 512, 1024),
        (1024, 1024, 1024),
    )  # channels of each set abstraction, finest first
    propagation: tuple[tuple[int, ...], ...] = (
        (1024, 512),
        (512, 512),
        (512, 512),
        (512, 256),
        (256, 128),
        (128, 64),
    )  # channels of each feature propagation, coarsest first

    def __post_init__(self):
        self.abstraction = tuple(tuple(widths) for widths in self.abstraction)
        self.propagation = tuple(tuple(widths) for widths in self.propagation)
        counts = {len(self.hierarchy.points), len(self.abstraction), len(self.propagation)}
        if len(counts) != 1 or not all(self.abstraction + self.propagation):
            raise AvatarError(
                "abstraction, propagation: expected one non-empty channel list for each of the "
                f"{len(self.hierarchy.points)} levels, got {len(self.abstraction)} and {len(self.propagation)}."
            )


class PointNorm(nn.BatchNorm1d):
    """Batch normalisation over every dimension but the last: ``(..., C)`` to ``(..., C)``."""

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features.flatten(0, -2)).view_as(features)


def point_mlp(widths: tuple[int, ...], first: type[nn.Linear] = nn.Linear) -> nn.Sequential:
    """Linear, normalisation, ReLU for each consecutive pair of widths; acts on the last dimension.

    ``first`` is the kind of the first layer: `WideLinear` where it sees positions.
    """
    layers: list[nn.Module] = []
    for fan_in, fan_out in itertools.pairwise(widths):
        layers += [nn.Linear(fan_in, fan_out) if layers else first(fan_in, fan_out), PointNorm(fan_out), nn.ReLU()]
    return nn.Sequential(*layers)


class SetAbstraction(nn.Module):
    """Groups each coarse point's neighbours, maps them through a shared network and takes the maximum.

    The first layer sees [neighbour feature, relative position] and is linear, so it is applied once a point before
    gathering, not once a neighbour: W_f f_j + W_p (x_j - x_i) = (W_f f_j + W_p x_j) - W_p x_i, exactly. In bfloat16
    the difference would be 7% rounding, so this layer and its normalisation are always float32.
    """

    def __init__(self, level: Level, channels: int, widths: tuple[int, ...]):
        super().__init__()
        self.level = level
        self.feature_layer = WideLinear(channels, widths[0])
        self.position_layer = WideLinear(3, widths[0], bias=False)
        self.first = nn.Sequential(PointNorm(widths[0]), nn.ReLU())
        self.rest = point_mlp(widths)

    def forward(self, features: Tensor) -> Tensor:
        """``(B, N, C)`` features of the finer level to ``(B, S, C')`` of the coarser."""
        level = self.level
        lifted = self.feature_layer(features) + self.position_layer(level.finer_positions)
        grouped = level.group(lifted) - self.position_layer(level.positions)[:, None]
        return self.rest(self.first(grouped)).amax(dim=2)


class FeaturePropagation(nn.Module):
    """Interpolates coarse features to the finer level, joins the finer level's own and maps both.

    The first layer sees [interpolated, own] and is linear, as interpolation is, so its first half comes before it,
    where there are fewer points: W_c (sum_k w_k c_k) = sum_k w_k (W_c c_k), exactly. The finest level's own features
    may be positions, so their half is always float32.
    """

    def __init__(self, level: Level, coarse_channels: int, fine_channels: int, widths: tuple[int, ...]):
        super().__init__()
        self.level = level
        self.mlp = point_mlp((coarse_channels + fine_channels, *widths))

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        """``(B, S, C)`` and ``(B, N, C')`` to ``(B, N, C'')``."""
        first, *rest = self.mlp
        mixing, adding = first.weight.split([coarse.shape[-1], fine.shape[-1]], dim=1)
        lifted = self.level.interpolate_up(linear(coarse, mixing)) + wide_linear(fine, adding, first.bias)
        for layer in rest:
            lifted = layer(lifted)
        return lifted


class SurfaceEncoder(nn.Module):
    """Down a hierarchy stage by stage and up again by feature propagation: what all encoders of a surface share."""

    def __init__(
        self,
        channels: int,
        levels: Sequence[Level],
        config: PointNet2Config,
        stages: Iterable[nn.Module],
        stem: nn.Module | None = None,
    ):
        """Builds the encoder around its stages.

        Args:
            channels: input features a vertex.
            levels: of the hierarchy, finest first.
            config: the last number of each list of channels is the width that a stage or propagation gives.
            stages: one a level, ``(B, N, C)`` features of the finer level to ``(B, S, C')`` of the coarser.
            stem: what comes before them, of the first stage's width.
        """
        super().__init__()
        self.channels, self.out_channels = channels, config.propagation[-1][-1]
        self.stem = stem or nn.Identity()
        self.abstractions = nn.ModuleList(stages)
        widths = [widths[-1] for widths in config.abstraction]
        widths = [widths[0] if stem else channels, *widths]
        self.propagations, coarse = nn.ModuleList(), widths.pop()
        for level, mlp in zip(reversed(levels), config.propagation):
            self.propagations.append(FeaturePropagation(level, coarse, widths.pop(), mlp))
            coarse = mlp[-1]

    def forward(self, features: Tensor) -> Tensor:
        """``(B, V, C)`` features on the template's vertices to ``(B, V, C')``."""
        check_shape("features", features, "B V C", C=self.channels)
        pyramid = [self.stem(features)]
        for abstraction in self.abstractions:
            pyramid.append(abstraction(pyramid[-1]))
        coarse = pyramid.pop()
        for propagation in self.propagations:
            coarse = propagation(coarse, pyramid.pop())
        return coarse


class PointNet2(SurfaceEncoder):
    """Hierarchical features on a body surface (CloSET 3.1, eq. 1): one vector for every template vertex.

    The template's vertices are the point cloud; what changes from frame to frame (posed vertices, a garment code)
    comes as features. All sampling and grouping is computed once, here.
    """

    def __init__(self, template: Template, channels: int, config: PointNet2Config):
        """Builds the encoder for one template and ``channels`` input features a vertex."""
        levels = build_levels(template.vertices, config.hierarchy)
        incoming = [channels, *(mlp[-1] for mlp in config.abstraction)]
        super().__init__(channels, levels, config, map(SetAbstraction, levels, incoming, config.abstraction))
