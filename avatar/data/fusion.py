"""Raw scans as meshes: what a scanner's fusion makes of a dressed body, with the truth kept beside every vertex.

Where surfaces touch (an arm on the trunk, the legs, cloth on cloth) a real fused mesh is one sheet: what lies inside
the contact is gone, and triangles of both sides share the vertices at its boundary. That, noise and holes are what
learned canonicalization (SCANimate 3.1) has to cope with; the perfect mesh of `scanner.scan_mesh` has none of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components

from avatar.data import scanner
from avatar.data.scanner import DressedSurface, ScanConfig, keep_points
from avatar.geometry.surface import vertex_normals
from avatar.geometry.trees import build_tree
from avatar.records import Scan

CORNERS = np.arange(3)
SMALLEST_COMPONENT = 30  # faces; smaller pieces are what scanning software throws away
NEARBY = 64  # nearest vertices in which a boundary vertex looks for another surface
FAR_AT_REST = 4  # times the merging distance: vertices as far apart at rest are on different parts of a surface
NOISE_ROUNDS = 3  # times each vertex's noise is blended with its neighbours': fusion has averaged many depth images
CHILDREN = {  # number of split edges: triangles over corners 0 1 2 and the middles 3 4 5 of edges 01 12 20
    1: ((0, 3, 2), (3, 1, 2)),
    2: ((3, 1, 4), (0, 3, 4), (0, 4, 2)),
    3: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
}


def fuse_mesh(surface: DressedSurface, config: ScanConfig, frame: str) -> Scan:
    """What can be seen of a dressed body as a raw mesh: edges of the scanner's fineness, contacts, noise, holes.

    A vertex where two surfaces were joined keeps the truth of one of them, by lot. Depends on nothing but the surface,
    the configuration (``points`` does not matter) and the frame's name. Raises `AvatarError` when nothing can be seen,
    or holes have taken every point.
    """
    rng = np.random.default_rng(scanner.frame_seed(config.seed, frame))
    scan = split_long_edges(scanner.scan_mesh(surface), config.edge)
    if config.merge:
        scan = weld_contacts(scan, config.merge, rng)
    if config.noise:
        scan = replace(scan, points=scan.points + fused_noise(scan, config.noise, rng))
    if config.holes:
        scan = keep_points(scan, scanner.outside_holes(scan.points, config.holes, config.hole_radius, rng))
        scan = drop_small_components(scan)
    return scanner.paint(replace(scan, normals=_face_normals(scan)), config.pattern)


def split_long_edges(scan: Scan, longest: float) -> Scan:
    """The same surface with every edge at most so long: longer ones are halved until none is left.

    Both triangles of an edge are split at its middle, so no gap opens. New vertices stand between their two, in truth
    too, and have the label of the first.
    """
    values = np.concatenate([scan.points, scan.normals, scan.canonical], axis=1)
    labels, faces = scan.labels, scan.faces
    while True:
        edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1).reshape(-1, 2)
        keys, which = np.unique(edges[:, 0] * len(values) + edges[:, 1], return_inverse=True)
        start, end = np.divmod(keys, len(values))
        long = np.linalg.norm(values[start, :3] - values[end, :3], axis=1) > longest
        if not long.any():
            break
        middles = np.where(long, len(values) + np.cumsum(long) - 1, -1)
        faces = split_faces(faces, middles[which].reshape(-1, 3))
        values = np.concatenate([values, (values[start[long]] + values[end[long]]) / 2])
        labels = np.concatenate([labels, labels[start[long]]])
    normals = values[:, 3:6] / np.maximum(np.linalg.norm(values[:, 3:6], axis=1, keepdims=True), 1e-12)
    return Scan(values[:, :3], normals, faces, labels, values[:, 6:])


def split_faces(faces: np.ndarray, middles: np.ndarray) -> np.ndarray:
    """Triangles split at the middles of their edges 01, 12, 20: ``(F, 3)`` vertex ids, -1 where an edge stays."""
    marked = middles >= 0
    count = marked.sum(axis=1)
    parts = [faces[count == 0]]
    for number, children in CHILDREN.items():
        some = count == number
        # turned so that the split edges come first
        first = np.where(number == 2, marked[some].argmin(axis=1) + 1, marked[some].argmax(axis=1))
        turn = (first[:, None] + CORNERS) % 3
        corners = np.take_along_axis(faces[some], turn, axis=1)
        between = np.take_along_axis(middles[some], turn, axis=1)
        parts.append(np.concatenate([corners, between], axis=1)[:, children].reshape(-1, 3))
    return np.concatenate(parts)


def weld_contacts(scan: Scan, distance: float, rng: np.random.Generator) -> Scan:
    """Joins surfaces closer than a distance into one sheet, as fusion does.

    Where two surfaces face each other, the faces between them are dropped. What is left of them there, and every open
    boundary near another surface (a region hidden by an arm was never seen, a sleeve ends on skin), is joined: vertices
    and those they face become one in their middle, so that triangles of both surfaces share them.
    """
    facing = scanner.facing_partners(scan.points, scan.normals, distance)
    inside = np.zeros(len(scan.points), bool)
    inside[np.concatenate(facing)] = True
    faces = scan.faces[~inside[scan.faces].all(axis=1)]
    borders = boundary_partners(scan, distance)
    pairs = np.concatenate([facing, borders], axis=1)  # vertices that become one
    links = coo_matrix((np.ones(pairs.shape[1], bool), tuple(pairs)), shape=(len(inside),) * 2)
    count, group = connected_components(links, directed=False)
    kept_of = np.empty(count, np.int64)  # whose truth a group keeps: the last one in a random order
    order = rng.permutation(len(inside))
    kept_of[group[order]] = order
    sums = np.stack([np.bincount(group, column, count) for column in scan.points.T.astype(np.float64)], axis=1)
    middles = sums / np.bincount(group, minlength=count)[:, None]
    faces = group[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    truth = {name: getattr(scan, name)[kept_of] for name in ("normals", "labels", "canonical")}
    return drop_small_components(Scan(middles.astype(np.float32), faces=faces, **truth))


def boundary_partners(scan: Scan, distance: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices ``(K,)`` on open boundaries that come close to another surface, and the nearest vertex of that.

    Another surface is another garment, the skin, or a part of the same that is far away at rest.
    """
    links = _links(scan)
    boundary = np.flatnonzero(np.abs(links - links.T).sum(axis=1))  # edges that no face runs along the other way
    nearby = min(NEARBY, len(scan.points))
    distances, ids = build_tree(scan.points).query(scan.points[boundary], k=nearby, distance_upper_bound=distance)
    known = np.isfinite(distances)
    ids = np.where(known, ids, 0)
    apart = np.linalg.norm(scan.canonical[ids] - scan.canonical[boundary, None], axis=-1) > FAR_AT_REST * distance
    other = known & (apart | (scan.labels[ids] != scan.labels[boundary, None]))
    near = other.any(axis=1)
    return boundary[near], ids[near, other[near].argmax(axis=1)]


