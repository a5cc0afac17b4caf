"""POP (The Power of Points, ICCV 2021): pose and garment features in the UV plane, one decoder for all points."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import torch
from torch import Tensor, nn

from avatar.checks import AvatarError
from avatar.methods.points import PointMethod
from avatar.nn.atlas import Atlas
from avatar.nn.decoders import DecoderConfig, Normals, PoseFrame, ShapeDecoder, TemplateNetwork
from avatar.nn.unet import UNet, UNetConfig
from avatar.records import Batch, SurfaceSamples, Template

PLACE_CHANNELS = 4  # UV coordinates, and patch coordinates that are zero: POP's decoder has kept SCALE's input


class PointSource(Enum):
    """Places on the body where points are predicted."""

    grid = "grid"  # POP: the pixels of a square UV grid, which leaves out small triangles
    surface = "surface"  # CloSET: even by area, as the caller draws them


@dataclass
class PopConfig:
    """POP's switches and sizes; the defaults are the paper's at full size, 11,255,718 parameters beside the codes."""

    pose_encoder: UNetConfig = field(default_factory=UNetConfig)
    pose_decoder: DecoderConfig = field(default_factory=DecoderConfig)
    garment_decoder: DecoderConfig = field(default_factory=DecoderConfig)  # with template only
    map_size: int = 128  # pixels a side of position and feature maps
    code_channels: int = 64  # channels of the learned garment map of each outfit
    code_std: float = 0.01  # standard deviation of a fresh garment map
    smoothing: int = 3  # 5 x 5 convolutions over the garment map, with nothing between them
    offset_scale: float = 0.02  # metres one unit of a decoder's output stands for
    template: bool = False  # CloSET's explicit template decomposition on POP's features (its table 5, POP + ETD)
    points: PointSource = PointSource.grid
    pose_frame: PoseFrame = PoseFrame.root  # axes of what the pose encoder sees; heading is ours
    normals: Normals = Normals.body  # what decoded normals start from; free as in the paper

    def __post_init__(self):
        if min(self.map_size, self.code_channels) < 1 or self.smoothing < 0:
            got = f"{self.map_size}, {self.code_channels}, {self.smoothing}"
            raise AvatarError(f"map_size, code_channels: expected at least 1, smoothing: at least 0, got {got}.")
        self.pose_encoder.check_map_size(self.map_size)
        if self.code_std < 0 or self.offset_scale <= 0:
            got = f"{self.code_std}, {self.offset_scale}"
            raise AvatarError(f"code_std, offset_scale: expected at least 0 and above 0, got {got}.")


class PopAvatar(TemplateNetwork):
    """The POP network: a learned feature map of the garment beside a U-Net's over the posed body's position map.

    Both maps are looked up at a point's place in the atlas, so features jump where the atlas is cut, however near two
    points are on the body.
    """

    scale_first = True

    def __init__(self, template: Template, outfits: int, config: PopConfig):
        """Builds the network on a body template with UV coordinates for a number of outfits."""
        super().__init__(template, config)
        self.atlas = Atlas(template, config.map_size)
        channels, size = config.code_channels, config.map_size
        self.codes = nn.Parameter(torch.randn(outfits, channels, size, size) * config.code_std)
        convolutions = [nn.Conv2d(channels, channels, 5, padding=2, bias=False) for _ in range(config.smoothing)]
        self.garment_encoder = nn.Sequential(*convolutions)
        self.pose_encoder = UNet(3, config.pose_encoder)
        channels += PLACE_CHANNELS
        if config.template:
            self.garment_decoder = ShapeDecoder(channels, config.garment_decoder)
        self.pose_decoder = ShapeDecoder(channels + config.pose_encoder.out_channels, config.pose_decoder)

    def template_samples(self, points: int) -> SurfaceSamples | None:
        """The points this network predicts when about ``points`` are asked for; None leaves them to the caller."""
        return self.atlas.pixel_points(points) if self.config.points is PointSource.grid else None

    def garment_features(self, codes: Tensor, samples: SurfaceSamples) -> Tensor:
        """Garment features of each point: ``(O, C, S, S)`` codes to ``(O, N, C)``."""
        return self.atlas.look_up_at(samples)(self.garment_encoder(codes))

    def pose_features(self, batch: Batch, samples: SurfaceSamples) -> Tensor:
        """Features ``(B, N, C)`` of each sample in the map of its frame's pose."""
        return self.atlas.look_up_at(samples)(self.pose_encoder(self.atlas.position_map(self.pose_input(batch))))

    def places(self, samples: SurfaceSamples) -> Tensor:
        """UV and patch coordinates of each point, ``(N, 4)``."""
        uv = self.atlas.place(samples)
        return torch.cat([uv, torch.zeros_like(uv)], dim=-1)


class Pop(PointMethod):
    """POP, with CloSET's explicit template decomposition as a variant."""

    name = "pop"
    Settings = PopConfig
    network = PopAvatar
