"""Statistics of scores: means over seeds and frames, the worst outfit, bootstrap intervals of differences."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from avatar.checks import AvatarError, unknown_name
from avatar.evaluation.metrics import METRICS
from avatar.evaluation.scores import FrameScore, Score, Scores, csv_text

FLOORS = ("sampling", "body", "static")
ALL = "all outfits"
COLUMNS = ("metric", "outfit", "method", "baseline", "difference", "low", "high", "confidence", "frames", "unit")


class Place(NamedTuple):
    """What a number in a table is of; ``fraction`` of the training frames only where methods are not named by it."""

    method: str
    outfit: str
    metric: str
    fraction: str = ""


class Cell(NamedTuple):
    """A method's mean on one outfit, over its ``frames`` and over its training seeds."""

    value: float
    frames: int
    points: int


class Interval(NamedTuple):
    """A difference of two methods, ``first - second``, and where it lies with the given confidence."""

    difference: float
    low: float
    high: float
    confidence: float
    frames: int


class Difference(NamedTuple):
    """A method less its baseline in one metric, over one outfit's frames or over those of all, in the metric's unit."""

    metric: str
    outfit: str
    method: str
    baseline: str
    interval: Interval


def named(method: str, *parts: str) -> str:
    """A method with what tells it apart in brackets, if there is anything."""
    parts = tuple(filter(None, parts))
    return f"{method} ({', '.join(parts)})" if parts else method


def method_key(row: Score | FrameScore) -> str:
    """A method's name in tables, with its variant."""
    return named(row.method, row.variant)


def by_split(rows: Iterable[Any]) -> list[Any]:
    """Scores whose outfits are named with their split where it is another than test, so that tables tell them apart."""
    return [row if row.split == "test" else replace(row, outfit=named(row.outfit, row.split)) for row in rows]


def base_method(method: str) -> str:
    """The method of a `method_key`, without its variant."""
    return method.split(" (")[0]


def floor_rank(method: str) -> int:
    """Floors come first, in their order."""
    return (*FLOORS, base_method(method)).index(base_method(method))


def order_methods(methods: Iterable[str]) -> list[str]:
    """Floors first, in their order, then the methods by name."""
    return sorted(methods, key=lambda method: (floor_rank(method), method))


def find_counterpart(method: str, methods: Iterable[str], base: str) -> str | None:
    """Which variant of a base method another one is set against: that of its own variant, or the only one."""
    candidates = [other for other in methods if base_method(other) == base]
    own = base + method.removeprefix(base_method(method))
    return own if own in candidates else candidates[0] if len(candidates) == 1 else None


def grouped(rows: Iterable[Any], key: Callable[[Any], Any]) -> dict[Any, list]:
    """Rows by key, both in their order of appearance."""
    groups: dict[Any, list] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    return groups


def rows_of(rows: Iterable[Score], metrics: Collection[str]) -> list[Score]:
    """The rows of some metrics; `AvatarError` where there are none."""
    found = [row for row in rows if row.metric in metrics]
    if not found:
        raise AvatarError(f"rows: no score of {', '.join(metrics)} among them.")
    return found


def average_seeds(rows: Iterable[Score], by_fraction: bool = False) -> dict[Place, Cell]:
    """Means over training seeds, in the metrics' units; ``by_fraction`` keeps the share of frames out of the names."""

    def place_of(row: Score) -> Place:
        share = f"{100 * row.fraction:g}%" if by_fraction else ""
        method = named(row.method, *(part for part in row.variant.split(", ") if part != share))
        return Place(method, row.outfit, row.metric, share)

    cells = {}
    for place, mine in grouped(rows, place_of).items():
        seeds = [row.seed for row in mine]
        if twice := [seed for seed in seeds if seeds.count(seed) > 1]:
            raise AvatarError(
                f"rows: two scores of {place.metric} for {place.method} on {place.outfit}, seed {twice[0]}; keep one, "
                "or tell them apart by variant."
            )
        value, points = np.mean([(row.value, row.points) for row in mine], axis=0)
        cells[place] = Cell(float(value), max(row.frames for row in mine), round(float(points)))
    return cells


def frame_weighted_mean(cells: Sequence[Cell | Score]) -> float:
    """The mean over all frames of all outfits: each outfit's mean counts as often as it has frames."""
    return float(np.average([cell.value for cell in cells], weights=[cell.frames for cell in cells]))


def worst_outfit(cells: Iterable[Cell], higher_is_better: bool = False) -> float:
    """The maximum over outfits of the per-outfit mean (the minimum, where higher is better)."""
    return (min if higher_is_better else max)(cell.value for cell in cells)


def paired_differences(frames: Iterable[FrameScore], metric: str, first: str, second: str) -> dict[str, list[float]]:
    """``first - second``, methods as `method_key` names them, on every frame of both, by outfit; seeds are averaged."""
    mine = (row for row in frames if row.metric == metric and method_key(row) in (first, second))
    differences: dict[str, list[float]] = {}
    for (outfit, _), rows in grouped(mine, lambda row: (row.outfit, row.frame)).items():
        values = grouped(rows, method_key)
        if len(values) == 2:
            means = [float(np.mean([row.value for row in values[method]])) for method in (first, second)]
            differences.setdefault(outfit, []).append(means[0] - means[1])
    return differences


def bootstrap_mean(
    groups: Iterable[Sequence[float]], resamples: int = 2000, confidence: float = 0.95, seed: int = 0
) -> Interval:
    """The mean of all values with its percentile bootstrap interval; values are redrawn within their group. They count
    as independent: true of settled poses; for neighbours in a motion the interval is too narrow.
    """
    groups = [np.asarray(values, np.float64) for values in groups]
    count = sum(map(len, groups))
    generator, sums = np.random.default_rng(seed), np.zeros(resamples)
    for values in groups:
        sums += values[generator.integers(len(values), size=(resamples, len(values)))].sum(axis=1)
    low, high = np.quantile(sums / count, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Interval(float(sum(v.sum() for v in groups)) / count, float(low), float(high), confidence, count)


def compare_methods(
    scores: Scores, metric: str, baseline: str, resamples: int = 2000, confidence: float = 0.95
) -> list[Difference]:
    """Differences of every method to the baseline, paired by frame: for each outfit, then for all together. A method's
    baseline is that of its own variant where there is one, else the plain or the only one.
    """
    frames = [row for row in scores.frames if row.metric == metric]
    methods = order_methods({method_key(row) for row in frames})
    if baseline not in {*methods, *map(base_method, methods)}:
        raise unknown_name("baseline", baseline, methods)
    found = []
    for method in methods:
        other = find_counterpart(method, methods, baseline) or (baseline if baseline in methods else None)
        if other in (None, method) or base_method(method) == "sampling":
            continue
        pairs = paired_differences(frames, metric, method, other)
        groups = {outfit: [pairs[outfit]] for outfit in sorted(pairs)}
        if len(pairs) > 1:
            groups[ALL] = list(pairs.values())
        for outfit, values in groups.items():
            found.append(Difference(metric, outfit, method, other, bootstrap_mean(values, resamples, confidence)))
    return found


def differences_csv(found: Iterable[Difference]) -> str:
    """All differences as tidy CSV, in the metrics' own units."""
    return csv_text(COLUMNS, ((*d[:-1], *d.interval, METRICS[d.metric].unit) for d in found))
