"""`predict` and `evaluate`: point clouds on disk from a run, and the table of all metrics from disk."""

from __future__ import annotations

import hashlib
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

from avatar.checks import AvatarError
from avatar.data.layouts import find_outfit
from avatar.data.open_layout import OpenOutfit
from avatar.data.outfits import Outfit
from avatar.data.splits import split_outfit
from avatar.environment import prepared_process
from avatar.evaluation.floors import score_body_floor, score_sampling_floor
from avatar.evaluation.scores import Scores, read_scores, write_scores
from avatar.evaluation.scoring import Label, ScoreConfig, score_predictions
from avatar.evaluation.tables import View, metric_table, outfit_table, to_markdown
from avatar.implicit.extraction import ExtractionConfig
from avatar.io.ledger import Ledger
from avatar.io.motions import read_motion
from avatar.io.npz import write_whole
from avatar.pipeline.methods import is_implicit, load_avatar
from avatar.training.implicit_prediction import predict_implicit_frames, predict_implicit_motion
from avatar.training.prediction import predict_frames, predict_motion
from avatar.training.runs import RunConfig, TrainedAvatar


@dataclass
class PredictConfig:
    """Posed point clouds from a trained run, for the frames of a split or for a motion file."""

    run: Path = Path("runs/closet/sample/dress/default")
    split: str = "test"  # or validation, the training frames that the run held back, or train
    motion: Path | None = None  # an AMASS .npz, a BVH file or one of our own; instead of the split
    fps: float = 30.0  # frames a second a motion is resampled to
    points: int = 50000  # 1,000 to 400,000
    surface: ExtractionConfig = field(default_factory=ExtractionConfig)  # of an implicit avatar
    checkpoint: str = "last"  # or best, on the held-back frames
    data_root: Path | None = None  # where the data are now; where they were at training if null
    device: str = "auto"


@dataclass
class EvaluateConfig:
    """Scores of prediction folders, with the floors in the same table."""

    runs: tuple[Path, ...] = (Path("runs/closet/sample/dress/default"),)
    split: str = "test"  # or validation, the training frames that the runs held back, or train
    floors: bool = True  # score the sampling floor and the bare body as well
    score: ScoreConfig = field(default_factory=ScoreConfig)
    data_root: Path | None = None  # where the data are now; where they were at training if null
    predictions: Path | None = None  # a foreign program's folder of <frame>.ply, instead of runs
    method: str = "foreign"  # its name in the table
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
        if (outfit.path / "train").is_dir()
        else outfit
        for outfit in outfits
    ]


def scores_file(folder: Path, split: str) -> Path:
    """Where a run's or a floor's scores on a split stand: ``scores.csv`` for test, ``scores.<split>.csv`` else."""
    return folder / ("scores.csv" if split == "test" else f"scores.{split}.csv")


@prepared_process()
def predict(config: PredictConfig) -> list[Path]:
    """Predicts every outfit of a run; gives the folders of point clouds.

    Raises:
        AvatarError: when a motion is asked for and the body cannot be posed (packed data has no body model).
    """
    avatar = load_avatar(config.run, config.checkpoint, config.device)
    folders = []
    for outfit in run_outfits(avatar, config.data_root):
        if config.motion is None:
            folders.append(predictions_folder(config.run, config.split, outfit.name))
            if is_implicit(avatar):
                meshes = meshes_folder(config.run, config.split, outfit.name)
                options = {"points": config.points, "config": config.surface}
                predict_implicit_frames(avatar, outfit, config.split, folders[-1], meshes, **options)
            else:
                predict_frames(avatar, outfit, config.split, folders[-1], config.points)
            continue
        if not isinstance(outfit, OpenOutfit):
            raise AvatarError(f"motion: {outfit.name} has no body model to pose; use split instead.")
        motion = read_motion(config.motion, config.fps)
        folders.append(predictions_folder(config.run, motion.name, outfit.name))
        if is_implicit(avatar):
            meshes = meshes_folder(config.run, motion.name, outfit.name)
            options = {"points": config.points, "config": config.surface}
            predict_implicit_motion(avatar, outfit, motion, folders[-1], meshes, **options)
        else:
            predict_motion(avatar, outfit, motion, folders[-1], config.points)
    return folders


@prepared_process()
def evaluate(config: EvaluateConfig) -> Scores:
    """Scores runs, or a foreign program's predictions, beside their floors; prints the tables.

    Each run's scores go to ``<run>/scores.csv``, the floors to ``<runs>/floors/<dataset>/<outfit>/scores.csv``; those
    on another split than test to ``scores.<split>.csv``.
    """
    if config.predictions is not None:
        outfit = find_outfit(config.data_root or Path("data"), config.dataset, config.outfit)
        folder = config.out or config.predictions
        label, done = Label(config.method), Ledger(folder)
        scores = score_predictions(config.predictions, outfit, config.split, config.score, label, None, done)
        write_scores(folder / "scores.csv", scores)
        if config.floors:
            scores = score_floors(outfit, config, 50_000, folder / "floors.csv") + scores
    else:
        scores = score_runs(config)
    print_tables(scores)
    return scores


