"""Exact closest points on a triangle mesh, with a sign: how far a point lies from a surface, and on which side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatar.checks import AvatarError, check_finite, check_shape
from avatar.geometry.trees import build_tree

FIRST_CANDIDATES = 8  # triangles tried for each query before asking whether a farther one could be closer
CHUNK_PAIRS = 1 << 20  # query-triangle pairs held at once: about 0.3 GB of temporaries


@dataclass(frozen=True)
class SurfaceHits:
    """Closest points ``(N, 3)`` on a mesh, their triangles ``face_ids (N,)`` and signed distances ``(N,)``, metres.

    Distances are negative inside (behind the surface, by the pseudo-normal at the closest point).
    """

    points: np.ndarray
    face_ids: np.ndarray
    signed_distances: np.ndarray


def closest_on_mesh(
    queries: np.ndarray, vertices: np.ndarray, faces: np.ndarray, exact_within: float = np.inf
) -> SurfaceHits:
    """The closest surface point to each query, exactly, and the side of the surface the query is on.

    Triangles are tried in the order of their pieces' distance, in lists that grow until no piece left out could be
    closer (its centre is too far away for its size). The sign is that of the angle-weighted
    pseudo-normal (Baerentzen and Aanaes 2005), which is right for every closed, consistently wound mesh, also where
    the closest point is an edge or a vertex.

    Args:
        queries: ``(N, 3)`` metres.
        vertices: ``(V, 3)`` metres.
        faces: ``(F, 3)`` counter-clockwise from outside.
        exact_within: beyond this distance the first triangles tried will do (the distance is then too large, by
            less than the size of an average triangle); saves most of the time where far points do not matter.

    Raises:
        AvatarError: on wrong shapes, non-finite coordinates or a mesh without faces.
    """
    check_shape("queries", queries, "N 3")
    check_shape("vertices", vertices, "V 3")
    if check_shape("faces", faces, "F 3")["F"] == 0:
        raise AvatarError("faces: expected a mesh with faces, got none.")
    queries, vertices = np.asarray(queries, np.float64), np.asarray(vertices, np.float64)
    check_finite("queries", queries)
    check_finite("vertices", vertices)
    search = _TriangleSearch(vertices[faces])
    face_ids = search.closest(queries, exact_within)
    points, weights = closest_on_triangles(queries, search.corners[face_ids])
    normals = _pseudo_normals(vertices, faces, face_ids, weights)
    away = queries - points
    sides = np.where((away * normals).sum(axis=1) < 0, -1.0, 1.0)
    return SurfaceHits(points, face_ids, sides * np.linalg.norm(away, axis=1))


class _TriangleSearch:
    """A KD-tree over small pieces of triangles: prepare once, query many."""

    def __init__(self, corners: np.ndarray):
        centres, self.owners, self.reach = _cover(corners)
        self.corners, self.tree = corners, build_tree(centres)
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        self.frames = np.concatenate([corners[:, 0], first, second], axis=1)
        dots = [(u * v).sum(axis=1) for u, v in ((first, first), (first, second), (second, second))]
        self.dots = np.stack(dots, axis=1)

    def closest(self, queries: np.ndarray, exact_within: float) -> np.ndarray:
        """The closest triangle of each query ``(N,)``, in rounds of growing candidate lists."""
        face_ids = np.empty(len(queries), np.int64)
        open_ids, k = np.arange(len(queries)), FIRST_CANDIDATES
        while len(open_ids):
            k = min(k, self.tree.n)
            unsure = []
            for ids in np.array_split(open_ids, len(open_ids) * k // CHUNK_PAIRS + 1):
                radii, found = self.tree.query(queries[ids], k=np.arange(1, k + 1), workers=-1)
                candidates = self.owners[found]
                squared = self._squared_distances(queries[ids], candidates)
                best = squared.argmin(axis=1)
                rows = np.arange(len(ids))
                face_ids[ids] = candidates[rows, best]
                distances = np.sqrt(squared[rows, best])
                unsure.append(ids[(distances > radii[:, -1] - self.reach) & (distances <= exact_within)])
            open_ids = np.concatenate(unsure) if k < self.tree.n else open_ids[:0]
            k *= 3
        return face_ids

    def _squared_distances(self, queries: np.ndarray, candidates: np.ndarray) -> np.ndarray:
        """Squared distance of each query to each of its candidate triangles ``(N, k)``, from dot products alone.

        A triangle is a + s u + t v, and the squared distance a quadratic in (s, t): its minimum is the plane's, or
        that of one of the three edges.
        """
        frames = self.frames[candidates]
        away = queries[:, None] - frames[..., :3]
        square = np.einsum("nki,nki->nk", away, away)
        along_u = np.einsum("nki,nki->nk", away, frames[..., 3:6])
        along_v = np.einsum("nki,nki->nk", away, frames[..., 6:])
        uu, uv, vv = np.moveaxis(self.dots[candidates], -1, 0)

        def at(s: np.ndarray, t: np.ndarray) -> np.ndarray:
            return square + s * (s * uu + 2 * t * uv - 2 * along_u) + t * (t * vv - 2 * along_v)

        tiny = np.finfo(np.float64).tiny
        zero = np.zeros_like(square)
        s, t = np.clip(along_u / np.maximum(uu, tiny), 0, 1), np.clip(along_v / np.maximum(vv, tiny), 0, 1)
        across = np.clip((along_v - along_u + uu - uv) / np.maximum(uu - 2 * uv + vv, tiny), 0, 1)
        best = np.minimum(np.minimum(at(s, zero), at(zero, t)), at(1 - across, across))
        area = np.maximum(uu * vv - uv * uv, tiny)
        s, t = (vv * along_u - uv * along_v) / area, (uu * along_v - uv * along_u) / area
        inside = (s > 0) & (t > 0) & (s + t < 1)
        return np.maximum(np.where(inside, np.minimum(best, at(s, t)), best), 0)


def _cover(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Balls that cover the triangles: centres ``(P, 3)``, the triangle of each ``(P,)`` and their common radius.

    Long triangles are halved across their longest edge until all pieces are about as small as the average one:
    with one ball a triangle, a single long one would make every search wide.
    """
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    radius = 0.7 * np.sqrt(np.linalg.norm(crosses, axis=1).mean() / 2) + np.ptp(corners) * 1e-3
    pieces, owners, done = corners, np.arange(len(corners)), []
    while len(pieces):
        centres = pieces.mean(axis=1)
        small = np.linalg.norm(pieces - centres[:, None], axis=2).max(axis=1) <= radius
        done.append((centres[small], owners[small]))
        pieces, owners = pieces[~small], owners[~small]
        longest = np.linalg.norm(np.roll(pieces, -1, axis=1) - pieces, axis=2).argmax(axis=1)
        turned = pieces[np.arange(len(pieces))[:, None], (longest[:, None] + np.arange(3)) % 3]
        middle = turned[:, :2].mean(axis=1)
        halves = (turned[:, 0], middle, turned[:, 2]), (middle, turned[:, 1], turned[:, 2])
        pieces = np.concatenate([np.stack(half, axis=1) for half in halves])
        owners = np.concatenate([owners, owners])
    return np.concatenate([c for c, _ in done]), np.concatenate([o for _, o in done]), float(radius)


