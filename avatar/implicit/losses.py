"""What the signed distance is trained on (SCANimate eqs. 14-17): IGR's terms and two that keep empty space empty."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from avatar.checks import AvatarError, check_shape
from avatar.records import LossTerms

TERMS = ("surface", "normal", "eikonal", "off_surface", "box", "color")


@dataclass
class ImplicitLossConfig:
    """Weights of the implicit avatar's loss terms; the paper's (appendix A.2), distances in metres."""

    surface: float = 1.0  # |f| on the scan, eq. 15
    normal: float = 1.0  # ||grad f - n|| on the scan, eq. 15
    eikonal: float = 1.0  # (||grad f|| - 1)^2 on the scan and in space, eq. 16
    off_surface: float = 0.1  # exp(-sharpness |f|) in space, eq. 17
    box: float = 1.0  # how far f is below zero on the sides of the box, where nothing is (the paper's code)
    color: float = 1.0  # L1 of colours (appendix A.3); trains the texture field alone
    sharpness: float = 100.0  # alpha of eq. 17, 1/metre

    def __post_init__(self):
        wrong = {key: value for key, value in vars(self).items() if value < 0}
        if wrong:
            raise AvatarError(f"loss: expected weights of at least 0, got {wrong}.")


@dataclass(frozen=True)
class FieldValues:
    """Distances and their gradients where the losses look: on the scan, in space and on the sides of the box.

    ``surface (B, S)`` and ``surface_gradients (B, S, 3)`` at scan points; ``space_gradients (B, M, 3)`` near the
    scan and in the box; ``empty (B, K)`` in the box; ``rim (B, R)`` on its sides; ``colors (B, S, 3)`` predicted.
    """

    surface: Tensor
    surface_gradients: Tensor
    space_gradients: Tensor
    empty: Tensor
    rim: Tensor
    colors: Tensor | None = None


def implicit_loss(
    values: FieldValues, normals: Tensor, config: ImplicitLossConfig, colors: Tensor | None = None
) -> LossTerms:
    """The objective of the implicit avatar, every part named.

    Args:
        values: the field at the step's points.
        normals: ``(B, S, 3)`` unit normals of the scan.
        config: weights.
        colors: ``(B, S, 3)`` of the scan in [0, 1], where a texture is learned.

    Returns:
        `LossTerms` reduced to means over points and frames.
    """
    dims = check_shape("surface", values.surface, "B S")
    check_shape("normals", normals, "B S 3", **dims)
    gradients = torch.cat([values.surface_gradients, values.space_gradients], dim=1)
    raw = {
        "surface": values.surface.abs().mean(),
        "normal": (values.surface_gradients - normals).norm(dim=-1).mean(),
        "eikonal": (gradients.norm(dim=-1) - 1).square().mean(),
        "off_surface": torch.exp(-config.sharpness * values.empty.abs()).mean(),
        "box": (-values.rim).clamp(min=0).mean(),
    }
    if values.colors is not None and colors is not None:
        check_shape("colors", colors, "B S 3", **dims)
        raw["color"] = (values.colors - colors).abs().mean()
    weights = {name: getattr(config, name) for name in raw}
    return LossTerms(raw, {name: value * weights[name] for name, value in raw.items() if weights[name]})