def score_runs(config: EvaluateConfig) -> Scores:
    """Scores every outfit of every run, and the floors once an outfit."""
    scores, seen = Scores(), set()
    for run in config.runs:
        avatar = load_avatar(run)
        settings = avatar.config
        label = Label(
            settings.method.variant,
            variant=", ".join(part for part in (variant_of(settings), config.split) if part not in ("", "test")),
            seed=settings.train.seed,
            steps=avatar.steps,
            seconds=avatar.seconds,
            commit=current_commit(),
            fraction=settings.split.train_fraction,
        )
        mine = Scores()
        for outfit in run_outfits(avatar, config.data_root):
            folder = predictions_folder(run, config.split, outfit.name)
            meshes = meshes_folder(run, config.split, outfit.name) if is_implicit(avatar) else None
            done = Ledger(run / "predictions")
            mine = mine + score_predictions(folder, outfit, config.split, config.score, label, meshes, done)
            if config.floors and outfit.path not in seen:
                seen.add(outfit.path)
                path = floors_root(run, settings) / "floors" / settings.dataset / outfit.name
                scores = scores + score_floors(outfit, config, mine.rows[-1].points, scores_file(path, config.split))
        write_scores(scores_file(run, config.split), mine)
        scores = scores + mine
    return scores


def variant_of(config: RunConfig) -> str:
    """What tells a run from its method's usual one: outfits it shares a network with, less data, a canonicalizer."""
    parts = [f"{len(config.outfit)} outfits"] if len(config.outfit) > 1 else []
    if config.split.train_fraction < 1:
        parts.append(f"{100 * config.split.train_fraction:g}%")
    if config.canonical != "default":
        parts.append(config.canonical)
    return ", ".join(parts)


def floors_root(run: Path, settings: RunConfig) -> Path:
    """Where the floors of a run's outfits go: the root that it lies in, or its own folder if it was moved.

    What a run's file says of its root is the word of whoever made it, and is believed only where it is true.
    """
    return settings.runs_root if settings.folder.resolve() == run.resolve() else run


def score_floors(outfit: Outfit, config: EvaluateConfig, points: int, path: Path) -> Scores:
    """The sampling floor and the bare body for one outfit, kept in a file for the next method.

    The file serves again when it was made with the same points, seed, scanner and data (by manifest); metrics that it
    lacks are added to it.
    """
    beside = path.with_suffix(".settings.txt")
    manifest = outfit.path / "manifest.json"
    data = hashlib.sha256(manifest.read_bytes()).hexdigest() if manifest.is_file() else outfit.path.resolve()
    draw = (config.score.scan_points, config.score.seed, config.score.motion)
    key, wanted = f"{config.split} {points} {draw} {getattr(outfit, 'scanner', None)} {data}", config.score.metrics
    kept, known = Scores(), []
    if path.is_file() and beside.is_file():
        made_with, _, names = beside.read_text().partition("\n")
        if made_with == key:
            kept, known = read_scores(path), names.split()
    missing = [name for name in wanted if name not in known]
    if missing:
        made = {"points": points, "commit": current_commit(), "ledger": Ledger(path.parent)}
        score = replace(config.score, metrics=missing)
        kept = kept + score_sampling_floor(outfit, config.split, score, **made)
        kept = kept + score_body_floor(outfit, config.split, score, **made)
        beside.unlink(missing_ok=True)  # it never speaks of another file than the one beside it
        write_scores(path, kept)
        write_whole(beside, f"{key}\n{' '.join([*known, *missing])}".encode())
    return kept.of_metrics(wanted)


def print_tables(scores: Scores) -> None:
    """Prints every metric of every outfit, and the excess over the sampling floor where floors were scored."""
    for outfit in dict.fromkeys(row.outfit for row in scores.rows):
        print(to_markdown(metric_table(scores.rows, outfit)))
    methods = {row.method for row in scores.rows}
    if "sampling" in methods:
        print(to_markdown(outfit_table(scores.rows, "cd_point", View.EXCESS)))


def read_all_scores(paths: Iterable[Path]) -> Scores:
    """Scores of several files, joined."""
    joined = Scores()
    for path in paths:
        joined = joined + read_scores(path)
    return joined


def current_commit() -> str:
    """The short hash of the code's commit, or nothing outside a checkout."""
    here = Path(__file__).parent
    command = ["git", "-C", str(here), "describe", "--always", "--dirty", "--exclude", "*"]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return result.stdout.strip() if result.returncode == 0 else ""
