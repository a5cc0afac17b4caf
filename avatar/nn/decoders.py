"""Point decoders, and the network with a garment template and pose-dependent wrinkles that CloSET and POP are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, normalize

from avatar.checks import AvatarError, check_shape
from avatar.geometry.sparse import pick
from avatar.geometry.surface import interpolate, interpolate_transforms, vertex_normals
from avatar.geometry.transforms import tilt_rotations, transform_directions
from avatar.nn.layers import WideLinear, point_mlp, wide_linear
from avatar.records import Batch, Prediction, SurfaceSamples, Template


@dataclass
class DecoderConfig:
    """Sizes of a point decoder; defaults are POP's shape decoder."""

    width: int = 256
    trunk: int = 4  # layers before the input is joined again
    branch: int = 2  # hidden layers of the offset branch and of the normal branch, after the joining layer

    def __post_init__(self):
        if self.width < 1 or self.trunk < 1 or self.branch < 0:
            raise AvatarError(f"width, trunk, branch: expected positive sizes, got {vars(self)}.")


class PoseFrame(Enum):
    """Axes in which a pose encoder sees the posed body."""

    root = "root"  # the pelvis's: whether the person stands, leans or lies is not seen
    heading = "heading"  # the pelvis's with its tilt: rotation about the vertical and place alone are removed


class Normals(Enum):
    """What decoded normals start from; one option of all methods, so that none has a head start over another."""

    body = "body"  # the body's own normals, which the decoders correct
    free = "free"  # nothing, as in the papers of POP, SCALE and CloSET


@dataclass(frozen=True)
class Decoded:
    """Per point, in the body's local frame: ``offsets (B, N, 3)`` and unnormalised ``normals (B, N, 3)``."""

    offsets: Tensor
    normals: Tensor

    def __add__(self, other: Decoded) -> Decoded:
        return Decoded(self.offsets + other.offsets, self.normals + other.normals)

    def scaled(self, scale: float) -> Decoded:
        """With offsets in metres of which ``scale`` is one unit; float32."""
        return Decoded(self.offsets.float() * scale, self.normals.float())


class ShapeDecoder(nn.Module):
    """The decoder POP, SCALE and CloSET share: a trunk, the input joined again, then an offset and a normal branch."""

    def __init__(self, channels: int, config: DecoderConfig, normals: bool = True):
        """Builds the decoder for ``channels`` features and coordinates of a place together; decoded normals are zero
        without ``normals``.
        """
        super().__init__()
        width = config.width
        self.trunk = point_mlp((channels,) + (width,) * config.trunk, activation=nn.Softplus)
        self.join = point_mlp((channels + width, width), activation=nn.Softplus)
        hidden = (width,) * (config.branch + 1)
        self.offset_branch = nn.Sequential(*point_mlp(hidden, activation=nn.Softplus), WideLinear(width, 3))
        self.normal_branch: nn.Module | None = None
        if normals:
            self.normal_branch = nn.Sequential(*point_mlp(hidden, activation=nn.Softplus), WideLinear(width, 3))

    def forward(self, features: Tensor, places: Tensor) -> Decoded:
        """``(B, N, C)`` features and ``(N, P)`` places of points to offsets and normals ``(B, N, 3)``.

        Under autocast places, offsets and normals are float32 all the same.
        """
        hidden = apply_joined(self.trunk, features, places)
        joined = apply_joined(self.join, features, places, hidden)
        offsets = self.offset_branch(joined)
        return Decoded(offsets, self.normal_branch(joined) if self.normal_branch else torch.zeros_like(offsets))


def apply_joined(layers: nn.Sequential, features: Tensor, places: Tensor, *others: Tensor) -> Tensor:
    """Layers on the joined channels of features, places and others, the places in float32: ``(B, N, C)``."""
    first, *rest = layers
    mixing, placing, *adding = first.weight.split([part.shape[-1] for part in (features, places, *others)], dim=1)
    hidden = linear(features, mixing) + wide_linear(places, placing, first.bias)
    for other, weight in zip(others, adding):
        hidden = hidden + linear(other, weight)
    for layer in rest:
        hidden = layer(hidden)
    return hidden


