"""What the cuts of a UV atlas do to predictions: jumps across them, and errors by the distance to the nearest one."""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from avatar.checks import AvatarError, check_shape
from avatar.geometry.surface import interpolate, sample_surface
from avatar.geometry.trees import build_tree
from avatar.geometry.uv import seam_edges
from avatar.records import PointCloud, Scan, SurfaceSamples, Template

SPACING = 1e-3  # metres between points that stand for a seam


@dataclass(frozen=True)
class EdgeSides:
    """The middles of some edges, each as a point of the triangle on either side: the same place on the body twice."""

    left: SurfaceSamples
    right: SurfaceSamples


def edge_sides(faces: Tensor, edges: Tensor) -> EdgeSides:
    """Both sides of mesh edges.

    Args:
        faces: ``(F, 3)``.
        edges: ``(E, 2)`` vertex ids, rising; those without two triangles (borders) are left out.
    """
    check_shape("faces", faces, "F 3")
    check_shape("edges", edges, "E 2")
    beside: dict[tuple[int, int], list[int]] = {tuple(edge): [] for edge in edges.tolist()}
    for face, corners in enumerate(faces.tolist()):
        for i in range(3):
            edge = tuple(sorted((corners[i], corners[i - 1])))
            if edge in beside:
                beside[edge].append(face)
    pairs = [(edge, found) for edge, found in beside.items() if len(found) == 2]
    ends = torch.tensor([edge for edge, _ in pairs], dtype=torch.long).reshape(-1, 2)
    sides = torch.tensor([found for _, found in pairs], dtype=torch.long).reshape(-1, 2)
    return EdgeSides(*(_middles(faces, ends, sides[:, side]) for side in (0, 1)))


def _middles(faces: Tensor, ends: Tensor, face_ids: Tensor) -> SurfaceSamples:
    """The middles of edges with ends ``(E, 2)`` as points of triangles ``(E,)``."""
    corners = faces[face_ids]
    on_edge = (corners[:, :, None] == ends[:, None]).any(dim=-1)
    return SurfaceSamples(corners, on_edge.float() / 2, face_ids)


def seam_distance(points: np.ndarray, vertices: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Distance ``(N,)`` of points ``(N, 3)`` on a body at rest to the nearest of its edges ``(E, 2)``, metres.

    Straight through space and to half a millimetre; near a seam that is the way along the surface.

    Raises:
        AvatarError: when there is no edge.
    """
    if not len(edges):
        raise AvatarError("edges: expected an atlas with seams, got one without any.")
    first, second = (np.asarray(vertices, np.float64)[edges[:, end]] for end in (0, 1))
    counts = np.ceil(np.linalg.norm(second - first, axis=1) / SPACING).astype(int) + 1
    which = np.repeat(np.arange(len(edges)), counts)
    places = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    shares = (places / np.maximum(counts[which] - 1, 1))[:, None]
    return build_tree(first[which] * (1 - shares) + second[which] * shares).query(points, workers=-1)[0]


@dataclass(frozen=True)
class PointErrors:
    """How far single predicted points are off a scan.

    ``distance (N,)`` metres to the tangent plane at the nearest scan point, which does not count the scan's spacing;
    ``angle (N,)`` degrees to its normal; ``clothed (N,)``, on a garment where the scan knows, else all true.
    """

    distance: np.ndarray
    angle: np.ndarray
    clothed: np.ndarray


def point_errors(cloud: PointCloud, scan: Scan) -> PointErrors:
    """The errors of predicted points against a scan of the same frame."""
    nearest = build_tree(scan.points).query(cloud.points, workers=-1)[1]
    normals = scan.normals[nearest].astype(np.float64)
    distance = np.abs(((cloud.points - scan.points[nearest]) * normals).sum(axis=1))
    clothed = np.ones(len(nearest), bool) if scan.labels is None else scan.labels[nearest] > 0
    return PointErrors(distance, angles_between(cloud.normals, normals), clothed)


def angles_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angles ``(N,)`` in degrees between unit vectors ``(N, 3)``; exact for small ones."""
    half = np.linalg.norm(first - second, axis=1) / 2
    return np.degrees(2 * np.arcsin(np.clip(half, 0, 1)))


LIMITS = (0.0, 0.01, 0.02, 0.03, 0.05, 0.1, 1.0)  # metres from the nearest seam; the first band is near one
BODY, SEAMS, OTHERS = "body", "seams", "other edges"
UNITS = {"distance": "m", "angle": "deg", "jump": "m", "normal_jump": "deg"}


@dataclass(frozen=True)
class SeamPlaces:
    """Places on a body where predictions are asked for.

    ``spread`` points with their seam ``distances (N,)``, metres; both sides of the atlas's ``seams`` and of as many
    ``others`` of the body's edges.
    """

    spread: SurfaceSamples
    distances: np.ndarray
    seams: EdgeSides
    others: EdgeSides

    @property
    def samples(self) -> SurfaceSamples:
        """All of them, in that order."""
        parts = [self.spread, self.seams.left, self.seams.right, self.others.left, self.others.right]
        return SurfaceSamples(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(SurfaceSamples)))


