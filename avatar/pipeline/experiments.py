"""`experiment` and `demo`: jobs of a paper's table from canonicalizing to scores; the main job from data to report."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from avatar.canonical.clothed import ClothedConfig
from avatar.checks import AvatarError, check_name
from avatar.data.folders import SPLITS, VALIDATION
from avatar.environment import prepared_process
from avatar.evaluation.aggregate import FLOORS, base_method, method_key
from avatar.evaluation.scores import read_scores, write_scores
from avatar.evaluation.scoring import ScoreConfig
from avatar.export.meshing import require_poisson
from avatar.export.pictures import load_pyvista
from avatar.implicit.extraction import ExtractionConfig
from avatar.invocation import CONF
from avatar.io.documents import read_json
from avatar.io.locks import lock_folder
from avatar.io.npz import write_whole
from avatar.methods.base import CANONICALIZER, CLOTHED_TEMPLATE
from avatar.methods.canonicalizer import CanonicalizeConfig
from avatar.methods.points import check_count
from avatar.methods.registry import find_method
from avatar.methods.settings import MethodChoice, RunConfig
from avatar.pipeline.canonicalization import canonicalize, check_scored, make_canonical_scans
from avatar.pipeline.reporting import CompareConfig, ReportConfig, compare, report
from avatar.pipeline.scores import EvaluateConfig, PredictConfig, evaluate, predict, scores_file
from avatar.pipeline.surfaces import MeshConfig, mesh
from avatar.runs.templating import TemplateConfig, make_template
from avatar.runs.training import train
from avatar.settings import settings_from_dict
from avatar.world import current_world

FRONT_END = "front_end.json"  # in a canonicalizer's folder: processor seconds that it and its template took
log = logging.getLogger(__name__)


@dataclass
class JobConfig(RunConfig):
    """A run with all that predicts and scores it."""

    points: int = 50000  # predicted a frame
    score: ScoreConfig = field(default_factory=ScoreConfig)
    canonicalizer: CanonicalizeConfig = field(default_factory=CanonicalizeConfig)  # its data and name are the run's
    clothed: ClothedConfig = field(default_factory=ClothedConfig)  # the clothed template, for methods that take one

    def __post_init__(self):
        super().__post_init__()
        check_count(self.points)

    @property
    def run(self) -> RunConfig:
        """The training run alone."""
        return RunConfig(**{f.name: getattr(self, f.name) for f in fields(RunConfig)})


@dataclass
class ExperimentConfig(JobConfig):
    """One job of an experiment: a run with all that makes it a row of a table, and what the table looks like. ``name``
    is the beginning of the run's: budget, share of the training frames and seed follow, so that jobs that differ in
    them never share a folder.
    """

    surface: ExtractionConfig = field(default_factory=ExtractionConfig)  # of an implicit avatar
    compare: CompareConfig = field(default_factory=CompareConfig)
    front_end: bool = False  # train.minutes count what the method's canonicalizer and clothed template took
    one_seed: tuple[str, ...] = ()  # variants that are trained with seed 0 alone, where others have several

    def __post_init__(self):
        super().__post_init__()
        known, splits = (*SPLITS, VALIDATION), self.compare.splits
        if unknown := set(splits) - set(known):
            raise AvatarError(f"compare.splits: expected some of {', '.join(known)}, got {', '.join(sorted(unknown))}.")
        if unknown := set(self.one_seed) - {path.stem for path in (CONF / "method").glob("*.yaml")}:
            raise AvatarError(f"one_seed: expected variants of conf/method, got {', '.join(sorted(unknown))}.")
        check_name("compare.table", f"{self.compare.table}_{self.budget}")
        if VALIDATION in splits and not self.split.validation_share:
            raise AvatarError("split.validation_share: expected above 0, for compare.splits names validation.")

    @property
    def run(self) -> RunConfig:
        """The training run alone, with its full name."""
        name = f"{self.name}_{self.budget}_{self.split.train_fraction:g}_seed{self.train.seed}"
        return replace(super().run, name=name)

    @property
    def budget(self) -> str:
        """The training's budget as it stands in names: ``1500steps`` or ``12min``."""
        return f"{self.train.minutes:g}min" if self.train.minutes else f"{self.train.steps}steps"

    @property
    def is_left_out(self) -> bool:
        """Whether this is another seed of a variant that has one alone."""
        return self.train.seed != 0 and self.method.variant in self.one_seed


@dataclass
class DemoConfig(JobConfig):
    """The main job: canonicalize, train an avatar and its static floor, predict, score, mesh and report."""

    static_share: float = 0.4  # of the training minutes, spent on the static floor
    meshes: int = 4  # frames meshed

    def __post_init__(self):
        super().__post_init__()
        if find_method(self.method.name).static is None:
            raise AvatarError(
                f"method: expected one with a static floor (CloSET or one of its variants), got {self.method.name}. "
                f"Hint: train others by tools/train.py method={self.method.variant}."
            )