def fused_noise(scan: Scan, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Noise of a fused mesh ``(M, 3)``: alike at neighbouring vertices, of a standard deviation in metres."""
    links = _links(scan)
    links = links + links.T
    degree = np.asarray(links.sum(axis=1)).reshape(-1, 1)
    waves = rng.standard_normal(scan.points.shape)
    for _ in range(NOISE_ROUNDS):
        waves = (waves + links @ waves / degree) / 2
    return (noise * waves / waves.std()).astype(np.float32)


def drop_small_components(scan: Scan) -> Scan:
    """The mesh without its smallest pieces, and without vertices that no face uses."""
    _, piece = connected_components(_links(scan), directed=False)
    faces_of = np.bincount(piece[scan.faces[:, 0]], minlength=piece.max() + 1)
    kept = (faces_of >= min(SMALLEST_COMPONENT, faces_of.max()))[piece]
    return keep_points(scan, kept)


def _links(scan: Scan) -> csr_matrix:
    """How many faces run along each edge in its direction, ``(M, M)``."""
    start, end = scan.faces.reshape(-1), np.roll(scan.faces, -1, axis=1).reshape(-1)
    return coo_matrix((np.ones(len(start)), (start, end)), shape=(len(scan.points),) * 2).tocsr()


def _face_normals(scan: Scan) -> np.ndarray:
    """Normals of the mesh as it is, not of the surface it was scanned from; that one's where faces cancel out."""
    normals = vertex_normals(torch.from_numpy(scan.points), torch.from_numpy(scan.faces)).numpy()
    return np.where(np.linalg.norm(normals, axis=1, keepdims=True) > 0.5, normals, scan.normals)
