"""Point decoders: from features and a position to a local offset and normal."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from enum import Enum

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, normalize

from avatar.checks import AvatarError
from avatar.geometry.surface import interpolate
from avatar.nn.pointnet2 import PointNorm
from avatar.nn.wide import WideLinear, wide_linear
from avatar.records import SurfaceSamples


@dataclass
class DecoderConfig:
    """Sizes of a point decoder; defaults are POP's shape decoder."""

    width: int = 256
    trunk: int = 4  # layers before the input is joined again
    branch: int = 2  # hidden layers of the offset branch and of the normal branch, after the joining layer

    def __post_init__(self):
        if self.width < 1 or self.trunk < 1 or self.branch < 0:
            raise AvatarError(f"width, trunk, branch: expected positive sizes, got {vars(self)}.")


@dataclass(frozen=True)
class Decoded:
    """Per point, in the body's local frame: ``offsets (B, N, 3)`` and unnormalised ``normals (B, N, 3)``."""

    offsets: Tensor
    normals: Tensor

    def __add__(self, other: Decoded) -> Decoded:
        return Decoded(self.offsets + other.offsets, self.normals + other.normals)


class Normals(Enum):
    """What decoded normals start from; one option of all methods, so that none has a head start over another."""

    body = "body"  # the body's own normals, which the decoders correct
    free = "free"  # nothing, as in the papers of POP, SCALE and CloSET


def bare_body(skin_normals: Tensor, samples: SurfaceSamples, normals: Normals) -> Decoded:
    """Zero offsets and the normals that decoders correct, ``(1, N, 3)``: the body's, or none.

    Args:
        skin_normals: ``(V, 3)`` unit normals of the template's vertices.
        samples: N points on the template.
        normals: what decoded normals start from.
    """
    start = interpolate(skin_normals, samples)[None]
    zeros = torch.zeros_like(start)
    return Decoded(zeros, start if normals is Normals.body else zeros)


class TemplateNetwork(nn.Module):
    """Base of networks that may have an explicit garment template (CloSET 3.2), decoded without the pose.

    Subclasses have ``config`` (``template``, ``normals``, ``offset_scale``), ``codes (O, ...)``, the body's
    ``vertices`` and ``skin_normals (V, 3)``, and `decode_garment`.
    """

    def decode_garment(self, codes: Tensor, samples: SurfaceSamples) -> Decoded:
        """The garment decoder's offsets and normals ``(O, N, 3)`` for garment codes."""
        raise NotImplementedError

    @torch.no_grad()
    def garment_template(self, outfit: int, samples: SurfaceSamples) -> Decoded:
        """The explicit garment template of one outfit in canonical space: points and unit normals ``(1, N, 3)``.

        Raises:
            AvatarError: when the model has no explicit template.
        """
        if not self.config.template:
            raise AvatarError("template: this model was built without an explicit garment template (template=false).")
        decoded = self.decode_garment(self.codes[outfit : outfit + 1], samples)
        dressed = bare_body(self.skin_normals, samples, self.config.normals) + decoded
        points = interpolate(self.vertices, samples) + dressed.offsets * self.config.offset_scale
        return Decoded(points, normalize(dressed.normals, dim=-1))


def softplus_mlp(widths: tuple[int, ...]) -> nn.Sequential:
    """Linear, normalisation, softplus for each consecutive pair of widths."""
    layers = []
    for fan_in, fan_out in itertools.pairwise(widths):
        layers += [nn.Linear(fan_in, fan_out), PointNorm(fan_out), nn.Softplus()]
    return nn.Sequential(*layers)


class ShapeDecoder(nn.Module):
    """The decoder POP, SCALE and CloSET share: a trunk, the input joined again, then an offset and a normal branch."""

    def __init__(self, channels: int, config: DecoderConfig):
        """Builds the decoder for ``channels`` features and coordinates of a place together."""
        super().__init__()
        width = config.width
        self.trunk = softplus_mlp((channels,) + (width,) * config.trunk)
        self.join = softplus_mlp((channels + width, width))
        hidden = (width,) * (config.branch + 1)
        self.offset_branch = nn.Sequential(*softplus_mlp(hidden), WideLinear(width, 3))
        self.normal_branch = nn.Sequential(*softplus_mlp(hidden), WideLinear(width, 3))

    def forward(self, features: Tensor, places: Tensor) -> Decoded:
        """``(B, N, C)`` features and ``(N, P)`` places of points to offsets and normals ``(B, N, 3)``.

        Under autocast places, offsets and normals are float32 all the same.
        """
        hidden = lift(self.trunk, features, places)
        joined = lift(self.join, features, places, hidden)
        return Decoded(self.offset_branch(joined), self.normal_branch(joined))


def lift(layers: nn.Sequential, features: Tensor, places: Tensor, *others: Tensor) -> Tensor:
    """Layers on the joined channels of features, places and others, the places in float32: ``(B, N, C)``."""
    first, *rest = layers
    parts = (features, places, *others)
    mixing, placing, *adding = first.weight.split([part.shape[-1] for part in parts], dim=1)
    lifted = linear(features, mixing) + wide_linear(places, placing, first.bias)
    for other, weight in zip(others, adding):
        lifted = lifted + linear(other, weight)
    for layer in rest:
        lifted = layer(lifted)
    return lifted