@prepared_process()
def demo(config: DemoConfig) -> Path:
    """Runs the main job; gives ``<runs>/demo/summary.json``, which says what was made and how long each stage took.
    Refuses before any work: outfits without test frames, and a machine that cannot mesh or draw.
    """
    seconds: dict[str, float] = {}

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        log.info("demo: %s", name)
        started = time.monotonic()
        yield
        seconds[name] = round(time.monotonic() - started, 1)

    settings, name = config.run, config.method.name
    budget = replace(settings.train, minutes=(settings.train.minutes or 2.0) * config.static_share)
    static = MethodChoice(name, "static", settings.method.settings | dict(find_method(name).static))
    for outfit in settings.outfits():
        outfit.frames("test")
    require_poisson()
    load_pyvista()
    with stage("canonicalize"):
        canonicalized = [canonicalize(canonicalizer_of(config, outfit)) for outfit in settings.outfit]
    if CLOTHED_TEMPLATE in needs_of(config):
        with stage("template"):
            for outfit in settings.outfit:
                make_template(template_of(config, outfit))
    with stage("train"):
        run = train(settings)
    with stage("train static floor"):
        floor = train(replace(settings, method=static, train=budget))
    with stage("predict"):
        folders = [path for folder in (run, floor) for path in predict(PredictConfig(run=folder, points=config.points))]
    with stage("evaluate"):
        scores = evaluate(EvaluateConfig(runs=(floor, run), score=config.score))
    with stage("mesh"):
        meshes = list(mesh(MeshConfig(run=run, frames=config.meshes)))
    with stage("report"):
        page = report(ReportConfig(run=run, against=(floor,)))
    columns = ("outfit", "method", "metric", "value", "unit")
    summary = {
        "seconds": seconds | {"total": round(sum(seconds.values()), 1)},
        "metrics": [{column: getattr(row, column) for column in columns} for row in scores.rows],
        "made": {
            "report": str(page),
            "canonical scans": [str(folder / "scans") for folder in canonicalized],
            "points": [str(path) for path in folders],
            "meshes": [str(path) for path in meshes],
            "weights": str(run / "avatar.safetensors"),
        },
    }
    path = config.runs_root / "demo" / "summary.json"
    write_whole(path, json.dumps(summary, indent=1).encode())
    return path


@prepared_process()
def experiment(config: ExperimentConfig) -> Path | list[Path]:
    """Canonicalizes and makes the clothed template where the method needs them, trains, predicts and scores; gives the
    run's folder. What is finished is not done again; what prediction, scores or pictures would refuse is refused before
    any work. A job that is left out (``one_seed``) makes nothing and gives an empty list.
    """
    if config.is_left_out:
        log.info("%s has seed 0 alone (one_seed): nothing to do.", config.method.variant)
        return []
    is_main, makers = current_world().is_main, canonicalizers_of(config)
    for split in set(config.compare.splits) - {VALIDATION}:
        for outfit in config.outfits():
            outfit.frames(split)
    for settings in makers:
        check_scored(settings, settings.frames())
    if config.compare.pictures:
        load_pyvista()
    for settings in makers:
        with lock_folder(settings.folder, wait=True):  # another job may be making it
            with counted(settings.folder, "canonicalizer", "scans/*/*.npz"):
                make_canonical_scans(settings, settings.frames())
            if CLOTHED_TEMPLATE in needs_of(config):
                with counted(settings.folder, "template", "template/*.npz"):
                    make_template(template_of(config, settings.outfit))
    run = train(charged(config, makers))
    made = {"points": config.points, "surface": config.surface, "device": config.device}
    for split in config.compare.splits if is_main else ():  # what the folder's ledgers know is not done again
        where = {"split": split, "data_root": config.data_root}
        predict(PredictConfig(run=run, **made, **where))
        evaluate(EvaluateConfig(runs=(run,), score=config.score, floors=split != VALIDATION, **where))
    return run


@contextmanager
def counted(folder: Path, part: str, made: str) -> Iterator[None]:
    """Keeps the processor time of a block that makes the files ``made`` (a pattern) in a canonicalizer's `FRONT_END`.

    What is interrupted counts together with what goes on from there; what is made anew counts once.
    """
    before, started, finished = newest_file(folder, made), time.process_time(), False
    try:
        yield
        finished = True
    finally:
        record = front_end_record(folder)
        seconds, whole = record.get(part, (0.0, False))
        if newest_file(folder, made) > before or not (finished or whole):
            elapsed = round(time.process_time() - started + (0 if whole else seconds), 1)
            write_whole(folder / FRONT_END, json.dumps(record | {part: (elapsed, finished)}).encode())


