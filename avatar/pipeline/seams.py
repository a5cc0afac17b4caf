"""`seams`: how runs predict near the cuts of the body's UV atlas, where POP's features jump and a surface's do not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from avatar.checks import AvatarError, check_name, check_shape, unknown_name
from avatar.data.outfits import Outfit
from avatar.data.splits import spaced_frames
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
    """How far predicted points are off a scan, ``(N,)`` each: metres to the tangent plane at the nearest scan point, so
    that its spacing does not count, degrees to its normal, and whether that is on a garment, where the scan knows.
    """

    distance: np.ndarray
    angle: np.ndarray
    clothed: np.ndarray


@dataclass(frozen=True)
class SeamPlaces:
    """Places on a body where predictions are asked for: ``spread`` points with their seam ``distances (N,)``, metres,
    and both sides of the atlas's ``seams`` and of as many ``others`` of the body's edges.
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


KEYS = tuple(SeamKey(metric, BODY, *band) for band in pairwise(LIMITS) for metric in ("distance", "angle"))
KEYS += tuple(SeamKey(metric, where) for where in (SEAMS, OTHERS) for metric in ("jump", "normal_jump"))


class SeamTest(NamedTuple):
    """One run's seam test on one outfit: ``sums (F, K, 2)`` of `KEYS` and the points in them, frame by frame."""

    label: Label
    dataset: str
    outfit: str
    sums: np.ndarray


@prepared_process()
def seams(config: SeamsConfig) -> Path:
    """Writes ``<out>/<table>.csv`` and ``<table>.md``, which it prints; gives the path of the latter. Refuses before
    anything is measured: no runs, implicit ones, a baseline that is none of them.
    """
    asked, every, tables = runs_by_outfit(config), [], []
    for mine in asked if config.baseline else ():
        names = [name_of(label_of(avatar)) for avatar, _ in mine]
        if config.baseline not in names:
            raise unknown_name("baseline", config.baseline, names)
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
    names = spaced_frames(outfit.frames(config.split), config.frames)
    sums = []
    for name in tracked(names, f"seams of {avatar.config.method.variant} on {outfit.name}"):
        frame = outfit.load(config.split, name)
        cloud = avatar.method.predict_at(avatar, outfit.name, frame.body, places.samples)
        sums.append(measure_seams(cloud, frame.scan, places))
    return SeamTest(label_of(avatar, table=config.table), outfit.dataset, outfit.name, np.array(sums))


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
    """Distance ``(N,)`` of points ``(N, 3)`` on a body at rest to the nearest of its edges ``(E, 2)``, metres. Straight
    through space and to half a millimetre; near a seam that is the way along the surface.
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


def measure_seams(cloud: PointCloud, scan: Scan, places: SeamPlaces) -> np.ndarray:
    """Sums of the `KEYS` over the predictions that end on cloth, and their counts, ``(K, 2)``, of one frame."""
    count, seams, others = len(places.distances), len(places.seams.left.face_ids), len(places.others.left.face_ids)
    errors, bands, values = point_errors(cloud, scan), np.digitize(places.distances, LIMITS) - 1, []
    for band in range(len(LIMITS) - 1):
        mine = (bands == band) & errors.clothed[:count]
        values += [errors.distance[:count][mine], errors.angle[:count][mine]]
    for start, size in ((count, seams), (count + 2 * seams, others)):
        left, right = slice(start, start + size), slice(start + size, start + 2 * size)
        jumps = np.linalg.norm(cloud.points[left] - cloud.points[right], axis=1)
        turns = angles_between(cloud.normals[left], cloud.normals[right])
        values += [jumps[errors.clothed[left]], turns[errors.clothed[left]]]
    return np.array([(value.sum(), len(value)) for value in values])


def mean_of(sums: np.ndarray) -> float:
    """The mean over the points of several frames or keys, ``(..., 2)`` sums and counts; NaN without any."""
    total, points = sums.reshape(-1, 2).sum(axis=0)
    return float(total / points) if points else float("nan")


def name_of(label: Label) -> str:
    """A run in tables."""
    return named(label.method, label.variant, f"seed {label.seed}" if label.seed else "")


def seams_csv(tests: Sequence[SeamTest]) -> str:
    """Every mean as a tidy row, in metres and degrees; distances from seams in metres."""
    rows = []
    for test in tests:
        shared = asdict(test.label) | {"dataset": test.dataset, "outfit": test.outfit, "frames": len(test.sums)}
        for key, sums in zip(KEYS, test.sums.swapaxes(0, 1)):
            measured = {"value": mean_of(sums), "points": int(sums[:, 1].sum()), "unit": UNITS[key.metric]}
            row = shared | key._asdict() | measured
            rows.append([row[column] for column in COLUMNS])
    return csv_text(COLUMNS, rows)


def seam_table(tests: Sequence[SeamTest]) -> Table:
    """One outfit's tests: metrics by distance to the seam, and jumps, down; runs across."""
    body = []
    for place, key in enumerate(KEYS):
        values = [mean_of(test.sums[:, place]) * SHOWN[UNITS[key.metric]][1] for test in tests]
        body.append(TableRow(key.label, tuple(v if np.isfinite(v) else None for v in values)))
    names = tuple(name_of(test.label) for test in tests)
    return Table(f"{tests[0].outfit}: seams", "where", names, tuple(body), NOTES)


def seam_differences(tests: Sequence[SeamTest], baseline: str) -> Table:
    """One outfit's tests less the baseline's at the same places, near seams and far, with intervals over frames."""
    names = [name_of(test.label) for test in tests]
    base, others = tests[names.index(baseline)], [test for test, name in zip(tests, names) if name != baseline]
    columns = tuple(name for name in names if name != baseline)

    def paired(test: SeamTest, places: Sequence[int]) -> Interval:
        """The mean over frames of what a run and the baseline differ by, over the points of some bands."""
        values = [[mean_of(sums[places]) for sums in each.sums] for each in (test, base)]
        differences = np.subtract(*values)
        return bootstrap_mean([differences[np.isfinite(differences)]])

    body, near = [], f"{100 * LIMITS[1]:g} cm"
    for metric in ("distance", "angle"):
        unit, scale = SHOWN[UNITS[metric]]
        places = [place for place, key in enumerate(KEYS) if key.metric == metric]
        for where, mine in ((f"nearer than {near}", places[:1]), (f"farther than {near}", places[1:])):
            intervals = [paired(test, mine) for test in others]
            body.append(interval_row(f"{metric}, {where} ({unit})", intervals, scale))
    note = f"Differences to {baseline} with 95% intervals: percentile bootstrap over frames, paired."
    return Table(f"{base.outfit}: seams, difference", "where", columns, tuple(body), (note,))
