"""Scoring of predictions on disk, one PLY a frame, whoever made them."""

from __future__ import annotations

import functools
import logging
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from avatar.checks import AvatarError, DataError
from avatar.data.outfits import Outfit
from avatar.evaluation.metrics import METRIC_NAMES, Comparison, Metric, find_metrics
from avatar.evaluation.scores import FrameScore, Score, Scores
from avatar.io.ledger import Ledger, file_digest, keyed
from avatar.io.meshes import read_mesh
from avatar.io.points import read_points
from avatar.progress import tracked
from avatar.records import Frame, Mesh, Scan

log = logging.getLogger(__name__)

# What a score is made by: metrics, floors and the draw of points, and the readers of data sets. Not how tables and
# plots are made of scores, nor how what is scored was trained: that shows in the hash of the prediction's file.
SOURCE = ("avatar.evaluation.floors", "avatar.data.layouts")
SIZE_RATIO = 5.0  # a prediction this many times larger or smaller than its scan is in other units


@dataclass
class ScoreConfig:
    """How predictions are scored.

    The same scan points are drawn for every method: a frame's draw depends on ``seed`` and its name alone.
    """

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


@dataclass(frozen=True)
class Memory:
    """Values that were measured before, each metric of each frame for itself.

    ``ledger`` keeps them (None: nothing is kept), ``what`` says in words what is scored, and ``made_of`` gives the hash
    of all that a frame's values are made of.
    """

    ledger: Ledger | None
    what: str
    made_of: Callable[[str], str]

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


def remember(ledger: Ledger | None, what: str, outfit: Any, split: str, source: tuple[str, ...], **made: Any) -> Memory:
    """The memory of one method's scores on an outfit.

    Args:
        ledger: where it is kept.
        what: the method, in words.
        outfit, split: what is scored: a data set's outfit, with `digest` and maybe a ``scanner``.
        source: the modules that make the values, see `keyed`.
        made: what else the values depend on; functions are asked for each frame by its name.
    """

    @functools.cache
    def made_of(name: str) -> str:
        parts = {key: value(name) if callable(value) else value for key, value in made.items()}
        scanner = vars(outfit.scanner) if hasattr(outfit, "scanner") else None
        return keyed(source, frame=outfit.digest(split, name), scanner=scanner, **parts)

    return Memory(ledger, f"{what} {outfit.name} {split}", made_of)


def remember_scores(
    ledger: Ledger | None, what: str, outfit: Any, split: str, config: ScoreConfig, **made: Any
) -> Memory:
    """The memory of scores of points; none for motion, whose frames depend on each other."""
    drawn = {"scan_points": config.scan_points, "seed": config.seed}
    return remember(None if config.motion else ledger, what, outfit, split, SOURCE, **drawn, **made)


def score_predictions(
    folder: str | Path,
    outfit: Outfit,
    split: str,
    config: ScoreConfig,
    label: Label,
    meshes: str | Path | None = None,
    ledger: Ledger | None = None,
) -> Scores:
    """Scores a folder of predictions, ``<frame>.ply`` with normals for every frame of the split.

    Args:
        folder: the predictions. Files that belong to no frame are ignored with a warning.
        outfit: where the true frames come from: its ``name``, ``dataset``, `frames` and `load`; penetration is
            scored where it has a ``template``.
        split: which of its splits.
        config: metrics and point counts.
        label: method, variant and training facts for the rows.
        meshes: a folder of predicted meshes, ``<frame>.ply`` or ``.obj``, which s2m_cm and normal_consistency then
            measure instead of the points; None for point methods.
        ledger: where values are kept, so that only new or changed ones are measured; None measures all.

    Returns:
        `Scores`: one row a metric, and the single frames.

    Raises:
        DataError: when frames have no prediction (naming them), or one is in other units than its scan.
        AvatarError: naming the frame, when a prediction is not valid.
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

    memory = remember_scores(ledger, "predictions", outfit, split, config, predicted=made_of)
    return score_frames(outfit, split, names, config, label, compare, memory, bool(surfaces))


def posed_body(outfit: Outfit, frame: Frame) -> Mesh | None:
    """The bare body under a frame as a mesh, or None where the outfit has no template to take faces from."""
    template = getattr(outfit, "template", None)
    return None if template is None else Mesh(frame.body.vertices, np.asarray(template.faces))


def draw_scan(frame: Frame, config: ScoreConfig) -> Scan:
    """The scan points a frame is scored against: a random subset, the same for every method."""
    count = len(frame.scan.points)
    if count <= config.scan_points:
        return frame.scan
    chosen = frame_generator(frame.name, config.seed).permutation(count)[: config.scan_points]
    return pick_points(frame.scan, np.sort(chosen))


def pick_points(scan: Scan, ids: np.ndarray) -> Scan:
    """Some of a scan's points, with their normals alone."""
    return Scan(scan.points[ids], scan.normals[ids])


