"""Tables made from tidy scores, with floors and definitions, as Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import groupby

import numpy as np

from avatar.checks import AvatarError
from avatar.evaluation.aggregate import (
    Cell,
    base_method,
    frame_weighted_mean,
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


@dataclass(frozen=True)
class TableRow:
    """A labelled row; None stands where there is no number. ``summary`` rows are set off from the others.

    ``texts`` are printed in the numbers' place where there is more to say.
    """

    label: str
    values: tuple[float | None, ...]
    decimals: int = 3
    summary: bool = False
    texts: tuple[str, ...] | None = None

    @property
    def cells(self) -> tuple[str, ...]:
        """The numbers as printed."""
        if self.texts is not None:
            return self.texts
        return tuple("–" if value is None else f"{value:.{self.decimals}f}" for value in self.values)


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
    grid = tabulate(rows, metric)
    methods = order_methods({method for cells in grid.values() for method in cells})
    if view is not View.VALUE:
        _check_floor(methods, "sampling", view)
        if view in BASES:
            _check_floor(methods, BASES[view], view)
    viewed = {outfit: _viewed(cells, known, view) for outfit, cells in grid.items()}
    body = [TableRow(outfit, tuple(_value(cells, m) for m in methods)) for outfit, cells in viewed.items()]
    columns = {m: [cells[m] for cells in viewed.values() if m in cells] for m in methods}
    whole = {m: cells for m, cells in columns.items() if len(cells) == len(viewed)}
    mean, label = (frame_weighted_mean, "mean over frames") if view not in BASES else (_plain_mean, "mean over outfits")
    body.append(TableRow(label, tuple(mean(whole[m]) if m in whole else None for m in methods), summary=True))
    falls = known.higher_is_better and view not in BASES
    worst = tuple(worst_outfit(whole[m], falls) if m in whole else None for m in methods)
    body.append(TableRow("min over outfits" if falls else "max over outfits", worst, summary=True))
    unit = "ratio" if view in BASES else known.shown_in
    title = f"{known.name}, {view.value} ({unit})"
    notes = (*_notes(known, view), *_point_notes(grid), *seed_notes(rows))
    return Table(title, "outfit", tuple(methods), tuple(body), notes)


def metric_table(rows: Sequence[Score], outfit: str, metrics: Sequence[str] = tuple(METRICS)) -> Table:
    """Metrics by methods for one outfit, all that were scored, with every definition in the notes."""
    mine = [row for row in rows if row.outfit == outfit]
    if not mine:
        raise AvatarError(f"outfit: nobody scored {outfit!r}; there are {', '.join(sorted({r.outfit for r in rows}))}.")
    scored = {row.metric for row in mine}
    known = [metric for metric in find_metrics(metrics) if metric.name in scored]
    grids = {metric.name: tabulate(mine, metric.name)[outfit] for metric in known}
    methods = order_methods({method for cells in grids.values() for method in cells})
    body = tuple(
        TableRow(
            f"{m.name} ({m.shown_in})" if m.shown_in != "1" else m.name,
            tuple(_value(_viewed(grids[m.name], m, View.VALUE), method) for method in methods),
        )
        for m in known
    )
    notes = [f"{m.name}: {m.definition}" for m in known] + [FLOOR_NOTE]
    notes += _point_notes({outfit: grids[known[0].name]}) if known else []
    return Table(outfit, "metric", tuple(methods), body, tuple(notes))


FLOOR_NOTE = (
    "Floors: sampling is a second random sampling of the true surface (what a perfect surface scores), body the bare "
    "body's surface, static the same network without its pose branch."
)


def _viewed(cells: dict[str, Cell], metric: Metric, view: View) -> dict[str, Cell]:
    """One outfit's cells as the view shows them; those that a missing floor leaves undefined are left out."""
    if view is View.VALUE:
        return {method: Cell(c.value * metric.scale, c.frames, c.points) for method, c in cells.items()}
    floor = _find_floor(cells, "sampling")
    if floor is None:
        return {}
    excess = {method: Cell(c.value - floor.value, c.frames, c.points) for method, c in cells.items()}
    if view is View.EXCESS:
        return {method: Cell(c.value * metric.scale, c.frames, c.points) for method, c in excess.items()}
    bases = {method: _find_base(excess, method, BASES[view]) for method in excess}
    return {
        method: Cell(c.value / base.value, c.frames, c.points)
        for method, c in excess.items()
        if (base := bases[method]) is not None and base.value != 0
    }


