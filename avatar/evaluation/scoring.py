"""Scoring of predictions on disk, one PLY a frame, whoever made them, and of the floors every comparison stands on."""

from __future__ import annotations

import functools
import logging
import math
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from avatar.checks import AvatarError, DataError
from avatar.data.outfits import Outfit
from avatar.evaluation.metrics import METRIC_NAMES, Comparison, Metric, find_metrics
from avatar.evaluation.scores import FrameScore, Score, Scores
from avatar.geometry.surface import interpolate, sample_surface, vertex_normals
from avatar.io.ledger import Ledger, file_digest, keyed
from avatar.io.meshes import read_mesh
from avatar.io.points import read_points
from avatar.progress import tracked
from avatar.records import Frame, Mesh, PointCloud, Scan

log = logging.getLogger(__name__)

# What a score is made by: metrics, floors and the draw of points, and the readers of data sets. Not how tables and
# plots are made of scores, nor how what is scored was trained: that shows in the hash of the prediction's file.
SOURCE = ("avatar.evaluation.scoring", "avatar.data.layouts")
SIZE_RATIO = 5.0  # a prediction this many times larger or smaller than its scan is in other units


@dataclass
class ScoreConfig:
    """How predictions are scored: all against the same scan points, drawn by ``seed`` and the frame's name alone."""

    scan_points: int = 40_000  # scan points compared a frame; all of them where a scan has fewer
    metrics: list[str] = field(default_factory=lambda: list(METRIC_NAMES))
    seed: int = 0
    motion: bool = False  # frames follow each other in time and predictions keep point order: adds jitter

    def __post_init__(self):
        if self.scan_points < 1:
            raise AvatarError(f"scan_points: expected at least 1, got {self.scan_points}.")
        find_metrics(self.metrics)


@dataclass(frozen=True)
class Label:
    """Who made the predictions: the columns of a score that scoring cannot know."""

    method: str
    table: str = ""
    variant: str = ""
    seed: int = 0
    steps: int = 0
    seconds: float = 0.0
    commit: str = ""
    fraction: float = 1.0
    split: str = "test"


class Memory:
    """Values of one method on an outfit that were measured before, each metric of each frame for itself. ``ledger``
    keeps them (None: nothing is kept); ``what`` is the method in words. ``source`` are the modules that make the values
    (see `keyed`), ``made`` is what else they depend on; functions are asked for each frame by its name.
    """

    def __init__(
        self, ledger: Ledger | None, what: str, outfit: Any, split: str, source: tuple[str, ...] = SOURCE, **made: Any
    ):
        self.ledger, self.what = ledger, f"{what} {outfit.name} {split}"

        @functools.cache
        def made_of(name: str) -> str:
            parts = {key: value(name) if callable(value) else value for key, value in made.items()}
            scanner = vars(outfit.scanner) if hasattr(outfit, "scanner") else None
            return keyed(source, frame=outfit.digest(split, name), scanner=scanner, **parts)

        self.made_of = made_of  # the hash of all that a frame's values are made of

    def recall(self, frame: str, metrics: Iterable[str]) -> tuple[dict[str, float], int]:
        """The known values of a frame by metric, and its point count; nothing that was made of something else."""
        if self.ledger is None:
            return {}, 0
        key = self.made_of(frame)
        found = {metric: self.ledger.find(f"{self.what}/{frame}/{metric}", key) for metric in metrics}
        points = max((note["points"] for note in found.values() if note), default=0)
        return {metric: note["value"] for metric, note in found.items() if note}, points

    def note(self, frame: str, values: dict[str, float], points: int) -> None:
        """Writes a frame's values down."""
        if self.ledger is not None and values:
            notes = {f"{self.what}/{frame}/{metric}": {"value": v, "points": points} for metric, v in values.items()}
            self.ledger.record_notes(self.made_of(frame), notes)


class Contender(NamedTuple):
    """What is scored: its label, what metrics see of a frame (with its ``points (N, 3)``), and its memory."""

    label: Label
    compare: Callable[[Frame], Any]
    memory: Memory


