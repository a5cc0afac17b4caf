"""What is said of many scores: means over frames, the worst outfit, and how sure a difference between methods is."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from avatar.checks import AvatarError
from avatar.evaluation.metrics import find_metrics
from avatar.evaluation.scores import FrameScore, Score

FLOORS = ("sampling", "body", "static")


@dataclass(frozen=True)
class Cell:
    """A method's mean on one outfit, over its ``frames`` and over its training seeds."""

    value: float
    frames: int
    points: int


@dataclass(frozen=True)
class Interval:
    """A difference of two methods, ``first - second``, and where it lies with the given confidence."""

    difference: float
    low: float
    high: float
    confidence: float
    frames: int

    def written(self, scale: float) -> str:
        """The difference and its interval as printed, in units ``1 / scale`` of the metric's."""
        values = (self.difference * scale, self.low * scale, self.high * scale)
        return "{:+.3f} [{:+.3f}, {:+.3f}]".format(*values)


def method_key(row: Score | FrameScore) -> str:
    """How a method is named in tables: with its variant in brackets, if it has one."""
    return f"{row.method} ({row.variant})" if row.variant else row.method


def base_method(method: str) -> str:
    """The method of a `method_key`, without its variant."""
    return method.split(" (")[0]


def order_methods(methods: Iterable[str]) -> list[str]:
    """Floors first, in their order, then the methods by name."""
    rank = {floor: place for place, floor in enumerate(FLOORS)}
    return sorted(methods, key=lambda method: (rank.get(base_method(method), len(FLOORS)), method))


def tabulate(rows: Iterable[Score], metric: str) -> dict[str, dict[str, Cell]]:
    """Outfit to method to `Cell` for one metric; several training seeds of a method are averaged.

    Raises:
        AvatarError: for an unknown metric, one that nobody scored, or two rows for the same number.
    """
    (known,) = find_metrics([metric])
    found: dict[str, dict[str, dict[int, Score]]] = defaultdict(lambda: defaultdict(dict))
    for row in rows:
        if row.metric != known.name:
            continue
        seeds = found[row.outfit][method_key(row)]
        if row.seed in seeds:
            raise AvatarError(
                f"rows: two scores of {known.name} for {method_key(row)} on {row.outfit}, seed {row.seed}; "
                "keep one, or tell them apart by variant."
            )
        seeds[row.seed] = row
    if not found:
        raise AvatarError(f"rows: no score of {known.name} among them.")
    return {
        outfit: {
            method: Cell(
                float(np.mean([s.value for s in seeds.values()])),
                max(s.frames for s in seeds.values()),
                round(float(np.mean([s.points for s in seeds.values()]))),
            )
            for method, seeds in methods.items()
        }
        for outfit, methods in sorted(found.items())
    }


def frame_weighted_mean(cells: Iterable[Cell]) -> float:
    """The mean over all frames of all outfits: each outfit's mean counts as often as it has frames."""
    cells = list(cells)
    return float(np.average([cell.value for cell in cells], weights=[cell.frames for cell in cells]))


def worst_outfit(cells: Iterable[Cell], higher_is_better: bool = False) -> float:
    """The maximum over outfits of the per-outfit mean (the minimum, where higher is better)."""
    values = [cell.value for cell in cells]
    return min(values) if higher_is_better else max(values)


def bootstrap_difference(
    frames: Iterable[FrameScore],
    metric: str,
    first: str,
    second: str,
    resamples: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> Interval:
    """Percentile bootstrap of the frame-weighted mean difference of two methods over the frames both have.

    Frames are paired and redrawn within their outfit. They count as independent: true of settled poses; neighbours
    in a motion are alike, and the interval is then too narrow.

    Args:
        frames: single-frame scores. first, second: methods as `method_key` names them.

    Raises:
        AvatarError: when the two methods have no frame in common.
    """
    find_metrics([metric])
    values: dict[tuple[str, str], dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in frames:
        if row.metric == metric and method_key(row) in (first, second):
            values[row.outfit, row.frame][method_key(row)].append(row.value)
    outfits: dict[str, list[float]] = defaultdict(list)
    for (outfit, _), pair in values.items():
        if first in pair and second in pair:
            outfits[outfit].append(float(np.mean(pair[first]) - np.mean(pair[second])))
    if not outfits:
        raise AvatarError(f"frames: {first} and {second} have no frame of {metric} in common.")
    return bootstrap_mean(outfits.values(), resamples, confidence, seed)


def bootstrap_mean(
    groups: Iterable[Sequence[float]], resamples: int = 2000, confidence: float = 0.95, seed: int = 0
) -> Interval:
    """The mean of all values with its percentile bootstrap interval; values are redrawn within their group."""
    groups = [np.asarray(values, np.float64) for values in groups]
    count = sum(map(len, groups))
    generator, sums = np.random.default_rng(seed), np.zeros(resamples)
    for values in groups:
        sums += values[generator.integers(len(values), size=(resamples, len(values)))].sum(axis=1)
    low, high = np.quantile(sums / count, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Interval(float(sum(v.sum() for v in groups)) / count, float(low), float(high), confidence, count)