def _value(cells: dict[str, Cell], method: str) -> float | None:
    return cells[method].value if method in cells else None


def _plain_mean(cells: Sequence[Cell]) -> float:
    return float(np.mean([cell.value for cell in cells]))


def _find_floor(cells: dict[str, Cell], floor: str) -> Cell | None:
    """A floor's cell, whatever its variant."""
    return next((cell for method, cell in cells.items() if base_method(method) == floor), None)


def _find_base(cells: dict[str, Cell], method: str, floor: str) -> Cell | None:
    """The floor a method is measured by: that of its own variant, or the only one there is."""
    variant = method.removeprefix(base_method(method))
    floors = [key for key in cells if base_method(key) == floor]
    if len(floors) > 1:
        floors = [key for key in floors if key == floor + variant]
    return cells[floors[0]] if floors else None


def _check_floor(methods: list[str], floor: str, view: View) -> None:
    if floor not in map(base_method, methods):
        raise AvatarError(f"rows: the view '{view.value}' needs the {floor} floor, and it was not scored.")


def _notes(metric: Metric, view: View) -> tuple[str, ...]:
    notes = (f"{metric.name}: {metric.definition}", FLOOR_NOTE)
    if view is not View.VALUE:
        notes += ("Excess: the value less the sampling floor's on the same outfit.",)
    return notes


def _point_notes(grid: dict[str, dict[str, Cell]]) -> list[str]:
    """A warning where methods predict other point counts than the sampling floor was taken at."""
    counts: dict[str, set[int]] = {}
    for cells in grid.values():
        for method, cell in cells.items():
            counts.setdefault(method, set()).add(cell.points)
    if len(set().union(*counts.values())) <= 1:
        return []
    listed = "; ".join(f"{m} {', '.join(f'{c:,}' for c in sorted(counts[m]))}" for m in order_methods(set(counts)))
    return [f"Point counts differ, and with them the sampling floor: {listed}."]


def seed_notes(rows: Sequence[Score]) -> list[str]:
    """Which methods' numbers are means over several trainings."""
    seeds: dict[str, set[int]] = {}
    for row in rows:
        seeds.setdefault(method_key(row), set()).add(row.seed)
    several = {method: sorted(found) for method, found in seeds.items() if len(found) > 1}
    return [f"Mean over seeds: {m} {', '.join(map(str, found))}." for m, found in several.items()]


def to_markdown(table: Table) -> str:
    """The table as GitHub Markdown: title, table, notes."""
    lines = [f"**{table.title}**", "", _pipes((table.corner, *table.heads))]
    lines.append("|---" + "|---:" * len(table.columns) + "|")
    for row in table.rows:
        cells = (row.label, *row.cells)
        lines.append(_pipes(tuple(f"*{cell}*" for cell in cells) if row.summary else cells))
    return "\n".join([*lines, "", *(f"- {note}" for note in table.notes), ""])


def _pipes(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def to_csv(table: Table) -> str:
    """The table as CSV with full precision, without title and notes; empty where there is no number."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow((table.corner, *table.heads))
    writer.writerows((row.label, *("" if v is None else repr(v) for v in row.values)) for row in table.rows)
    return text.getvalue()


def to_latex(table: Table) -> str:
    """The table as a LaTeX ``table`` for booktabs, its notes in the caption."""
    columns = "l" + "r" * len(table.columns)
    head = " & ".join(map(_escape, (table.corner, *table.columns)))
    lines = ["\\begin{table}", "\\centering", f"\\begin{{tabular}}{{{columns}}}", "\\toprule", *_group_lines(table)]
    lines.append(f"{head} \\\\")
    ruled = None
    for row in table.rows:
        if row.summary != ruled:
            lines.append("\\midrule")
            ruled = row.summary
        lines.append(" & ".join(map(_escape, (row.label, *row.cells))) + " \\\\")
    caption = " ".join(map(_escape, (f"{table.title}.", *table.notes)))
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", f"\\caption{{{caption}}}", "\\end{table}", ""])


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
