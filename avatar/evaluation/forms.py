"""The papers' table forms: scores spread over rows and columns by what they are of, and the numbers papers report."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import product

from avatar.checks import AvatarError
from avatar.evaluation.aggregate import FLOORS, Cell, base_method, frame_weighted_mean, worst_outfit
from avatar.evaluation.metrics import METRICS, find_metrics
from avatar.evaluation.scores import Score
from avatar.evaluation.tables import Table, TableRow, seed_notes

MEAN, WORST = "mean", "max"  # over frames of all outfits; over outfits


class Axis(Enum):
    """What the rows or the columns of a table tell apart."""

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
            named = ", ".join(axis.value for axis in axes)
            raise AvatarError(f"form: expected every axis once, method and metric among them, got {named}.")
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


@dataclass(frozen=True)
class _Place:
    """Where a cell stands on each axis."""

    method: str
    outfit: str
    metric: str
    fraction: str


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
    cells = _cells([row for row in rows if row.metric in known], Axis.fraction in (*form.rows, *form.columns))
    if not cells:
        raise AvatarError(f"rows: no score of {', '.join(known)} among them.")
    notes = [f"{name}: {metric.definition}" for name, metric in known.items()] + seed_notes(rows)
    if excess:
        cells = _above_sampling(cells)
        notes.append("Excess: the value less the sampling floor's on the same outfit.")
    _summarise(cells)
    shown = _labels(cells, form)
    down, across = (list(product(*(shown[axis] for axis in axes))) for axes in (form.rows, form.columns))
    body = []
    for row in down:
        line = dict(zip(form.rows, row))
        values = [_value(cells, line | dict(zip(form.columns, column)), shown) for column in across]
        if any(value is not None for value in values):
            summary = line.get(Axis.outfit) in (MEAN, WORST)
            body.append(
                TableRow(", ".join(_name(axis, label) for axis, label in line.items()), tuple(values), 3, summary)
            )
    named = [[_name(axis, label) for axis, label in zip(form.columns, column)] for column in across]
    groups = tuple(", ".join(names[:-1]) for names in named) if len(form.columns) > 1 else ()
    corner, heads = ", ".join(axis.value for axis in form.rows), tuple(names[-1] for names in named)
    return _without_empty_columns(Table(title, corner, heads, tuple(body), tuple(notes), groups))


def reported_table(reported: ReportedTable) -> Table:
    """A paper's numbers as a table."""
    body = tuple(TableRow(label, values) for label, values in reported.rows.items())
    return Table(f"Reported: {reported.source}", "paper", reported.columns, body, ())


def _cells(rows: Iterable[Score], by_fraction: bool) -> dict[_Place, Cell]:
    """Displayed values by place, seeds averaged."""
    found: dict[_Place, dict[int, Score]] = {}
    for row in rows:
        share = f"{100 * row.fraction:g}%"
        parts = [part for part in row.variant.split(", ") if part and not (by_fraction and part == share)]
        method = f"{row.method} ({', '.join(parts)})" if parts else row.method
        seeds = found.setdefault(_Place(method, row.outfit, row.metric, share if by_fraction else ""), {})
        if row.seed in seeds:
            raise AvatarError(
                f"rows: two scores of {row.metric} for {method} on {row.outfit}, seed {row.seed}; keep one, or tell "
                "them apart by variant."
            )
        seeds[row.seed] = row
    cells = {}
    for place, seeds in found.items():
        values = [score.value * METRICS[place.metric].scale for score in seeds.values()]
        first = next(iter(seeds.values()))
        cells[place] = Cell(sum(values) / len(values), first.frames, first.points)
    return cells


def _above_sampling(cells: dict[_Place, Cell]) -> dict[_Place, Cell]:
    """Every cell less the sampling floor of its outfit and metric; those without one are left out."""
    floors = {(p.outfit, p.metric): c.value for p, c in cells.items() if base_method(p.method) == "sampling"}
    return {
        place: Cell(cell.value - floors[place.outfit, place.metric], cell.frames, cell.points)
        for place, cell in cells.items()
        if (place.outfit, place.metric) in floors and base_method(place.method) != "sampling"
    }


def _summarise(cells: dict[_Place, Cell]) -> None:
    """Adds the mean over frames and the worst outfit of every method that has all the outfits."""
    outfits = {place.outfit for place in cells}
    groups: dict[tuple[str, str, str], list[Cell]] = {}
    for place, cell in cells.items():
        groups.setdefault((place.method, place.metric, place.fraction), []).append(cell)
    for (method, metric, fraction), mine in groups.items():
        if len(mine) == len(outfits):
            frames, points = sum(cell.frames for cell in mine), mine[0].points
            worst = worst_outfit(mine, METRICS[metric].higher_is_better)
            cells[_Place(method, MEAN, metric, fraction)] = Cell(frame_weighted_mean(mine), frames, points)
            cells[_Place(method, WORST, metric, fraction)] = Cell(worst, frames, points)


def _labels(cells: dict[_Place, Cell], form: FormConfig) -> dict[Axis, list[str]]:
    """The labels on each axis, in order."""
    methods = list(dict.fromkeys(place.method for place in cells))
    rank = {floor: place for place, floor in enumerate(FLOORS)}
    methods.sort(key=lambda method: rank.get(base_method(method), len(rank)))
    outfits = [name for name in dict.fromkeys(place.outfit for place in cells) if name not in (MEAN, WORST)]
    several = len(outfits) > 1
    outfits = (outfits if form.outfits or not several else []) + ([MEAN, WORST] if form.summary and several else [])
    fractions = sorted({place.fraction for place in cells}, key=lambda share: -float(share.rstrip("%") or 100))
    return {
        Axis.method: methods,
        Axis.outfit: outfits if Axis.outfit in (*form.rows, *form.columns) else [MEAN],
        Axis.metric: list(dict.fromkeys(place.metric for place in cells)),
        Axis.fraction: fractions,
    }


def _value(cells: dict[_Place, Cell], line: dict[Axis, str], shown: dict[Axis, list[str]]) -> float | None:
    """The number at a row and a column; axes that the form lacks have one label."""
    place = {axis.value: line.get(axis, shown[axis][0]) for axis in Axis}
    cell = cells.get(_Place(**place))
    return None if cell is None else cell.value


def _name(axis: Axis, label: str) -> str:
    """A label as printed: metrics with their unit."""
    if axis is Axis.metric and METRICS[label].shown_in != "1":
        return f"{label} ({METRICS[label].shown_in})"
    return label


def _without_empty_columns(table: Table) -> Table:
    kept = [i for i in range(len(table.columns)) if any(row.values[i] is not None for row in table.rows)]
    rows = tuple(replace(row, values=tuple(row.values[i] for i in kept)) for row in table.rows)
    columns, groups = (tuple(heads[i] for i in kept if heads) for heads in (table.columns, table.groups))
    return replace(table, columns=columns, rows=rows, groups=groups)
