"""CloSET: a clothed avatar as points on a continuous body surface with an explicit garment template (CVPR 2023)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from avatar.canonical.fields import SkinningField, SkinningFieldConfig
from avatar.checks import AvatarError
from avatar.data.outfits import Outfit
from avatar.geometry.surface import interpolate
from avatar.geometry.transforms import transform_directions, transform_points
from avatar.methods.base import CANONICALIZER, TrainedAvatar
from avatar.methods.canonicalizer import canonicalizer_folder, load_canonicalizer
from avatar.methods.points import PointMethod
from avatar.methods.settings import FitConfig, RunConfig
from avatar.nn.decoders import Decoded, DecoderConfig, Normals, PoseFrame, ShapeDecoder, TemplateNetwork
from avatar.nn.encoders import ENCODERS, Encoder, PointNet2Config
from avatar.nn.locality import LocalPoseConfig, LocalPoseEncoder
from avatar.nn.posing import LearnedSkinning
from avatar.records import Batch, Prediction, SurfaceSamples, Template
from avatar.settings import settings_from_dict, settings_to_dict

FULL_GARMENT_ENCODER = {
    "abstraction": ((32, 32, 32), (32, 32, 64), (64, 64, 64), (64, 64, 128), (128, 128, 128), (128, 128, 128)),
    "propagation": ((128, 128), (128, 64), (64, 64), (64, 64), (64, 64), (64, 64)),
}
FREE_RATE = 4.0  # units of a decoder's output that one of a free offset stands for, beside codes learned at one rate


class Skinning(Enum):
    """Source of the skinning that poses the dressed surface from the canonical pose to a frame's."""

    body = "body"  # CloSET: the transform of the skin an offset starts from
    learned = "learned"  # SCANimate: a canonicalizer's field, evaluated at the offset point itself


class PoseLocality(Enum):
    """What a point's wrinkles may depend on of the pose."""

    whole = "global"  # CloSET: PointNet++ over the posed body, whose coarse levels see all of it
    kinematic = "kinematic"  # SCANimate: the joints near the point in the kinematic tree


@dataclass
class ClosetConfig:
    """CloSET's switches and sizes; the defaults are the paper's method at full size."""

    pose_encoder: PointNet2Config = field(default_factory=PointNet2Config)
    garment_encoder: PointNet2Config = field(default_factory=lambda: PointNet2Config(**FULL_GARMENT_ENCODER))
    garment_decoder: DecoderConfig = field(default_factory=DecoderConfig)
    pose_decoder: DecoderConfig = field(default_factory=DecoderConfig)
    code_channels: int = 64  # width of the learned garment code on each template vertex
    code_std: float = 0.01  # standard deviation of a fresh garment code
    code_skip: bool = False  # the decoders see the garment code itself beside its features (ours)
    free_offsets: bool = False  # an offset of each vertex, learned beside the code, is added to the template's (ours)
    offset_scale: float = 0.02  # metres one unit of a decoder's output stands for (POP)
    template: bool = True  # explicit template decomposition (CloSET 3.2); False is the CSF ablation
    pose: bool = True  # the pose branch; False is the `static` floor: a garment template skinned by the body
    pose_noise: float = 0.0  # metres; noise on the pose encoder's input in training
    relative: bool = True  # the pose encoder's first abstraction sees how features differ from a group's centre as well
    rest_vertices: bool = True  # the pose encoder sees the template's vertices as features beside the posed ones
    pose_frame: PoseFrame = PoseFrame.root  # axes of what the pose encoder sees; heading is ours
    pose_locality: PoseLocality = PoseLocality.whole
    local_encoder: LocalPoseConfig = field(default_factory=LocalPoseConfig)  # instead of pose_encoder when kinematic
    skinning: Skinning = Skinning.body
    train_field: bool = False  # whether training moves the canonicalizer's field, too
    encoder: Encoder = Encoder.pointnet2  # of both branches; conf/encoder/ has channels for each kind
    normals: Normals = Normals.body  # what decoded normals start from; free as in the paper

    def __post_init__(self):
        if not (self.template or self.pose):
            raise AvatarError("template, pose: expected at least one branch, got neither.")
        if self.free_offsets and not self.template:
            raise AvatarError("free_offsets: they are part of the explicit template; set template=true.")
        if self.pose_noise and self.pose_locality is PoseLocality.kinematic:
            raise AvatarError("pose_noise: it is for the global pose encoder; set it to 0 with kinematic locality.")
        if self.train_field and self.skinning is Skinning.body:
            raise AvatarError("train_field: there is a field to train with skinning=learned only.")
        if self.code_channels < 1 or self.code_std < 0 or self.offset_scale <= 0 or self.pose_noise < 0:
            expected = "code_channels, offset_scale: expected positive values, code_std, pose_noise: not negative ones"
            got = f"{self.code_channels}, {self.offset_scale}, {self.code_std}, {self.pose_noise}"
            raise AvatarError(f"{expected}, got {got}.")


