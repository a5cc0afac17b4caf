"""Oriented point clouds rendered from around a person: what the eye compares, normals and silhouettes."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

AZIMUTHS = tuple(range(0, 360, 60))  # degrees around the vertical
ELEVATION = 20.0  # degrees above the horizon, so that no two views have the same outline
PIXELS = 192  # height and width of a view
MARGIN = 0.05  # metres around the scan
EDGE_ON = 1e-3  # discs whose normal has less than this towards the viewer are not seen


def view_axes() -> Tensor:
    """Rows right, up and towards the viewer of every view, ``(6, 3, 3)``."""
    turn, lift = np.radians(AZIMUTHS), np.radians(ELEVATION)
    towards = np.stack([np.sin(turn) * np.cos(lift), np.full_like(turn, np.sin(lift)), np.cos(turn) * np.cos(lift)], 1)
    right = np.stack([np.cos(turn), np.zeros_like(turn), -np.sin(turn)], axis=1)
    return torch.from_numpy(np.stack([right, np.cross(towards, right), towards], axis=1))


def render_normals(points: Tensor, normals: Tensor, radius: float, center: Tensor, extent: float) -> Tensor:
    """Normal maps of a cloud's discs under an orthographic camera.

    A disc is drawn as a flat cone, so that of discs that overlap on one surface the one whose middle is nearest shows.

    Args:
        points, normals: ``(N, 3)`` float64, metres and unit length.
        radius: of every disc, metres.
        center: ``(3,)`` middle of the views; extent: metres from one side of a view to the other.

    Returns:
        ``(6, PIXELS, PIXELS, 3)`` normals in the world's frame; zero where nothing is seen.
    """
    pixel = extent / PIXELS
    reach = int(np.ceil(radius / pixel))
    steps = torch.arange(-reach, reach + 1)
    across, up = (steps.flatten() for steps in torch.meshgrid(steps, steps, indexing="xy"))
    maps = torch.zeros(len(AZIMUTHS), PIXELS * PIXELS, 3, dtype=points.dtype)
    for image, axes in zip(maps, view_axes()):
        x, y, z = ((points - center) @ axes.T).float().T
        facing = (normals @ axes.T).float()
        slope = torch.where(facing[:, 2:].abs() < EDGE_ON, torch.inf, -facing[:, :2] / facing[:, 2:])
        column, row = ((place / pixel + PIXELS / 2).floor().long() for place in (x, y))
        right = ((column + 0.5 - PIXELS / 2) * pixel - x)[:, None] + across * pixel  # from the middle to each pixel
        above = ((row + 0.5 - PIXELS / 2) * pixel - y)[:, None] + up * pixel
        depth = slope[:, :1] * right + slope[:, 1:] * above  # of the disc's plane
        away = right.square() + above.square() + depth.square()
        disc, step = (away <= radius**2).nonzero(as_tuple=True)
        column, row = column[disc] + across[step], row[disc] + up[step]
        inside = (column >= 0) & (column < PIXELS) & (row >= 0) & (row < PIXELS)
        disc, step, column, row = (values[inside] for values in (disc, step, column, row))
        order = (z[disc] + depth[disc, step] - away[disc, step].sqrt()).argsort()
        front = np.full(PIXELS * PIXELS, -1)
        front[(row * PIXELS + column)[order].numpy()] = disc[order].numpy()  # the last, nearest one stays
        filled = torch.from_numpy(front >= 0)
        image[filled] = normals[torch.from_numpy(front)[filled]]
    return maps.unflatten(1, (PIXELS, PIXELS))


def view_frame(scan: Tensor) -> tuple[Tensor, float]:
    """Centre and extent of views that show all of a scan ``(M, 3)``, whatever the direction."""
    low, high = scan.amin(dim=0), scan.amax(dim=0)
    return (low + high) / 2, float((high - low).norm()) + 2 * MARGIN


def normal_map_error(maps: Tensor, scan_maps: Tensor) -> Tensor:
    """Mean angle between two clouds' normal maps where both are seen, degrees; 180 where they nowhere overlap."""
    both = maps.any(dim=-1) & scan_maps.any(dim=-1)
    if not both.any():
        return maps.new_tensor(180.0)
    cosine = (maps[both] * scan_maps[both]).sum(dim=-1)
    return torch.rad2deg(cosine.clamp(-1, 1).acos()).mean()


def silhouette_overlap(maps: Tensor, scan_maps: Tensor) -> Tensor:
    """Intersection over union of two clouds' silhouettes, all views together."""
    mine, theirs = maps.any(dim=-1), scan_maps.any(dim=-1)
    return (mine & theirs).sum().double() / (mine | theirs).sum().clamp(min=1)
