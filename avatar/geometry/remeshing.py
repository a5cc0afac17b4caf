"""Even triangles: a surface cut along a level of a vertex value, and isotropic remeshing of surfaces with borders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from avatar.checks import AvatarError, check_faces, check_shape
from avatar.geometry.closest import closest_on_mesh
from avatar.geometry.laplacians import boundary_edges
from avatar.records import Mesh

LONG, SHORT = 4 / 3, 4 / 5  # of the wanted length: edges beyond are split and collapsed (Botsch and Kobbelt 2004)
ROUNDS = 30  # of collapses and of flips an iteration, at most; each takes a set of edges that do not touch
FLATTER = 0.3  # of the lower of two triangles' heights that a flip must leave
UPRIGHT = 0.2  # cosine between a triangle's normals before and after a change, at least
TAUBIN = (0.5, -0.53)  # factors of a smoothing and a widening step
NEAREST = 1e-3  # share of an edge that a cut keeps away from its ends


def used_vertices(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The indices ``(U,)`` of the vertices that faces use, and the faces over those alone."""
    used, corners = np.unique(faces, return_inverse=True)
    return used, corners.reshape(faces.shape)


def cut_at_level(vertices: np.ndarray, faces: np.ndarray, values: np.ndarray, level: float) -> Mesh:
    """The part of a surface where a vertex value is above a level; triangles across are cut along it, linearly.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
        values: ``(V,)``.
        level: where to cut.

    Returns:
        The part, with its border along the level; faces keep their sense. It may have no faces.
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


def isotropic_remesh(mesh: Mesh, edge: float, iterations: int = 6) -> Mesh:
    """The same surface with triangles of nearly one size and shape: edges about ``edge`` long.

    Incremental remeshing (Botsch and Kobbelt 2004): long edges are split, short ones collapsed, edges flipped towards
    six neighbours a vertex, vertices moved along the surface to the middle of their neighbours and back onto the
    surface given. Borders stay borders: their vertices move along them alone. All changes of one kind are made at once,
    on edges that do not touch, so the result does not depend on chance.

    Args:
        mesh: manifold, with or without borders; ``colors`` are not kept.
        edge: metres.
        iterations: rounds of all steps.

    Raises:
        AvatarError: for a length that is not positive, or faces that do not fit the vertices.
    """
    if edge <= 0:
        raise AvatarError(f"edge: expected a length above 0, got {edge}.")
    check_faces(mesh.faces, check_shape("vertices", mesh.vertices, "V 3")["V"])
    given = Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))
    vertices, faces = given.vertices, given.faces
    for iteration in range(iterations):
        vertices, faces = split_long(vertices, faces, LONG * edge)
        vertices, faces = collapse_short(vertices, faces, SHORT * edge, LONG * edge)
        faces = flip_edges(vertices, faces)
        vertices = relax(vertices, faces)
        if iteration == iterations - 1 or iteration % 2:
            vertices = closest_on_mesh(vertices, given.vertices, given.faces).points
    return Mesh(vertices, faces)


@dataclass(frozen=True)
class Edges:
    """Edges of a manifold: ``ends (E, 2)`` ascending, ``faces (E, 2)`` beside each (-1: none), ``across (E, 2)`` the
    corners of those faces off the edge, ``border (V,)`` bool vertices."""

    ends: np.ndarray
    faces: np.ndarray
    across: np.ndarray
    border: np.ndarray


def find_edges(faces: np.ndarray, count: int) -> Edges:
    """The edges of faces over ``count`` vertices; of an edge with more than two faces, the first two."""
    directed = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    opposite = np.roll(faces, -2, axis=1).reshape(-1)
    keys = directed.min(axis=1) * count + directed.max(axis=1)
    order = np.argsort(keys, kind="stable")
    unique, first, number = np.unique(keys[order], return_index=True, return_counts=True)
    one, other = order[first], order[np.minimum(first + 1, len(order) - 1)]
    double = number > 1
    ends = np.stack(np.divmod(unique, count), axis=1)
    border = np.zeros(count, bool)
    border[ends[~double]] = True
    return Edges(
        ends,
        np.stack([one // 3, np.where(double, other // 3, -1)], axis=1),
        np.stack([opposite[one], np.where(double, opposite[other], -1)], axis=1),
        border,
    )


CHILDREN = {  # number of split edges: triangles over corners 0 1 2 and the middles 3 4 5 of edges 01 12 20
    1: ((0, 3, 2), (3, 1, 2)),
    2: ((3, 1, 4), (0, 3, 4), (0, 4, 2)),
    3: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
}


def split_faces(faces: np.ndarray, middles: np.ndarray) -> np.ndarray:
    """Triangles split at the middles of their edges 01, 12, 20: ``(F, 3)`` vertex ids, -1 where an edge stays."""
    marked = middles >= 0
    count = marked.sum(axis=1)
    parts = [faces[count == 0]]
    for number, children in CHILDREN.items():
        some = count == number
        # turned so that the split edges come first
        first = np.where(number == 2, marked[some].argmin(axis=1) + 1, marked[some].argmax(axis=1))
        turn = (first[:, None] + np.arange(3)) % 3
        corners = np.take_along_axis(faces[some], turn, axis=1)
        between = np.take_along_axis(middles[some], turn, axis=1)
        parts.append(np.concatenate([corners, between], axis=1)[:, children].reshape(-1, 3))
    return np.concatenate(parts)


def split_long(vertices: np.ndarray, faces: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Halves every edge longer than ``longest`` until none is left; both triangles of an edge are split."""
    while True:
        edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1), axis=-1).reshape(-1, 2)
        keys, which = np.unique(edges[:, 0] * len(vertices) + edges[:, 1], return_inverse=True)
        start, end = np.divmod(keys, len(vertices))
        long = np.linalg.norm(vertices[start] - vertices[end], axis=1) > longest
        if not long.any():
            return vertices, faces
        middles = np.where(long, len(vertices) + np.cumsum(long) - 1, -1)
        faces = split_faces(faces, middles[which].reshape(-1, 3))
        vertices = np.concatenate([vertices, (vertices[start[long]] + vertices[end[long]]) / 2])


