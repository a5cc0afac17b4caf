"""`predict` and `evaluate`: point clouds on disk from a run, and the table of all metrics from disk."""

from __future__ import annotations

import json
import subprocess
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from avatar.data.layouts import find_outfit
from avatar.data.outfits import Outfit
from avatar.data.splits import split_outfit
from avatar.environment import prepared_process
from avatar.evaluation import scoring
from avatar.evaluation.aggregate import FLOORS, by_split, method_key
from avatar.evaluation.scores import Score, Scores, frames_path, read_scores, write_scores
from avatar.evaluation.scoring import SOURCE, Label, ScoreConfig, find_predictions, score_predictions
from avatar.evaluation.tables import Table, View, metric_table, outfit_table, to_markdown
from avatar.implicit.extraction import ExtractionConfig
from avatar.io.documents import read_json
from avatar.io.ledger import Ledger, digest_of, keyed
from avatar.io.locks import lock_folder
from avatar.io.motions import MotionConfig, resample_motion
from avatar.io.npz import write_whole
from avatar.methods.base import TrainedAvatar
from avatar.methods.settings import RunConfig
from avatar.nn.decoders import Normals
from avatar.runs.prediction import predict_frames
from avatar.runs.training import load_avatar

MOTION = "motion.json"  # in the folder of a predicted motion: its frames a second, and how many there are
DEFAULT_RATE = 30.0  # frames a second of predicted motions


@dataclass
class PredictConfig(MotionConfig):
    """Posed point clouds from a trained run, for the frames of a split or for a motion file."""

    run: Path = Path("runs/closet/sample/dress/default")
    split: str = "test"  # or interpolation; validation, the frames that the run held back from training; train
    fps: float | None = None  # frames a second a motion is resampled to, 30 if null; its own where the file has none
    points: int = 50000  # 1,000 to 400,000
    surface: ExtractionConfig = field(default_factory=ExtractionConfig)  # of an implicit avatar
    checkpoint: str = "last"  # or best, on the held-back frames
    data_root: Path | None = None  # where the data are now; where they were at training if null
    device: str = "auto"


@dataclass
class EvaluateConfig:
    """Scores of prediction folders, with the floors in the same table."""

    runs: tuple[Path, ...] = (Path("runs/closet/sample/dress/default"),)
    split: str = "test"  # or interpolation; validation, the frames that the runs held back from training; train
    floors: bool = True  # score the sampling floor and the bare body as well
    score: ScoreConfig = field(default_factory=ScoreConfig)
    data_root: Path | None = None  # where the data are now; where they were at training if null
    predictions: Path | None = None  # a foreign program's folder of <frame>.ply, instead of runs
    label: str = "foreign"  # its name in the table
    dataset: str = "sample"  # the data it predicts
    outfit: str = "dress"
    out: Path | None = None  # where the scores of foreign predictions go; beside them if null


def predictions_folder(run: Path, name: str, outfit: str) -> Path:
    """Where a run's predictions stand: ``<run>/predictions/<split or motion>/<outfit>``."""
    return run / "predictions" / name / outfit


def meshes_folder(run: Path, name: str, outfit: str) -> Path:
    """Where a run's surfaces stand: ``<run>/meshes/<split or motion>/<outfit>``."""
    return run / "meshes" / name / outfit


def run_outfits(avatar: TrainedAvatar, data_root: Path | None) -> list[Outfit]:
    """The outfits a run was trained on, where they are now or then; what it held back is their validation split."""
    outfits = replace(avatar.config, data_root=data_root or avatar.config.data_root).outfits()
    return [
        outfit.with_validation(split_outfit(outfit, avatar.config.split).validation)
        if outfit.has_frames("train")
        else outfit
        for outfit in outfits
    ]


def scores_file(folder: Path, split: str) -> Path:
    """Where a run's or a floor's scores on a split stand: ``scores.csv`` for test, ``scores.<split>.csv`` else."""
    return folder / ("scores.csv" if split == "test" else f"scores.{split}.csv")


