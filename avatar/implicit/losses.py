"""The training objective of the signed distance (SCANimate eqs. 14-17, appendix A.2): query points and loss terms."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from avatar.checks import check_range, check_shape
from avatar.implicit.avatar import ImplicitAvatar
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
        check_range(self, *vars(self), low=0)


@dataclass(frozen=True)
class FieldValues:
    """Signed distances and their gradients at a step's query points.

    ``surface (B, S)`` and ``surface_gradients (B, S, 3)`` at scan points; ``space_gradients (B, M, 3)`` near
    the scan and in the box; ``uniform (B, K)`` in the box; ``boundary (B, R)`` on its sides; ``colors (B, S, 3)``.
    """

    surface: Tensor
    surface_gradients: Tensor
    space_gradients: Tensor
    uniform: Tensor
    boundary: Tensor
    colors: Tensor | None = None


def implicit_loss(
    values: FieldValues, normals: Tensor, config: ImplicitLossConfig, colors: Tensor | None = None
) -> LossTerms:
    """The training loss of the implicit avatar (SCANimate eqs. 14-17), means over points and frames, every term named.

    ``normals (B, S, 3)`` are the scan's, unit; ``colors (B, S, 3)`` in [0, 1], where a texture is learned.
    """
    dims = check_shape("surface", values.surface, "B S")
    check_shape("normals", normals, "B S 3", **dims)
    gradients = torch.cat([values.surface_gradients, values.space_gradients], dim=1)
    raw = {
        "surface": values.surface.abs().mean(),
        "normal": (values.surface_gradients - normals).norm(dim=-1).mean(),
        "eikonal": (gradients.norm(dim=-1) - 1).square().mean(),
        "off_surface": torch.exp(-config.sharpness * values.uniform.abs()).mean(),
        "box": (-values.boundary).clamp(min=0).mean(),
    }
    if values.colors is not None and colors is not None:
        check_shape("colors", colors, "B S 3", **dims)
        raw["color"] = (values.colors - colors).abs().mean()
    weights = {name: getattr(config, name) for name in raw}
    return LossTerms(raw, {name: value * weights[name] for name, value in raw.items() if weights[name]})


@dataclass
class QueryConfig:
    """Numbers of query points of a frame and step, beside those on its scan; the paper's (appendix A.2)."""

    near_points: int = 10_000  # half about the scan, half about the body
    near_distance: float = 0.1  # metres, standard deviation of each coordinate
    box_points: int = 2000  # anywhere in the box
    boundary_points: int = 500  # on the sides of the box

    def __post_init__(self):
        check_range(self, "near_points", "box_points", "boundary_points", low=1)
        check_range(self, "near_distance", above=0)


@dataclass(frozen=True)
class QueryPoints:
    """Canonical query points: ``near (B, M, 3)`` scan or body, ``uniform (B, K, 3)``, ``boundary (B, R, 3)``."""

    near: Tensor
    uniform: Tensor
    boundary: Tensor


def sample_queries(
    scan: Tensor, body: Tensor, box: Tensor, config: QueryConfig, generator: torch.Generator
) -> QueryPoints:
    """Query points of a step: Gaussian about scan and body, uniform in the box and on its boundary.

    Of canonical ``scan (B, S, 3)``, ``body (V, 3)`` and ``box (2, 3)`` on one device. The same state of the CPU's
    ``generator`` draws the same points.
    """
    dims = check_shape("scan", scan, "B S 3")
    check_shape("body", body, "V 3")
    low, size = box[0], box[1] - box[0]

    def draw(*shape: int) -> Tensor:
        return torch.rand(dims["B"], *shape, generator=generator).to(scan)

    about_body = config.near_points // 2
    of_scan = (draw(config.near_points - about_body) * dims["S"]).long().clamp(max=dims["S"] - 1)
    of_body = (draw(about_body) * len(body)).long().clamp(max=len(body) - 1)
    anchors = torch.cat([scan.gather(1, of_scan[..., None].expand(-1, -1, 3)), body[of_body]], dim=1)
    near = anchors + config.near_distance * torch.randn(anchors.shape, generator=generator).to(scan)
    uniform = draw(config.box_points, 3)
    boundary, side = draw(config.boundary_points, 3), (draw(config.boundary_points, 1) * 6).long().clamp(max=5)
    boundary = boundary.scatter(2, side % 3, (side // 3).to(boundary))
    return QueryPoints(near, low + size * uniform, low + size * boundary)


def query_field(avatar: ImplicitAvatar, scan: Tensor, space: QueryPoints, joint_transforms: Tensor) -> FieldValues:
    """Distances, their gradients and colours, where there are any, at the points of a step, in one evaluation.

    Of canonical ``scan (B, S, 3)`` and ``joint_transforms (B, J, 4, 4)`` posed_from_canonical. Gradients are those of
    the whole field, pose features included; with gradients switched on they can be differentiated again.
    """
    parts = [scan, space.near, space.uniform, space.boundary]
    learning = torch.is_grad_enabled()
    with torch.enable_grad():
        places = torch.cat(parts, dim=1).requires_grad_()
        distances = avatar(places, joint_transforms)
        (gradients,) = torch.autograd.grad(distances.sum(), places, create_graph=learning)
    counts = [part.shape[1] for part in parts]
    surface, _, uniform, boundary = (distances if learning else distances.detach()).split(counts, dim=1)
    on_scan, near, in_box, _ = gradients.split(counts, dim=1)
    colors = None if avatar.texture is None else avatar.colors(scan, joint_transforms)
    return FieldValues(surface, on_scan, torch.cat([near, in_box], dim=1), uniform, boundary, colors)