def score_predictions(
    folder: str | Path,
    outfit: Outfit,
    split: str,
    config: ScoreConfig,
    label: Label,
    meshes: str | Path | None = None,
    ledger: Ledger | None = None,
) -> Scores:
    """Scores a folder of predictions, ``<frame>.ply`` with normals for every frame of a split of an outfit. ``meshes``
    is a folder of predicted meshes, ``.ply`` or ``.obj``, which s2m_cm and normal_consistency then measure instead of
    the points. Values that ``ledger`` keeps are not measured again. Raises `DataError` when frames have no prediction
    (naming them) or one is in other units than its scan, and `AvatarError` naming a frame that is not valid.
    """
    names = frame_names(outfit, split)
    clouds = find_predictions(Path(folder), names, (".ply",))
    surfaces = find_predictions(Path(meshes), names, (".ply", ".obj")) if meshes is not None else {}

    def compare(frame: Frame) -> Comparison:
        path = clouds[frame.name]
        prediction, scan = read_points(path), draw_scan(frame, config)
        sizes = [np.ptp(cloud.points, axis=0).max() for cloud in (prediction, scan)]
        ratio = sizes[0] / max(float(sizes[1]), 1e-12)
        if not 1 / SIZE_RATIO < ratio < SIZE_RATIO:
            expected = "expected a prediction about as large as its scan"
            raise DataError(path, f"{expected}, got {ratio:.3g} times its size.", "Use metres.")
        mesh = read_mesh(surfaces[frame.name]) if surfaces else None
        return Comparison(prediction, scan, posed_body(outfit, frame), mesh)

    def made_of(name: str) -> list[str]:
        return [file_digest(files[name]) for files in (clouds, surfaces) if files]

    memory = remember_points(ledger, "predictions", outfit, split, config, predicted=made_of)
    metrics = [metric for metric in find_metrics(config.metrics) if surfaces or not metric.needs_mesh]
    return score_frames(outfit, split, names, metrics, [Contender(label, compare, memory)], config.motion)


def measure_floors(
    outfit: Outfit, split: str, config: ScoreConfig, points: int, commit: str = "", ledger: Ledger | None = None
) -> Scores:
    """Scores floors as if they were predictions of so many ``points``, each frame for itself. ``sampling`` is a second
    sampling of the true surface: what a perfect surface scores. Outfits without ``resample`` are sampled from their
    scans' meshes (variant ``mesh``); where these are points there is no sampling floor, and a warning says so. ``body``
    are points spread area-uniformly over the posed bare body.
    """
    resample, config = getattr(outfit, "resample", None), replace(config, motion=False)
    names = frame_names(outfit, split)
    meshes = resample is None and have_meshes(outfit, split, names)

    def sampling(frame: Frame) -> Comparison:
        scan, seed = draw_scan(frame, config), config.seed + 1
        if meshes:
            again = sample_body(Mesh(frame.scan.points, frame.scan.faces), points, seed)
        else:
            sampled = resample(split, frame.name, points, seed=seed)
            again = PointCloud(sampled.points, sampled.normals)
            if (again.points[:10, None] == frame.scan.points).all(axis=2).any(axis=1).all():
                raise AvatarError("resample: expected another sampling of the surface, got the scan's own points.")
        return Comparison(again, scan, posed_body(outfit, frame))

    def bare(frame: Frame) -> Comparison:
        body = posed_body(outfit, frame)
        return Comparison(sample_body(body, points, config.seed), draw_scan(frame, config), body)

    floors = {"sampling": sampling} if meshes or resample else {}
    contenders = []
    for floor, compare in (floors | {"body": bare}).items():
        label = Label(floor, variant="mesh" if meshes and floor == "sampling" else "", commit=commit, split=split)
        memory = remember_points(ledger, floor, outfit, split, config, points=points)
        contenders.append(Contender(label, compare, memory))
    metrics = [metric for metric in find_metrics(config.metrics) if not metric.needs_mesh]
    return score_frames(outfit, split, names, metrics, contenders)


def have_meshes(outfit: Outfit, split: str, names: Sequence[str]) -> bool:
    """Whether the scans of all frames are meshes, so that their surface can be sampled again; a warning if not.

    Halves of a scan would give a floor that methods, which are compared with all of it, lie below.
    """
    without = next((name for name in names if outfit.load(split, name).scan.faces is None), None)
    if without is not None:
        reason = f"the scan of {without} has no scan_faces, so that its surface cannot be sampled again"
        log.warning("%s: there is no sampling floor, and no excess over it: %s.", outfit.name, reason)
    return without is None


def remember_points(
    ledger: Ledger | None, what: str, outfit: Any, split: str, config: ScoreConfig, **made: Any
) -> Memory:
    """The memory of scores of points; none for motion, whose frames depend on each other."""
    drawn = {"scan_points": config.scan_points, "seed": config.seed}
    return Memory(None if config.motion else ledger, what, outfit, split, **drawn, **made)


def posed_body(outfit: Outfit, frame: Frame) -> Mesh:
    """The bare body under a frame."""
    return Mesh(frame.body.vertices, np.asarray(outfit.template.faces))


def sample_body(body: Mesh, points: int, seed: int) -> PointCloud:
    """Points spread area-uniformly over a mesh, with interpolated vertex normals."""
    vertices = torch.from_numpy(np.asarray(body.vertices, np.float64))
    faces = torch.from_numpy(np.asarray(body.faces, np.int64))
    samples = sample_surface(vertices, faces, points, torch.Generator().manual_seed(seed))
    normals = torch.nn.functional.normalize(interpolate(vertex_normals(vertices, faces), samples), dim=-1)
    return PointCloud(interpolate(vertices, samples).numpy(), normals.numpy())


