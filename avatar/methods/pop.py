"""POP (The Power of Points, ICCV 2021): pose and garment features in the UV plane, one decoder for all points."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from avatar.checks import AvatarError, check_shape
from avatar.geometry.sparse import pick
from avatar.geometry.surface import interpolate, vertex_normals
from avatar.geometry.transforms import transform_directions
from avatar.methods.points import PointMethod
from avatar.nn.atlas import Atlas, uv_and_patch
from avatar.nn.decoders import Decoded, DecoderConfig, Normals, ShapeDecoder, TemplateNetwork, bare_body
from avatar.nn.unet import UNet, UNetConfig
from avatar.records import Batch, Prediction, SurfaceSamples, Template

PLACE_CHANNELS = 4  # UV coordinates, and patch coordinates that are zero: POP's decoder has kept SCALE's input


class PointSource(Enum):
    """Where on the body points are predicted."""

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
    normals: Normals = Normals.body  # what decoded normals start from; free as in the paper

    def __post_init__(self):
        if min(self.map_size, self.code_channels) < 1 or self.smoothing < 0:
            raise AvatarError(
                "map_size, code_channels: expected at least 1, smoothing: at least 0, "
                f"got {self.map_size}, {self.code_channels}, {self.smoothing}."
            )
        if self.map_size % 2**self.pose_encoder.levels:
            raise AvatarError(
                f"map_size: expected a multiple of {2**self.pose_encoder.levels}, as pose_encoder.levels="
                f"{self.pose_encoder.levels} halvings need, got {self.map_size}."
            )
        if self.code_std < 0 or self.offset_scale <= 0:
            raise AvatarError(
                f"code_std, offset_scale: expected at least 0 and above 0, got {self.code_std}, {self.offset_scale}."
            )


class PopAvatar(TemplateNetwork):
    """The POP network, for one outfit or many: each is a learned feature map beside that of the pose.

    The pose map is a U-Net over the posed body's position map. Both maps are looked up at a point's place in the
    atlas, so features jump where the atlas is cut, however near two points are on the body.
    """

    outfit_modules = ("garment_encoder", "garment_decoder")  # see `nn.shared_norm.synchronize_norms`

    def __init__(self, template: Template, outfits: int, config: PopConfig):
        """Builds the network on a body template with UV coordinates for a number of outfits."""
        super().__init__()
        self.config = config
        self.atlas = Atlas(template, config.map_size)
        self.register_buffer("vertices", template.vertices.clone(), persistent=False)
        self.register_buffer("skin_normals", vertex_normals(template.vertices, template.faces), persistent=False)
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

    def places(self, samples: SurfaceSamples) -> Tensor:
        """UV and patch coordinates of each point, ``(N, 4)``."""
        uv = self.atlas.place(samples)
        return uv_and_patch(uv, torch.zeros_like(uv))

    def forward(self, batch: Batch, samples: SurfaceSamples, wrinkles: bool = True) -> Prediction:
        """Predicts the dressed surface of each frame at template points.

        Args:
            batch: posed bodies with their outfits (its scans are not looked at).
            samples: N points on the template; any on the body, `template_samples` gives the paper's.
            wrinkles: False leaves the pose out, for a network with an explicit template.

        Returns:
            `Prediction` with ``x = T r + p``; its parts are named with an explicit template alone.
        """
        check_shape("pose_vertices", batch.pose_vertices, "B V 3", V=len(self.vertices))
        if not (wrinkles or self.config.template):
            raise AvatarError("wrinkles: a model without explicit garment template has nothing else to predict.")
        outfits = batch.outfits
        row = torch.searchsorted(outfits, batch.outfit_ids)
        codes = pick(self.codes, outfits)
        garment, places = self.garment_features(codes, samples), self.places(samples)
        parts = []
        if self.config.template:
            decoded = self.garment_decoder(garment, places)
            parts.append(Decoded(pick(decoded.offsets, row), pick(decoded.normals, row)))
        if wrinkles:
            image = self.pose_encoder(self.atlas.position_map(batch.pose_vertices))
            pose = self.atlas.look_up_at(samples)(image)
            parts.append(self.pose_decoder(torch.cat([pose, pick(garment, row)], dim=-1), places))
        parts = [Decoded(part.offsets.float() * self.config.offset_scale, part.normals.float()) for part in parts]
        local = sum(parts, bare_body(self.skin_normals.float(), samples, self.config.normals))
        with torch.autocast(local.offsets.device.type, enabled=False):  # half precision is millimetres here
            linear = interpolate(batch.vertex_transforms[..., :3, :3].flatten(-2), samples).unflatten(-1, (3, 3))
            points = interpolate(batch.vertices, samples) + transform_directions(linear, local.offsets)
            normals = normalize(transform_directions(linear, local.normals), dim=-1)
        return Prediction(
            points=points,
            normals=normals,
            offsets=local.offsets,
            garment_offsets=parts[0].offsets if self.config.template else None,
            wrinkle_offsets=parts[-1].offsets if wrinkles and self.config.template else None,
            wrinkle_normals=parts[-1].normals if wrinkles and self.config.template else None,
            codes=codes,
        )

    def decode_garment(self, codes: Tensor, samples: SurfaceSamples) -> Decoded:
        """What the garment decoder gives for codes ``(O, ...)``: offsets and normals ``(O, N, 3)``."""
        return self.garment_decoder(self.garment_features(codes, samples), self.places(samples))


class Pop(PointMethod):
    """POP, with CloSET's explicit template decomposition as a variant."""

    name = "pop"
    Settings = PopConfig
    network = PopAvatar
