"""How much better or worse methods are than a baseline, and how sure that is; and what their training cost."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avatar.checks import unknown_name
from avatar.evaluation.aggregate import Interval, base_method, bootstrap_difference, method_key, order_methods
from avatar.evaluation.metrics import METRICS
from avatar.evaluation.scores import Score, Scores
from avatar.evaluation.tables import Table, TableRow

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

    A method's baseline is that of its own variant where there is one.

    Raises:
        AvatarError: when the baseline was not scored.
    """
    frames = [row for row in scores.frames if row.metric == metric]
    methods = order_methods({method_key(row) for row in frames})
    if baseline not in {*methods, *map(base_method, methods)}:
        raise unknown_name("baseline", baseline, methods)
    found = []
    for method in methods:
        other = find_baseline(method, methods, baseline)
        if other in (None, method) or base_method(method) == "sampling":
            continue
        pair = [row for row in frames if method_key(row) in (method, other)]
        shared = _shared_outfits(pair, method, other)
        groups = [(outfit, [row for row in pair if row.outfit == outfit]) for outfit in shared]
        groups += [(ALL, pair)] if len(shared) > 1 else []
        for outfit, mine in groups:
            interval = bootstrap_difference(mine, metric, method, other, resamples, confidence)
            found.append(Difference(metric, outfit, method, other, interval))
    return found


def find_baseline(method: str, methods: Sequence[str], baseline: str) -> str | None:
    """What a method is set against: the baseline of its own variant, else the plain or the only one, else nothing."""
    candidates = [other for other in methods if base_method(other) == baseline]
    own = baseline + method.removeprefix(base_method(method))
    if own in candidates:
        return own
    if baseline in methods:
        return baseline
    return candidates[0] if len(candidates) == 1 else None


def _shared_outfits(frames: Sequence, first: str, second: str) -> list[str]:
    """Outfits of which both methods were scored on a frame; another split's frames are none of test's."""
    seen = {key: {(row.outfit, row.frame) for row in frames if method_key(row) == key} for key in (first, second)}
    return sorted({outfit for outfit, _ in seen[first] & seen[second]})


def difference_table(found: Sequence[Difference], metric: str) -> Table:
    """Outfits by methods: differences to the baseline with their intervals, negative where the method is lower."""
    known = METRICS[metric]
    mine = [difference for difference in found if difference.metric == metric]
    methods = tuple(dict.fromkeys(difference.method for difference in mine))
    outfits = dict.fromkeys(d.outfit for d in mine if d.outfit != ALL)
    outfits |= dict.fromkeys(d.outfit for d in mine if d.outfit == ALL)
    cells = {(d.outfit, d.method): d.interval for d in mine}
    rows = []
    for outfit in outfits:
        intervals = [cells.get((outfit, method)) for method in methods]
        values = tuple(None if i is None else i.difference * known.scale for i in intervals)
        texts = tuple("–" if i is None else i.written(known.scale) for i in intervals)
        rows.append(TableRow(outfit, values, summary=outfit == ALL, texts=texts))
    confidence = 100 * mine[0].interval.confidence if mine else 95
    notes = (
        f"Difference to the baseline ({', '.join(dict.fromkeys(d.baseline for d in mine))}) with its {confidence:g}% "
        "interval: percentile bootstrap over frames, paired by frame, redrawn within each outfit. An interval speaks "
        "of other frames, not of another training.",
    )
    return Table(f"{known.name}, difference ({known.shown_in})", "outfit", methods, tuple(rows), notes)


def differences_csv(found: Sequence[Difference]) -> str:
    """All differences as tidy CSV, in the metrics' own units."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for d in found:
        i = d.interval
        row = (d.metric, d.outfit, d.method, d.baseline, i.difference, i.low, i.high, i.confidence, i.frames)
        writer.writerow((*row, METRICS[d.metric].unit))
    return text.getvalue()


def budget_table(rows: Sequence[Score]) -> Table:
    """What each method's training took: steps and minutes a run, and whether the methods had the same."""
    spent: dict[str, dict[tuple[str, int], tuple[int, float]]] = {}
    for row in rows:
        if row.steps:
            spent.setdefault(method_key(row), {})[row.outfit, row.seed] = (row.steps, row.seconds)
    body, steps, minutes = [], set(), []
    for method in order_methods(spent):
        runs = list(spent[method].values())
        steps |= {count for count, _ in runs}
        minutes += [seconds / 60 for _, seconds in runs]
        mean = (float(np.mean([count for count, _ in runs])), float(np.mean([seconds for _, seconds in runs])) / 60)
        body.append(TableRow(method, mean, texts=(f"{mean[0]:,.0f}", f"{mean[1]:.1f}")))
    if not body:
        note = "Nothing here was trained."
    elif len(steps) == 1:
        note = f"Equal steps: {steps.pop():,} each."
    elif max(minutes) <= 1.05 * min(minutes):
        note = f"Equal time: {np.mean(minutes):.1f} minutes each."
    else:
        note = "Neither steps nor time were equal."
    return Table("training of one run", "method", ("steps", "minutes"), tuple(body), (note, SHARED_NOTE))


SHARED_NOTE = "Minutes are by the clock; jobs that share a machine slow each other down."
