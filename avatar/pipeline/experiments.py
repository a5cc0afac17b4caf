"""`experiment`: the jobs of a paper's table, each from canonicalizing to scores, and the table of all of them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from avatar.checks import AvatarError
from avatar.data.folders import SPLITS, VALIDATION
from avatar.environment import prepared_process
from avatar.evaluation.aggregate import FLOORS, base_method, method_key
from avatar.evaluation.scoring import ScoreConfig
from avatar.export.pictures import load_pyvista
from avatar.implicit.extraction import ExtractionConfig
from avatar.io.locks import lock_folder
from avatar.methods.base import CANONICALIZER
from avatar.methods.canonicalizer import CanonicalizeConfig
from avatar.methods.points import check_count
from avatar.methods.registry import find_method
from avatar.methods.settings import RunConfig
from avatar.pipeline.canonicalization import check_scored, score_canonical_scans
from avatar.pipeline.comparison import CompareConfig, compare
from avatar.pipeline.scores import EvaluateConfig, PredictConfig, evaluate, predict, read_all_scores, scores_file
from avatar.runs.canonicalizing import canonicalize_frames, train_canonicalizer
from avatar.runs.training import train
from avatar.settings import settings_from_dict
from avatar.world import current_world

log = logging.getLogger(__name__)


@dataclass
class ExperimentConfig(RunConfig):
    """One job of an experiment: a run with all that makes it a row of a table, and what the table looks like.

    ``name`` is the beginning of the run's: budget, share of the training frames and seed follow, so that jobs that
    differ in them never share a folder.
    """

    points: int = 50000  # predicted a frame
    surface: ExtractionConfig = field(default_factory=ExtractionConfig)  # of an implicit avatar
    score: ScoreConfig = field(default_factory=ScoreConfig)
    canonicalizer: CanonicalizeConfig = field(default_factory=CanonicalizeConfig)  # of methods that take one
    compare: CompareConfig = field(default_factory=CompareConfig)

    def __post_init__(self):
        super().__post_init__()
        check_count(self.points)
        known, splits = (*SPLITS, VALIDATION), self.compare.splits
        if unknown := set(splits) - set(known):
            raise AvatarError(f"compare.splits: expected some of {', '.join(known)}, got {', '.join(sorted(unknown))}.")
        if VALIDATION in splits and not self.split.validation_share:
            raise AvatarError("split.validation_share: expected above 0, for compare.splits names validation.")

    @property
    def run(self) -> RunConfig:
        """The training run alone, with its full name."""
        train, share = self.train, f"{self.split.train_fraction:g}"
        budget = f"{train.minutes:g}min" if train.minutes else f"{train.steps}steps"
        values = {f.name: getattr(self, f.name) for f in fields(RunConfig)}
        return RunConfig(**values | {"name": f"{self.name}_{budget}_{share}_seed{train.seed}"})


@prepared_process()
def experiment(config: ExperimentConfig) -> Path:
    """Canonicalizes where the method needs it, trains, predicts and scores; what is finished is not done again.

    Returns:
        The run's folder.

    Raises:
        AvatarError: before any work, for what prediction, scores or pictures would refuse after training.
    """
    is_main = current_world().is_main
    check_job(config)
    for outfit in config.outfit if takes_canonicalizer(config.run) else ():
        prepare_canonicalizer(config, outfit)
    folder = train(config.run)
    if is_main:
        score_run(config, folder)
    return folder


def check_job(config: ExperimentConfig) -> None:
    """Refuses what could not be predicted, scored or drawn once the run is trained.

    Raises:
        AvatarError: for a split without frames, scores of canonical scans without truth, a machine that cannot draw.
    """
    for split in set(config.compare.splits) - {VALIDATION}:
        for outfit in config.outfits():
            outfit.frames(split)
    for name in config.outfit if takes_canonicalizer(config.run) else ():
        settings = canonicalizer_of(config, name)
        check_scored(settings, settings.frames())
    if config.compare.pictures:
        load_pyvista()


def takes_canonicalizer(run: RunConfig) -> bool:
    """Whether a run needs its outfits' canonicalizers."""
    method = find_method(run.method.name)
    settings = settings_from_dict(method.Settings, run.method.settings, "method.settings.")
    return CANONICALIZER in method.needs(run, settings)


def canonicalizer_of(config: ExperimentConfig, outfit: str) -> CanonicalizeConfig:
    """The settings of the canonicalizer that an experiment's run takes for an outfit."""
    shared = {name: getattr(config, name) for name in ("dataset", "data_root", "runs_root", "device")}
    return replace(config.canonicalizer, outfit=outfit, name=config.canonical, **shared)


def prepare_canonicalizer(config: ExperimentConfig, outfit: str) -> None:
    """Makes an outfit's canonicalizer and its scans, or waits until another job has; scores it where asked for."""
    settings = canonicalizer_of(config, outfit)
    with lock_folder(settings.folder, wait=True):
        frames = settings.frames()
        train_canonicalizer(settings, frames)
        canonicalize_frames(settings, frames)
        if settings.scored:
            score_canonical_scans(settings, frames)


def score_run(config: ExperimentConfig, folder: Path) -> None:
    """Predicts the frames of each split and scores them; what the folder's ledgers know is not done again."""
    made = {"points": config.points, "surface": config.surface, "device": config.device}
    for split in config.compare.splits:
        where = {"split": split, "data_root": config.data_root}
        predict(PredictConfig(run=folder, **made, **where))
        evaluate(EvaluateConfig(runs=(folder,), score=config.score, floors=split != VALIDATION, **where))


def tabulate_experiment(configs: Sequence[ExperimentConfig]) -> Path:
    """The table of an experiment's finished jobs, in the form that its first one asks for."""
    first = configs[0]
    runs = tuple(config.run.folder for config in configs)
    takers = [config for config in configs if takes_canonicalizer(config.run)]
    folders = [canonicalizer_of(config, outfit).folder for config in takers for outfit in config.outfit]
    scored = [folder for folder in dict.fromkeys(folders) if (folder / "scores.csv").is_file()]
    settings = replace(first.compare, runs=runs, runs_root=first.runs_root, canonicalizers=tuple(scored))
    if settings.baseline and not has_baseline(settings):
        log.warning("No differences to %s: none of the finished jobs is of it.", settings.baseline)
        settings = replace(settings, baseline="")
    return compare(settings)


def has_baseline(config: CompareConfig) -> bool:
    """Whether the method that others are set against is a floor, or one of the runs was of it."""
    files = [scores_file(run, split) for run in config.runs for split in config.splits]
    methods = {method_key(row) for row in read_all_scores(files).rows}
    return config.baseline in {*FLOORS[:2], *methods, *map(base_method, methods)}
