"""The U-Net of POP and SCALE: from an image of surface positions to a feature image of the same size."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from avatar.checks import AvatarError, check_range, check_shape
from avatar.nn.layers import WideConv2d

SMOOTH_LEVELS = 3  # the last ones upsample and convolve, for transposed convolutions leave checkerboards
WIDEST = 8  # times the first level's channels


@dataclass
class UNetConfig:
    """Sizes of a U-Net; the defaults are POP's pose encoder, 10,348,192 parameters."""

    levels: int = 7  # halvings of the image
    width: int = 32  # channels after the first halving; doubled by each, up to eight times
    out_channels: int = 64
    affine: bool = False  # whether normalisations learn a scale and a shift

    def __post_init__(self):
        check_range(self, "levels", low=SMOOTH_LEVELS)
        check_range(self, "width", "out_channels", low=1)

    def check_map_size(self, *sizes: int, name: str = "map_size") -> None:
        """Refuses images whose pixels a side cannot be halved at every level, with an `AvatarError` for ``name``."""
        parts = 2**self.levels
        if min(sizes) < 1 or any(size % parts for size in sizes):
            needed = f"expected a multiple of {parts}, as the {self.levels} levels of pose_encoder.levels need"
            raise AvatarError(f"{name}: {needed}, got {' x '.join(map(str, sizes))}.")


class Doubling(nn.Module):
    """Bilinear interpolation of images, ``(..., H, W)`` to ``(..., 2 H, 2 W)`` (``align_corners=False``).

    Two matrix products: unlike torch's own, their backward pass is repeatable on CUDA.
    """

    def forward(self, image: Tensor) -> Tensor:
        rows, columns = (self.weights(size, image) for size in image.shape[-2:])
        return rows @ image @ columns.T

    @staticmethod
    def weights(size: int, like: Tensor) -> Tensor:
        """Weights ``(2 size, size)`` between the centres of pixels, constant beyond the outermost."""
        centres = torch.arange(size, device=like.device)
        places = (torch.arange(2 * size, device=like.device) / 2 - 0.25).clamp(0, size - 1)
        return (1 - (places[:, None] - centres).abs()).clamp(min=0).to(like.dtype)


class UNet(nn.Module):
    """Strided convolutions down, the way back up with every level's image joined in (pix2pix, as POP sizes it)."""

    def __init__(self, channels: int, config: UNetConfig):
        """Builds the network for images of ``channels`` channels."""
        super().__init__()
        self.channels, self.config = channels, config
        widths = [config.width * min(2**level, WIDEST) for level in range(config.levels)]
        self.downs, self.ups = nn.ModuleList(), nn.ModuleList()
        for level, (fan_in, fan_out) in enumerate(itertools.pairwise([channels, *widths])):
            layers = [nn.LeakyReLU(0.2)] if level else []
            convolution = WideConv2d if level < 2 else nn.Conv2d  # positions until the first normalisation
            layers.append(convolution(fan_in, fan_out, 4, stride=2, padding=1, bias=False))
            if 0 < level < config.levels - 1:
                layers.append(nn.BatchNorm2d(fan_out, affine=config.affine))
            self.downs.append(nn.Sequential(*layers))
        fan_in = widths.pop()
        for level, fan_out in enumerate([*reversed(widths), config.out_channels]):
            last = level == config.levels - 1
            norm = [] if last else [nn.BatchNorm2d(fan_out, affine=config.affine)]
            if level < config.levels - SMOOTH_LEVELS:
                enlarge = [nn.ConvTranspose2d(fan_in, fan_out, 4, stride=2, padding=1, bias=False)]
            else:
                enlarge = [Doubling(), nn.Conv2d(fan_in, fan_out, 3, padding=1)]
            self.ups.append(nn.Sequential(nn.ReLU(), *enlarge, *norm))
            fan_in = 2 * fan_out

    def forward(self, image: Tensor) -> Tensor:
        """``(B, C, H, W)`` to ``(B, C', H, W)``; raises `AvatarError` unless both are multiples of ``2 ** levels``."""
        dims = check_shape("image", image, "B C H W", C=self.channels)
        self.config.check_map_size(dims["H"], dims["W"], name="image")
        pyramid = []
        for down in self.downs:
            image = down(image)
            pyramid.append(image)
        image = pyramid.pop()
        for up in self.ups:
            image = up(image)
            if pyramid:
                image = torch.cat([image, pyramid.pop()], dim=1)
        return image
