"""Races: contenders for one job take turns in one process, so that ratios hang less on what else the machine does."""

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
    """Why a contender is not there, for a table that others read: no path of this machine."""
    return f"not installed (extra {EXTRAS[package]})"


@dataclass(frozen=True)
class Lap:
    """One run's ``seconds`` by the clock, and those that processors spent on it in this process."""

    seconds: float
    processor: float


@dataclass(frozen=True)
class Job:
    """What all benchmarks are told: sizes (``quick`` ones are for tests), device, and settings of networks by label.

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
        """The avatars that run: all, or the small ones in tests."""
        return [label for label in self.avatars if label.endswith("_small") or not self.quick]

    @property
    def largest_pop(self) -> str:
        """POP's label that the others are measured by."""
        return next(label for label in ("pop_full", "pop_small") if label in self.labels)

    def cost(self, lap: Lap) -> float:
        """What a run costs in seconds: of processors on the CPU, where others may want them too, else by the clock."""
        return lap.processor if self.device == "cpu" else lap.seconds

    def size(self, full: int, quick: int) -> int:
        """A size, or its stand-in for tests."""
        return quick if self.quick else full


@dataclass(frozen=True)
class Race:
    """Contenders for one job of one size.

    ``contenders`` are names to functions that prepare a contender and give what is timed; ``base`` is the one the
    others are measured by; ``gap`` gives how far a result is from the base's, where they must agree; ``absent`` are
    names to reasons of those that cannot run here; ``points`` is the size for the table's column.
    """

    topic: str
    case: str
    contenders: dict[str, Callable[[], Run]]
    base: str
    gap: Callable[[Any, Any], float] | None = None
    absent: dict[str, str] = field(default_factory=dict)
    points: int = 0


@dataclass(frozen=True)
class Figure:
    """One number of the table: who, at what, and the seconds of each round it comes from."""

    topic: str
    case: str
    contender: str
    metric: str
    value: float
    unit: str
    points: int = 0
    rounds: tuple[float, ...] = ()


def time_once(run: Run) -> Lap:
    """Times one run, with all that it started on a GPU."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    started, spent = time.perf_counter(), time.process_time()
    run()
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return Lap(time.perf_counter() - started, time.process_time() - spent)


def take_turns(runs: dict[str, Run], repeats: int) -> dict[str, list[Lap]]:
    """Times of every run in every round; the order turns round from one round to the next."""
    laps: dict[str, list[Lap]] = {name: [] for name in runs}
    for turn in range(repeats):
        for name in list(runs)[:: -1 if turn % 2 else 1]:
            laps[name].append(time_once(runs[name]))
    return laps


def run_race(race: Race, repeats: int) -> list[Figure]:
    """Times all contenders after one run each to warm up, in which results are compared.

    Returns:
        For each contender its ``seconds`` and ``processor_seconds`` (medians of the rounds), ``spread`` (quartiles'
        distance over the median), ``ratio`` and ``processor_ratio`` (medians over rounds of its seconds by the
        base's) and, where results are compared, its ``gap``. On a machine that others use, processors' seconds are
        the steadier measure.

    Raises:
        AvatarError: when the base is not among the contenders.
    """
    if race.base not in race.contenders:
        raise AvatarError(f"{race.topic}: expected the base {race.base} among {', '.join(race.contenders)}.")
    runs = {name: prepare() for name, prepare in race.contenders.items()}
    found = {name: run() for name, run in runs.items()}
    gaps = {name: race.gap(found[name], found[race.base]) for name in runs} if race.gap else {}
    laps = take_turns(runs, repeats)

    def figure(name: str, metric: str, value: float, unit: str, rounds: tuple[float, ...] = ()) -> Figure:
        return Figure(race.topic, race.case, name, metric, value, unit, race.points, rounds)

    figures = []
    for name, mine in laps.items():
        seconds, spent = [lap.seconds for lap in mine], [lap.processor for lap in mine]
        pairs = list(zip(mine, laps[race.base]))
        low, _, high = quantiles(seconds, n=4) if len(seconds) > 1 else seconds * 3
        figures += [
            figure(name, "ratio", median(lap.seconds / base.seconds for lap, base in pairs), "1"),
            figure(name, "processor_ratio", median(lap.processor / base.processor for lap, base in pairs), "1"),
            figure(name, "seconds", median(seconds), "s", tuple(seconds)),
            figure(name, "processor_seconds", median(spent), "s", tuple(spent)),
            figure(name, "spread", (high - low) / median(seconds), "1"),
        ]
        figures += [figure(name, "gap", gaps[name], "1")] if gaps else []
    return figures
