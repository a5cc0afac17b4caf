"""Differences of methods to a baseline with their intervals, and what training cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from avatar.checks import unknown_name
from avatar.evaluation.aggregate import (
    Interval,
    base_method,
    bootstrap_mean,
    find_counterpart,
    grouped,
    method_key,
    order_methods,
    paired_differences,
)
from avatar.evaluation.metrics import METRICS
from avatar.evaluation.scores import Score, Scores, csv_text
from avatar.evaluation.tables import Table, TableRow, interval_row

ALL = "all outfits"
COLUMNS = ("metric", "outfit", "method", "baseline", "difference", "low", "high", "confidence", "frames", "unit")


@dataclass(frozen=True)
class Difference:
    """A method less its baseline in one metric, over one outfit's frames or over those of all, in the metric's unit."""

    metric: str
    outfit: str
    method: str
    baseline: str
    interval: Interval


def compare_methods(
    scores: Scores, metric: str, baseline: str, resamples: int = 2000, confidence: float = 0.95
) -> list[Difference]:
    """Differences of every method to the baseline, paired by frame: for each outfit, then for all together.

    A method's baseline is that of its own variant where there is one, else the plain or the only one.

    Raises:
        AvatarError: when the baseline was not scored.
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
            interval = bootstrap_mean(values, resamples, confidence)
            found.append(Difference(metric, outfit, method, other, interval))
    return found


def difference_table(found: Sequence[Difference], metric: str) -> Table:
    """Outfits by methods: differences to the baseline with their intervals, negative where the method is lower."""
    known = METRICS[metric]
    mine = [difference for difference in found if difference.metric == metric]
    methods = tuple(dict.fromkeys(difference.method for difference in mine))
    cells = {(d.outfit, d.method): d.interval for d in mine}
    outfits = sorted(dict.fromkeys(d.outfit for d in mine), key=lambda outfit: outfit.startswith(ALL))
    rows = [
        interval_row(outfit, [cells.get((outfit, method)) for method in methods], known.scale, outfit.startswith(ALL))
        for outfit in outfits
    ]
    confidence = 100 * mine[0].interval.confidence if mine else 95
    notes = (
        f"Difference to the baseline ({', '.join(dict.fromkeys(d.baseline for d in mine))}) with its {confidence:g}% "
        "interval: percentile bootstrap over frames, paired by frame, redrawn within each outfit. An interval speaks "
        "of other frames, not of another training.",
    )
    return Table(f"{known.name}, difference ({known.shown_in})", "outfit", methods, tuple(rows), notes)


def differences_csv(found: Sequence[Difference]) -> str:
    """All differences as tidy CSV, in the metrics' own units."""
    rows = ((d.metric, d.outfit, d.method, d.baseline, *astuple(d.interval), METRICS[d.metric].unit) for d in found)
    return csv_text(COLUMNS, rows)


def budget_table(rows: Sequence[Score]) -> Table:
    """What each method's training took: steps and minutes a run, and whether the methods had the same."""
    trained = grouped((row for row in rows if row.steps), method_key)
    body, steps, minutes = [], set(), []
    for method in order_methods(trained):
        spent = {(row.outfit, row.seed): (row.steps, row.seconds / 60) for row in trained[method]}
        counts, times = zip(*spent.values())
        steps.update(counts)
        minutes += times
        mean = float(np.mean(counts)), float(np.mean(times))
        body.append(TableRow(method, mean, texts=(f"{mean[0]:,.0f}", f"{mean[1]:.1f}")))
    if not body:
        note = "Nothing here was trained."
    elif len(steps) == 1:
        note = f"Equal steps: {steps.pop():,} each."
    elif max(minutes) <= 1.05 * min(minutes):
        note = f"Equal time: {np.mean(minutes):.1f} minutes each."
    else:
        note = "Neither steps nor time were equal."
    shared = "Minutes are by the clock; jobs that share a machine slow each other down."
    return Table("training of one run", "method", ("steps", "minutes"), tuple(body), (note, shared))