def draw_scan(frame: Frame, config: ScoreConfig) -> Scan:
    """The scan points a frame is scored against: a random subset, the same for every method."""
    if len(frame.scan.points) <= config.scan_points:
        return frame.scan
    chosen = np.sort(frame_generator(frame.name, config.seed).permutation(len(frame.scan.points))[: config.scan_points])
    return Scan(frame.scan.points[chosen], frame.scan.normals[chosen])


def frame_generator(name: str, seed: int) -> np.random.Generator:
    """Random state that depends on a frame's name and a seed, not on the frames before it."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def frame_names(outfit: Outfit, split: str) -> list[str]:
    """The names of a split's frames, in time."""

    def in_time(name: str) -> tuple[str, int, str]:
        sequence, _, number = name.rpartition(".")
        return sequence, int(number) if number.isdecimal() else 0, name

    return sorted(outfit.frames(split), key=in_time)


def find_predictions(folder: Path, names: Sequence[str], suffixes: tuple[str, ...] = (".ply",)) -> dict[str, Path]:
    """The file of every frame in a folder of predictions; missing ones are refused, files of no frame a warning."""
    if not folder.is_dir():
        raise DataError(folder, "there is no such folder of predictions.", "Run tools/predict.py first.")

    def some(names: Sequence[str]) -> str:
        return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")

    there = {path.name: path for path in sorted(folder.iterdir()) if path.suffix in suffixes}
    found = {name: there.pop(f"{name}{suffix}") for name in names for suffix in suffixes if f"{name}{suffix}" in there}
    if missing := [name for name in names if name not in found]:
        raise DataError(
            folder,
            f"{len(missing)} of {len(names)} frames have no prediction ({', '.join(suffixes)}): {some(missing)}.",
            "Predict them, or score the split that was predicted.",
        )
    if there:
        log.warning("%s: ignored %d files that belong to no frame: %s.", folder, len(there), some(list(there)))
    return found


def score_frames(
    outfit: Outfit,
    split: str,
    names: Sequence[str],
    metrics: Sequence[Metric],
    contenders: Sequence[Contender],
    motion: bool = False,
    partial: bool = False,
) -> Scores:
    """Every metric of every frame of some contenders, frame by frame, and their means. Values that a memory knows are
    not measured again; where they may be ``partial``, those that a frame does not have (not finite) are left out.
    Errors are passed on with the frame's name. ``motion`` measures metrics of sequences too.
    """
    frames: list[FrameScore] = []
    found: dict[Label, dict[str, list[float]]] = {c.label: {m.name: [] for m in metrics} for c in contenders}
    counts: dict[Label, list[int]] = {c.label: [] for c in contenders}
    window = []
    for name in tracked(names, f"score {', '.join(c.label.method for c in contenders)} on {outfit.name}"):
        frame = None
        for label, compare, memory in contenders:
            values, points = memory.recall(name, [m.name for m in metrics])
            missing = [m for m in metrics if not m.sequential and m.name not in values]
            if missing or motion:
                try:
                    frame = frame or outfit.load(split, name)
                    comparison = compare(frame)
                    new = {m.name: float(m.measure(comparison)) for m in missing}
                    if motion:
                        window = [*window, (name, comparison.points)][-3:]
                        new |= _measure_sequence([m for m in metrics if m.sequential], window)
                except DataError:
                    raise
                except AvatarError as error:
                    raise AvatarError(f"outfit {outfit.name}, {label.method}, frame {name}: {error}") from error
                points = len(comparison.points)
                memory.note(name, new, points)
                values |= new
            counts[label].append(points)
            for metric, value in values.items():
                if math.isfinite(value) or not partial:
                    where = (outfit.name, label.method, label.variant, label.seed, name)
                    frames.append(FrameScore(*where, metric, value, label.split))
                    found[label][metric].append(value)
    rows = []
    for label, counted in counts.items():
        made = asdict(label) | {"outfit": outfit.name, "dataset": outfit.dataset}
        made["points"] = round(float(np.mean(counted)))
        for metric in metrics:
            if values := found[label][metric.name]:  # of the frames that have it
                number = {"metric": metric.name, "value": float(np.mean(values)), "unit": metric.unit}
                rows.append(Score(**made, **number, frames=len(values)))
    return Scores(rows, frames)


def _measure_sequence(metrics: list[Metric], window: list[tuple[str, torch.Tensor]]) -> dict[str, float]:
    """Metrics of motion at the last of three frames, where these follow each other in one sequence."""
    sequences, numbers = zip(*(name.rpartition(".")[::2] for name, _ in window))
    follow = len(window) == 3 and len(set(sequences)) == 1 and all(number.isdecimal() for number in numbers)
    if not follow or [int(n) - int(numbers[0]) for n in numbers] != [0, 1, 2]:
        return {}
    clouds = [points for _, points in window]
    if len({len(points) for points in clouds}) > 1:
        raise AvatarError(f"motion: expected one point count a sequence, got {[len(points) for points in clouds]}.")
    return {metric.name: float(metric.measure(torch.stack(clouds))) for metric in metrics}
