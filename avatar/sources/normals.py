"""Normals of scan points that have none: estimated from their neighbours, oriented piece by piece."""

from __future__ import annotations

import logging

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree

from avatar.checks import AvatarError, check_finite, check_shape
from avatar.geometry.trees import build_tree
from avatar.io.raw_surface import vertex_normals
from avatar.records import Mesh

NEIGHBOURS = 16
LINKS = 8  # nearest neighbours between which orientation is propagated
SHARP = 0.5  # cosine between neighbouring normals: below, orientation is not propagated (folds, gaps between surfaces)
SKIN = 0.01  # metres from the skin at which its own normal says as much as the direction away from it
VIEWS = 32  # directions that the cloud is looked at from
PIXEL = 2.5  # mean distances between neighbours
DOUBTFUL = 0.25  # of a vote's weight, as a share: pieces decided by less are counted as doubtful
MOST_DOUBTFUL = 0.05  # share of the points in doubtful pieces from which on a warning is given
CHUNK = 50_000  # points at a time
log = logging.getLogger(__name__)


def oriented_normals(points: np.ndarray, body: Mesh | None, name: str = "points") -> np.ndarray:
    """Unit normals ``(M, 3)`` float32 of ``points (M, 3)``: the smallest principal axis of each one's 16 neighbours.

    Orientation is propagated along a minimum spanning forest of the neighbour graph, weighted by the angle between
    normals (Hoppe et al. 1992), and cut where neighbouring normals differ by more than 60 degrees. Each piece is then
    turned by a vote of its points: away from the posed ``body`` in metres, where it is known, else towards those of 32
    directions from which a point is not covered by others. A warning under ``name`` says where more than 5% of the
    points lie in pieces whose votes nearly cancel. Raises `AvatarError` for fewer points than neighbours.
    """
    check_shape(name, points, "M 3")
    check_finite(name, points)
    if len(points) < NEIGHBOURS:
        raise AvatarError(f"{name}: expected at least {NEIGHBOURS} to estimate normals, got {len(points)}.")
    points = points.astype(np.float64)
    axes, neighbours, spacing = principal_axes(points)
    signs, piece = propagated_signs(axes, neighbours)
    normals = axes * signs[:, None]
    votes = seen_votes(points, normals, spacing) if body is None else body_votes(points, normals, body)
    totals, weights = np.bincount(piece, votes), np.bincount(piece, np.abs(votes))
    sure = np.abs(totals) >= DOUBTFUL * weights
    if (doubtful := 1 - float(sure[piece].mean())) > MOST_DOUBTFUL:
        log.warning("%s: normals of %.0f%% of the points may point inward: store them if known.", name, 100 * doubtful)
    return (normals * np.where(totals < 0, -1, 1)[piece, None]).astype(np.float32)


def principal_axes(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Smallest principal axes ``(M, 3)`` of neighbourhoods, neighbours ``(M, K)``, mean distance to the nearest."""
    tree, count = build_tree(points), len(points)
    axes, neighbours, nearest = np.empty_like(points), np.empty((count, LINKS), np.int64), np.empty(count)
    for start in range(0, count, CHUNK):
        part = slice(start, start + CHUNK)
        distances, ids = tree.query(points[part], k=NEIGHBOURS)
        around = points[ids]
        around -= around.mean(axis=1, keepdims=True)
        axes[part] = np.linalg.eigh(np.einsum("mki,mkj->mij", around, around))[1][:, :, 0]
        neighbours[part], nearest[part] = ids[:, 1 : LINKS + 1], distances[:, 1]
    return axes, neighbours, float(nearest.mean())


def propagated_signs(axes: np.ndarray, neighbours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signs ``(M,)`` that make axes ``(M, 3)`` agree within each piece, and the piece ``(M,)`` of each point."""
    count = len(axes)
    one, other = np.repeat(np.arange(count), neighbours.shape[1]), neighbours.reshape(-1)
    cosines = np.einsum("ei,ei->e", axes[one], axes[other])
    kept = np.abs(cosines) >= SHARP
    links = coo_matrix((1 + 1e-6 - np.abs(cosines[kept]), (one[kept], other[kept])), (count, count))
    forest = minimum_spanning_tree(links)
    pieces, piece = connected_components(forest, directed=False)
    # all pieces hang from one further node, so that one traversal reaches every point after its parent
    roots = np.unique(piece, return_index=True)[1]
    tree = forest.tocoo()
    rows = np.concatenate([tree.row, np.full(pieces, count)])
    whole = coo_matrix((np.ones(len(rows)), (rows, np.concatenate([tree.col, roots]))), (count + 1, count + 1))
    parents = breadth_first_order(whole.tocsr(), count, directed=False)[1]
    parents[roots] = roots
    own = np.einsum("mi,mi->m", axes, axes[parents[:count]])
    signs = np.where(own < 0, -1, 1)
    signs[roots] = 1
    above = parents[:count].copy()
    while (above != above[above]).any():  # pointer jumping: the product of signs up to each root in log(depth) steps
        signs, above = signs * signs[above], above[above]
    return signs, piece


def body_votes(points: np.ndarray, normals: np.ndarray, body: Mesh) -> np.ndarray:
    """Votes ``(M,)`` of points for their normals: positive where these point away from the body."""
    ids = build_tree(body.vertices).query(points)[1]
    outward = points - body.vertices[ids] + SKIN * vertex_normals(body.vertices, body.faces)[ids]
    return (normals * outward).sum(axis=1) / np.maximum(np.linalg.norm(outward, axis=1), 1e-12)


def seen_votes(points: np.ndarray, normals: np.ndarray, spacing: float) -> np.ndarray:
    """Votes ``(M,)`` of points for their normals: towards the directions from which no other points cover them.

    Seen in parallel projection with pixels of two and a half spacings; of a pixel's points those within its width of
    the first one are seen.
    """
    votes, size = np.zeros(len(points)), PIXEL * spacing
    turns = np.arange(VIEWS) * np.pi * (3 - np.sqrt(5))
    heights = 1 - (2 * np.arange(VIEWS) + 1) / VIEWS
    rings = np.sqrt(1 - heights**2)
    for view in np.stack([rings * np.cos(turns), heights, rings * np.sin(turns)], axis=1):
        across = np.linalg.svd(view[None])[2][1:]
        pixels = np.floor(points @ across.T / size).astype(np.int64)
        pixels -= pixels.min(axis=0)
        pixel = pixels[:, 0] * (pixels[:, 1].max() + 1) + pixels[:, 1]
        depth = points @ view
        first = np.full(pixel.max() + 1, -np.inf)
        np.maximum.at(first, pixel, depth)
        votes += np.where(depth > first[pixel] - size, normals @ view, 0)
    return votes
