"""What metrics are made of: faces that cross, and clouds rendered from around a person."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from avatar.geometry.closest import cut_triangles
from avatar.geometry.trees import build_tree

PAIRS = 200_000  # of triangles, tested at once
LONG = 3.0  # edges longer than this many medians are cut up for the search of neighbours
AZIMUTHS = tuple(range(0, 360, 60))  # degrees around the vertical
ELEVATION = 20.0  # degrees above the horizon, so that no two views have the same outline
PIXELS = 192  # height and width of a view
MARGIN = 0.05  # metres around the scan
EDGE_ON = 1e-3  # discs whose normal has less than this towards the viewer are not seen


def crossing_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether each face ``(F, 3)`` of a mesh ``(V, 3)`` cuts through one that shares no vertex with it, ``(F,)`` bool.
    An edge that passes through a triangle is a crossing; triangles in one plane are not.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    crossing = np.zeros(len(faces), bool)
    if len(faces) < 2:
        return crossing
    corners = vertices[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    longest = LONG * max(float(np.median(edges)), 1e-9)
    corners, whole, centres, reach = cut_triangles(vertices, faces, longest)
    sizes = np.floor(np.log2(np.maximum(reach, 1e-12)))
    for size in np.unique(sizes):  # each triangle meets those of its size and smaller ones, which lie near it
        alike, larger = np.flatnonzero(sizes == size), np.flatnonzero(sizes >= size)
        tree, bound = build_tree(centres[alike]), reach[alike].max()
        for rows in np.array_split(larger, len(larger) * 64 // PAIRS + 1):
            found = tree.query_ball_point(centres[rows], reach[rows] + bound)
            first = np.repeat(rows, [len(ids) for ids in found])
            second = alike[np.concatenate(found).astype(np.int64)]
            once = (sizes[first] > size) | (first < second)
            first, second = first[once], second[once]
            joined = (faces[whole[first]][:, :, None] == faces[whole[second]][:, None]).any(axis=(1, 2))
            boxes = (corners[first].min(axis=1) <= corners[second].max(axis=1)) & (
                corners[second].min(axis=1) <= corners[first].max(axis=1)
            )
            first, second = (ids[~joined & boxes.all(axis=1)] for ids in (first, second))
            hit = edges_cut(corners[first], corners[second]) | edges_cut(corners[second], corners[first])
            crossing[whole[first[hit]]] = crossing[whole[second[hit]]] = True
    return crossing


def edges_cut(triangles: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Whether an edge of each triangle ``(N, 3, 3)`` passes through the other one of its pair, ``(N,)``."""
    origin = triangles
    along = np.roll(triangles, -1, axis=1) - origin
    base = others[:, None, 0]
    one, two = others[:, None, 1] - base, others[:, None, 2] - base
    normal = np.cross(along, two)
    scale = (one * normal).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):  # an edge along the plane has no one place in it
        away = origin - base
        u = (away * normal).sum(axis=-1) / scale
        across = np.cross(away, one)
        v = (along * across).sum(axis=-1) / scale
        t = (two * across).sum(axis=-1) / scale
        return ((u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)).any(axis=1)


def view_axes() -> Tensor:
    """Rows right, up and towards the viewer of every view, ``(6, 3, 3)``."""
    turn, lift = np.radians(AZIMUTHS), np.radians(ELEVATION)
    towards = np.stack([np.sin(turn) * np.cos(lift), np.full_like(turn, np.sin(lift)), np.cos(turn) * np.cos(lift)], 1)
    right = np.stack([np.cos(turn), np.zeros_like(turn), -np.sin(turn)], axis=1)
    return torch.from_numpy(np.stack([right, np.cross(towards, right), towards], axis=1))


def render_normals(points: Tensor, normals: Tensor, radius: float, center: Tensor, extent: float) -> Tensor:
    """Orthographic normal maps of a cloud's discs, ``(6, PIXELS, PIXELS, 3)``, zero where nothing is seen. ``points``
    and unit ``normals (N, 3)`` float64; the discs' ``radius``, the views' ``center (3,)`` and their ``extent`` from
    side to side in metres. A disc is drawn as a flat cone, so that of discs that overlap on one surface the one whose
    middle is nearest shows.
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