class ClosetAvatar(TemplateNetwork):
    """The CloSET network: garment codes on the template's vertices and the pose, both encoded on the surface.

    With learned skinning ``x = T(w(c)) c``, c = p + r in the canonical pose.
    """

    def __init__(self, template: Template, outfits: int, config: ClosetConfig):
        """Builds the network on a body template for a number of outfits."""
        super().__init__(template, config)
        self.skinning: LearnedSkinning | None = None
        codes = torch.randn(outfits, len(template.vertices), config.code_channels) * config.code_std
        if config.free_offsets:
            codes = torch.cat([codes, torch.zeros_like(codes[..., :3])], dim=-1)
        self.codes = nn.Parameter(codes)
        encoder = ENCODERS[config.encoder]
        self.garment_encoder = encoder(template, config.code_channels, config.garment_encoder)
        channels = self.garment_encoder.out_channels + 3 + (config.code_channels if config.code_skip else 0)
        if config.template:
            self.garment_decoder = ShapeDecoder(channels, config.garment_decoder)
        if config.pose:
            if config.pose_locality is PoseLocality.kinematic:
                self.pose_encoder = LocalPoseEncoder(template, config.local_encoder)
            else:
                channels_in = 6 if config.rest_vertices else 3
                self.pose_encoder = encoder(template, channels_in, config.pose_encoder, config.relative)
            self.pose_decoder = ShapeDecoder(channels + self.pose_encoder.out_channels, config.pose_decoder)

    def skin_with(self, skinning: LearnedSkinning) -> None:
        """Gives a model with ``skinning=learned`` its outfits' fields; they are part of its state from then on.

        Raises `AvatarError` for a model skinned by the body, or fields of another number of outfits.
        """
        if self.config.skinning is not Skinning.learned:
            raise AvatarError("skinning: this model is skinned by the body (skinning=body) and takes no fields.")
        count = len(skinning.fields)
        if count != len(self.codes):
            raise AvatarError(f"fields: expected one for each of {len(self.codes)} outfits, got {count}.")
        self.skinning = skinning

    def garment_features(self, codes: Tensor, samples: SurfaceSamples) -> Tensor:
        """Garment features of each sample: ``(O, V, C)`` codes to ``(O, N, C')``."""
        codes = codes[..., : self.config.code_channels]
        features = self.garment_encoder(codes)
        return interpolate(torch.cat([features, codes], dim=-1) if self.config.code_skip else features, samples)

    def decode_garment(self, codes: Tensor, garment: Tensor, places: Tensor, samples: SurfaceSamples) -> Decoded:
        """As `TemplateNetwork.decode_garment`, with the free offsets added where there are some."""
        decoded = super().decode_garment(codes, garment, places, samples)
        if not self.config.free_offsets:
            return decoded
        free = interpolate(codes[..., self.config.code_channels :], samples) * FREE_RATE
        return Decoded(decoded.offsets + free, decoded.normals)

    def pose_features(self, batch: Batch, samples: SurfaceSamples) -> Tensor:
        """Features ``(B, N, C)`` of each sample, of its frame's whole pose or of the joints near it."""
        if self.config.pose_locality is PoseLocality.kinematic:
            return self.pose_encoder(batch.joint_transforms, samples)
        pose_vertices = self.pose_input(batch)
        if self.training and self.config.pose_noise:
            pose_vertices = pose_vertices + torch.randn_like(pose_vertices) * self.config.pose_noise
        if self.config.rest_vertices:
            pose_vertices = torch.cat([pose_vertices, self.vertices.expand_as(pose_vertices)], dim=-1)
        return interpolate(self.pose_encoder(pose_vertices), samples)

    def pose_points(self, local: Decoded, batch: Batch, samples: SurfaceSamples) -> Prediction:
        """As `TemplateNetwork.pose_points`, with learned skinning by the fields of the batch's outfits.

        Raises `AvatarError` with learned skinning, before `skin_with` gave the model its fields.
        """
        if self.config.skinning is Skinning.body or batch.canonical:
            return super().pose_points(local, batch, samples)
        if self.skinning is None:
            raise AvatarError("skinning: expected the fields of a canonicalizer (skin_with) before the first use.")
        with torch.autocast(local.offsets.device.type, enabled=False):
            canonical = self.skinning.skin(batch.outfit_ids, samples) + local.offsets
            transforms = self.skinning(canonical, batch.joint_transforms, batch.outfit_ids)
            normals = normalize(transform_directions(transforms, local.normals), dim=-1)
            return Prediction(transform_points(transforms, canonical), normals, local.offsets)


