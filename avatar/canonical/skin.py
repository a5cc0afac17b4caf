"""Bare skin: where scans lie on the body that was fitted to them, found by a vote of the scans vertex by vertex.

Compared in the pose of each scan: there a scan of bare skin lies on the body within the scanner's noise and the fit's
error, and what unposing adds (at elbows, knees and armpits) is not in the comparison.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatar.checks import AvatarError, check_shape
from avatar.geometry.laplacians import mesh_parts, smooth_votes, vertex_areas
from avatar.geometry.trees import build_tree
from avatar.records import Template

NEAR = 0.015  # metres around a body vertex in which a scan is compared with it
CANDIDATES = 6  # scan points tried for each vertex
AGREE = 0.5  # cosine between normals of one and the same surface, at least: 60 degrees
COVER_AGREE = 0.2  # the same for cloth and the skin far below it
MAJORITY = 24  # points around a scan's point, itself counted, that decide whether it is garment
NOISE_FACTOR = 3.0  # standard deviations within which an offset counts as noise
BARE_PARTS = ("head", "wrist", "hand")  # joints of what is bare on most people
QUANTILE, QUANTILE_SIGMAS = 0.8, 1.2816  # of absolute offsets, and its place in standard deviations of a normal one
FEWEST = 20  # vertices of a part that make it worth asking
FINEST = 1e-4  # metres; no scan is more exact than that
NOISE_SHARE = 0.1  # of the vertices, those that lie closest, where a body's joints have no such names


def body_offsets(
    points: np.ndarray, normals: np.ndarray, vertices: np.ndarray, vertex_normals: np.ndarray
) -> np.ndarray:
    """How far outside the body a scan lies at each body vertex, ``(V,)`` metres; NaN where it does not show.

    Near vertices: the median over the scan points around of the distance along both normals' mean, which is exact on
    a sphere and so not biased where the body is round. Other vertices that scan points are nearest to (of all body
    vertices), seen from them through the cloth: the median distance to those points. Scan ``points (M, 3)`` and body
    ``vertices (V, 3)`` in one pose, metres, with unit normals.
    """
    check_shape("normals", normals, "M 3", **check_shape("points", points, "M 3"))
    check_shape("vertex_normals", vertex_normals, "V 3", **check_shape("vertices", vertices, "V 3"))
    count = min(CANDIDATES, len(points))
    distances, ids = build_tree(points).query(vertices, k=np.arange(1, count + 1), distance_upper_bound=NEAR)
    found = np.isfinite(distances)
    ids = np.where(found, ids, 0)
    found &= np.einsum("vkc,vc->vk", normals[ids], vertex_normals) > AGREE
    middle = normals[ids] + vertex_normals[:, None]
    middle /= np.maximum(np.linalg.norm(middle, axis=2, keepdims=True), 1e-6)
    across = np.einsum("vkc,vkc->vk", points[ids] - vertices[:, None], middle)
    offsets = _row_medians(np.where(found, across, np.nan))
    distances, owner = build_tree(vertices).query(points)
    covering = np.isnan(offsets[owner]) & (distances > NEAR)
    covering &= np.einsum("mc,mc->m", normals, vertex_normals[owner]) > COVER_AGREE
    order = np.lexsort((distances[covering], owner[covering]))
    owners, far = owner[covering][order], distances[covering][order]
    covered, first, number = np.unique(owners, return_index=True, return_counts=True)
    offsets[covered] = far[first + number // 2]
    return offsets


def _row_medians(values: np.ndarray) -> np.ndarray:
    """The median of each row without its NaN, ``(V, K)`` to ``(V,)``; NaN for a row of nothing else."""
    ordered = np.sort(values, axis=1)
    count = np.isfinite(values).sum(axis=1)
    middle = np.maximum(count - 1, 0) // 2
    return np.where(count > 0, ordered[np.arange(len(values)), middle], np.nan)


@dataclass(frozen=True)
class SkinVote:
    """Which body vertices are ``bare (V,)``, bool, and what share of the scans shows each or its cover, ``seen (V,)``.

    Standard deviations on bare skin, metres: ``noise`` of one scan's offset, ``spread`` of the median over scans.
    """

    bare: np.ndarray
    seen: np.ndarray
    noise: float
    spread: float


def bare_parts(template: Template) -> list[np.ndarray]:
    """Vertices ``(V,)`` bool of head, left and right hand by the names of the joints; none for other names."""
    weights, sides = template.weights.numpy(), {}
    for joint, name in enumerate(template.joint_names):
        if any(part in name for part in BARE_PARTS):
            sides.setdefault(name.partition("_")[0], []).append(joint)
    return [weights[:, joints].sum(axis=1) > 0.5 for joints in sides.values()]


def estimate_noise(offsets: np.ndarray, template: Template) -> float:
    """Standard deviation of offsets ``(S, V)`` on bare skin, metres: of the barest of head, left and right hand.

    From a quantile of the absolute offsets, so that hair, a cuff or a beard on a fifth of the part do not count. For a
    body whose joints have other names, from the tenth of the vertices that lie closest to their scans. Raises
    `AvatarError` when no scan shows any vertex of the body.
    """
    check_shape("offsets", offsets, "S V", V=len(template.vertices))
    sizes = np.abs(offsets)
    seen = np.isfinite(sizes).any(axis=0)
    if not seen.any():
        raise AvatarError(
            "scans: expected them to lie around the body, none comes near any vertex. "
            "Hint: check that scans and body have one unit and one origin."
        )
    parts = [part & seen for part in bare_parts(template) if (part & seen).sum() >= FEWEST]
    if not parts:
        typical = np.nanmedian(sizes[:, seen], axis=0)
        chosen = np.argsort(typical)[: max(1, int(NOISE_SHARE * seen.sum()))]
        parts = [np.flatnonzero(seen)[chosen]]
    return min(float(np.nanquantile(sizes[:, part], QUANTILE)) for part in parts) / QUANTILE_SIGMAS


def vote_skin(offsets: np.ndarray, template: Template, length: float, smallest: float) -> SkinVote:
    """Bare skin by the vote of all scans' ``offsets (S, V)`` from `body_offsets`, smoothed over the body.

    A vertex votes bare where the median of its offsets over the scans is within three standard deviations of what such
    medians are on head and hands. Votes are smoothed over ``length`` metres of the body (`smooth_votes`), so that
    vertices that no scan shows (eyelids, armpits, between fingers) go with those around them and borders are clean;
    then islands below ``smallest`` square metres take their surroundings' label. Raises `AvatarError` when no scan
    shows any vertex of the body.
    """
    noise = estimate_noise(offsets, template)
    shown = np.isfinite(offsets)
    seen = shown.mean(axis=0)
    median = _row_medians(offsets.T)
    spread = max(estimate_noise(median[None], template), FINEST)
    votes = (np.abs(np.nan_to_num(median, nan=np.inf)) <= NOISE_FACTOR * spread).astype(np.float64)
    vertices, faces = template.vertices.numpy(), template.faces.numpy()
    share = smooth_votes(vertices, faces, votes, seen, length)
    share = np.where(np.isnan(share), 1.0, share)  # parts that no scan shows (eyeballs, teeth) are the body's
    bare = without_islands(faces, share > 0.5, vertex_areas(vertices, faces), smallest)
    return SkinVote(bare, seen, noise, spread)


def without_islands(faces: np.ndarray, labels: np.ndarray, areas: np.ndarray, smallest: float) -> np.ndarray:
    """Labels ``(V,)`` bool whose connected islands below an area take the other label; the largest of each stays.
    ``areas (V,)`` and ``smallest`` are square metres.
    """
    labels = labels.copy()
    for value in (False, True):
        inside = labels == value
        part = mesh_parts(faces[inside[faces].all(axis=1)], len(labels))
        sizes = np.bincount(part[inside], areas[inside], minlength=part.max() + 1)
        if inside.any():
            small = inside & (sizes[part] < min(smallest, sizes.max()))
            labels[small] = not value
    return labels


def label_points(
    points: np.ndarray, normals: np.ndarray, vertices: np.ndarray, vertex_normals: np.ndarray, vote: SkinVote
) -> np.ndarray:
    """Which points ``(M,)`` of a posed scan are garment: those that do not lie on bare skin within three standard
    deviations of one scan's noise, by the majority of the points around each. Arguments as for `body_offsets`.
    """
    _, owner = build_tree(vertices).query(points)
    middle = normals + vertex_normals[owner]
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-6)
    across = np.einsum("mc,mc->m", points - vertices[owner], middle)
    tolerance = NOISE_FACTOR * max(vote.noise, vote.spread)
    near = np.linalg.norm(points - vertices[owner], axis=1) < max(2 * NEAR, 2 * tolerance)
    garment = ~(vote.bare[owner] & near & (np.abs(across) <= tolerance))
    _, ids = build_tree(points).query(points, k=min(MAJORITY, len(points)))
    return garment[ids.reshape(len(points), -1)].mean(axis=1) > 0.5
