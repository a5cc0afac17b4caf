"""Self-intersection of a triangle mesh."""

from __future__ import annotations

import numpy as np
import trimesh

from avatar.geometry.trees import build_tree

PAIRS = 200_000  # of triangles, tested at once
LONG = 3.0  # edges longer than this many medians are cut up for the search of neighbours


def crossing_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether each face cuts through another one that shares no vertex with it, ``(F,)`` bool.

    Args:
        vertices: ``(V, 3)``, metres; faces: ``(F, 3)``.

    An edge that passes through a triangle is a crossing; triangles in one plane are not.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    crossing = np.zeros(len(faces), bool)
    if len(faces) < 2:
        return crossing
    corners = vertices[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    longest = LONG * max(float(np.median(edges)), 1e-9)
    pieces, cut, whole = trimesh.remesh.subdivide_to_size(vertices, faces, longest, max_iter=20, return_index=True)
    corners = pieces[cut]
    centers = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centers[:, None], axis=2).max(axis=1)
    tree = build_tree(centers)
    for start in range(0, len(cut), chunk := max(PAIRS // 64, 1)):
        rows = np.arange(start, min(start + chunk, len(cut)))
        found = tree.query_ball_point(centers[rows], reach[rows] + reach.max())
        first = np.repeat(rows, [len(ids) for ids in found])
        second = np.concatenate(found).astype(np.int64)
        alike = (faces[whole[first]][:, :, None] == faces[whole[second]][:, None]).any(axis=(1, 2))
        boxes = (corners[first].min(axis=1) <= corners[second].max(axis=1)) & (
            corners[second].min(axis=1) <= corners[first].max(axis=1)
        )
        first, second = (ids[~alike & boxes.all(axis=1)] for ids in (first, second))
        hit = edges_cut(corners[first], corners[second])
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
