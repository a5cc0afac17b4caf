"""SCANimate's networks: an MLP on Fourier features, the pose-aware signed distance (eq. 18) and the texture (A.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

from avatar.checks import AvatarError, check_shape
from avatar.geometry.precision import full_precision


@dataclass
class MlpConfig:
    """Size of a network on points; the defaults are IGR's as SCANimate uses it (appendix A.1)."""

    widths: tuple[int, ...] = (512, 512, 512, 343, 512, 512)  # hidden layers
    skip: int = 4  # the hidden layer, counted from 0, that gets the network's input again
    orders: int = 8  # Fourier features sin, cos(2^k x) for k below this
    beta: float = 100.0  # sharpness of the softplus

    def __post_init__(self):
        if not self.widths or min(self.widths) < 1 or not 0 < self.skip < len(self.widths):
            raise AvatarError(
                f"widths, skip: expected positive widths and a skip in (0, {len(self.widths)}), "
                f"got {self.widths} and {self.skip}."
            )
        if not 0 <= self.orders <= 16 or self.beta <= 0:
            raise AvatarError(f"orders: expected 0 to 16, got {self.orders}; beta: above 0, got {self.beta}.")


class SkipMlp(nn.Module):
    """Softplus layers with weight norm; one of them gets the input again, scaled so that its variance stays.

    Always in full precision: what goes in are positions, what comes out is a distance to half a millimetre.
    """

    def __init__(self, inputs: int, outputs: int, config: MlpConfig):
        """Builds the network: ``inputs`` channels to ``outputs`` channels."""
        super().__init__()
        self.skip, self.softplus = config.skip, nn.Softplus(beta=config.beta)
        incoming, layers = inputs, []
        for place, width in enumerate(config.widths):
            layers.append(nn.Linear(incoming + (inputs if place == config.skip else 0), width))
            incoming = width
        self.layers = nn.ModuleList(weight_norm(layer) for layer in layers)
        self.head = weight_norm(nn.Linear(incoming, outputs))
        self.channels = incoming

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

        The geometric initialisation of IGR (SAL, Atzmon and Lipman 2020, theorem 1): every hidden layer keeps
        lengths in the mean, the head averages. Columns of all other inputs start at zero, so waves and pose add
        nothing at first; they learn all the same.
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


def fourier_features(points: Tensor, orders: int) -> Tensor:
    """``(..., 3)`` to ``(..., 3 (1 + 2 orders))``: the points, then sin and cos of 2^k of them (NeRF, without pi)."""
    waves = [wave(2**order * points) for order in range(orders) for wave in (torch.sin, torch.cos)]
    return torch.cat([points, *waves], dim=-1)


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

    Inside, the box is centred and shrunk as a whole to [-1, 1], never stretched, so the network's gradient is that
    of the distance in metres.
    """

    def __init__(self, pose_channels: int, box: Tensor, config: SdfConfig):
        """Builds the network as a sphere in its box.

        Args:
            pose_channels: width of the pose features; 0 for a surface that no pose moves.
            box: ``(2, 3)`` lowest and highest corner of the space it is about, metres.
            config: size of the network.
        """
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

    def features(self, points: Tensor, pose: Tensor) -> Tensor:
        """Features of the last hidden layer, which the texture field sees: ``(B, N, C)``."""
        return self.mlp.features(self.inputs(points, pose))

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
