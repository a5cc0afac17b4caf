"""The network that geometry and colour share: Fourier features, and a weight-normalised MLP that sees them twice."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

from avatar.checks import AvatarError
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
