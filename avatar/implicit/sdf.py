"""A signed distance that knows the pose (SCANimate eq. 18): points of canonical space and pose features to metres."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from avatar.checks import AvatarError, check_shape
from avatar.implicit.networks import MlpConfig, SkipMlp, fourier_features


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
