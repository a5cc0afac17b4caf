"""Comparisons: candidates are timed in interleaved order in one process, so that other load affects ratios less."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from statistics import median, quantiles
from typing import Any

import torch

from avatar.checks import AvatarError
from avatar.invocation import EXTRAS

Run = Callable[[], Any]


def absence(package: str) -> str:
    """Reason why a candidate is missing, for a published table: without paths of this machine."""
    return f"not installed (extra {EXTRAS[package]})"


@dataclass(frozen=True)
class Timing:
    """Wall-clock ``seconds`` of one run, and ``processor`` seconds of this process."""

    seconds: float
    processor: float


@dataclass(frozen=True)
class Job:
    """Settings of all benchmarks: sizes (``quick`` ones are for tests), device, and settings of networks by label.

    ``avatars`` are labels such as ``closet_small`` (the method's name first) to options of the method's settings,
    ``canonicalizers`` labels to options of the canonicalizer's run.
    """

    quick: bool
    device: str
    avatars: dict[str, dict[str, Any]]
    canonicalizers: dict[str, dict[str, Any]]
    frames: int = 4  # of a training step

    @property
    def labels(self) -> list[str]:
        """Labels of the avatars that run: all, or the small ones in tests."""
        return [label for label in self.avatars if label.endswith("_small") or not self.quick]

    @property
    def largest_pop(self) -> str:
        """Label of the POP that is the baseline."""
        return next(label for label in ("pop_full", "pop_small") if label in self.labels)

    def cost(self, timing: Timing) -> float:
        """Cost of a run in seconds: processor seconds on the CPU, which may be shared, else wall-clock seconds."""
        return timing.processor if self.device == "cpu" else timing.seconds

    def size(self, full: int, quick: int) -> int:
        """Size, or the smaller one for tests."""
        return quick if self.quick else full


@dataclass(frozen=True)
class Comparison:
    """Candidates for one computation of one size.

    ``candidates`` are names to functions that prepare a candidate and return the function to time; ``baseline`` is the
    one that times are divided by; ``gap`` is the difference between a result and the baseline's, where they must agree;
    ``absent`` are names to reasons of those that cannot run here; ``points`` is the size for the table's column.
    """

    topic: str
    case: str
    candidates: dict[str, Callable[[], Run]]
    baseline: str
    gap: Callable[[Any, Any], float] | None = None
    absent: dict[str, str] = field(default_factory=dict)
    points: int = 0


@dataclass(frozen=True)
class Figure:
    """Value of a table, of one candidate in one case, with the seconds of each round it is computed from."""

    topic: str
    case: str
    candidate: str
    metric: str
    value: float
    unit: str
    points: int = 0
    rounds: tuple[float, ...] = ()


def time_once(run: Run) -> Timing:
    """Times one run, including its work on a GPU."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    started, spent = time.perf_counter(), time.process_time()
    run()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return Timing(time.perf_counter() - started, time.process_time() - spent)


def time_interleaved(runs: dict[str, Run], repeats: int) -> dict[str, list[Timing]]:
    """Times of every run in every round; the order is reversed from one round to the next."""
    timings: dict[str, list[Timing]] = {name: [] for name in runs}
    for turn in range(repeats):
        for name in list(runs)[:: -1 if turn % 2 else 1]:
            timings[name].append(time_once(runs[name]))
    return timings


def run_comparison(comparison: Comparison, repeats: int) -> list[Figure]:
    """Times all candidates after one warm-up run each, whose results are compared.

    Returns:
        For each candidate its ``seconds`` and ``processor_seconds`` (medians of the rounds), ``spread`` (quartiles'
        distance over the median), ``ratio`` and ``processor_ratio`` (medians over rounds of its seconds divided by the
        baseline's) and, where results are compared, its ``gap``. On a shared machine, processor seconds vary less.

    Raises:
        AvatarError: when the baseline is not among the candidates.
    """
    if comparison.baseline not in comparison.candidates:
        known = ", ".join(comparison.candidates)
        raise AvatarError(f"{comparison.topic}: expected the baseline {comparison.baseline} among {known}.")
    runs = {name: prepare() for name, prepare in comparison.candidates.items()}
    found = {name: run() for name, run in runs.items()}
    gaps = {name: comparison.gap(found[name], found[comparison.baseline]) for name in runs} if comparison.gap else {}
    timings = time_interleaved(runs, repeats)

    def figure(name: str, metric: str, value: float, unit: str, rounds: tuple[float, ...] = ()) -> Figure:
        return Figure(comparison.topic, comparison.case, name, metric, value, unit, comparison.points, rounds)

    figures = []
    for name, mine in timings.items():
        seconds, spent = [timing.seconds for timing in mine], [timing.processor for timing in mine]
        pairs = list(zip(mine, timings[comparison.baseline]))
        low, _, high = quantiles(seconds, n=4) if len(seconds) > 1 else seconds * 3
        figures += [
            figure(name, "ratio", median(one.seconds / base.seconds for one, base in pairs), "1"),
            figure(
                name,
                "processor_ratio",
                median(one.processor / base.processor for one, base in pairs),
                "1",
            ),
            figure(name, "seconds", median(seconds), "s", tuple(seconds)),
            figure(name, "processor_seconds", median(spent), "s", tuple(spent)),
            figure(name, "spread", (high - low) / median(seconds), "1"),
        ]
        figures += [figure(name, "gap", gaps[name], "1")] if gaps else []
    return figures
