"""`bench`: how fast it is, as ratios of contenders run side by side, in a tidy CSV and as Markdown."""

from __future__ import annotations

import logging
import math
import os
import platform
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from avatar.checks import AvatarError
from avatar.data.outfits import SAFE_NAME
from avatar.environment import choose_device, prepared_process
from avatar.evaluation.scores import Scores, write_scores
from avatar.io.npz import write_whole
from avatar.pipeline.scores import current_commit
from benchmarks.avatars import predict_races, step_races
from benchmarks.ceilings import ceiling_figures
from benchmarks.encoders import encoder_races
from benchmarks.growth import growth_figures
from benchmarks.memory import peak_memory
from benchmarks.races import Figure, Job, Race, run_race
from benchmarks.search import chamfer_races, nearest_races
from benchmarks.surfaces import canonicalizer_races, extraction_races, poisson_races, simulation_races
from benchmarks.tables import MACHINE, keep_others, to_markdown, to_scores

RACES: dict[str, Callable[[Job], list[Race]]] = {
    "nearest": nearest_races,
    "chamfer": chamfer_races,
    "pointnet2": encoder_races,
    "step": step_races,
    "predict": predict_races,
    "canonicalizer": canonicalizer_races,
    "extraction": extraction_races,
    "poisson": poisson_races,
    "simulation": simulation_races,
}
OTHERS: dict[str, Callable[[Job, int], list[Figure]]] = {"growth": growth_figures, "ceilings": ceiling_figures}
PACKAGES = ("torch", "numpy", "scipy", "open3d-cpu", "open3d", "newton")
WAITING = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")  # how idle threads wait (avatar.environment)
report = logging.getLogger(__name__)


@dataclass
class BenchConfig:
    """What is timed, how often and at which sizes; `conf/bench.yaml` adds the small networks."""

    only: tuple[str, ...] = ()  # topics; empty for all
    repeats: int = 5  # rounds that a median is over
    quick: bool = False  # small sizes, for tests
    frames: int = 4  # of a training step; four of full size take 18 GB while contenders share a process
    memory: bool = True  # also each contender's peak memory, in a process of its own
    avatars: dict[str, dict[str, Any]] = field(default_factory=lambda: {"closet_full": {}, "pop_full": {}})
    canonicalizers: dict[str, dict[str, Any]] = field(default_factory=lambda: {"full": {}})
    out: Path = Path("runs/tables")  # where the table's files go
    table: str = "bench"  # the name of the table's files
    device: str = "auto"

    def __post_init__(self):
        unknown = [topic for topic in self.only if topic not in RACES | OTHERS]
        if unknown:
            raise AvatarError(f"only: expected some of {', '.join(RACES | OTHERS)}, got {', '.join(unknown)}.")
        if min(self.repeats, self.frames) < 1:
            raise AvatarError(f"repeats, frames: expected at least 1, got {self.repeats} and {self.frames}.")
        if not SAFE_NAME.fullmatch(self.table):
            raise AvatarError(f"table: expected a plain name, got {self.table!r}.")


@prepared_process()
def bench(config: BenchConfig) -> Path:
    """Runs the benchmarks; writes ``<out>/<table>.csv``, ``.frames.csv`` (every round) and ``.md``, and gives the last.

    Topics that are not asked for keep the rows they have in these files.

    Raises:
        AvatarError: for labels of networks there are no settings for.
    """
    job = Job(config.quick, choose_device(config.device).type, config.avatars, config.canonicalizers, config.frames)
    scores = machine_rows(config)
    for topic in config.only or (*RACES, *OTHERS):
        load = Figure(topic, "", MACHINE, "load", os.getloadavg()[0], "1")
        figures = run_races(topic, job, config) if topic in RACES else OTHERS[topic](job, config.repeats)
        scores = scores + to_scores(config.table, [load, *figures], config.repeats, current_commit())
    path = config.out / f"{config.table}.csv"
    scores = keep_others(path, scores)
    write_scores(path, scores)
    text = to_markdown(scores.rows)
    write_whole(path.with_suffix(".md"), text.encode())
    print(f"{text}\nwritten: {config.out / config.table}.*")
    return path.with_suffix(".md")


def run_races(topic: str, job: Job, config: BenchConfig) -> list[Figure]:
    """A topic's races, after the memory of each contender in a process of its own; and who is absent."""
    races = RACES[topic](job)
    figures = memory_figures(RACES[topic], races, job) if config.memory else []
    for race in races:
        report.info("bench: %s, %s", race.topic, race.case)
        figures += run_race(race, config.repeats) if race.contenders else []
        figures += [Figure(race.topic, race.case, who, "absent", math.nan, why) for who, why in race.absent.items()]
    return figures


def memory_figures(build: Callable[[Job], list[Race]], races: list[Race], job: Job) -> list[Figure]:
    """Peak memory of every contender of a topic."""
    figures = []
    for place, race in enumerate(races):
        for name in race.contenders:
            report.info("bench: memory of %s, %s, %s", race.topic, race.case, name)
            peak = peak_memory(build, job, place, name)
            if peak is not None:
                figures.append(Figure(race.topic, race.case, name, "memory", peak, "MiB", race.points))
    return figures


def describe_machine() -> dict[str, str]:
    """Processor, threads, accelerator and versions, in words."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        named = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        cpu = named[0].partition(":")[2].strip() if named else cpu
    waiting = ", ".join(f"{name}={os.environ[name]}" for name in WAITING if name in os.environ)
    facts = {
        "processor": f"{cpu}, {os.cpu_count()} cores",
        "threads": f"{torch.get_num_threads()}, {waiting or 'idle ones as OpenMP likes'}",
        "accelerator": torch.cuda.get_device_name() if torch.cuda.is_available() else "none",
        "system": f"{platform.system()}, Python {platform.python_version()}",
    }
    for name in PACKAGES:
        try:
            facts[name] = version(name)
        except PackageNotFoundError:
            continue
    return facts


def machine_rows(config: BenchConfig) -> Scores:
    """What `describe_machine` says, as rows."""
    facts = [Figure(MACHINE, text, name, "fact", 1.0, "1") for name, text in describe_machine().items()]
    return to_scores(config.table, facts, 0, current_commit())
