"""The papers' table forms: scores spread over rows and columns by what they are of, and the numbers papers report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import product

from avatar.checks import AvatarError
from avatar.evaluation.aggregate import (
    Cell,
    Place,
    average_seeds,
    base_method,
    floor_rank,
    frame_weighted_mean,
    grouped,
    worst_outfit,
)
from avatar.evaluation.metrics import METRICS, find_metrics
from avatar.evaluation.scores import Score
from avatar.evaluation.tables import EXCESS_NOTE, Table, TableRow, definitions, seed_notes

MEAN, WORST = "mean", "max"  # over frames of all outfits; over outfits


class Axis(Enum):
    """What the rows or the columns of a table tell apart: the fields of a `Place`."""

    method = "method"
    outfit = "outfit"
    metric = "metric"
    fraction = "fraction"  # of the training frames; the method's name then leaves it out


@dataclass
class FormConfig:
    """Which axes run down a table and which across, the first of several being the slowest.

    An outfit axis has its single outfits, their mean and their worst, as chosen; without an outfit axis a cell is
    the mean over frames.
    """

    rows: tuple[Axis, ...] = (Axis.outfit,)
    columns: tuple[Axis, ...] = (Axis.metric, Axis.method)
    outfits: bool = True  # a line for each outfit
    summary: bool = True  # and for mean and worst

    def __post_init__(self):
        axes = [*self.rows, *self.columns]
        if len(set(axes)) < len(axes) or not {Axis.method, Axis.metric} <= set(axes):
            found = ", ".join(axis.value for axis in axes)
            raise AvatarError(f"form: expected every axis once, method and metric among them, got {found}.")
        if not (self.outfits or self.summary):
            raise AvatarError("form: expected outfits, summary or both.")


@dataclass
class ReportedTable:
    """What a paper's table says, for comparison: typed from the paper, as its ``source`` names it."""

    source: str = ""
    columns: tuple[str, ...] = ()
    rows: dict[str, tuple[float | None, ...]] = field(default_factory=dict)  # null where the paper has no number

    def __post_init__(self):
        wrong = [label for label, values in self.rows.items() if len(values) != len(self.columns)]
        if wrong:
            raise AvatarError(f"reported: expected {len(self.columns)} numbers a row, row {wrong[0]!r} has others.")


def reported_table(reported: ReportedTable) -> Table:
    """A paper's numbers as a table."""
    body = tuple(TableRow(label, values) for label, values in reported.rows.items())
    return Table(f"Reported: {reported.source}", "paper", reported.columns, body, ())


def form_table(
    rows: Sequence[Score], metrics: Sequence[str], form: FormConfig, title: str = "", excess: bool = False
) -> Table:
    """Scores in a paper's form; methods and outfits in their order of appearance, floors first.

    Several seeds of a method are averaged, and named in the notes. With ``excess`` every value is less the sampling
    floor's on the same outfit.

    Raises:
        AvatarError: for unknown metrics, metrics that nobody scored, or two scores of one seed for one cell.
    """
    known = {metric.name: metric for metric in find_metrics(tuple(metrics))}
    axes = (*form.rows, *form.columns)
    cells = average_seeds((row for row in rows if row.metric in known), Axis.fraction in axes)
    if not cells:
        raise AvatarError(f"rows: no score of {', '.join(known)} among them.")
    cells = {place: replace(cell, value=cell.value * known[place.metric].scale) for place, cell in cells.items()}
    if excess:
        cells = _above_sampling(cells)
    cells |= _summaries(cells)
    shown = _labels(cells, form)
    down, across = (list(product(*(shown[axis] for axis in chosen))) for chosen in (form.rows, form.columns))
    body = []
    for row in down:
        line = {axis: labels[0] for axis, labels in shown.items()} | dict(zip(form.rows, row))
        places = [line | dict(zip(form.columns, column)) for column in across]
        found = [cells.get(Place(*(place[axis] for axis in Axis))) for place in places]
        values = tuple(None if cell is None else cell.value for cell in found)
        if any(found):
            summary = Axis.outfit in form.rows and line[Axis.outfit] in (MEAN, WORST)
            body.append(TableRow(", ".join(map(_heading, form.rows, row)), values, summary))
    kept = [i for i in range(len(across)) if any(row.values[i] is not None for row in body)]
    body = [replace(row, values=tuple(row.values[i] for i in kept)) for row in body]
    names = [list(map(_heading, form.columns, across[i])) for i in kept]
    groups = tuple(", ".join(parts[:-1]) for parts in names) if len(form.columns) > 1 else ()
    corner, heads = ", ".join(axis.value for axis in form.rows), tuple(parts[-1] for parts in names)
    notes = (*definitions(known.values()), *seed_notes(rows), *([EXCESS_NOTE] if excess else []))
    return Table(title, corner, heads, tuple(body), notes, groups)


def _above_sampling(cells: dict[Place, Cell]) -> dict[Place, Cell]:
    """Every cell less the sampling floor of its outfit and metric; those without one are left out."""
    floors = {(p.outfit, p.metric): cell.value for p, cell in cells.items() if base_method(p.method) == "sampling"}
    return {
        place: replace(cell, value=cell.value - floors[place.outfit, place.metric])
        for place, cell in cells.items()
        if (place.outfit, place.metric) in floors and base_method(place.method) != "sampling"
    }


def _summaries(cells: dict[Place, Cell]) -> dict[Place, Cell]:
    """The mean over frames and the worst outfit of every method that has all the outfits."""
    count, found = len({place.outfit for place in cells}), {}
    for places in grouped(cells, lambda place: place._replace(outfit="")).values():
        if len(places) == count:
            first, mine = places[0], [cells[place] for place in places]
            worst = worst_outfit(mine, METRICS[first.metric].higher_is_better)
            found[first._replace(outfit=MEAN)] = replace(mine[0], value=frame_weighted_mean(mine))
            found[first._replace(outfit=WORST)] = replace(mine[0], value=worst)
    return found


def _labels(cells: dict[Place, Cell], form: FormConfig) -> dict[Axis, list[str]]:
    """The labels on each axis, in order; one for an axis that the form lacks."""
    methods, outfits, metrics, fractions = (list(dict.fromkeys(p[i] for p in cells)) for i in range(len(Axis)))
    outfits = [outfit for outfit in outfits if outfit not in (MEAN, WORST)]
    if Axis.outfit not in (*form.rows, *form.columns):
        outfits = [MEAN]
    elif len(outfits) > 1:
        outfits = [*(outfits if form.outfits else []), *((MEAN, WORST) if form.summary else ())]
    methods.sort(key=floor_rank)
    fractions.sort(key=lambda share: -float(share.rstrip("%") or 100))
    return dict(zip(Axis, (methods, outfits, metrics, fractions)))


def _heading(axis: Axis, label: str) -> str:
    """A label as printed: metrics with their unit."""
    return METRICS[label].heading if axis is Axis.metric else label
