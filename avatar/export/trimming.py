"""Trimming of Poisson surfaces: the caps across sleeves, necks and hems, which no points support, are cut away.

Dropping a fixed share of low-density vertices (POP's way) leaves ragged boundaries and also removes parts of closed
surfaces, so support is measured against the points. A vertex is unsupported where its nearest points all lie to one
side (their centroid is shifted along the surface as on a boundary, whatever their density) and nothing follows on the
other, or where the nearest point is far. The surface is cut along the line between, through its triangles.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from avatar.geometry.trees import build_tree
from avatar.records import Mesh, PointCloud

NEIGHBOURS = 24
BOUNDARY_SHIFT = 4 / (3 * np.pi)  # centroid of a half disc, in radii: what a vertex on a straight boundary sees
LOOK_AHEAD = 0.9  # share of the look-ahead ball that must be empty; its surface touches the vertex's own boundary
SPACING_NEIGHBOUR = 8  # the point itself counted; its distance measures the local spacing
HOLE_SPACINGS = 2.5  # random points leave gaps this many such distances wide
BARELY = 1e-3  # how far below the cut forgiven vertices are put


def trim_surface(mesh: Mesh, cloud: PointCloud, max_hole: float, min_part: float) -> Mesh:
    """The part of a reconstructed surface that the points, with unit normals, support; without unused vertices.

    Gaps in the points up to ``max_hole`` metres wide stay closed, wider ones are opened; where points are so sparse
    that such gaps are everywhere, a gap must be a few times their spacing. Connected parts with less than the share
    ``min_part`` of the whole area are dropped. The mesh has no triangles when nothing is supported.
    """
    tree = build_tree(cloud.points)
    near, _ = tree.query(cloud.points, k=min(SPACING_NEIGHBOUR, len(cloud.points)))
    holes = np.maximum(max_hole, HOLE_SPACINGS * near[:, -1])
    distances, ids = tree.query(mesh.vertices, k=min(NEIGHBOURS, len(cloud.points)))
    holes = holes[ids[:, 0]]
    across = cloud.normals[ids[:, 0]]  # on a thin finger the centroid lies inside, which makes no boundary
    shifts = cloud.points[ids].mean(axis=1) - mesh.vertices
    shifts -= (shifts * across).sum(axis=1, keepdims=True) * across
    lengths = np.maximum(np.linalg.norm(shifts, axis=1), 1e-12)
    excess = lengths / np.maximum(distances[:, -1], 1e-12) / BOUNDARY_SHIFT - 1
    edge = np.flatnonzero(excess > 0)
    reach = holes[edge] / 2
    beyond, _ = tree.query(mesh.vertices[edge] - shifts[edge] / lengths[edge, None] * reach[:, None])
    excess[edge[beyond < LOOK_AHEAD * reach]] = -BARELY  # something follows: a gap, not a boundary
    excess = np.maximum(excess, distances[:, 0] / (holes / 2) - 1)
    excess = _forgive_small_holes(mesh, excess, holes)
    return drop_small_parts(cut_surface(mesh, excess), min_part)


def _forgive_small_holes(mesh: Mesh, excess: np.ndarray, holes: np.ndarray) -> np.ndarray:
    """Keeps unsupported patches smaller than a hole across: noise, fingertips, the tip of the nose."""
    outside = excess > 0
    labels = _vertex_parts(mesh.faces[outside[mesh.faces].all(axis=1)], len(mesh.vertices))
    count = labels.max() + 1
    low, high, allowed = np.full((count, 3), np.inf), np.full((count, 3), -np.inf), np.zeros(count)
    np.minimum.at(low, labels, mesh.vertices)
    np.maximum.at(high, labels, mesh.vertices)
    np.maximum.at(allowed, labels, holes)
    small = (np.linalg.norm(high - low, axis=1) < allowed)[labels]
    return np.where(outside & small, -BARELY, excess)


def cut_surface(mesh: Mesh, values: np.ndarray) -> Mesh:
    """The part of a mesh where values ``(V,)`` at its vertices, linear in between, are at most zero; without colours.

    Triangles that the zero line crosses are split along it, so the boundary is a line and not a row of teeth.
    """
    inside = values <= 0
    corners = inside[mesh.faces]
    kept = mesh.faces[corners.all(axis=1)]
    crossed = mesh.faces[corners.any(axis=1) & ~corners.all(axis=1)]
    alone = inside[crossed] == (inside[crossed].sum(axis=1) == 1)[:, None]  # the corner on its own side
    order = (alone.argmax(axis=1)[:, None] + np.arange(3)) % 3
    tip, left, right = np.take_along_axis(crossed, order, axis=1).T
    pairs = np.sort(np.concatenate([np.stack([tip, left], 1), np.stack([tip, right], 1)]), axis=1)
    edges, ids = np.unique(pairs, axis=0, return_inverse=True)
    ids = ids.reshape(-1) + len(mesh.vertices)
    to_left, to_right = ids[: len(tip)], ids[len(tip) :]
    start, end = mesh.vertices[edges].astype(np.float64).swapaxes(0, 1)
    first, second = values[edges].T
    along = (first / np.where(first == second, 1, first - second))[:, None]
    boundary = start + along * (end - start)
    single = inside[tip]
    pieces = [
        kept,
        np.stack([tip, to_left, to_right], axis=1)[single],
        np.stack([left, right, to_left], axis=1)[~single],
        np.stack([right, to_right, to_left], axis=1)[~single],
    ]
    return _compact(np.concatenate([mesh.vertices, boundary]), np.concatenate(pieces))


def drop_small_parts(mesh: Mesh, min_share: float) -> Mesh:
    """The mesh without connected parts whose share of the whole area is below ``min_share``."""
    if not len(mesh.faces):
        return mesh
    labels = _vertex_parts(mesh.faces, len(mesh.vertices))[mesh.faces[:, 0]]
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    areas = np.bincount(labels, np.linalg.norm(np.cross(b - a, c - a), axis=1))
    return _compact(mesh.vertices, mesh.faces[areas[labels] >= min_share * areas.sum()])


def _vertex_parts(faces: np.ndarray, count: int) -> np.ndarray:
    """Number of the connected part each of ``count`` vertices belongs to, joined by ``faces``."""
    starts, ends = faces[:, [0, 1]].reshape(-1), faces[:, [1, 2]].reshape(-1)
    links = coo_array((np.ones(len(starts), bool), (starts, ends)), shape=(count, count))
    return connected_components(links, directed=False)[1]


def _compact(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """A mesh with only the vertices that are used, in their order."""
    used, ids = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used], ids.reshape(-1, 3))