class TemplateNetwork(nn.Module):
    """Network of CloSET and POP: garment and pose features of template points, decoded and posed with the body.

    For one outfit or many, each a learned code. The garment branch does not see the pose, so it runs once an outfit in
    the batch, whatever the number of frames. Subclasses build ``codes (O, ...)``, ``garment_encoder``,
    ``garment_decoder`` (with an explicit template, CloSET 3.2) and ``pose_decoder`` (unless without pose), and have
    ``garment_features(codes, samples)`` ``(O, N, C)`` and ``pose_features(batch, samples)`` ``(B, N, C)``.
    """

    outfit_modules = ("garment_encoder", "garment_decoder")  # see `nn.layers.synchronize_norms`
    scale_first = False  # whether offsets are scaled before their parts are added, which rounds otherwise

    def __init__(self, template: Template, config: Any):
        super().__init__()
        self.config = config
        self.pose_decoder: ShapeDecoder | None = None
        self.register_buffer("vertices", template.vertices.clone(), persistent=False)
        self.register_buffer("pelvis", template.joints[0].clone(), persistent=False)
        self.register_buffer("skin_normals", vertex_normals(template.vertices, template.faces), persistent=False)

    def pose_input(self, batch: Batch) -> Tensor:
        """The posed body ``(B, V, 3)`` that the pose encoder sees, in the axes of ``config.pose_frame``."""
        if self.config.pose_frame is PoseFrame.root:
            return batch.pose_vertices
        tilt = tilt_rotations(batch.joint_transforms[:, 0, :3, :3])
        return (batch.pose_vertices - self.pelvis) @ tilt.transpose(-1, -2) + self.pelvis

    def places(self, samples: SurfaceSamples) -> Tensor:
        """Coordinates ``(N, P)`` of each sample that the decoders see: its position on the template."""
        return interpolate(self.vertices, samples)

    def forward(self, batch: Batch, samples: SurfaceSamples, wrinkles: bool = True) -> Prediction:
        """Predicts the dressed surface of each frame at template points.

        Args:
            batch: posed bodies with their outfits (its scans are not looked at).
            samples: N points on the template; any number, the same network serves all.
            wrinkles: False leaves the pose branch out: the garment template alone, posed with the body.

        Returns:
            `Prediction` with ``x = T r + p`` (CloSET 3.2), r = r^g + r^p in the body's local frame; the parts are named
            where there are both.

        Raises:
            AvatarError: for other vertices than the template's, or without wrinkles where there is no template.
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
            decoded = self.decode_garment(codes, garment, places, samples)
            parts.append(Decoded(pick(decoded.offsets, row), pick(decoded.normals, row)))
        if wrinkles and self.pose_decoder:
            pose = self.pose_features(batch, samples)
            parts.append(self.pose_decoder(torch.cat([pose, pick(garment, row)], dim=-1), places))
        start, scale = self.start(batch, samples, wrinkles), self.config.offset_scale
        scaled = [part.scaled(scale) for part in parts]
        local = sum(scaled, start.scaled(scale)) if self.scale_first else sum(parts, start).scaled(scale)
        both = len(parts) == 2  # alone they are the whole, not a part of it
        return replace(
            self.pose_points(local, batch, samples),
            garment_offsets=scaled[0].offsets if self.config.template else None,
            wrinkle_offsets=scaled[-1].offsets if both else None,
            wrinkle_normals=scaled[-1].normals if both else None,
            codes=codes,
        )

    def decode_garment(self, codes: Tensor, garment: Tensor, places: Tensor, samples: SurfaceSamples) -> Decoded:
        """The garment template of each outfit, ``(O, N, 3)``, from codes ``(O, ...)`` and features ``(O, N, C)``."""
        return self.garment_decoder(garment, places)

    def start(self, batch: Batch, samples: SurfaceSamples, wrinkles: bool) -> Decoded:
        """What decoders correct, ``(1, N, 3)`` or ``(B, N, 3)``: the bare body."""
        return self.bare_body(samples)

    def bare_body(self, samples: SurfaceSamples) -> Decoded:
        """Zero offsets and the normals that decoders correct, ``(1, N, 3)``: the body's, or none."""
        normals = interpolate(self.skin_normals, samples)[None]
        zeros = torch.zeros_like(normals)
        return Decoded(zeros, normals if self.config.normals is Normals.body else zeros)

    def pose_points(self, local: Decoded, batch: Batch, samples: SurfaceSamples) -> Prediction:
        """Offsets from the skin, in metres, and normals posed with the batch's bodies: posed points, unit normals.

        In float32 whatever the network runs in: half precision is millimetres here.
        """
        with torch.autocast(local.offsets.device.type, enabled=False):
            transforms = interpolate_transforms(batch.vertex_transforms[..., :3, :3], samples)
            points = interpolate(batch.vertices, samples) + transform_directions(transforms, local.offsets)
            normals = normalize(transform_directions(transforms, local.normals), dim=-1)
        return Prediction(points, normals, local.offsets)

    @torch.no_grad()
    def garment_template(self, outfit: int, samples: SurfaceSamples) -> Prediction:
        """The explicit garment template of one outfit in canonical space, as a prediction of one frame.

        Raises `AvatarError` when the model has no explicit template.
        """
        if not self.config.template:
            raise AvatarError("template: this model was built without an explicit garment template (template=false).")
        codes = self.codes[outfit : outfit + 1]
        decoded = self.decode_garment(codes, self.garment_features(codes, samples), self.places(samples), samples)
        local = (self.bare_body(samples) + decoded).scaled(self.config.offset_scale)
        points = interpolate(self.vertices, samples) + local.offsets
        return Prediction(points, normalize(local.normals, dim=-1), local.offsets)
