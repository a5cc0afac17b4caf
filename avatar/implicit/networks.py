"""SCANimate's networks: pose features of a point and the pose-aware signed distance (eq. 18), and the texture (A.3)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from itertools import product

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

from avatar.body.skinning import tree_distances
from avatar.checks import AvatarError, check_range, check_shape
from avatar.geometry.precision import full_precision
from avatar.geometry.transforms import fourier_features, relative_quaternions

MAX_NODES = 1 << 24
CHUNK = 65_536  # nodes evaluated at once


class Attention(Enum):
    """Which joints count as near in the kinematic tree."""

    neighbours = "neighbours"  # up and down the tree: the paper
    ancestors = "ancestors"  # up the tree alone: the paper's code


def attention_map(parents: tuple[int, ...], rings: int, attention: Attention, normalised: bool) -> Tensor:
    """W ``(J, J)`` of SCANimate eq. 18: how much a point skinned to a column's joint attends to a row's.

    Joints up to ``rings`` edges of the tree apart do, each with itself as well. If ``normalised``, columns sum to 1
    (the paper's code) instead of being 0 and 1 (the paper).
    """
    if rings < 0:
        raise AvatarError(f"rings: expected at least 0, got {rings}.")
    near = tree_distances(parents) <= rings
    if attention is Attention.ancestors:
        above = torch.eye(len(parents), dtype=torch.bool)
        for joint, parent in enumerate(parents[1:], start=1):
            above[:, joint] |= above[:, parent]
        near &= above
    weights = near.float()
    return weights / weights.sum(dim=0) if normalised else weights


def joint_quaternions(joint_transforms: Tensor, parents: tuple[int, ...]) -> Tensor:
    """`relative_quaternions` in the order (w, x, y, z), ``(B, J, 4, 4)`` to ``(B, J - 1, 4)``."""
    return relative_quaternions(joint_transforms, parents).roll(1, dims=-1)


class PoseGate(nn.Module):
    """Pose features of a point: (W g(x)) o theta, each joint's quaternion times how much the point attends to it."""

    def __init__(
        self,
        parents: tuple[int, ...],
        rings: int = 4,
        attention: Attention = Attention.neighbours,
        normalised: bool = False,
    ):
        """Prepares the gate of a kinematic tree; see `attention_map`."""
        super().__init__()
        self.parents = tuple(parents)
        self.channels = 4 * (len(parents) - 1)
        self.register_buffer("attention", attention_map(parents, rings, attention, normalised)[1:], persistent=False)

    @full_precision
    def forward(self, weights: Tensor, joint_transforms: Tensor) -> Tensor:
        """``(B, N, J)`` skinning weights and ``(B, J, 4, 4)`` posed_from_canonical to ``(B, N, 4 (J - 1))``."""
        dims = check_shape("weights", weights, "B N J", J=len(self.parents))
        check_shape("joint_transforms", joint_transforms, "B J 4 4", B=dims["B"], J=dims["J"])
        gates = weights @ self.attention.T
        quaternions = joint_quaternions(joint_transforms, self.parents)
        return (gates.unsqueeze(-1) * quaternions[:, None]).flatten(-2)


class FieldLattice(nn.Module):
    """A frozen field ``(B, N, 3) -> (B, N, C)`` as trilinear look-ups, for those smooth over a few centimetres.

    Differentiable in the points; outside its box the value at the border is given.
    """

    def __init__(self, field: Callable[[Tensor], Tensor], box: Tensor, spacing: float):
        """Evaluates the field, with ``(1, N, 3)`` points, at nodes ``spacing`` metres apart in a box ``(2, 3)``."""
        super().__init__()
        check_shape("box", box, "2 3")
        if spacing <= 0:
            raise AvatarError(f"spacing: expected above 0 metres, got {spacing}.")
        cells = ((box[1] - box[0]) / spacing).ceil().long().clamp(min=1)
        if (cells + 1).double().prod() > MAX_NODES:
            raise AvatarError(f"spacing: expected at most {MAX_NODES} nodes, {spacing} m makes more of this box.")
        steps = [spacing * torch.arange(int(count) + 1, dtype=box.dtype, device=box.device) for count in cells]
        nodes = torch.stack(torch.meshgrid(*steps, indexing="ij"), dim=-1).reshape(-1, 3) + box[0]
        with torch.no_grad():
            values = torch.cat([field(chunk[None])[0] for chunk in nodes.split(CHUNK)])
        self.spacing = spacing
        self.register_buffer("cells", cells, persistent=False)
        self.register_buffer("origin", box[0].clone(), persistent=False)
        self.register_buffer("values", values, persistent=False)

    def forward(self, points: Tensor) -> Tensor:
        """Interpolated values ``(B, N, C)`` at points ``(B, N, 3)``; where a point is NaN, so are its values."""
        check_shape("points", points, "B N 3")
        place = ((points - self.origin) / self.spacing).clamp(min=0).minimum(self.cells.to(points.dtype))
        low = place.detach().nan_to_num().floor().long().minimum(self.cells - 1)
        share = place - low
        sides = (1 - share, share)
        blended = 0
        for corner in product((0, 1), repeat=3):
            x, y, z = (low[..., axis] + corner[axis] for axis in range(3))
            row = (x * (self.cells[1] + 1) + y) * (self.cells[2] + 1) + z
            weight = sides[corner[0]][..., 0] * sides[corner[1]][..., 1] * sides[corner[2]][..., 2]
            blended = blended + weight.unsqueeze(-1) * self.values[row]
        return blended


@dataclass
class MlpConfig:
    """Size of a network on points; the defaults are IGR's as SCANimate uses it (appendix A.1)."""

    widths: tuple[int, ...] = (512, 512, 512, 343, 512, 512)  # hidden layers
    skip: int = 4  # the hidden layer, counted from 0, that gets the network's input again
    orders: int = 8  # Fourier features sin, cos(2^k x) for k below this
    beta: float = 100.0  # sharpness of the softplus

    def __post_init__(self):
        if not self.widths or min(self.widths) < 1:
            raise AvatarError(f"widths: expected positive numbers of channels, got {self.widths}.")
        check_range(self, "skip", low=1, high=len(self.widths) - 1)
        check_range(self, "orders", low=0, high=16)
        check_range(self, "beta", above=0)


class SkipMlp(nn.Module):
    """Softplus layers with weight norm; one of them gets the input again, scaled so that its variance stays.

    Always in full precision: what goes in are positions, what comes out is a distance to half a millimetre.
    """

    def __init__(self, inputs: int, outputs: int, config: MlpConfig):
        """Builds the network: ``inputs`` channels to ``outputs`` channels."""
        super().__init__()
        self.skip, self.softplus = config.skip, nn.Softplus(beta=config.beta)
        *incoming, self.channels = inputs, *config.widths
        incoming[config.skip] += inputs
        self.layers = nn.ModuleList(weight_norm(nn.Linear(*sizes)) for sizes in zip(incoming, config.widths))
        self.head = weight_norm(nn.Linear(self.channels, outputs))

    @full_precision
    def features(self, inputs: Tensor) -> Tensor:
        """What the last hidden layer makes of ``(..., inputs)``: ``(..., channels)``."""
        hidden = inputs
        for place, layer in enumerate(self.layers):
            if place == self.skip:
                hidden = torch.cat([hidden, inputs], dim=-1) / math.sqrt(2)
            hidden = self.softplus(layer(hidden))
        return hidden

    @full_precision
    def forward(self, inputs: Tensor) -> Tensor:
        """``(..., inputs)`` to ``(..., outputs)``."""
        return self.head(self.features(inputs))

    @torch.no_grad()
    def start_as_sphere(self, radius: float) -> None:
        """Sets the weights so that the output is about |x| - radius, x being the first three inputs.

        The geometric initialisation of IGR (SAL, Atzmon and Lipman 2020, theorem 1): hidden layers keep lengths in the
        mean, the head averages. Columns of all other inputs start at zero: waves and pose add nothing at first.
        """
        for place, layer in enumerate(self.layers):
            weight = torch.randn_like(layer.weight) * math.sqrt(2 / layer.out_features)
            inputs = self.layers[0].in_features
            if place in (0, self.skip):
                weight[:, layer.in_features - inputs + 3 :] = 0
            layer.weight = weight
            layer.bias.zero_()
        mean = math.sqrt(math.pi / self.head.in_features)
        self.head.weight = mean + 1e-4 * torch.randn_like(self.head.weight)
        self.head.bias.fill_(-radius)


@dataclass
class SdfConfig(MlpConfig):
    """The signed distance network; the defaults are the paper's."""

    radius: float = 0.5  # of the sphere it starts as, in halves of the box's longest side

    def __post_init__(self):
        super().__post_init__()
        if not 0 < self.radius < 1:
            raise AvatarError(f"radius: expected between 0 and 1, got {self.radius}.")


class PosedSdf(nn.Module):
    """Distance to the dressed surface in canonical space, negative inside, metres, for a pose.

    The box is shrunk as a whole to [-1, 1], never stretched, so the network's gradient is that of the distance.
    """

    def __init__(self, pose_channels: int, box: Tensor, config: SdfConfig):
        """Builds the network as a sphere in its box ``(2, 3)``, metres; 0 ``pose_channels`` if no pose moves it."""
        super().__init__()
        check_shape("box", box, "2 3")
        self.config, self.pose_channels = config, pose_channels
        self.register_buffer("centre", box.mean(dim=0))
        self.register_buffer("scale", (box[1] - box[0]).max() / 2)
        self.mlp = SkipMlp(3 * (1 + 2 * config.orders) + pose_channels, 1, config)
        self.mlp.start_as_sphere(config.radius)

    def inputs(self, points: Tensor, pose: Tensor) -> Tensor:
        """What the network sees of points ``(B, N, 3)`` with pose features ``(B, N, P)``."""
        dims = check_shape("points", points, "B N 3")
        check_shape("pose", pose, "B N P", P=self.pose_channels, **dims)
        waves = fourier_features((points - self.centre) / self.scale, self.config.orders)
        return torch.cat([waves, pose], dim=-1)

    def forward(self, points: Tensor, pose: Tensor) -> Tensor:
        """Signed distances ``(B, N)``, metres, of points ``(B, N, 3)`` with pose features ``(B, N, P)``."""
        return self.mlp(self.inputs(points, pose)).squeeze(-1) * self.scale


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