def seam_places(template: Template, points: int, seed: int) -> SeamPlaces:
    """The places of the seam test on a body; the seed draws the spread points and the other edges.

    Raises:
        AvatarError: for a body without UV coordinates.
    """
    if template.uv is None or template.uv_faces is None:
        raise AvatarError("template: expected a body with UV coordinates, to ask at their seams, got none.")
    generator = torch.Generator().manual_seed(seed)
    spread = sample_surface(template.vertices, template.faces, points, generator)
    cuts = seam_edges(template.faces, template.uv_faces)
    every = torch.cat([template.faces[:, [i, (i + 1) % 3]] for i in range(3)]).sort(dim=1).values.unique(dim=0)
    both, counts = torch.cat([every, cuts]).unique(dim=0, return_counts=True)
    plain = both[counts == 1]
    plain = plain[torch.randperm(len(plain), generator=generator)[: len(cuts)]]
    distances = seam_distance(interpolate(template.vertices, spread).numpy(), template.vertices.numpy(), cuts.numpy())
    return SeamPlaces(spread, distances, edge_sides(template.faces, cuts), edge_sides(template.faces, plain))


@dataclass(frozen=True)
class SeamKey:
    """A metric where it is taken: on the body at seam distances in ``[low, high)`` metres, or at edges."""

    metric: str
    where: str
    low: float = 0.0
    high: float = 0.0


@dataclass(frozen=True)
class FrameMean:
    """A metric's mean over some points of one frame, NaN without any, and their count."""

    mean: float
    points: int


def measure_seams(cloud: PointCloud, scan: Scan, places: SeamPlaces) -> dict[SeamKey, FrameMean]:
    """Errors by seam distance, and jumps at seams and other edges, of one frame predicted at the places.

    Only predictions that end on cloth count, where the scan knows what is.
    """
    count, seams, others = len(places.distances), len(places.seams.left.face_ids), len(places.others.left.face_ids)
    if len(cloud.points) != count + 2 * (seams + others):
        raise AvatarError(f"cloud: expected a point for each place, got {len(cloud.points)}.")
    errors, found = point_errors(cloud, scan), {}
    bands = np.digitize(places.distances, LIMITS) - 1
    for band, (low, high) in enumerate(pairwise(LIMITS)):
        mine = (bands == band) & errors.clothed[:count]
        found[SeamKey("distance", BODY, low, high)] = _mean_of(errors.distance[:count][mine])
        found[SeamKey("angle", BODY, low, high)] = _mean_of(errors.angle[:count][mine])
    for where, start, size in ((SEAMS, count, seams), (OTHERS, count + 2 * seams, others)):
        left, right = slice(start, start + size), slice(start + size, start + 2 * size)
        clothed = errors.clothed[left]
        jumps = np.linalg.norm(cloud.points[left] - cloud.points[right], axis=1)
        found[SeamKey("jump", where)] = _mean_of(jumps[clothed])
        turns = angles_between(cloud.normals[left], cloud.normals[right])
        found[SeamKey("normal_jump", where)] = _mean_of(turns[clothed])
    return found


def _mean_of(values: np.ndarray) -> FrameMean:
    return FrameMean(float(values.mean()) if len(values) else float("nan"), len(values))
