"""Even triangles: a surface cut along a level of a vertex value, and remeshed up to its border."""

from __future__ import annotations

import logging
import warnings

import numpy as np
import trimesh

from avatar.checks import AvatarError, check_faces, check_shape, require
from avatar.geometry.laplacians import boundary_edges, mesh_parts
from avatar.geometry.trees import build_tree
from avatar.records import Mesh

NEAREST = 1e-3  # share of an edge that a cut keeps away from its ends
PLACES = 8  # on every edge of a border, to which others are compared
FINE = 30  # vertices of the surface a cluster, at least
TRIES = 3  # subdivisions, each four times finer, until clusters make a manifold
FEWEST_CLUSTERS = 12
TAUBIN = (0.5, -0.53)  # factors of a smoothing and a widening step


def used_vertices(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The indices ``(U,)`` of the vertices that faces use, and the faces over those alone."""
    used, corners = np.unique(faces, return_inverse=True)
    return used, corners.reshape(faces.shape)


def cut_at_level(vertices: np.ndarray, faces: np.ndarray, values: np.ndarray, level: float) -> Mesh:
    """The part of a surface ``vertices (V, 3)``, ``faces (F, 3)`` where ``values (V,)`` are above a level.

    Triangles across are cut along it, linearly; faces keep their sense. The part may have no faces.
    Raises `AvatarError` on wrong shapes.
    """
    check_shape("values", values, "V", V=check_shape("vertices", vertices, "V 3")["V"])
    above = values > level
    number = above[faces].sum(axis=1)
    crossing = faces[(number > 0) & (number < 3)]
    # turned so that the corner that is alone on its side comes first
    alone = np.where(above[crossing].sum(axis=1) == 1, above[crossing].argmax(axis=1), above[crossing].argmin(axis=1))
    turned = np.take_along_axis(crossing, (alone[:, None] + np.arange(3)) % 3, axis=1)
    edges = np.sort(np.stack([turned[:, [0, 1]], turned[:, [0, 2]]], axis=1), axis=2).reshape(-1, 2)
    keys, which = np.unique(edges[:, 0] * len(vertices) + edges[:, 1], return_inverse=True)
    start, end = np.divmod(keys, len(vertices))
    share = (level - values[start]) / (values[end] - values[start])
    share = np.clip(share, NEAREST, 1 - NEAREST)[:, None]
    places = np.concatenate([vertices, vertices[start] + share * (vertices[end] - vertices[start])])
    near, far = (which.reshape(-1, 2) + len(vertices)).T
    tip = above[turned[:, 0]]
    parts = [
        faces[number == 3],
        np.stack([turned[:, 0], near, far], axis=1)[tip],
        np.stack([turned[:, 1], turned[:, 2], far], axis=1)[~tip],
        np.stack([turned[:, 1], far, near], axis=1)[~tip],
    ]
    used, corners = used_vertices(places, np.concatenate(parts))
    return Mesh(places[used], corners)


def even_triangles(part: Mesh, surface: Mesh, edge: float) -> Mesh:
    """A part of a surface remeshed to triangles of nearly one size and shape, edges about ``edge`` metres long.

    Vertices are centres of clusters of one area (approximated centroidal Voronoi diagrams, Valette and Chassery 2004;
    pyacvd). Those at a border lie half an edge within it: so what is clustered is the part and half an edge of
    ``surface`` around it, and its border's vertices then move onto the part's. Gaps narrower than an edge are closed.
    The same mesh gives the same triangles. Where clusters make no manifold (`manifold_faults`), the surface is made
    finer up to twice; the last result is given.

    Raises:
        AvatarError: for a length that is not positive, faces that do not fit the vertices, or without pyacvd.
    """
    if edge <= 0:
        raise AvatarError(f"edge: expected a length above 0, got {edge}.")
    check_faces(part.faces, check_shape("vertices", part.vertices, "V 3")["V"])
    ends = part.vertices[boundary_edges(part.faces)]
    shares = np.linspace(0, 1, PLACES)[:, None]
    border = (ends[:, :1] * (1 - shares) + ends[:, 1:] * shares).reshape(-1, 3)
    whole = widen(part, border, surface, edge / 2) if len(border) else part
    area = trimesh.triangles.area(whole.vertices[whole.faces]).sum()
    count = max(FEWEST_CLUSTERS, round(area / (edge**2 * np.sqrt(3) / 2)))
    logging.getLogger("pyacvd").setLevel(logging.WARNING)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pyacvd asks pyvista for what it has renamed
        polygons = require("pyvista").PolyData.from_regular_faces(whole.vertices.astype(np.float64), whole.faces)
        clusters = require("pyacvd").Clustering(polygons)
        clusters.subdivide(max(1, int(np.ceil(np.log(FINE * count / len(whole.vertices)) / np.log(4)))))
        for remaining in reversed(range(TRIES)):
            clusters.cluster(count)
            made = clusters.create_mesh()
            vertices, faces = np.array(made.points, np.float64), np.array(made.regular_faces, np.int64)
            if not remaining or not manifold_faults(faces):
                break
            clusters.subdivide(1)
    if len(border):
        outer = np.unique(boundary_edges(faces))
        vertices[outer] = border[build_tree(border).query(vertices[outer])[1]]
    return Mesh(vertices, faces)


def widen(part: Mesh, border: np.ndarray, surface: Mesh, width: float) -> Mesh:
    """A part of a surface, with what of that surface goes on from it within a width of its ``border (N, 3)``."""
    away, _ = build_tree(np.concatenate([part.vertices, border])).query(surface.vertices)
    near = mesh_parts(surface.faces[(away < width)[surface.faces].all(axis=1)], len(away))
    away[~np.isin(near, near[away == 0])] = 2 * width  # other sheets of the surface
    return cut_at_level(surface.vertices, surface.faces, -away, -width)


def manifold_faults(faces: np.ndarray) -> int:
    """How often faces ``(F, 3)`` are no oriented manifold: edges used twice in one sense, vertices of two borders."""
    edges = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    starts = boundary_edges(faces)[:, 0]
    return len(edges) - len(np.unique(edges, axis=0)) + len(starts) - len(np.unique(starts))


def smooth_borders(vertices: np.ndarray, faces: np.ndarray, rounds: int) -> np.ndarray:
    """Vertices ``(V, 3)`` whose borders are smoothed as curves, with little shrinking (Taubin 1995); all others stay.

    Each round is a smoothing and a widening step; waves shorter than about ``4 sqrt(rounds)`` edges go.
    """
    around = boundary_edges(faces)
    after, before = np.full((2, len(vertices)), -1)
    after[around[:, 0]] = around[:, 1]
    before[around[:, 1]] = around[:, 0]
    once = np.bincount(around[:, 0], minlength=len(vertices)) == 1
    moving = np.flatnonzero(once & (np.bincount(around[:, 1], minlength=len(vertices)) == 1))
    vertices = vertices.copy()
    for _ in range(rounds):
        for factor in TAUBIN:
            middle = (vertices[after[moving]] + vertices[before[moving]]) / 2
            vertices[moving] += factor * (middle - vertices[moving])
    return vertices