def closest_on_triangles(queries: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The closest point of one triangle to each query. ``(N, 3)`` and ``(N, 3, 3)`` to points and weights, ``(N, 3)``.

    Weights are barycentric; those of a point on an edge or at a corner are exactly zero elsewhere.
    """
    best_points, best_weights = np.empty_like(queries), np.zeros_like(queries)
    best = np.full(len(queries), np.inf)
    for start, end in ((0, 1), (1, 2), (2, 0)):
        edge = corners[:, end] - corners[:, start]
        length = np.maximum((edge * edge).sum(axis=1), np.finfo(np.float64).tiny)
        along = np.clip(((queries - corners[:, start]) * edge).sum(axis=1) / length, 0.0, 1.0)
        points = corners[:, start] + along[:, None] * edge
        gaps = np.square(queries - points).sum(axis=1)
        closer = gaps < best
        best[closer], best_points[closer] = gaps[closer], points[closer]
        best_weights[closer] = 0.0
        best_weights[closer, start], best_weights[closer, end] = 1 - along[closer], along[closer]
    inner = _barycentric(queries, corners)
    inside = (inner > 0).all(axis=1)
    best_weights[inside] = inner[inside]
    best_points[inside] = (inner[inside, :, None] * corners[inside]).sum(axis=1)
    return best_points, best_weights


def _barycentric(queries: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Barycentric weights of the queries' projections to the triangles' planes; NaN for triangles without area."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = np.cross(first, second)
    away = queries - corners[:, 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        areas = (normals * normals).sum(axis=1)
        beta = (np.cross(away, second) * normals).sum(axis=1) / areas
        gamma = (np.cross(first, away) * normals).sum(axis=1) / areas
    return np.stack([1 - beta - gamma, beta, gamma], axis=1)


def _pseudo_normals(vertices: np.ndarray, faces: np.ndarray, face_ids: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Unnormalised pseudo-normals where closest points lie: of the face, of the edge or of the corner."""
    corners = vertices[faces]
    crosses = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    units = crosses / np.maximum(np.linalg.norm(crosses, axis=1, keepdims=True), 1e-30)
    at_vertices, at_edges = np.zeros_like(vertices), np.zeros((len(faces), 3, 3))
    for corner in range(3):
        after = corners[:, (corner + 1) % 3] - corners[:, corner]
        before = corners[:, (corner + 2) % 3] - corners[:, corner]
        lengths = np.linalg.norm(after, axis=1) * np.linalg.norm(before, axis=1)
        cosines = np.divide((after * before).sum(axis=1), lengths, out=np.ones(len(faces)), where=lengths > 0)
        np.add.at(at_vertices, faces[:, corner], np.arccos(np.clip(cosines, -1, 1))[:, None] * units)
    edges = np.sort(np.stack([np.roll(faces, -1, axis=1), np.roll(faces, -2, axis=1)], axis=2), axis=2)
    _, edge_ids = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    sums = np.zeros((edge_ids.max() + 1, 3))
    np.add.at(sums, edge_ids.ravel(), np.repeat(units, 3, axis=0))
    at_edges = sums[edge_ids].reshape(-1, 3, 3)  # at_edges[f, i] is the edge opposite corner i
    on = weights > 0
    normals = units[face_ids]
    edge = on.sum(axis=1) == 2
    normals[edge] = at_edges[face_ids[edge], np.argmin(weights[edge], axis=1)]
    corner = on.sum(axis=1) == 1
    normals[corner] = at_vertices[faces[face_ids[corner], np.argmax(weights[corner], axis=1)]]
    return normals
