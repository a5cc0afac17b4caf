"""Seam tests as tidy rows and tables: methods at the same places of the body, near seams and far from them."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from avatar.checks import unknown_name
from avatar.evaluation.aggregate import Interval, bootstrap_mean
from avatar.evaluation.scoring import Label
from avatar.evaluation.seams import BODY, LIMITS, UNITS, FrameMean, SeamKey
from avatar.evaluation.tables import Table, TableRow

COLUMNS = ("table", "dataset", "outfit", "method", "variant", "seed", "steps", "metric", "where", "low", "high")
COLUMNS += ("value", "unit", "points", "frames", "commit")


@dataclass(frozen=True)
class SeamTest:
    """One run's seam test on one outfit, frame by frame, in the same order for all runs."""

    label: Label
    dataset: str
    outfit: str
    frames: tuple[dict[SeamKey, FrameMean], ...]

    @property
    def name(self) -> str:
        """The run in tables."""
        return name_of(self.label)

    def mean(self, key: SeamKey) -> FrameMean:
        """A metric over the points of all frames."""
        values = [frame[key] for frame in self.frames if frame[key].points]
        points = sum(value.points for value in values)
        total = sum(value.mean * value.points for value in values)
        return FrameMean(total / points if points else float("nan"), points)


def name_of(label: Label) -> str:
    """A run in tables."""
    parts = [part for part in (label.variant, f"seed {label.seed}" if label.seed else "") if part]
    return f"{label.method} ({', '.join(parts)})" if parts else label.method


def check_baseline(names: Sequence[str], baseline: str) -> None:
    """Refuses a baseline that is none of the runs in a table.

    Raises:
        AvatarError: naming those there are.
    """
    if baseline not in names:
        raise unknown_name("baseline", baseline, names)


def to_csv(tests: Sequence[SeamTest]) -> str:
    """Every mean as a tidy row, in metres and degrees; distances from seams in metres."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    for test in tests:
        shared = asdict(test.label) | {"dataset": test.dataset, "outfit": test.outfit, "frames": len(test.frames)}
        for key in test.frames[0]:
            mean = test.mean(key)
            row = asdict(key) | {"value": mean.mean, "points": mean.points, "unit": UNITS[key.metric]}
            writer.writerow(shared | row)
    return text.getvalue()


def seam_table(tests: Sequence[SeamTest]) -> Table:
    """One outfit's tests: metrics by distance to the seam, and jumps, down; runs across."""
    body = []
    for key in tests[0].frames[0]:
        values = [test.mean(key).mean * _scale(key) for test in tests]
        body.append(TableRow(_describe(key), tuple(v if np.isfinite(v) else None for v in values)))
    return Table(f"{tests[0].outfit}: seams", "where", tuple(test.name for test in tests), tuple(body), NOTES)


def seam_differences(tests: Sequence[SeamTest], baseline: str, confidence: float = 0.95) -> Table:
    """One outfit's tests less a baseline's at the same places, near seams and far, with intervals over frames.

    Raises:
        AvatarError: when no run has the baseline's name.
    """
    names = [test.name for test in tests]
    check_baseline(names, baseline)
    base, others = tests[names.index(baseline)], [test for test in tests if test.name != baseline]
    body = []
    for metric in ("distance", "angle"):
        keys = [key for key in base.frames[0] if (key.metric, key.where) == (metric, BODY)]
        near = f"{100 * LIMITS[1]:g} cm"
        for where, mine in ((f"nearer than {near}", keys[:1]), (f"farther than {near}", keys[1:])):
            intervals = [_paired(test, base, mine, confidence) for test in others]
            scale = _scale(keys[0])
            texts = tuple(
                f"{i.difference * scale:+.3f} [{i.low * scale:+.3f}, {i.high * scale:+.3f}]" for i in intervals
            )
            values = tuple(i.difference * scale for i in intervals)
            body.append(TableRow(f"{metric}, {where} ({_unit(keys[0])})", values, texts=texts))
    note = f"Differences to {baseline} with {100 * confidence:g}% intervals: percentile bootstrap over frames, paired."
    return Table(f"{base.outfit}: seams, difference", "where", tuple(t.name for t in others), tuple(body), (note,))


def _paired(test: SeamTest, base: SeamTest, keys: Sequence[SeamKey], confidence: float) -> Interval:
    """The mean over frames of what two runs differ by, over the points of some bands."""
    values = [[_joined(frame, keys) for frame in each.frames] for each in (test, base)]
    differences = np.subtract(*values)
    return bootstrap_mean([differences[np.isfinite(differences)]], confidence=confidence)


def _joined(frame: dict[SeamKey, FrameMean], keys: Sequence[SeamKey]) -> float:
    """One frame's mean over several bands together."""
    found = [frame[key] for key in keys if frame[key].points]
    points = sum(mean.points for mean in found)
    return sum(mean.mean * mean.points for mean in found) / points if points else float("nan")


def _describe(key: SeamKey) -> str:
    name = key.metric.replace("_", " ")
    if key.where != BODY:
        return f"{name} at {key.where} ({_unit(key)})"
    band = f"{100 * key.low:g} to {100 * key.high:g} cm" if key.high < LIMITS[-1] else f"over {100 * key.low:g} cm"
    return f"{name}, {band} ({_unit(key)})"


def _unit(key: SeamKey) -> str:
    return "°" if UNITS[key.metric] == "deg" else "mm"


def _scale(key: SeamKey) -> float:
    return 1.0 if UNITS[key.metric] == "deg" else 1000.0


NOTES = (
    "Predictions at the same places of the body for all methods; only those that end on cloth, where scans know it.",
    "distance: mean distance of predicted points to the tangent plane at the nearest scan point, by how far their "
    "place on the body at rest is from the nearest seam of the UV atlas. angle: the same for normals.",
    "jump: mean distance between two predictions for one place, the middle of an edge, as a point of the triangle on "
    "either side. normal jump: the same for normals. Other edges are drawn at random, as many as there are seams.",
)
