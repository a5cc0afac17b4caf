"""Encoders of a body's surface on a constant template: PointNet++, PointMLP and PointNeXt (CloSET 3.1 and table 5)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, relu

from avatar.checks import AvatarError, check_shape
from avatar.geometry.neighbours import ball_query
from avatar.geometry.precision import widen
from avatar.nn.hierarchy import FixedRows, HierarchyConfig, Level, build_levels, centre_rows
from avatar.nn.layers import PointNorm, WideLinear, point_mlp, wide_linear
from avatar.records import Template

FULL_ABSTRACTION = ((64, 64, 128), (128, 128, 256), (256, 256, 512), (512, 512, 512), (512, 512, 1024), (1024,) * 3)
FULL_PROPAGATION = ((1024, 512), (512, 512), (512, 512), (512, 256), (256, 128), (128, 64))


@dataclass
class PointNet2Config:
    """Channels of a PointNet++ encoder; defaults are the full pose encoder, about 10.2 M parameters."""

    hierarchy: HierarchyConfig = field(default_factory=HierarchyConfig)
    abstraction: tuple[tuple[int, ...], ...] = FULL_ABSTRACTION  # channels of each set abstraction, finest first
    propagation: tuple[tuple[int, ...], ...] = FULL_PROPAGATION  # channels of each feature propagation, coarsest first

    def __post_init__(self):
        self.abstraction = tuple(map(tuple, self.abstraction))
        self.propagation = tuple(map(tuple, self.propagation))
        counts = {len(self.hierarchy.points), len(self.abstraction), len(self.propagation)}
        if len(counts) != 1 or not all(self.abstraction + self.propagation):
            expected = f"one non-empty channel list for each of the {len(self.hierarchy.points)} levels"
            got = f"{len(self.abstraction)} and {len(self.propagation)}"
            raise AvatarError(f"abstraction, propagation: expected {expected}, got {got}.")


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
        features = self.level.interpolate_up(linear(coarse, mixing)) + wide_linear(fine, adding, first.bias)
        for layer in rest:
            features = layer(features)
        return features


class SurfaceEncoder(nn.Module):
    """Down a hierarchy stage by stage and up again by feature propagation (CloSET 3.1, eq. 1).

    The template's vertices are the point cloud; what changes from frame to frame (posed vertices, a garment code)
    comes as features. All sampling and grouping is computed once, with the hierarchy.

    ``stage(level, channels, widths, relative)`` makes what goes down one level, ``(B, N, C)`` features of the finer
    level to ``(B, S, C')`` of the coarser; the last of its widths is C'. A ``stem`` of the first stage's width may come
    before.
    """

    stage: Callable[[Level, int, tuple[int, ...], bool], nn.Module]
    has_stem = False

    def __init__(self, template: Template, channels: int, config: PointNet2Config, relative: bool = False):
        """Builds the encoder for one template and ``channels`` input features a vertex.

        With ``relative`` the first stage sees how features differ from those of a group's centre as well.
        """
        super().__init__()
        self.channels, self.out_channels = channels, config.propagation[-1][-1]
        levels = build_levels(template.vertices, config.hierarchy)
        widths = [widths[-1] for widths in config.abstraction]
        self.stem = point_mlp((channels, widths[0]), WideLinear) if self.has_stem else nn.Identity()
        widths.insert(0, widths[0] if self.has_stem else channels)
        first = [relative, *[False] * len(levels)]
        self.abstractions = nn.ModuleList(map(self.stage, levels, widths, config.abstraction, first))
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


class SetAbstraction(nn.Module):
    """Groups each coarse point's neighbours, maps them through a shared network and takes the maximum (PointNet++).

    The first layer sees [neighbour feature, relative position] and is linear, so it is applied once a point before
    gathering, not once a neighbour: W_f f_j + W_p (x_j - x_i) = (W_f f_j + W_p x_j) - W_p x_i, exactly. In bfloat16
    the difference would be 7% rounding, so this layer and its normalisation are always float32.

    A ``relative`` one sees (f_j - f_i) / radius as well, by a layer of its own: how positions turn and stretch about
    the centre, which is far smaller than they are themselves.
    """

    def __init__(self, level: Level | Neighbourhoods, channels: int, widths: tuple[int, ...], relative: bool = False):
        super().__init__()
        self.level = level
        self.feature_layer = WideLinear(channels, widths[0])
        self.position_layer = WideLinear(3, widths[0], bias=False)
        self.first = nn.Sequential(PointNorm(widths[0]), nn.ReLU())
        self.rest = point_mlp(widths)
        self.difference_layer = WideLinear(channels, widths[0], bias=False) if relative else None
        self.own = centre_rows(level) if relative else None

    def forward(self, features: Tensor) -> Tensor:
        """``(B, N, C)`` features of the finer level to ``(B, S, C')`` of the coarser."""
        lifted = self.feature_layer(features) + self.position_layer(self.level.finer_positions)
        centres = self.position_layer(self.level.positions)
        if self.difference_layer is not None:
            differing = self.difference_layer(features / self.level.radius)
            lifted, centres = lifted + differing, centres + self.own(differing)
        grouped = self.level.group(lifted) - centres.unsqueeze(-2)
        return self.rest(self.first(grouped)).amax(dim=2)


class PointNet2(SurfaceEncoder):
    """PointNet++: features on the template's vertices to one vector for each of them."""

    stage = SetAbstraction


def two_layers(width: int, inner: int) -> nn.Sequential:
    """Two layers around a middle of another width, for a residual block to add to its input."""
    return nn.Sequential(
        nn.Linear(width, inner), PointNorm(inner), nn.ReLU(), nn.Linear(inner, width), PointNorm(width)
    )


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
    """Two layers around a narrow middle, added to what came in (eq. 4's residual blocks): ``(..., C)`` to the same."""

    def __init__(self, width: int, inner: int):
        super().__init__()
        self.layers = two_layers(width, inner)

    def forward(self, features: Tensor) -> Tensor:
        return relu(features + self.layers(features))


class PointMLPLevel(nn.Module):
    """One stage: affine neighbourhoods, residual blocks, maximum over the neighbours, residual blocks (eq. 4).

    The neighbours' differences alone would not tell what is at the centre, so its own feature is joined to them; the
    layer that takes both is linear, and applied to a centre once. Differences are taken, and centres seen, in float32.
    ``widths`` are the inner widths of the residual blocks, then the stage's own. All its features are ``relative``.
    """

    def __init__(self, level: Level, channels: int, widths: tuple[int, ...], relative: bool = True):
        super().__init__()
        *inner, width = widths
        self.level = level
        self.own = centre_rows(level)
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
    """PointMLP (ICLR 2022): residual point networks on neighbourhoods in a common scale.

    A level's channels are the inner widths of its residual blocks (before and after the maximum alike), then its width.
    Neighbours are PointNet++'s balls, not the paper's k nearest, and the way back up is its feature propagation.
    """

    stage = PointMLPLevel


class Neighbourhoods(nn.Module):
    """Groups of points around centres with positions in units of the groups' radius, so that all scales look alike.

    As a `Level` has, ``positions (S, 3)``, ``finer_positions (N, 3)``, ``groups (S, K)``, ``group`` and ``radius``.
    """

    def __init__(self, centres: Tensor, points: Tensor, groups: Tensor, radius: float):
        super().__init__()
        self.radius = radius
        self.register_buffer("positions", centres / radius, persistent=False)
        self.register_buffer("finer_positions", points / radius, persistent=False)
        self.register_buffer("groups", groups.clone(), persistent=False)
        self.group = FixedRows.of_groups(groups, len(points))


class InvertedResidual(nn.Module):
    """InvResMLP: a layer on the neighbours, their maximum, two point layers with a wide middle, added to the input."""

    def __init__(self, around: Neighbourhoods, width: int, inner: int):
        super().__init__()
        self.aggregation = SetAbstraction(around, width, (width,))
        self.mixing = two_layers(width, inner)

    def forward(self, features: Tensor) -> Tensor:
        """``(B, S, C)`` to ``(B, S, C)``."""
        return relu(features + self.mixing(self.aggregation(features)))


class PointNeXtLevel(nn.Sequential):
    """One stage: a set abstraction, then inverted residual blocks that look twice as far."""

    def __init__(self, level: Level, channels: int, widths: tuple[int, ...], relative: bool = False):
        *inner, width = widths
        down = Neighbourhoods(level.positions, level.finer_positions, level.groups, level.radius)
        reach, count = 2 * level.radius, min(level.groups.shape[1], len(level.groups))
        ranks = torch.arange(len(level.positions)) if level.spread else None  # they are in farthest-point order
        groups = ball_query(level.positions, level.positions, reach, count, ranks)
        around = Neighbourhoods(level.positions, level.positions, groups, reach)
        blocks = (InvertedResidual(around, width, wide) for wide in inner)
        super().__init__(SetAbstraction(down, channels, (width,), relative), *blocks)


class PointNeXt(SurfaceEncoder):
    """PointNeXt (NeurIPS 2022): PointNet++ with radius-normalised positions and residual blocks.

    A level's channels are the inner widths of its blocks (the paper: four times the width), then its width.
    """

    stage = PointNeXtLevel
    has_stem = True


class Encoder(Enum):
    """What makes features on the body's surface out of features on its vertices (CloSET, table 5)."""

    pointnet2 = "pointnet2"
    pointmlp = "pointmlp"
    pointnext = "pointnext"


ENCODERS = {Encoder.pointnet2: PointNet2, Encoder.pointmlp: PointMLP, Encoder.pointnext: PointNeXt}