def frame_generator(name: str, seed: int) -> np.random.Generator:
    """Random state that depends on a frame's name and a seed, not on the frames before it."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def frame_names(outfit: Outfit, split: str) -> list[str]:
    """The names of a split's frames; a split without any is an error."""
    names = list(outfit.frames(split))
    if not names:
        raise AvatarError(f"split: outfit {outfit.name} has no frames in {split!r}.")
    return names


def find_predictions(folder: Path, names: Sequence[str], suffixes: tuple[str, ...] = (".ply",)) -> dict[str, Path]:
    """The file of every frame in a folder of predictions; files of no frame are a warning.

    Raises:
        DataError: when there is no such folder, or naming the frames that have no file.
    """
    if not folder.is_dir():
        raise DataError(folder, "there is no such folder of predictions.", "Run tools/predict.py first.")
    there = {path.name: path for path in sorted(folder.iterdir()) if path.suffix in suffixes}
    found = {name: there.pop(f"{name}{suffix}") for name in names for suffix in suffixes if f"{name}{suffix}" in there}
    missing = [name for name in names if name not in found]
    if missing:
        raise DataError(
            folder,
            f"{len(missing)} of {len(names)} frames have no prediction ({', '.join(suffixes)}): {_some(missing)}.",
            "Predict them, or score the split that was predicted.",
        )
    if there:
        log.warning("%s: ignored %d files that belong to no frame: %s.", folder, len(there), _some(there))
    return found


def _some(names: Iterable[str]) -> str:
    names = list(names)
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def score_frames(
    outfit: Outfit,
    split: str,
    names: list[str],
    config: ScoreConfig,
    label: Label,
    compare: Callable[[Frame], Comparison],
    memory: Memory,
    meshes: bool = False,
) -> Scores:
    """Every metric of every frame, and their means.

    Metrics of meshes are measured where ``meshes`` says that every frame has one. ``compare`` makes the `Comparison` of
    a frame. Errors it or a metric raises are passed on with the frame's name. Values that ``memory`` knows are not
    measured again.
    """
    metrics = [m for m in find_metrics(config.metrics) if meshes or not m.needs_mesh]
    if not getattr(outfit, "template", None) and any(m.needs_body for m in metrics):
        metrics = [m for m in metrics if not m.needs_body]
        log.warning("%s: no template, so penetration into the body is not scored.", outfit.name)
    frames: list[FrameScore] = []
    counts, window = [], []
    for name in tracked(sorted(names, key=_in_time), f"score {label.method} on {outfit.name}"):
        values, points = memory.recall(name, [m.name for m in metrics])
        missing = [m for m in metrics if not m.sequential and m.name not in values]
        if missing or config.motion:
            try:
                comparison = compare(outfit.load(split, name))
                new = {m.name: float(m.measure(comparison)) for m in missing}
                if config.motion:
                    window = [*window, (name, comparison.points)][-3:]
                    new |= _measure_sequence([m for m in metrics if m.sequential], window)
            except DataError:
                raise
            except AvatarError as error:
                raise AvatarError(f"outfit {outfit.name}, {label.method}, frame {name}: {error}") from error
            points = len(comparison.points)
            memory.note(name, new, points)
            values |= new
        counts.append(points)
        frames += [
            FrameScore(outfit.name, label.method, label.variant, label.seed, name, metric, float(value), label.split)
            for metric, value in values.items()
        ]
    return Scores(mean_scores(frames, metrics, label, outfit.dataset, round(float(np.mean(counts)))), frames)


def _in_time(name: str) -> tuple[str, int, str]:
    sequence, _, number = name.rpartition(".")
    return sequence, int(number) if number.isdecimal() else 0, name


def _measure_sequence(metrics: list[Metric], window: list[tuple[str, torch.Tensor]]) -> dict[str, torch.Tensor]:
    """Metrics of motion at the last of three frames, where these follow each other in one sequence."""
    sequences, numbers = zip(*(name.rpartition(".")[::2] for name, _ in window))
    follow = len(window) == 3 and len(set(sequences)) == 1 and all(number.isdecimal() for number in numbers)
    if not follow or [int(n) - int(numbers[0]) for n in numbers] != [0, 1, 2]:
        return {}
    clouds = [points for _, points in window]
    if len({len(points) for points in clouds}) > 1:
        raise AvatarError(f"motion: expected one point count a sequence, got {[len(points) for points in clouds]}.")
    return {metric.name: metric.measure(torch.stack(clouds)) for metric in metrics}


def mean_scores(
    frames: Sequence[FrameScore], metrics: Iterable[Metric], label: Label, dataset: str, points: int
) -> list[Score]:
    """Means over one method's frames of one outfit, of the metrics that at least one frame has."""
    rows = []
    for metric in metrics:
        values = [frame.value for frame in frames if frame.metric == metric.name]
        if values:
            number = {"metric": metric.name, "value": float(np.mean(values)), "unit": metric.unit}
            where = {"outfit": frames[0].outfit, "dataset": dataset, "frames": len(values), "points": points}
            rows.append(Score(**asdict(label), **number, **where))
    return rows
