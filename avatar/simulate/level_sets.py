"""Surfaces from scalar fields: surface nets on a grid, clipping without slivers, relaxing on the level set."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
import trimesh
from scipy.ndimage import map_coordinates

SNAP = 0.4  # vertices nearer to a cut than this share of their edge move onto it, so no sliver is cut off


@dataclass(frozen=True)
class Grid:
    """A scalar field sampled on a regular grid: ``values (X, Y, Z)``, ``origin (3,)`` and ``step`` in metres."""

    values: np.ndarray
    origin: np.ndarray
    step: float

    def sample(self, points: np.ndarray) -> np.ndarray:
        """Trilinear values at ``(N, 3)`` points: ``(N,)``."""
        return map_coordinates(self.values, ((points - self.origin) / self.step).T, order=1, mode="nearest")

    def gradient(self, points: np.ndarray) -> np.ndarray:
        """Central differences at ``(N, 3)`` points: ``(N, 3)``."""
        shifts = np.eye(3) * self.step * 0.75
        return np.stack([self.sample(points + s) - self.sample(points - s) for s in shifts], -1) / (1.5 * self.step)

    def project(self, points: np.ndarray) -> np.ndarray:
        """One Newton step of ``(N, 3)`` points to the zero level along the gradient, at most a grid step long."""
        gradient = self.gradient(points)
        length = self.sample(points) / np.maximum((gradient**2).sum(-1), 0.25)
        return points - np.clip(length, -self.step, self.step)[:, None] * gradient


def surface_nets(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """The zero level of a field as vertices ``(V, 3)`` in metres and triangles ``(F, 3)`` facing positive values.

    Naive surface nets (Gibson 1998): one vertex a cell at the mean of its edge crossings, one quad an edge.
    """
    shape = np.array(grid.values.shape)
    sums, counts, quads = np.zeros((np.prod(shape - 1), 3)), np.zeros((np.prod(shape - 1), 1)), []
    for axis in range(3):
        u, v, along = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3, axis]]
        low, high = (np.moveaxis(np.moveaxis(grid.values, axis, 0)[part], 0, axis) for part in (np.s_[:-1], np.s_[1:]))
        at = np.argwhere((low < 0) != (high < 0))
        at = at[(((at > 0) & (at < shape - 1)) | (along > 0)).all(axis=1)]
        a, b = low[tuple(at.T)], high[tuple(at.T)]
        crossing = at + along * (a / (a - b))[:, None]
        around = [np.ravel_multi_index(cell.T, shape - 1) for cell in (at - u - v, at - v, at, at - u)]
        for cell in around:
            np.add.at(sums, cell, crossing)
            np.add.at(counts, cell, 1)
        quad = np.stack(around, -1)
        quads.append(np.where((a < 0)[:, None], quad, quad[:, ::-1]))
    used, quads = np.unique(np.concatenate(quads), return_inverse=True)
    vertices = sums[used] / counts[used] * grid.step + grid.origin
    return vertices, split_quads(vertices, quads.reshape(-1, 4))


def split_quads(vertices: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Triangles ``(2 Q, 3)`` of quads ``(Q, 4)``, split along the shorter diagonal."""
    a, b, c, d = quads.T
    short = np.linalg.norm(vertices[a] - vertices[c], axis=1) <= np.linalg.norm(vertices[b] - vertices[d], axis=1)
    first = np.where(short[:, None], np.stack([a, b, c], 1), np.stack([a, b, d], 1))
    second = np.where(short[:, None], np.stack([a, c, d], 1), np.stack([b, c, d], 1))
    return np.concatenate([first, second])


def mesh_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Undirected edges ``(E, 2)`` and how many faces have each ``(E,)``."""
    return np.unique(face_sides(faces), axis=0, return_counts=True)


def face_sides(faces: np.ndarray) -> np.ndarray:
    """The sides of faces, smaller index first: ``(3 F, 2)``, the first three of the first face."""
    return np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)


def clip(vertices: np.ndarray, faces: np.ndarray, signed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The part of a mesh where a value ``(V,)`` of its vertices is negative, cut along its zero level.

    Vertices near the cut move onto it first, so that no sliver is left along the new boundary.
    """
    vertices, signed = vertices.copy(), signed.astype(float).copy()
    edges, _ = mesh_edges(faces)
    crossing = edges[(signed[edges[:, 0]] < 0) != (signed[edges[:, 1]] < 0)]
    both = np.concatenate([crossing, crossing[:, ::-1]])
    share = signed[both[:, 0]] / (signed[both[:, 0]] - signed[both[:, 1]])
    order = np.argsort(share, kind="stable")
    movers, first = np.unique(both[order, 0], return_index=True)
    nearest = order[first]
    near = share[nearest] < SNAP
    movers, nearest = movers[near], nearest[near]
    vertices[movers] += share[nearest, None] * (vertices[both[nearest, 1]] - vertices[movers])
    signed[movers] = 0.0

    sides = np.sign(signed)[faces]
    keep = faces[(sides <= 0).all(1) & (sides < 0).any(1)]
    cut = faces[(sides < 0).any(1) & (sides > 0).any(1)]
    new_faces, ids, points = [], {}, []

    def middle(i: int, j: int) -> int:
        key = (min(i, j), max(i, j))
        if key not in ids:
            ids[key] = len(vertices) + len(points)
            t = signed[i] / (signed[i] - signed[j])
            points.append(vertices[i] + t * (vertices[j] - vertices[i]))
        return ids[key]

    for face in cut:
        polygon = []
        for i, j in zip(face, np.roll(face, -1)):
            if signed[i] <= 0:
                polygon.append(int(i))
            if signed[i] * signed[j] < 0:
                polygon.append(middle(int(i), int(j)))
        new_faces += [[polygon[0], polygon[k], polygon[k + 1]] for k in range(1, len(polygon) - 1)]
    faces = np.concatenate([keep, np.array(new_faces, dtype=int).reshape(-1, 3)])
    return compact(np.concatenate([vertices, np.array(points).reshape(-1, 3)]), faces)


