"""Tables made from tidy scores, with floors and definitions, as Markdown and LaTeX."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import groupby

import numpy as np

from avatar.checks import AvatarError
from avatar.evaluation.aggregate import (
    Cell,
    Interval,
    average_seeds,
    base_method,
    find_counterpart,
    frame_weighted_mean,
    grouped,
    method_key,
    order_methods,
    tabulate,
    worst_outfit,
)
from avatar.evaluation.metrics import METRICS, Metric, find_metrics
from avatar.evaluation.scores import Score


class View(Enum):
    """What a table shows of a metric; excess is the value less the sampling floor's."""

    VALUE = "value"
    EXCESS = "excess"
    OF_BODY = "excess over the body floor's excess"
    OF_STATIC = "excess over the static method's excess"


BASES = {View.OF_BODY: "body", View.OF_STATIC: "static"}
FLOOR_NOTE = (
    "Floors: sampling is a second random sampling of the true surface (what a perfect surface scores), body the bare "
    "body's surface, static the same network without its pose branch."
)
EXCESS_NOTE = "Excess: the value less the sampling floor's on the same outfit."


@dataclass(frozen=True)
class TableRow:
    """A labelled row; None stands where there is no number. ``summary`` rows are set off from the others.

    ``texts`` are printed in the numbers' place where there is more to say.
    """

    label: str
    values: tuple[float | None, ...]
    summary: bool = False
    texts: tuple[str, ...] | None = None

    @property
    def cells(self) -> tuple[str, ...]:
        """The numbers as printed."""
        return self.texts or tuple("–" if value is None else f"{value:.3f}" for value in self.values)


def interval_row(label: str, intervals: Sequence[Interval | None], scale: float, summary: bool = False) -> TableRow:
    """Differences with their intervals, in units ``1 / scale`` of the metric's."""
    values = tuple(None if i is None else i.difference * scale for i in intervals)
    return TableRow(label, values, summary, tuple("–" if i is None else i.written(scale) for i in intervals))


@dataclass(frozen=True)
class Table:
    """A table ready to print: ``corner`` heads the labels, ``notes`` hold the definitions printed below.

    ``groups``, where there are any, stand above the columns: one a column, equal neighbours as one heading.
    """

    title: str
    corner: str
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]
    notes: tuple[str, ...]
    groups: tuple[str, ...] = ()

    @property
    def heads(self) -> tuple[str, ...]:
        """The columns by their full names."""
        return tuple(f"{group}, {column}" for group, column in zip(self.groups, self.columns)) or self.columns


def outfit_table(rows: Sequence[Score], metric: str, view: View = View.VALUE) -> Table:
    """Outfits by methods for one metric, with mean and worst outfit below and its definition in the notes.

    Raises:
        AvatarError: for an unknown or unscored metric, or a view whose floor was not scored.
    """
    (known,) = find_metrics([metric])
    grid, ratio = tabulate(rows, metric), view in BASES
    methods = order_methods({method for cells in grid.values() for method in cells})
    for floor in () if view is View.VALUE else ("sampling", BASES.get(view, "sampling")):
        if floor not in map(base_method, methods):
            raise AvatarError(f"rows: the view '{view.value}' needs the {floor} floor, and it was not scored.")
    shown = {outfit: _viewed(cells, view, 1 if ratio else known.scale) for outfit, cells in grid.items()}
    columns = {method: [cells[method] for cells in shown.values() if method in cells] for method in methods}
    whole = {method: cells for method, cells in columns.items() if len(cells) == len(shown)}
    falls = known.higher_is_better and not ratio
    mean = _plain_mean if ratio else frame_weighted_mean
    means = {method: mean(cells) for method, cells in whole.items()}
    worst = {method: worst_outfit(cells, falls) for method, cells in whole.items()}
    body = [
        *(TableRow(outfit, _values(cells, methods)) for outfit, cells in shown.items()),
        TableRow("mean over outfits" if ratio else "mean over frames", tuple(map(means.get, methods)), summary=True),
        TableRow("min over outfits" if falls else "max over outfits", tuple(map(worst.get, methods)), summary=True),
    ]
    notes = [*definitions([known]), FLOOR_NOTE, *([] if view is View.VALUE else [EXCESS_NOTE])]
    notes += [*_point_notes(grid.values()), *seed_notes(rows)]
    title = f"{known.name}, {view.value} ({'ratio' if ratio else known.shown_in})"
    return Table(title, "outfit", tuple(methods), tuple(body), tuple(notes))


def metric_table(rows: Sequence[Score], outfit: str) -> Table:
    """Metrics by methods for one outfit, all that were scored, with every definition in the notes."""
    table = tabulate_metrics(rows, outfit, METRICS.values())
    scored = {row.metric for row in rows if row.outfit == outfit}
    first = next((name for name in METRICS if name in scored), None)
    mine = [row for row in rows if row.outfit == outfit and row.metric == first]
    counts = _point_notes(tabulate(mine, first).values()) if mine else []
    return replace(table, notes=(*table.notes, FLOOR_NOTE, *counts))