def newest_file(folder: Path, made: str) -> float:
    """When the newest file of a pattern in a folder was written; 0 where there is none."""
    return max((path.stat().st_mtime for path in folder.glob(made)), default=0.0)


def front_end_record(folder: Path) -> dict[str, tuple[float, bool]]:
    """The parts of a canonicalizer's front end: processor seconds, and whether the part was finished."""
    path = folder / FRONT_END
    return {part: tuple(values) for part, values in read_json(path).items()} if path.is_file() else {}


def front_end_seconds(folder: Path) -> float:
    """Processor seconds that a canonicalizer's folder has taken."""
    return sum(seconds for seconds, _ in front_end_record(folder).values())


def charged(config: ExperimentConfig, makers: Sequence[CanonicalizeConfig]) -> RunConfig:
    """The training run, with ``front_end`` on those minutes of its budget that its canonicalizers have left.

    Raises `AvatarError` where they have left none.
    """
    run, minutes = config.run, config.train.minutes
    if not (config.front_end and minutes):
        return run
    spent = sum(front_end_seconds(settings.folder) for settings in makers)
    left = minutes - spent / 60
    if left <= 0:
        problem = f"expected more than the front end took, {minutes - left:.1f} minutes, got {minutes:g}."
        raise AvatarError(f"train.minutes: {problem} Hint: fewer steps of the canonicalizer, or front_end=false.")
    return replace(run, spent=spent, train=replace(run.train, minutes=left))


def canonicalizer_of(config: JobConfig, outfit: str) -> CanonicalizeConfig:
    """The settings of the canonicalizer that a job's run takes for an outfit."""
    shared = {name: getattr(config, name) for name in ("dataset", "data_root", "runs_root", "device")}
    return replace(config.canonicalizer, outfit=outfit, name=config.canonical, **shared)


def template_of(config: JobConfig, outfit: str) -> TemplateConfig:
    """The settings of the clothed template that a job's run takes for an outfit; without pictures."""
    shared = {name: getattr(config, name) for name in ("dataset", "data_root", "runs_root", "canonical", "clothed")}
    return TemplateConfig(outfit=outfit, pictures=0, **shared)


def needs_of(config: JobConfig) -> frozenset[str]:
    """What a job's method needs made of the outfits, as `Method.needs`."""
    method, run = find_method(config.method.name), config.run
    return method.needs(run, settings_from_dict(method.Settings, run.method.settings, "method.settings."))


def canonicalizers_of(config: ExperimentConfig) -> list[CanonicalizeConfig]:
    """The settings of the canonicalizers that an experiment's run needs, one an outfit."""
    return [canonicalizer_of(config, outfit) for outfit in config.outfit if CANONICALIZER in needs_of(config)]


def tabulate_experiment(configs: Sequence[ExperimentConfig]) -> Path:
    """The table of an experiment's finished jobs, in the form that its first one asks for; the path of its Markdown.
    Jobs of several budgets have a table each, ``<table>_<budget>``; the path is then that of the scores of all,
    ``<table>.csv``. Raises `AvatarError` where all jobs are left out.
    """
    groups: dict[str, list[ExperimentConfig]] = {}
    for config in configs:
        if not config.is_left_out:
            groups.setdefault(config.budget, []).append(config)
    if not groups:
        raise AvatarError("one_seed: expected a job of seed 0, got none to tabulate. Hint: add train.seed=0.")
    name = configs[0].compare.table
    tables = {budget: f"{name}_{budget}" if len(groups) > 1 else name for budget in groups}
    written = [tabulate_jobs(group, tables[budget]) for budget, group in groups.items()]
    if len(groups) == 1:
        return written[0]
    path = written[0].with_name(f"{name}.csv")
    write_scores(path, read_scores(*(table.with_suffix(".csv") for table in written)))
    return path


def tabulate_jobs(configs: Sequence[ExperimentConfig], table: str) -> Path:
    """One table of finished jobs."""
    first, runs = configs[0], tuple(config.run.folder for config in configs)
    folders = [settings.folder for config in configs for settings in canonicalizers_of(config)]
    scored = [folder for folder in dict.fromkeys(folders) if (folder / "scores.csv").is_file()]
    settings = replace(first.compare, table=table, runs=runs, runs_root=first.runs_root, canonicalizers=tuple(scored))
    if settings.baseline and not has_baseline(settings):
        log.warning("No differences to %s: none of the finished jobs is of it.", settings.baseline)
        settings = replace(settings, baseline="")
    return compare(settings)


def has_baseline(config: CompareConfig) -> bool:
    """Whether the method that others are set against is a floor, or one of the runs was of it."""
    files = [scores_file(run, split) for run in config.runs for split in config.splits]
    methods = {method_key(row) for row in read_scores(*files).rows}
    return config.baseline in {*FLOORS[:2], *methods, *map(base_method, methods)}
