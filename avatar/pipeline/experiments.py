"""`experiment`: the jobs of a paper's table, each from canonicalizing to scores, and the table of all of them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from avatar.environment import prepared_process
from avatar.evaluation.scoring import ScoreConfig
from avatar.implicit.extraction import ExtractionConfig
from avatar.io.npz import write_whole
from avatar.nn.closet import Skinning
from avatar.pipeline.canonicalization import score_canonical_scans
from avatar.pipeline.comparison import CompareConfig, compare
from avatar.pipeline.methods import train
from avatar.pipeline.scores import EvaluateConfig, PredictConfig, evaluate, predict, scores_file
from avatar.settings import settings_to_dict
from avatar.training.canonicalizing import CanonicalizeConfig, canonicalize_frames, train_canonicalizer
from avatar.training.distributed import current_team
from avatar.training.implicit_runs import METHOD as SCANIMATE
from avatar.training.locks import lock_folder
from avatar.training.runs import WEIGHTS, RunConfig, Space

SCORED = "scored.txt"  # in a run's folder: what its scores were made of


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
    """
    run, leads = config.run, current_team().leads
    if takes_canonicalizer(run):
        for outfit in run.outfit:
            prepare_canonicalizer(config, outfit)
    folder = train(run)
    if leads:
        score_run(config, folder)
    return folder


def takes_canonicalizer(run: RunConfig) -> bool:
    """Whether a run needs its outfits' canonicalizers."""
    learned = run.method.settings.get("skinning") == Skinning.learned.value
    return run.method.name == SCANIMATE or learned or run.space is Space.canonical


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
        if settings.scored and not (settings.folder / "scores.csv").is_file():
            score_canonical_scans(settings, frames)


def score_run(config: ExperimentConfig, folder: Path) -> None:
    """Predicts the frames of each split and scores them, unless the scores there are were made of the same."""
    key = score_key(config, folder)
    stamp = folder / SCORED
    files = [scores_file(folder, split) for split in config.compare.splits]
    if stamp.is_file() and stamp.read_text() == key and all(file.is_file() for file in files):
        return
    stamp.unlink(missing_ok=True)
    made = {"points": config.points, "surface": config.surface, "device": config.device}
    for split in config.compare.splits:
        where = {"split": split, "data_root": config.data_root}
        predict(PredictConfig(run=folder, **made, **where))
        evaluate(EvaluateConfig(runs=(folder,), score=config.score, floors=split == "test", **where))
    write_whole(stamp, key.encode())


def score_key(config: ExperimentConfig, folder: Path) -> str:
    """All that a run's scores depend on, as one hash: weights, data, points and metrics."""
    parts = [_digest(folder / f"{WEIGHTS}.safetensors"), str(config.points)]
    parts += [str(settings_to_dict(part)) for part in (config.surface, config.score)]
    manifests = [outfit.path / "manifest.json" for outfit in config.outfits()]
    parts += [_digest(path) for path in manifests if path.is_file()]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def tabulate_experiment(configs: Sequence[ExperimentConfig]) -> Path:
    """The table of an experiment's finished jobs, in the form that its first one asks for."""
    first = configs[0]
    runs = tuple(config.run.folder for config in configs)
    takers = [config for config in configs if takes_canonicalizer(config.run)]
    folders = [canonicalizer_of(config, outfit).folder for config in takers for outfit in config.outfit]
    scored = [folder for folder in dict.fromkeys(folders) if (folder / "scores.csv").is_file()]
    return compare(replace(first.compare, runs=runs, runs_root=first.runs_root, canonicalizers=tuple(scored)))
