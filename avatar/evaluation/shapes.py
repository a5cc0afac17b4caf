"""What metrics are made of: closest points on meshes, faces that cross, and clouds rendered from around a person."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import trimesh
from torch import Tensor

from avatar.checks import AvatarError, check_finite, check_shape
from avatar.geometry.trees import build_tree

FIRST_CANDIDATES = 8  # triangles tried for each query before asking whether a farther one could be closer
CHUNK_PAIRS = 1 << 17  # query-triangle pairs compared at once: what fits a processor's cache is fastest
PAIRS = 200_000  # of triangles, tested at once
LONG = 3.0  # edges longer than this many medians are cut up for the search of neighbours
AZIMUTHS = tuple(range(0, 360, 60))  # degrees around the vertical
ELEVATION = 20.0  # degrees above the horizon, so that no two views have the same outline
PIXELS = 192  # height and width of a view
MARGIN = 0.05  # metres around the scan
EDGE_ON = 1e-3  # discs whose normal has less than this towards the viewer are not seen


class SurfaceHits(NamedTuple):
    """Closest points ``(N, 3)`` on a mesh and signed distances ``(N,)`` to them, metres, negative inside."""

    points: np.ndarray
    signed_distances: np.ndarray


def closest_on_mesh(
    queries: np.ndarray, vertices: np.ndarray, faces: np.ndarray, exact_within: float = np.inf
) -> SurfaceHits:
    """The closest point of a mesh ``(V, 3)``, ``(F, 3)`` to each query ``(N, 3)``, exactly, and the query's side of it.
    The sign is that of the angle-weighted pseudo-normal (Baerentzen and Aanaes 2005), which is right for every closed
    mesh wound counter-clockwise from outside, also at edges and vertices. Beyond ``exact_within`` metres the first
    triangles tried will do (the distance is then too large, by less than the size of an average triangle); that saves
    most of the time where far points do not matter.
    """
    check_shape("queries", queries, "N 3")
    check_shape("vertices", vertices, "V 3")
    if check_shape("faces", faces, "F 3")["F"] == 0:
        raise AvatarError("faces: expected a mesh with faces, got none.")
    queries, vertices = np.asarray(queries, np.float64), np.asarray(vertices, np.float64)
    check_finite("queries", queries)
    check_finite("vertices", vertices)
    face_ids = _closest_faces(queries, vertices, np.asarray(faces), exact_within)
    points, weights = closest_on_triangles(queries, vertices[faces[face_ids]])
    away = queries - points
    normals = _pseudo_normals(trimesh.Trimesh(vertices, faces, process=False), face_ids, weights)
    sides = np.where((away * normals).sum(axis=1) < 0, -1.0, 1.0)
    return SurfaceHits(points, sides * np.linalg.norm(away, axis=1))


def _closest_faces(queries: np.ndarray, vertices: np.ndarray, faces: np.ndarray, exact_within: float) -> np.ndarray:
    """The closest triangle of each query ``(N,)``: candidates by the distance of their pieces' centres. Lists of
    candidates grow until no piece left out could be closer: its centre is too far away for its size. Long triangles are
    cut into pieces about as small as the average one, for a single long one would make every search wide.
    """
    corners = vertices[faces]
    areas = trimesh.triangles.area(corners)
    longest = 1.6 * np.sqrt(areas.mean()) + np.ptp(corners) * 1e-3
    _, owners, centres, reach = _cut(vertices, faces, longest)
    tree, reach = build_tree(centres), reach.max()
    face_ids, remaining, k = np.empty(len(queries), np.int64), np.arange(len(queries)), FIRST_CANDIDATES
    while len(remaining):
        k, unsure = min(k, tree.n), []
        for ids in np.array_split(remaining, len(remaining) * k // CHUNK_PAIRS + 1):
            radii, found = tree.query(queries[ids], k=np.arange(1, k + 1), workers=-1)
            candidates = owners[found]
            squared, _ = _candidates(np.repeat(queries[ids], k, axis=0), corners[candidates.ravel()])
            squared = np.minimum.reduce(squared).reshape(-1, k)
            face_ids[ids] = candidates[np.arange(len(ids)), squared.argmin(axis=1)]
            nearest = np.sqrt(np.maximum(squared.min(axis=1), 0))
            unsure.append(ids[(nearest > radii[:, -1] - reach) & (nearest <= exact_within)])
        remaining = np.concatenate(unsure) if k < tree.n else remaining[:0]
        k *= 3
    return face_ids


def _cut(vertices: np.ndarray, faces: np.ndarray, longest: float) -> tuple[np.ndarray, ...]:
    """Triangles cut into pieces of at most an edge length: corners ``(P, 3, 3)``, faces, centres, reach from them."""
    places, pieces, owners = trimesh.remesh.subdivide_to_size(vertices, faces, longest, max_iter=20, return_index=True)
    centres = places[pieces].mean(axis=1)
    return places[pieces], owners, centres, np.linalg.norm(places[pieces] - centres[:, None], axis=2).max(axis=1)


def closest_on_triangles(queries: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The closest point of one triangle to each query. ``(N, 3)`` and ``(N, 3, 3)`` to points and weights, ``(N, 3)``.
    Weights are barycentric; those of a point on an edge or at a corner are exactly zero elsewhere.
    """
    squared, weights = _candidates(queries, corners)
    best = np.array(weights)[np.argmin(squared, axis=0), :, np.arange(len(queries))]
    return np.einsum("ni,nij->nj", best, corners), best