@prepared_process()
def predict(config: PredictConfig) -> list[Path]:
    """Predicts every outfit of a run; gives the folders of point clouds. A motion needs bodies that can be posed."""
    avatar, folders = load_avatar(config.run, config.checkpoint, config.device), []
    for outfit in run_outfits(avatar, config.data_root):
        motion = config.motion and config.read_motion(outfit.posable_body(), config.fps)
        if motion and config.fps is None and config.step == 1:
            motion = resample_motion(motion, DEFAULT_RATE)
        name = motion.name if motion else config.split
        folders.append(predictions_folder(config.run, name, outfit.name))
        where = (folders[-1], meshes_folder(config.run, name, outfit.name), config.points, config.surface)
        written = predict_frames(avatar, outfit, motion or config.split, *where)
        if motion:
            for path in set(folders[-1].glob(f"{motion.name}.*.ply")) - set(written):
                path.unlink()  # the end of an earlier prediction with more frames a second
            write_whole(folders[-1] / MOTION, json.dumps({"fps": motion.fps, "frames": len(motion.poses)}).encode())
    return folders


def predicted_fps(folder: Path) -> float:
    """The frames a second that a motion was predicted at; 30 for the frames of a split."""
    path = folder / MOTION
    return float(read_json(path)["fps"]) if path.is_file() else DEFAULT_RATE


def predicted_count(folder: Path) -> int | None:
    """The frames that a motion was predicted in; None where that was not noted."""
    path = folder / MOTION
    return read_json(path).get("frames") if path.is_file() else None


@prepared_process()
def evaluate(config: EvaluateConfig) -> Scores:
    """Scores runs, or a foreign program's predictions, beside their floors; prints the tables. Each run's scores go to
    its `scores_file`, the floors to that in `floors_folder`. Ledgers there keep what was measured: what is unchanged
    (predictions, data, settings, and the code of the metrics) is not measured again.
    """
    scores = score_runs(config) if config.predictions is None else score_foreign(config, config.predictions)
    print("\n".join(map(to_markdown, score_tables(scores.rows))))
    return scores


def score_foreign(config: EvaluateConfig, folder: Path) -> Scores:
    """Scores a foreign program's folder of predictions, and its floors at as many points."""
    outfit = find_outfit(config.data_root or Path("data"), config.dataset, config.outfit)
    find_predictions(folder, outfit.frames(config.split))
    out = config.out or folder
    with lock_folder(out, wait=True):
        ledger, label = Ledger(out), Label(config.label, split=config.split)
        scores = score_predictions(folder, outfit, config.split, config.score, label, None, ledger)
        save_scores(out / "scores.csv", scores, ledger, keyed(SOURCE))
        floors = score_floors(outfit, config, scores.rows[0].points, out / "floors.csv") if config.floors else Scores()
    return floors + scores


def score_runs(config: EvaluateConfig) -> Scores:
    """Scores every outfit of every run, and its floors at the point count that most runs predict."""
    scores, floors, split = Scores(), {}, config.split
    avatars = {run: load_avatar(run) for run in config.runs}
    runs = [(run, avatar, run_outfits(avatar, config.data_root)) for run, avatar in avatars.items()]
    for run, _, outfits in runs:
        for outfit in outfits:
            find_predictions(predictions_folder(run, split, outfit.name), outfit.frames(split))  # before any is scored
    for run, avatar, outfits in runs:
        mine, label = Scores(), label_of(avatar, split=split)
        with lock_folder(run / "predictions", wait=True):
            ledger = Ledger(run)
            for outfit in outfits:
                folder = predictions_folder(run, split, outfit.name)
                meshes = meshes_folder(run, split, outfit.name) if avatar.method.makes_meshes else None
                mine += score_predictions(folder, outfit, split, config.score, label, meshes, ledger)
            save_scores(scores_file(run, split), mine, ledger, keyed(SOURCE))
        scores += mine
        for outfit in outfits if config.floors else ():
            points = next(row.points for row in mine.rows if row.outfit == outfit.name)
            path = floors_folder(floors_root(run, avatar.config), avatar.config.dataset, outfit.name, points)
            floors[outfit.name, points] = score_floors(outfit, config, points, scores_file(path, split))
    for (name, points), found in floors.items():
        scores = found + scores if points == common_points(scores.rows, name) else scores
    return scores


