"""The point-avatar methods by name: each is a settings class and the network it configures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from avatar.checks import AvatarError, unknown_name
from avatar.geometry.surface import sample_surface
from avatar.nn.baselines.pop import PopAvatar, PopConfig
from avatar.nn.baselines.scale import ScaleAvatar, ScaleConfig
from avatar.nn.closet import ClosetAvatar, ClosetConfig
from avatar.records import SurfaceSamples, Template


@dataclass(frozen=True)
class Method:
    """A network class, built as ``network(template, outfits, settings)``, and its settings class."""

    settings: type
    network: type[nn.Module]


METHODS = {
    "closet": Method(ClosetConfig, ClosetAvatar),
    "pop": Method(PopConfig, PopAvatar),
    "scale": Method(ScaleConfig, ScaleAvatar),
}


def find_method(name: str) -> Method:
    """The method of a name.

    Raises:
        AvatarError: listing the methods there are.
    """
    if name not in METHODS:
        raise unknown_name("method", name, METHODS)
    return METHODS[name]


def build_avatar(name: str, template: Template, outfits: int, settings: Any) -> nn.Module:
    """A fresh network of a method; ``settings`` must be of the method's own class."""
    method = find_method(name)
    if not isinstance(settings, method.settings):
        raise AvatarError(f"settings: expected {method.settings.__name__}, got {type(settings).__name__}.")
    return method.network(template, outfits, settings)


def draw_samples(
    model: nn.Module, vertices: Tensor, faces: Tensor, points: int, generator: torch.Generator
) -> SurfaceSamples:
    """Where on the body a network predicts: spread evenly by area, or at points of its own.

    A network on UV maps has its grid's pixels or patches instead (``template_samples(points)``); their number is then
    close to ``points``, not equal.
    """
    own = getattr(model, "template_samples", None)
    samples = own(points) if own else None
    return sample_surface(vertices, faces, points, generator) if samples is None else samples