def _candidates(queries: np.ndarray, corners: np.ndarray) -> tuple[list, list]:
    """Squared distances ``(N,)`` to the closest points inside triangles and on their edges, with barycentric weights. A
    triangle is a + s u + t v, and the squared distance a quadratic in (s, t), from dot products alone. Inside comes
    first, infinitely far where the plane's minimum is not inside.
    """
    first, second, away = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], queries - corners[:, 0]
    products = ((first, first), (first, second), (second, second), (away, first), (away, second), (away, away))
    uu, uv, vv, au, av, aa = (np.einsum("ni,ni->n", *pair) for pair in products)
    tiny, zero = np.finfo(np.float64).tiny, np.zeros(len(queries))
    area = uu * vv - uv * uv
    area = np.where(area > 0, area, np.inf)  # of a triangle without area the edges are all there is
    s, t = (vv * au - uv * av) / area, (uu * av - uv * au) / area
    inside = (s > 0) & (t > 0) & (s + t < 1)
    s, t = s * inside, t * inside
    on_first, on_second = np.clip(au / np.maximum(uu, tiny), 0, 1), np.clip(av / np.maximum(vv, tiny), 0, 1)
    on_third = np.clip((av - au + uu - uv) / np.maximum(uu - 2 * uv + vv, tiny), 0, 1)
    weights = [(1 - s - t, s, t), (1 - on_first, on_first, zero), (1 - on_second, zero, on_second)]
    weights.append((zero, 1 - on_third, on_third))
    squared = [aa + s * (s * uu + 2 * t * uv - 2 * au) + t * (t * vv - 2 * av) for _, s, t in weights]
    squared[0] = np.where(inside, np.minimum.reduce(squared), np.inf)
    return squared, weights


def _pseudo_normals(mesh: trimesh.Trimesh, face_ids: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Pseudo-normals where closest points lie: of the face, of the edge or, weighted by angles, of the corner."""
    normals, on = mesh.face_normals[face_ids], weights > 0
    edge, corner = on.sum(axis=1) == 2, on.sum(axis=1) == 1
    sums = np.zeros((len(mesh.edges_unique), 3))
    np.add.at(sums, mesh.faces_unique_edges.ravel(), np.repeat(mesh.face_normals, 3, axis=0))
    across = (weights[edge].argmin(axis=1) + 1) % 3  # a face's edge i runs from its corner i to the next
    normals[edge] = sums[mesh.faces_unique_edges[face_ids[edge], across]]
    normals[corner] = mesh.vertex_normals[mesh.faces[face_ids[corner], weights[corner].argmax(axis=1)]]
    return normals


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
    corners, whole, centres, reach = _cut(vertices, faces, longest)
    tree = build_tree(centres)
    for rows in np.array_split(np.arange(len(corners)), len(corners) * 64 // PAIRS + 1):
        found = tree.query_ball_point(centres[rows], reach[rows] + reach.max())
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
