"""`seams`: how runs predict near the cuts of the body's UV atlas: jumps across them, and errors by distance to them.

POP's features jump there and a surface's do not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from avatar.checks import AvatarError, check_name, check_shape, unknown_name
from avatar.data.outfits import Outfit
from avatar.environment import prepared_process
from avatar.evaluation.aggregate import Interval, bootstrap_mean, grouped, named
from avatar.evaluation.scores import csv_text
from avatar.evaluation.scoring import Label
from avatar.evaluation.tables import Table, TableRow, interval_row, to_markdown
from avatar.geometry.surface import interpolate, sample_surface
from avatar.geometry.trees import build_tree
from avatar.geometry.uv import seam_edges
from avatar.io.npz import write_whole
from avatar.methods.base import TrainedAvatar
from avatar.pipeline.scores import label_of, run_outfits
from avatar.pipeline.surfaces import spaced_frames
from avatar.progress import tracked
from avatar.records import PointCloud, Scan, SurfaceSamples, Template
from avatar.runs.training import load_avatar

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


@dataclass
class SeamsConfig:
    """The seam test of some runs; point methods only, for what is asked is at chosen places of the body."""

    runs: tuple[Path, ...] = ()
    table: str = "seams"  # the name of the table's files
    baseline: str = ""  # the run, as the table names it, that others are set against; empty for none
    split: str = "test"
    points: int = 20000  # places on the body, the same for all runs of an outfit
    frames: int | None = None  # this many of the split, evenly spaced; all of them if null
    seed: int = 0
    data_root: Path | None = None  # where the data are now; where they were at training if null
    out: Path = Path("runs/tables")  # where the table's files go

    def __post_init__(self):
        check_name("table", self.table)
        if self.points < 1 or (self.frames is not None and self.frames < 1):
            raise AvatarError(f"points, frames: expected at least 1, got {self.points} and {self.frames}.")


class EdgeSides(NamedTuple):
    """The middles of some edges, each as a point of the triangle on either side: the same place on the body twice."""

    left: SurfaceSamples
    right: SurfaceSamples


class PointErrors(NamedTuple):
    """How far single predicted points are off a scan.

    ``distance (N,)`` metres to the tangent plane at the nearest scan point, which does not count the scan's spacing;
    ``angle (N,)`` degrees to its normal; ``clothed (N,)``, on a garment where the scan knows, else all true.
    """

    distance: np.ndarray
    angle: np.ndarray
    clothed: np.ndarray


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
        parts = [self.spread, *self.seams, *self.others]
        return SurfaceSamples(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(SurfaceSamples)))


class SeamKey(NamedTuple):
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


class FrameMean(NamedTuple):
    """A metric's mean over some points of one frame, NaN without any, and their count."""

    mean: float
    points: int


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


@prepared_process()
def seams(config: SeamsConfig) -> Path:
    """Writes ``<out>/<table>.csv`` and ``<table>.md``, which it prints; gives the path of the latter.

    Refuses before anything is measured: no runs, implicit ones, a baseline that is none of them; and bodies without UV
    coordinates.
    """
    asked, every, tables = runs_by_outfit(config), [], []
    for mine in asked if config.baseline else ():
        check_baseline([name_of(label_of(avatar)) for avatar, _ in mine], config.baseline)
    for mine in asked:
        places = seam_places(mine[0][1].template, config.points, config.seed)
        tests = [probe_seams(config, avatar, outfit, places) for avatar, outfit in mine]
        tables += [seam_table(tests), *([seam_differences(tests, config.baseline)] if config.baseline else [])]
        every += tests
    text = "\n".join(map(to_markdown, tables))
    write_whole(config.out / f"{config.table}.csv", seams_csv(every).encode())
    write_whole(config.out / f"{config.table}.md", text.encode())
    print(f"{text}\nwritten: {config.out / config.table}.*")
    return config.out / f"{config.table}.md"


def runs_by_outfit(config: SeamsConfig) -> list[list[tuple[TrainedAvatar, Outfit]]]:
    """The runs, loaded, of each outfit that they were trained on."""
    if not config.runs:
        raise AvatarError("runs: expected the folders of trained runs, got none.")
    found = []
    for run in config.runs:
        avatar = load_avatar(run)
        if not avatar.method.on_body:
            raise AvatarError(
                f"{run}: expected a method with points at chosen places of the body, got {avatar.method.name}. "
                "Hint: leave it out."
            )
        found += [(avatar, outfit) for outfit in run_outfits(avatar, config.data_root)]
    return list(grouped(found, lambda pair: (pair[1].dataset, pair[1].name)).values())