def _neighbours(edges: Edges, count: int) -> csr_matrix:
    """Which vertices an edge joins, symmetric ``(V, V)`` of ones."""
    start, end = edges.ends.T
    ones = np.ones(2 * len(start))
    return csr_matrix((ones, (np.concatenate([start, end]), np.concatenate([end, start]))), shape=(count, count))


def _spread_least(ranks: np.ndarray, edges: Edges) -> np.ndarray:
    """The least rank of a vertex and its neighbours, ``(V,)``."""
    least = ranks.copy()
    np.minimum.at(least, edges.ends[:, 0], ranks[edges.ends[:, 1]])
    np.minimum.at(least, edges.ends[:, 1], ranks[edges.ends[:, 0]])
    return least


def _face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _upright(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Whether normals (of any length) point the same way before and after; those of no length do not."""
    sizes = np.linalg.norm(before, axis=-1) * np.linalg.norm(after, axis=-1)
    return (before * after).sum(axis=-1) > UPRIGHT * np.maximum(sizes, 1e-30)


def collapse_short(
    vertices: np.ndarray, faces: np.ndarray, shortest: float, longest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Collapses edges shorter than ``shortest`` where that keeps the surface a manifold, makes no edge longer than
    ``longest`` and turns no triangle over; ends on a border stay there."""
    for _ in range(ROUNDS):
        edges = find_edges(faces, len(vertices))
        start, end = edges.ends.T
        lengths = np.linalg.norm(vertices[start] - vertices[end], axis=1)
        at_border = edges.faces[:, 1] < 0
        between_borders = edges.border[start] & edges.border[end] & ~at_border
        links = _neighbours(edges, len(vertices))
        common = np.asarray(links[start].multiply(links[end]).sum(axis=1)).reshape(-1)
        open_to = (lengths < shortest) & ~between_borders & (common == np.where(at_border, 1, 2))
        candidates = np.flatnonzero(open_to)
        while len(candidates):  # those refused make way for their neighbours
            chosen = _apart(candidates, lengths, edges, len(vertices))
            allowed = _collapsible(vertices, faces, edges, chosen, longest)
            if allowed.any():
                chosen = chosen[allowed]
                break
            candidates = np.setdiff1d(candidates, chosen)
        if not len(candidates):
            break
        keep, gone = edges.ends[chosen].T
        swapped = edges.border[gone] & ~edges.border[keep]
        keep, gone = np.where(swapped, gone, keep), np.where(swapped, keep, gone)
        one_sided = edges.border[keep] & ~edges.border[gone]
        vertices = vertices.copy()
        vertices[keep] = np.where(one_sided[:, None], vertices[keep], (vertices[keep] + vertices[gone]) / 2)
        renamed = np.arange(len(vertices))
        renamed[gone] = keep
        faces = renamed[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    used, faces = used_vertices(vertices, faces)
    return vertices[used], faces


def _apart(candidates: np.ndarray, order: np.ndarray, edges: Edges, count: int) -> np.ndarray:
    """Some of the candidate edges, the least in order first, no two of them with neighbours in common."""
    rank = np.full(len(order), len(order))
    rank[candidates[np.argsort(order[candidates], kind="stable")]] = np.arange(len(candidates))
    least = np.full(count, len(order))
    for column in range(2):
        np.minimum.at(least, edges.ends[candidates, column], rank[candidates])
    around = _spread_least(_spread_least(least, edges), edges)
    return candidates[(around[edges.ends[candidates]] == rank[candidates][:, None]).all(axis=1)]


def _collapsible(
    vertices: np.ndarray, faces: np.ndarray, edges: Edges, chosen: np.ndarray, longest: float
) -> np.ndarray:
    """Which of the chosen edges (no two of them near each other) may be collapsed."""
    first, second = edges.ends[chosen].T
    target = (vertices[first] + vertices[second]) / 2
    border = edges.border[[first, second]]
    target = np.where((border[0] & ~border[1])[:, None], vertices[first], target)
    target = np.where((border[1] & ~border[0])[:, None], vertices[second], target)
    owner = np.full(len(vertices), -1)
    owner[first] = owner[second] = np.arange(len(chosen))
    moved = vertices.copy()
    moved[first] = moved[second] = target
    owners = owner[faces]
    touched = owners.max(axis=1)
    staying = (touched >= 0) & ((owners >= 0).sum(axis=1) == 1)
    before, after = (_face_normals(places, faces[staying]) for places in (vertices, moved))
    corners = moved[faces[staying]]
    reach = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
    fine = _upright(before, after) & (reach <= longest)
    bad = np.zeros(len(chosen), bool)
    bad[touched[staying][~fine]] = True
    return ~bad


def flip_edges(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Flips edges wherever that brings the numbers of neighbours nearer to six (four on a border)."""
    for _ in range(ROUNDS):
        edges = find_edges(faces, len(vertices))
        valence = np.bincount(edges.ends.reshape(-1), minlength=len(vertices))
        excess = valence - np.where(edges.border, 4, 6)
        pairs = np.concatenate([edges.ends, edges.across], axis=1).T
        now = np.square(excess[pairs]).sum(axis=0)
        then = np.square(excess[pairs] + np.array([[-1], [-1], [1], [1]])).sum(axis=0)
        inner = np.flatnonzero((edges.faces[:, 1] >= 0) & (then < now))
        now, then, (c, d) = now[inner], then[inner], edges.across[inner].T
        # where c stands in the first face tells in which sense that face runs along the edge
        first = faces[edges.faces[inner, 0]]
        at = (first == c[:, None]).argmax(axis=1)
        a, b = first[np.arange(len(at)), (at + 1) % 3], first[np.arange(len(at)), (at + 2) % 3]
        before = np.stack([first, faces[edges.faces[inner, 1]]], axis=1)
        new = np.stack([np.stack([c, a, d], axis=1), np.stack([d, b, c], axis=1)], axis=1)
        old = _face_normals(vertices, before[:, 0]) + _face_normals(vertices, before[:, 1])
        keys = edges.ends[:, 0] * len(vertices) + edges.ends[:, 1]
        linked = np.isin(np.minimum(c, d) * len(vertices) + np.maximum(c, d), keys)
        if not len(inner):
            break
        good = ~linked & (c != d) & (np.minimum(valence[a], valence[b]) > 3)
        for side in range(2):
            good &= _upright(old, _face_normals(vertices, new[:, side]))
        good &= _shortest_height(vertices, new) > FLATTER * _shortest_height(vertices, before)
        candidates = np.flatnonzero(good)
        if not len(candidates):
            break
        rank = np.full(len(inner), len(inner))
        rank[candidates[np.argsort((then - now)[candidates], kind="stable")]] = np.arange(len(candidates))
        least = np.full(len(vertices), len(inner))
        corners = np.stack([a, b, c, d], axis=1)
        np.minimum.at(least, corners[candidates].reshape(-1), np.repeat(rank[candidates], 4))
        chosen = candidates[(least[corners[candidates]] == rank[candidates][:, None]).all(axis=1)]
        faces = faces.copy()
        faces[edges.faces[inner[chosen], 0]] = new[chosen, 0]
        faces[edges.faces[inner[chosen], 1]] = new[chosen, 1]
    return faces


def _shortest_height(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """The least height of some triangles ``(N, T, 3)`` side by side, ``(N,)``."""
    corners = vertices[triangles]
    sides = np.linalg.norm(corners - np.roll(corners, -1, axis=2), axis=3).max(axis=2)
    normals = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    return (np.linalg.norm(normals, axis=2) / np.maximum(sides, 1e-12)).min(axis=1)


def relax(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vertices moved along the surface to the middle of their neighbours; those on a border, along it.

    Tangential, so that the surface does not shrink; a border's ends that have not two border edges stay.
    """
    edges = find_edges(faces, len(vertices))
    links = _neighbours(edges, len(vertices))
    middle = links @ vertices / np.maximum(np.asarray(links.sum(axis=1)), 1)
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], _face_normals(vertices, faces))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    step = middle - vertices
    step -= np.einsum("vi,vi->v", step, normals)[:, None] * normals
    around = boundary_edges(faces)
    after, before = np.full((2, len(vertices)), -1)
    after[around[:, 0]] = around[:, 1]
    before[around[:, 1]] = around[:, 0]
    simple = np.bincount(around[:, 0], minlength=len(vertices)) == 1
    simple &= np.bincount(around[:, 1], minlength=len(vertices)) == 1
    along = vertices[after] - vertices[before]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-20)
    onward = (vertices[after] + vertices[before]) / 2 - vertices
    onward = np.einsum("vi,vi->v", onward, along)[:, None] * along
    step = np.where(edges.border[:, None], np.where(simple[:, None], onward, 0), step)
    return vertices + step


def smooth_borders(vertices: np.ndarray, faces: np.ndarray, rounds: int) -> np.ndarray:
    """Vertices whose borders are smoothed as curves, with little shrinking (Taubin 1995); all others stay.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
        rounds: pairs of a smoothing and a widening step; waves shorter than about ``4 sqrt(rounds)`` edges go.
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