def tabulate_metrics(rows: Sequence[Score], outfit: str, metrics: Iterable[Metric], first: str = "") -> Table:
    """Those of some metrics that were scored by methods for one outfit, with their definitions in the notes.

    Floors come first, or the method named ``first``.

    Raises:
        AvatarError: for an outfit that nobody scored, or two rows for the same number.
    """
    cells = average_seeds(row for row in rows if row.outfit == outfit)
    if not cells:
        raise AvatarError(f"outfit: nobody scored {outfit!r}; there are {', '.join(sorted({r.outfit for r in rows}))}.")
    grid = {m: {place.method: cell for place, cell in cells.items() if place.metric == m.name} for m in metrics}
    grid = {metric: _viewed(found, View.VALUE, metric.scale) for metric, found in grid.items() if found}
    methods = order_methods({method for found in grid.values() for method in found})
    methods.sort(key=lambda method: method != first if first else False)
    body = tuple(TableRow(metric.heading, _values(found, methods)) for metric, found in grid.items())
    return Table(outfit, "metric", tuple(methods), body, tuple(definitions(grid)))


def definitions(metrics: Iterable[Metric]) -> list[str]:
    """What stands below a table of some metrics."""
    return [f"{metric.name}: {metric.definition}" for metric in metrics]


def _viewed(cells: dict[str, Cell], view: View, scale: float) -> dict[str, Cell]:
    """One outfit's cells as the view shows them; those that a missing floor leaves undefined are left out."""
    floor = 0.0
    if view is not View.VALUE:
        floor = next((cell.value for method, cell in cells.items() if base_method(method) == "sampling"), None)
        if floor is None:
            return {}
    excess = {method: replace(cell, value=(cell.value - floor) * scale) for method, cell in cells.items()}
    if view not in BASES:
        return excess
    bases = {method: excess.get(find_counterpart(method, excess, BASES[view])) for method in excess}
    return {
        method: replace(cell, value=cell.value / bases[method].value)
        for method, cell in excess.items()
        if bases[method] and bases[method].value
    }


def _plain_mean(cells: Sequence[Cell]) -> float:
    return float(np.mean([cell.value for cell in cells]))


def _values(cells: dict[str, Cell], methods: Sequence[str]) -> tuple[float | None, ...]:
    return tuple(cells[method].value if method in cells else None for method in methods)


def _point_notes(grid: Iterable[dict[str, Cell]]) -> list[str]:
    """A warning where methods predict other point counts than the sampling floor was taken at."""
    counts: dict[str, set[int]] = {}
    for cells in grid:
        for method, cell in cells.items():
            counts.setdefault(method, set()).add(cell.points)
    if len(set().union(*counts.values())) <= 1:
        return []
    listed = "; ".join(f"{m} {', '.join(f'{c:,}' for c in sorted(counts[m]))}" for m in order_methods(counts))
    return [f"Point counts differ, and with them the sampling floor: {listed}."]


def seed_notes(rows: Sequence[Score]) -> list[str]:
    """Which methods' numbers are means over several trainings."""
    seeds = {method: sorted({row.seed for row in mine}) for method, mine in grouped(rows, method_key).items()}
    return [f"Mean over seeds: {m} {', '.join(map(str, found))}." for m, found in seeds.items() if len(found) > 1]


def to_markdown(table: Table) -> str:
    """The table as GitHub Markdown: title, table, notes."""
    lines = [
        f"**{table.title}**",
        "",
        _pipes((table.corner, *table.heads)),
        "|---" + "|---:" * len(table.columns) + "|",
    ]
    for row in table.rows:
        cells = (row.label, *row.cells)
        lines.append(_pipes(f"*{cell}*" for cell in cells) if row.summary else _pipes(cells))
    return "\n".join([*lines, "", *(f"- {note}" for note in table.notes), ""])


def _pipes(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def to_latex(table: Table) -> str:
    """The table as a LaTeX ``table`` for booktabs, its notes in the caption."""
    lines = ["\\begin{table}", "\\centering", f"\\begin{{tabular}}{{l{'r' * len(table.columns)}}}", "\\toprule"]
    lines += [*_group_lines(table), _ampersands((table.corner, *table.columns))]
    for _, rows in groupby(table.rows, lambda row: row.summary):
        lines += ["\\midrule", *(_ampersands((row.label, *row.cells)) for row in rows)]
    caption = " ".join(map(_escape, (f"{table.title}.", *table.notes)))
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", f"\\caption{{{caption}}}", "\\end{table}", ""])


def _ampersands(cells: Iterable[str]) -> str:
    return " & ".join(map(_escape, cells)) + " \\\\"


def _group_lines(table: Table) -> list[str]:
    """The headings above the columns, each with a rule below it."""
    heads, rules, column = [], [], 2
    for group, members in groupby(table.groups):
        width = len(list(members))
        heads.append(f"\\multicolumn{{{width}}}{{c}}{{{_escape(group)}}}")
        rules.append(f"\\cmidrule(lr){{{column}-{column + width - 1}}}")
        column += width
    return [" & ".join(["", *heads]).strip() + " \\\\", " ".join(rules)] if heads else []


LATEX = {
    **{c: f"\\{c}" for c in "&%$#_{}"},
    "\\": "\\textbackslash{}",
    "~": "\\textasciitilde{}",
    "^": "\\textasciicircum{}",
    "²": "\\textsuperscript{2}",
    "–": "--",
}


def _escape(text: str) -> str:
    return "".join(LATEX.get(character, character) for character in text)
