"""What the cuts of a UV atlas do to predictions: jumps across them, and errors by the distance to the nearest one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from avatar.checks import AvatarError, check_shape, unknown_name
from avatar.evaluation.aggregate import Interval, bootstrap_mean, named
from avatar.evaluation.scores import csv_text
from avatar.evaluation.scoring import Label
from avatar.evaluation.tables import Table, TableRow, interval_row
from avatar.geometry.surface import interpolate, sample_surface
from avatar.geometry.trees import build_tree
from avatar.geometry.uv import seam_edges
from avatar.records import PointCloud, Scan, SurfaceSamples, Template

SPACING = 1e-3  # metres between points that stand for a seam
LIMITS = (0.0, 0.01, 0.02, 0.03, 0.05, 0.1, 1.0)  # metres from the nearest seam; the first band is near one
BODY, SEAMS, OTHERS = "body", "seams", "other edges"
UNITS = {"distance": "m", "angle": "deg", "jump": "m", "normal_jump": "deg"}
SHOWN = {"m": ("mm", 1000.0), "deg": ("°", 1.0)}  # unit: that of tables, and how many of it
COLUMNS = ("table", "dataset", "outfit", "method", "variant", "seed", "steps", "metric", "where", "low", "high")
COLUMNS += ("value", "unit", "points", "frames", "commit")
NOTES = (
    "Predictions at the same places of the body for all methods; only those that end on cloth, where scans know it.",
    "distance: mean distance of predicted points to the tangent plane at the nearest scan point, by how far their "
    "place on the body at rest is from the nearest seam of the UV atlas. angle: the same for normals.",
    "jump: mean distance between two predictions for one place, the middle of an edge, as a point of the triangle on "
    "either side. normal jump: the same for normals. Other edges are drawn at random, as many as there are seams.",
)


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
    around = torch.stack([faces, faces.roll(-1, dims=1)], dim=2).sort(dim=2).values.reshape(-1, 2)
    size = int(faces.max()) + 1
    keys, order = (around[:, 0] * size + around[:, 1]).sort(stable=True)
    wanted = edges[:, 0] * size + edges[:, 1]
    first, last = torch.searchsorted(keys, wanted), torch.searchsorted(keys, wanted, right=True)
    ends, first = edges[last - first == 2], first[last - first == 2]
    sides = []
    for face_ids in (order[first] // 3, order[first + 1] // 3):
        corners = faces[face_ids]
        on_edge = (corners[:, :, None] == ends[:, None]).any(dim=-1)
        sides.append(SurfaceSamples(corners, on_edge.float() / 2, face_ids))
    return EdgeSides(*sides)


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

    @property
    def label(self) -> str:
        """The row of a table, with its unit."""
        place = f" at {self.where}"
        if self.where == BODY:
            over = self.high >= LIMITS[-1]
            place = f", over {100 * self.low:g} cm" if over else f", {100 * self.low:g} to {100 * self.high:g} cm"
        return f"{self.metric.replace('_', ' ')}{place} ({SHOWN[UNITS[self.metric]][0]})"

    @property
    def scale(self) -> float:
        """What means are shown times."""
        return SHOWN[UNITS[self.metric]][1]


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
    errors, values = point_errors(cloud, scan), {}
    bands = np.digitize(places.distances, LIMITS) - 1
    for band, (low, high) in enumerate(pairwise(LIMITS)):
        mine = (bands == band) & errors.clothed[:count]
        values[SeamKey("distance", BODY, low, high)] = errors.distance[:count][mine]
        values[SeamKey("angle", BODY, low, high)] = errors.angle[:count][mine]
    for where, start, size in ((SEAMS, count, seams), (OTHERS, count + 2 * seams, others)):
        left, right = slice(start, start + size), slice(start + size, start + 2 * size)
        clothed = errors.clothed[left]
        jumps = np.linalg.norm(cloud.points[left] - cloud.points[right], axis=1)
        values[SeamKey("jump", where)] = jumps[clothed]
        values[SeamKey("normal_jump", where)] = angles_between(cloud.normals[left], cloud.normals[right])[clothed]
    return {key: FrameMean(float(v.mean()) if len(v) else float("nan"), len(v)) for key, v in values.items()}


def pooled(means: Iterable[FrameMean]) -> FrameMean:
    """The mean over the points of several frames or bands."""
    means = [mean for mean in means if mean.points]
    points, total = sum(mean.points for mean in means), sum(mean.mean * mean.points for mean in means)
    return FrameMean(total / points if points else float("nan"), points)


@dataclass(frozen=True)
class SeamTest:
    """One run's seam test on one outfit, frame by frame, in the same order for all runs."""

    label: Label
    dataset: str
    outfit: str
    frames: tuple[dict[SeamKey, FrameMean], ...]

    @property
    def name(self) -> str:
        """The run in tables."""
        return name_of(self.label)

    def mean(self, key: SeamKey) -> FrameMean:
        """A metric over the points of all frames."""
        return pooled(frame[key] for frame in self.frames)