class Closet(PointMethod):
    """CloSET and its variants; ``skinning=learned`` takes the fields of the outfits' canonicalizers."""

    name = "closet"
    Settings = ClosetConfig
    network = ClosetAvatar
    static: ClassVar[Mapping[str, Any]] = {"pose": False}

    def needs(self, run: RunConfig, settings: ClosetConfig) -> frozenset[str]:
        learned = {CANONICALIZER} if settings.skinning is Skinning.learned else set()
        return super().needs(run, settings) | learned

    def build(self, run: RunConfig, settings: ClosetConfig, template: Template, outfits: list[Outfit]) -> ClosetAvatar:
        model = super().build(run, settings, template, outfits)
        if settings.skinning is Skinning.learned:
            model.skin_with(learned_skinning(run.runs_root, outfits, run.canonical, settings.train_field))
        return model

    def describe(self, model: ClosetAvatar) -> dict[str, Any]:
        if model.skinning is None:
            return {}
        return {"fields": [settings_to_dict(skin.config) for skin in model.skinning.fields]}

    def rebuild(self, settings: Any, template: Template, outfits: int, facts: dict, weights: dict) -> ClosetAvatar:
        encoder = facts["config"]["method"]["settings"].get("garment_encoder", {})
        if "spread" not in encoder.get("hierarchy", {}):  # groups are no part of the weights
            problem = "expected in the settings of trained weights, got none: they are of an earlier version"
            raise AvatarError(f"garment_encoder.hierarchy.spread: {problem}. Hint: train the run again.")
        model = super().rebuild(settings, template, outfits, facts, weights)
        if settings.skinning is Skinning.learned:
            box = torch.tensor([[-1.0], [1.0]]).expand(2, 3)  # the fields' sizes alone matter: their state is loaded
            configs = [settings_from_dict(SkinningFieldConfig, values, "fields.") for values in facts["fields"]]
            fields = [SkinningField(len(template.parents), config, box) for config in configs]
            model.skin_with(LearnedSkinning(fields, [template] * len(fields)))
        return model

    def fit_code(self, avatar: TrainedAvatar, batch: Batch, options: FitConfig) -> Tensor:
        """As `PointMethod.fit_code`. Raises `AvatarError` with learned skinning, whose fields are the outfits' own."""
        if avatar.settings.skinning is Skinning.learned:
            hint = "canonicalize and train the new one, or fit a run with skinning=body."
            raise AvatarError(f"run: learned skinning belongs to the outfits it was trained on. Hint: {hint}")
        return super().fit_code(avatar, batch, options)


def learned_skinning(runs_root: Path, outfits: list[Outfit], name: str, trainable: bool) -> LearnedSkinning:
    """Forward fields of the outfits' canonicalizers, ready to pose an avatar.

    Raises `DataError` when a canonicalizer is not there, or learned no field (weights=nearest, knn).
    """
    folders = [canonicalizer_folder(runs_root, outfit, name) for outfit in outfits]
    fields = [load_canonicalizer(folder, "cpu").forward_field for folder in folders]
    return LearnedSkinning(fields, [outfit.template for outfit in outfits], trainable)
