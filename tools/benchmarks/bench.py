"""Benchmarks of speed and memory: ratios of candidates run side by side, as a tidy CSV and as Markdown."""

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

from avatar.checks import SAFE_NAME, AvatarError
from avatar.environment import choose_device, prepared_process
from avatar.evaluation.scores import Scores, write_scores
from avatar.io.npz import write_whole
from avatar.pipeline.scores import current_commit
from benchmarks.avatars import predict_comparisons, step_comparisons
from benchmarks.ceilings import ceiling_figures
from benchmarks.comparisons import Comparison, Figure, Job, run_comparison
from benchmarks.encoders import encoder_comparisons
from benchmarks.growth import growth_figures
from benchmarks.memory import peak_memory
from benchmarks.search import chamfer_comparisons, nearest_comparisons
from benchmarks.surfaces import (
    canonicalizer_comparisons,
    extraction_comparisons,
    mesh_comparisons,
    poisson_comparisons,
    simulation_comparisons,
)
from benchmarks.tables import MACHINE, keep_others, to_markdown, to_scores

COMPARISONS: dict[str, Callable[[Job], list[Comparison]]] = {
    "nearest": nearest_comparisons,
    "chamfer": chamfer_comparisons,
    "pointnet2": encoder_comparisons,
    "step": step_comparisons,
    "predict": predict_comparisons,
    "canonicalizer": canonicalizer_comparisons,
    "extraction": extraction_comparisons,
    "poisson": poisson_comparisons,
    "mesh": mesh_comparisons,
    "simulation": simulation_comparisons,
}
OTHERS: dict[str, Callable[[Job, int], list[Figure]]] = {"growth": growth_figures, "ceilings": ceiling_figures}
PACKAGES = ("torch", "numpy", "scipy", "open3d-cpu", "open3d", "newton")
WAITING = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")  # how idle threads wait (avatar.environment)
report = logging.getLogger(__name__)


@dataclass
class BenchConfig:
    """Topics, repeats and sizes of the benchmarks; `bench.yaml` adds the small networks."""

    only: tuple[str, ...] = ()  # topics; empty for all
    repeats: int = 5  # rounds that a median is over
    quick: bool = False  # small sizes, for tests
    frames: int = 4  # of a training step; four of full size take 18 GB while candidates share a process
    memory: bool = True  # also each candidate's peak memory, in a process of its own
    avatars: dict[str, dict[str, Any]] = field(default_factory=lambda: {"closet_full": {}, "pop_full": {}})
    canonicalizers: dict[str, dict[str, Any]] = field(default_factory=lambda: {"full": {}})
    out: Path = Path("runs/tables")  # where the table's files go
    table: str = "bench"  # the name of the table's files
    device: str = "auto"

    def __post_init__(self):
        unknown = [topic for topic in self.only if topic not in COMPARISONS | OTHERS]
        if unknown:
            raise AvatarError(f"only: expected some of {', '.join(COMPARISONS | OTHERS)}, got {', '.join(unknown)}.")
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
    for topic in config.only or (*COMPARISONS, *OTHERS):
        load = Figure(topic, "", MACHINE, "load", os.getloadavg()[0], "1")
        figures = run_comparisons(topic, job, config) if topic in COMPARISONS else OTHERS[topic](job, config.repeats)
        scores = scores + to_scores(config.table, [load, *figures], config.repeats, current_commit())
    path = config.out / f"{config.table}.csv"
    scores = keep_others(path, scores)
    write_scores(path, scores)
    text = to_markdown(scores.rows)
    write_whole(path.with_suffix(".md"), text.encode())
    print(f"{text}\nwritten: {config.out / config.table}.*")
    return path.with_suffix(".md")


def run_comparisons(topic: str, job: Job, config: BenchConfig) -> list[Figure]:
    """Figures of a topic: the memory of each candidate in a process of its own, its times, and missing candidates."""
    comparisons = COMPARISONS[topic](job)
    figures = memory_figures(COMPARISONS[topic], comparisons, job) if config.memory else []
    for comparison in comparisons:
        report.info("bench: %s, %s", comparison.topic, comparison.case)
        figures += run_comparison(comparison, config.repeats) if comparison.candidates else []
        figures += [
            Figure(comparison.topic, comparison.case, who, "absent", math.nan, why)
            for who, why in comparison.absent.items()
        ]
    return figures


def memory_figures(build: Callable[[Job], list[Comparison]], comparisons: list[Comparison], job: Job) -> list[Figure]:
    """Peak memory of every candidate of a topic."""
    figures = []
    for place, comparison in enumerate(comparisons):
        for name in comparison.candidates:
            report.info("bench: memory of %s, %s, %s", comparison.topic, comparison.case, name)
            peak = peak_memory(build, job, place, name)
            if peak is not None:
                figures.append(
                    Figure(comparison.topic, comparison.case, name, "memory", peak, "MiB", comparison.points)
                )
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
        "threads": f"{torch.get_num_threads()}, {waiting or 'default waiting of idle ones'}",
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
    """Rows with the facts of `describe_machine`."""
    facts = [Figure(MACHINE, text, name, "fact", 1.0, "1") for name, text in describe_machine().items()]
    return to_scores(config.table, facts, 0, current_commit())