def name_of(label: Label) -> str:
    """A run in tables."""
    return named(label.method, label.variant, f"seed {label.seed}" if label.seed else "")


def check_baseline(names: Sequence[str], baseline: str) -> None:
    """Refuses a baseline that is none of the runs in a table.

    Raises:
        AvatarError: naming those there are.
    """
    if baseline not in names:
        raise unknown_name("baseline", baseline, names)


def seams_csv(tests: Sequence[SeamTest]) -> str:
    """Every mean as a tidy row, in metres and degrees; distances from seams in metres."""
    rows = []
    for test in tests:
        shared = asdict(test.label) | {"dataset": test.dataset, "outfit": test.outfit, "frames": len(test.frames)}
        for key in test.frames[0]:
            mean = test.mean(key)
            row = shared | asdict(key) | {"value": mean.mean, "points": mean.points, "unit": UNITS[key.metric]}
            rows.append([row[column] for column in COLUMNS])
    return csv_text(COLUMNS, rows)


def seam_table(tests: Sequence[SeamTest]) -> Table:
    """One outfit's tests: metrics by distance to the seam, and jumps, down; runs across."""
    body = []
    for key in tests[0].frames[0]:
        values = [test.mean(key).mean * key.scale for test in tests]
        body.append(TableRow(key.label, tuple(v if np.isfinite(v) else None for v in values)))
    return Table(f"{tests[0].outfit}: seams", "where", tuple(test.name for test in tests), tuple(body), NOTES)


def seam_differences(tests: Sequence[SeamTest], baseline: str, confidence: float = 0.95) -> Table:
    """One outfit's tests less a baseline's at the same places, near seams and far, with intervals over frames.

    Raises:
        AvatarError: when no run has the baseline's name.
    """
    names = [test.name for test in tests]
    check_baseline(names, baseline)
    base, others = tests[names.index(baseline)], [test for test in tests if test.name != baseline]
    body, near = [], f"{100 * LIMITS[1]:g} cm"
    for metric in ("distance", "angle"):
        keys = [key for key in base.frames[0] if (key.metric, key.where) == (metric, BODY)]
        for where, mine in ((f"nearer than {near}", keys[:1]), (f"farther than {near}", keys[1:])):
            intervals = [_paired(test, base, mine, confidence) for test in others]
            label = f"{metric}, {where} ({SHOWN[UNITS[metric]][0]})"
            body.append(interval_row(label, intervals, keys[0].scale))
    note = f"Differences to {baseline} with {100 * confidence:g}% intervals: percentile bootstrap over frames, paired."
    return Table(f"{base.outfit}: seams, difference", "where", tuple(t.name for t in others), tuple(body), (note,))


def _paired(test: SeamTest, base: SeamTest, keys: Sequence[SeamKey], confidence: float) -> Interval:
    """The mean over frames of what two runs differ by, over the points of some bands."""
    values = [[pooled(frame[key] for key in keys).mean for frame in each.frames] for each in (test, base)]
    differences = np.subtract(*values)
    return bootstrap_mean([differences[np.isfinite(differences)]], confidence=confidence)