def label_of(avatar: TrainedAvatar, **more: str) -> Label:
    """Who made a run's predictions: the columns that its scores begin with."""
    settings = avatar.config
    return Label(
        settings.method.variant,
        variant=variant_of(settings),
        seed=settings.train.seed,
        steps=avatar.steps,
        seconds=avatar.seconds + avatar.config.spent,
        commit=current_commit(),
        fraction=settings.split.train_fraction,
        **more,
    )


def variant_of(config: RunConfig) -> str:
    """What tells a run from its method's usual one: several outfits, less data, free normals, a canonicalizer."""
    parts = [f"{len(config.outfit)} outfits"] if len(config.outfit) > 1 else []
    if config.split.train_fraction < 1:
        parts.append(f"{100 * config.split.train_fraction:g}%")
    if config.method.settings.get("normals") == Normals.free.value:
        parts.append("free normals")
    if config.canonical != "default":
        parts.append(config.canonical)
    return ", ".join(parts)


def floors_root(run: Path, settings: RunConfig) -> Path:
    """Where the floors of a run's outfits go: the root that its file names, if it lies there, else its own folder."""
    return settings.runs_root if settings.folder.resolve() == run.resolve() else run


def score_floors(outfit: Outfit, config: EvaluateConfig, points: int, path: Path) -> Scores:
    """The sampling floor and the bare body for one outfit at a point count, kept in a file for the next method. Metrics
    that the file has of the same points, seed, scanner, data and code stay in it. Another process that wants the same
    floors waits for them.
    """
    memory = scoring.remember_points(None, "floors", outfit, config.split, config.score, points=points)
    key = digest_of([memory.made_of(name) for name in outfit.frames(config.split)])
    with lock_folder(path.parent, wait=True):
        ledger = Ledger(path.parent)
        scores = scoring.measure_floors(outfit, config.split, config.score, points, current_commit(), ledger)
        kept = read_scores(path) if ledger.find(path.name, key) else Scores()
        others = {row.metric for row in kept.rows} - set(config.score.metrics)
        save_scores(path, kept.only("metric", others) + scores, ledger, key)
    return scores


def floors_folder(root: Path, dataset: str, outfit: str, points: int) -> Path:
    """Where an outfit's floors at a point count stand: ``<root>/floors/<dataset>/<outfit>/<points>``."""
    return root / "floors" / dataset / outfit / str(points)


def read_floors(root: Path, dataset: str, outfit: str, rows: Iterable[Score], split: str = "test") -> Scores:
    """A split's floors at the point count that most of an outfit's methods in ``rows`` predict, if they were made."""
    path = scores_file(floors_folder(root, dataset, outfit, common_points(rows, outfit)), split)
    return read_scores(path) if path.is_file() else Scores()


def common_points(rows: Iterable[Score], outfit: str) -> int:
    """The point count that most of an outfit's methods predict; of two that as many have, the larger."""
    mine = (row for row in rows if row.outfit == outfit and row.method not in FLOORS[:2])
    counts = Counter(points for points, _, _ in {(row.points, method_key(row), row.seed) for row in mine})
    return max(counts, key=lambda points: (counts[points], points))


def save_scores(path: Path, scores: Scores, ledger: Ledger, key: str) -> None:
    """Writes scores, and notes in the ledger of their folder by what they were made, unless it says the same."""
    write_scores(path, scores)
    if ledger.find(path.name, key) is None:
        ledger.record(path.name, key, [file for file in (path, frames_path(path)) if file.is_file()])


def are_current(path: Path) -> bool:
    """Whether a file of scores of predictions is as `evaluate` wrote it, with the metrics' code as it is now."""
    return Ledger(path.parent).find(path.name, keyed(SOURCE)) is not None


def score_tables(rows: Sequence[Score]) -> list[Table]:
    """Every metric of every outfit, split by split, and the excess over the sampling floor where it was scored."""
    found = []
    for split in dict.fromkeys(row.split for row in rows):
        mine = by_split(row for row in rows if row.split == split)
        found += [metric_table(mine, outfit) for outfit in dict.fromkeys(row.outfit for row in mine)]
        if ("sampling", "cd_point") in {(row.method, row.metric) for row in mine}:
            found.append(outfit_table(mine, "cd_point", View.EXCESS))
    return found


def current_commit() -> str:
    """The short hash of the code's commit, or nothing outside a checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--exclude", "*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
