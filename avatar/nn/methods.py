"""The point-avatar methods by name: each is a settings class and the network it configures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import nn

from avatar.checks import AvatarError
from avatar.nn.closet import ClosetAvatar, ClosetConfig
from avatar.records import Template


@dataclass(frozen=True)
class Method:
    """A network class, built as ``network(template, outfits, settings)``, and its settings class."""

    settings: type
    network: type[nn.Module]


METHODS = {"closet": Method(ClosetConfig, ClosetAvatar)}


def find_method(name: str) -> Method:
    """The method of a name.

    Raises:
        AvatarError: listing the methods there are.
    """
    if name not in METHODS:
        raise AvatarError(f"method: expected one of {', '.join(METHODS)}, got {name!r}.")
    return METHODS[name]


def build_avatar(name: str, template: Template, outfits: int, settings: Any) -> nn.Module:
    """A fresh network of a method; ``settings`` must be of the method's own class."""
    method = find_method(name)
    if not isinstance(settings, method.settings):
        raise AvatarError(f"settings: expected {method.settings.__name__}, got {type(settings).__name__}.")
    return method.network(template, outfits, settings)