def probe_seams(config: SeamsConfig, avatar: TrainedAvatar, outfit: Outfit, places: SeamPlaces) -> SeamTest:
    """A run asked at places of an outfit's body, for the frames of a split."""
    names = spaced_frames(list(outfit.frames(config.split)), config.frames)
    frames = []
    for name in tracked(names, f"seams of {avatar.config.method.variant} on {outfit.name}"):
        frame = outfit.load(config.split, name)
        cloud = avatar.method.predict_at(avatar, outfit.name, frame.body, places.samples)
        frames.append(measure_seams(cloud, frame.scan, places))
    return SeamTest(label_of(avatar, table=config.table), outfit.dataset, outfit.name, tuple(frames))


def edge_sides(faces: Tensor, edges: Tensor) -> EdgeSides:
    """Both sides of edges ``(E, 2)``, rising vertex ids, of faces ``(F, 3)``; those on a border are left out."""
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
    """
    if not len(edges):
        raise AvatarError("edges: expected an atlas with seams, got one without any.")
    first, second = (np.asarray(vertices, np.float64)[edges[:, end]] for end in (0, 1))
    counts = np.ceil(np.linalg.norm(second - first, axis=1) / SPACING).astype(int) + 1
    which = np.repeat(np.arange(len(edges)), counts)
    places = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    shares = (places / np.maximum(counts[which] - 1, 1))[:, None]
    return build_tree(first[which] * (1 - shares) + second[which] * shares).query(points, workers=-1)[0]


def seam_places(template: Template, points: int, seed: int) -> SeamPlaces:
    """The places of the seam test on a body with UV coordinates; the seed draws the spread points and other edges."""
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


def name_of(label: Label) -> str:
    """A run in tables."""
    return named(label.method, label.variant, f"seed {label.seed}" if label.seed else "")


def check_baseline(names: Sequence[str], baseline: str) -> None:
    """Refuses a baseline that is none of the runs in a table."""
    if baseline not in names:
        raise unknown_name("baseline", baseline, names)


def seams_csv(tests: Sequence[SeamTest]) -> str:
    """Every mean as a tidy row, in metres and degrees; distances from seams in metres."""
    rows = []
    for test in tests:
        shared = asdict(test.label) | {"dataset": test.dataset, "outfit": test.outfit, "frames": len(test.frames)}
        for key in test.frames[0]:
            mean = test.mean(key)
            row = shared | key._asdict() | {"value": mean.mean, "points": mean.points, "unit": UNITS[key.metric]}
            rows.append([row[column] for column in COLUMNS])
    return csv_text(COLUMNS, rows)


def seam_table(tests: Sequence[SeamTest]) -> Table:
    """One outfit's tests: metrics by distance to the seam, and jumps, down; runs across."""
    body = []
    for key in tests[0].frames[0]:
        values = [test.mean(key).mean * SHOWN[UNITS[key.metric]][1] for test in tests]
        body.append(TableRow(key.label, tuple(v if np.isfinite(v) else None for v in values)))
    return Table(f"{tests[0].outfit}: seams", "where", tuple(test.name for test in tests), tuple(body), NOTES)


def seam_differences(tests: Sequence[SeamTest], baseline: str, confidence: float = 0.95) -> Table:
    """One outfit's tests less the baseline's at the same places, near seams and far, with intervals over frames."""
    names = [test.name for test in tests]
    check_baseline(names, baseline)
    base, others = tests[names.index(baseline)], [test for test in tests if test.name != baseline]

    def paired(test: SeamTest, keys: Sequence[SeamKey]) -> Interval:
        """The mean over frames of what a run and the baseline differ by, over the points of some bands."""
        values = [[pooled(frame[key] for key in keys).mean for frame in each.frames] for each in (test, base)]
        differences = np.subtract(*values)
        return bootstrap_mean([differences[np.isfinite(differences)]], confidence=confidence)

    body, near = [], f"{100 * LIMITS[1]:g} cm"
    for metric in ("distance", "angle"):
        unit, scale = SHOWN[UNITS[metric]]
        keys = [key for key in base.frames[0] if (key.metric, key.where) == (metric, BODY)]
        for where, mine in ((f"nearer than {near}", keys[:1]), (f"farther than {near}", keys[1:])):
            body.append(interval_row(f"{metric}, {where} ({unit})", [paired(test, mine) for test in others], scale))
    note = f"Differences to {baseline} with {100 * confidence:g}% intervals: percentile bootstrap over frames, paired."
    return Table(f"{base.outfit}: seams, difference", "where", tuple(t.name for t in others), tuple(body), (note,))