def compact(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same mesh without unused vertices."""
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def largest_component(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The connected piece of a mesh with most vertices."""
    labels = trimesh.graph.connected_component_labels(mesh_edges(faces)[0], len(vertices))
    return compact(vertices, faces[labels[faces[:, 0]] == np.bincount(labels).argmax()])


def drop_ears(faces: np.ndarray) -> np.ndarray:
    """Faces without those that hang on the mesh by a single edge or a single corner."""
    while True:
        _, ids, counts = np.unique(face_sides(faces), axis=0, return_inverse=True, return_counts=True)
        ears = (counts[ids].reshape(-1, 3) == 1).sum(1) >= 2
        if not ears.any():
            return faces
        faces = faces[~ears]


def collapse_short_edges(vertices: np.ndarray, faces: np.ndarray, shortest: float) -> tuple[np.ndarray, np.ndarray]:
    """Merges the ends of edges shorter than a length, farthest-apart ones at a time, and drops what closes up."""
    vertices = vertices.copy()
    while True:
        edges, counts = mesh_edges(faces)
        lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        rim = np.isin(np.arange(len(vertices)), edges[counts == 1])
        bridge = (counts > 1) & rim[edges].all(axis=1)  # merging these would pinch the rim
        short = np.flatnonzero((lengths < shortest) & ~bridge)
        if not len(short):
            return compact(vertices, faces)
        both = np.concatenate([edges, edges[:, ::-1]])
        neighbours = sparse.csr_matrix((np.ones(len(both)), both.T), shape=(len(vertices),) * 2)
        busy, target = np.zeros(len(vertices), bool), np.arange(len(vertices))
        for i, j in edges[short[np.argsort(lengths[short], kind="stable")]]:
            ring = neighbours[[i, j]].indices
            if busy[ring].any():
                continue
            busy[ring] = True
            keep, drop = (i, j) if rim[i] else (j, i)
            if rim[i] == rim[j]:
                vertices[keep] = (vertices[i] + vertices[j]) / 2
            target[drop] = keep
        faces = target[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        _, first, repeats = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
        faces = faces[np.sort(first[repeats == 1])]  # faces that fell onto each other vanish together


def flip_edges(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces after turning every edge whose opposite angles sum to more than a straight one (Delaunay)."""
    faces = faces.copy()
    for _ in range(20):
        sides = np.concatenate([faces[:, [0, 1, 2]], faces[:, [1, 2, 0]], faces[:, [2, 0, 1]]])
        owner = np.tile(np.arange(len(faces)), 3)
        keys = np.sort(sides[:, :2], axis=1)
        order = np.lexsort((keys[:, 1], keys[:, 0]))
        twin = (keys[order[1:]] == keys[order[:-1]]).all(axis=1)
        one, two = order[:-1][twin], order[1:][twin]
        (i, j, k), opposite = sides[one].T, sides[two, 2]

        def angle(at, a=i, b=j):
            u, v = vertices[a] - vertices[at], vertices[b] - vertices[at]
            return np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), (u * v).sum(axis=1))

        excess = angle(k) + angle(opposite) - np.pi
        known = {tuple(key) for key in keys.tolist()}
        busy, flipped = np.zeros(len(faces), bool), False
        for n in np.argsort(-excess, kind="stable")[: int((excess > 1e-3).sum())]:
            a, b = owner[one[n]], owner[two[n]]
            new = (int(min(k[n], opposite[n])), int(max(k[n], opposite[n])))
            if busy[a] or busy[b] or new in known:
                continue
            faces[a], faces[b] = (i[n], opposite[n], k[n]), (opposite[n], j[n], k[n])
            known.add(new)
            busy[a] = busy[b] = flipped = True
        if not flipped:
            break
    return faces


def smoothing_matrix(faces: np.ndarray, count: int) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Neighbour averages ``(V, V)``, of boundary vertices along the boundary only, and the boundary's mask ``(V,)``."""
    edges, counts = mesh_edges(faces)
    rim = np.isin(np.arange(count), edges[counts == 1])
    pairs = np.concatenate([edges, edges[:, ::-1]])
    pairs = pairs[~rim[pairs[:, 0]] | np.tile(counts == 1, 2)]
    matrix = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count)).tocsr()
    return sparse.diags(1 / np.maximum(matrix.sum(1).A1, 1)) @ matrix, rim


def relax(vertices: np.ndarray, faces: np.ndarray, grid: Grid, rounds: int = 15) -> np.ndarray:
    """Evens out triangles by averaging neighbours and going back to the level set after each round."""
    average, rim = smoothing_matrix(faces, len(vertices))
    for _ in range(rounds):
        vertices = grid.project(vertices + np.where(rim, 0.3, 0.5)[:, None] * (average @ vertices - vertices))
    return vertices
