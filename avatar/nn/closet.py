"""CloSET: a clothed avatar as points on a continuous body surface with an explicit garment template (CVPR 2023)."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from avatar.checks import AvatarError, check_shape
from avatar.geometry.surface import interpolate, vertex_normals
from avatar.nn.decoders import Decoded, DecoderConfig, ShapeDecoder
from avatar.nn.pointnet2 import PointNet2, PointNet2Config
from avatar.records import Batch, Prediction, SurfaceSamples, Template

FULL_GARMENT_ENCODER = {
    "abstraction": (
        (32, 32, 32),
        (32, 32, 64),
        (64, 64, 64),
        (64, 64, 128),
        (128, 128, 128),
        (128, 128, 128),
    ),
    "propagation": ((128, 128), (128, 64), (64, 64), (64, 64), (64, 64), (64, 64)),
}


@dataclass
class ClosetConfig:
    """CloSET's switches and sizes; the defaults are the paper's method at full size."""

    pose_encoder: PointNet2Config = field(default_factory=PointNet2Config)
    garment_encoder: PointNet2Config = field(default_factory=lambda: PointNet2Config(**FULL_GARMENT_ENCODER))
    garment_decoder: DecoderConfig = field(default_factory=DecoderConfig)
    pose_decoder: DecoderConfig = field(default_factory=DecoderConfig)
    code_channels: int = 64  # width of the learned garment code on each template vertex
    code_std: float = 0.01  # standard deviation of a fresh garment code
    offset_scale: float = 0.02  # metres one unit of a decoder's output stands for (POP)
    template: bool = True  # explicit template decomposition (CloSET 3.2); False is the CSF ablation
    pose: bool = True  # the pose branch; False is the `static` floor: a garment template skinned by the body
    pose_noise: float = 0.0  # metres; noise on the pose encoder's input in training

    def __post_init__(self):
        if not (self.template or self.pose):
            raise AvatarError("template, pose: expected at least one branch, got neither.")
        if self.code_channels < 1 or self.code_std < 0 or self.offset_scale <= 0 or self.pose_noise < 0:
            raise AvatarError(
                "code_channels, offset_scale: expected positive values, code_std, pose_noise: not negative ones, "
                f"got {self.code_channels}, {self.offset_scale}, {self.code_std}, {self.pose_noise}."
            )


class ClosetAvatar(nn.Module):
    """The CloSET network: garment codes and pose encoded on the surface, decoded into a posed oriented point cloud.

    For one outfit or many; each outfit is a learned code on the template's vertices. The garment branch does not
    see the pose, so it runs once an outfit in the batch, whatever the number of frames.
    """

    def __init__(self, template: Template, outfits: int, config: ClosetConfig):
        """Builds the network on a body template for a number of outfits."""
        super().__init__()
        self.config = config
        self.register_buffer("vertices", template.vertices.clone(), persistent=False)
        self.register_buffer("skin_normals", vertex_normals(template.vertices, template.faces), persistent=False)
        codes = torch.randn(outfits, len(template.vertices), config.code_channels) * config.code_std
        self.codes = nn.Parameter(codes)
        self.garment_encoder = PointNet2(template, config.code_channels, config.garment_encoder)
        channels = self.garment_encoder.out_channels + 3
        if config.template:
            self.garment_decoder = ShapeDecoder(channels, config.garment_decoder)
        if config.pose:
            self.pose_encoder = PointNet2(template, 3, config.pose_encoder)
            self.pose_decoder = ShapeDecoder(channels + self.pose_encoder.out_channels, config.pose_decoder)

    def surface_features(self, codes: Tensor, samples: SurfaceSamples) -> Tensor:
        """Garment features and template position of each sample: ``(O, V, C)`` codes to ``(O, N, C' + 3)``."""
        features = interpolate(self.garment_encoder(codes), samples)
        positions = interpolate(self.vertices, samples).expand(len(codes), -1, -1)
        return torch.cat([features, positions.to(features.dtype)], dim=-1)

    def decode_wrinkles(self, pose_vertices: Tensor, garment: Tensor, samples: SurfaceSamples) -> Decoded:
        """Pose branch: ``(B, V, 3)`` posed body and ``(B, N, C)`` surface features to wrinkle offsets and normals."""
        if self.training and self.config.pose_noise:
            pose_vertices = pose_vertices + torch.randn_like(pose_vertices) * self.config.pose_noise
        pose = interpolate(self.pose_encoder(pose_vertices), samples)
        return self.pose_decoder(torch.cat([pose, garment], dim=-1))

    def skin(self, samples: SurfaceSamples) -> Decoded:
        """The bare body, which both decoders correct: no offset, and the body's own normals ``(1, N, 3)``."""
        normals = interpolate(self.skin_normals, samples)[None]
        return Decoded(torch.zeros_like(normals), normals)

    def forward(self, batch: Batch, samples: SurfaceSamples, wrinkles: bool = True) -> Prediction:
        """Predicts the dressed surface of each frame at the sampled template points.

        Args:
            batch: posed bodies with their outfits (its scans are not looked at).
            samples: N points on the template; any number, the same network serves all.
            wrinkles: False leaves the pose branch out: the garment template alone, skinned by the body.

        Returns:
            `Prediction` with ``x = T r + p`` (CloSET 3.2), r = r^g + r^p in the body's local frame.
        """
        check_shape("pose_vertices", batch.pose_vertices, "B V 3", V=len(self.vertices))
        if not (wrinkles or self.config.template):
            raise AvatarError("wrinkles: a model without explicit garment template has nothing else to predict.")
        outfits, row = batch.outfit_ids.unique(return_inverse=True)
        codes = self.codes[outfits]
        garment = self.surface_features(codes, samples)
        parts = []
        if self.config.template:
            decoded = self.garment_decoder(garment)
            parts.append(Decoded(decoded.offsets[row], decoded.normals[row]))
        if self.config.pose and wrinkles:
            parts.append(self.decode_wrinkles(batch.pose_vertices, garment[row], samples))
        local = sum(parts, self.skin(samples))

        scale = self.config.offset_scale
        offsets = (local.offsets * scale).float()
        linear = interpolate(batch.vertex_transforms[..., :3, :3].flatten(-2), samples).unflatten(-1, (3, 3))
        points = interpolate(batch.vertices, samples) + (linear @ offsets.unsqueeze(-1)).squeeze(-1)
        normals = normalize((linear @ local.normals.float().unsqueeze(-1)).squeeze(-1), dim=-1)
        return Prediction(
            points=points,
            normals=normals,
            offsets=offsets,
            garment_offsets=parts[0].offsets.float() * scale if self.config.template else None,
            wrinkle_offsets=parts[-1].offsets.float() * scale if self.config.pose and wrinkles else None,
            wrinkle_normals=parts[-1].normals.float() if self.config.pose and wrinkles else None,
            codes=codes,
        )

    @torch.no_grad()
    def garment_template(self, outfit: int, samples: SurfaceSamples) -> Decoded:
        """The explicit garment template of one outfit in canonical space: points and unit normals ``(1, N, 3)``.

        Raises:
            AvatarError: when the model has no explicit template.
        """
        if not self.config.template:
            raise AvatarError("template: this model was built without an explicit garment template (template=false).")
        decoded = self.garment_decoder(self.surface_features(self.codes[outfit : outfit + 1], samples))
        dressed = self.skin(samples) + decoded
        points = interpolate(self.vertices, samples) + dressed.offsets * self.config.offset_scale
        return Decoded(points, normalize(dressed.normals, dim=-1))
