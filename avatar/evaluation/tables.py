"""Tables made from tidy scores, with floors and definitions, also in the papers' forms; as Markdown and LaTeX."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import groupby, product

import numpy as np

from avatar.checks import AvatarError
from avatar.evaluation import aggregate
from avatar.evaluation.aggregate import Cell, Difference, Interval, Place, base_method, grouped, method_key
from avatar.evaluation.metrics import METRICS, Metric, find_metrics
from avatar.evaluation.scores import Score

MEAN, WORST = "mean", "max"  # over frames of all outfits; over outfits


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


class Axis(Enum):
    """What the rows or the columns of a table tell apart: the fields of a `Place`."""

    method = "method"
    outfit = "outfit"
    metric = "metric"
    fraction = "fraction"  # of the training frames; the method's name then leaves it out


@dataclass
class FormConfig:
    """Which axes run down a table and which across, the first of several being the slowest. An outfit axis has its
    outfits, their mean and their worst, as chosen; else a cell is the mean over frames.
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


@dataclass(frozen=True)
class TableRow:
    """A labelled row, None where there is no number; ``summary`` sets it off, ``texts`` are printed instead of it."""

    label: str
    values: tuple[float | None, ...]
    summary: bool = False
    texts: tuple[str, ...] | None = None

    @property
    def cells(self) -> tuple[str, ...]:
        """The numbers as printed."""
        return self.texts or tuple("–" if value is None else f"{value:.3f}" for value in self.values)


@dataclass(frozen=True)
class Table:
    """A table ready to print: ``corner`` heads the labels, ``notes`` stand below. ``groups``, if any, stand above the
    columns: one a column, equal neighbours as one heading.
    """

    title: str
    corner: str
    columns: tuple[str, ...]
    rows: tuple[TableRow, ...]
    notes: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()

    @property
    def heads(self) -> tuple[str, ...]:
        """The columns by their full names."""
        return tuple(f"{group}, {column}" for group, column in zip(self.groups, self.columns)) or self.columns


def outfit_table(rows: Sequence[Score], metric: str, view: View = View.VALUE) -> Table:
    """Outfits by methods for one metric, with mean and worst outfit below and its definition in the notes."""
    (known,) = find_metrics([metric])
    cells, ratio = aggregate.average_seeds(aggregate.rows_of(rows, [metric])), view in BASES
    methods, outfits = aggregate.order_methods({p.method for p in cells}), sorted({p.outfit for p in cells})
    falls = known.higher_is_better and not ratio
    ends = (f"mean over {'outfits' if ratio else 'frames'}", f"{'min' if falls else 'max'} over outfits")
    shown = view_cells(cells, view, METRICS)
    shown |= _summaries(shown, len(outfits), ends, falls)
    labels = dict(zip(Axis, (methods, [*outfits, *ends], [metric], [""])))
    notes = [*definitions([known]), FLOOR_NOTE, *([] if view is View.VALUE else [EXCESS_NOTE])]
    notes += [*_point_notes(cells), *seed_notes(rows)]
    title = f"{known.name}, {view.value} ({'ratio' if ratio else known.shown_in})"
    return _arrange(title, shown, (Axis.outfit,), (Axis.method,), labels, METRICS, notes, ends, whole=True)


def metric_table(rows: Sequence[Score], outfit: str) -> Table:
    """Metrics by methods for one outfit, all that were scored, with every definition in the notes."""
    table = tabulate_metrics(rows, [outfit], METRICS)
    scored = {row.metric for row in rows if row.outfit == outfit}
    first = next((name for name in METRICS if name in scored), None)
    cells = aggregate.average_seeds(row for row in rows if row.outfit == outfit and row.metric == first)
    return replace(table, notes=(*table.notes, FLOOR_NOTE, *_point_notes(cells)))


def tabulate_metrics(
    rows: Sequence[Score], outfits: Sequence[str], known: Mapping[str, Metric], first: str = ""
) -> Table:
    """Those of some metrics that were scored by methods, for some outfits, with their definitions in the notes. Floors
    come first, or the method named ``first``.
    """
    cells = aggregate.average_seeds(row for row in rows if row.outfit in outfits and row.metric in known)
    methods = aggregate.order_methods({place.method for place in cells})
    methods.sort(key=lambda method: method != first if first else False)
    names = [name for name in known if name in {place.metric for place in cells}]
    labels = dict(zip(Axis, (methods, outfits, names, [""])))
    down = (Axis.metric,) if len(outfits) == 1 else (Axis.outfit, Axis.metric)
    notes = definitions(known[name] for name in names)
    cells = view_cells(cells, View.VALUE, known)
    return _arrange(", ".join(outfits), cells, down, (Axis.method,), labels, known, notes)


def form_table(
    rows: Sequence[Score], metrics: Sequence[str], form: FormConfig, title: str = "", excess: bool = False
) -> Table:
    """Scores in a paper's form; methods and outfits in their order of appearance, floors first. Several seeds of a
    method are averaged, and named in the notes. With ``excess`` every value is less the sampling floor's on the same
    outfit.
    """
    known, axes = find_metrics(metrics), (*form.rows, *form.columns)
    cells = aggregate.average_seeds(aggregate.rows_of(rows, metrics), Axis.fraction in axes)
    cells = view_cells(cells, View.EXCESS if excess else View.VALUE, METRICS)
    if excess:
        cells = {place: cell for place, cell in cells.items() if base_method(place.method) != "sampling"}
    methods, outfits, names, fractions = (list(dict.fromkeys(place[i] for place in cells)) for i in range(len(Axis)))
    for name in names:
        mine = {place: cell for place, cell in cells.items() if place.metric == name}
        cells |= _summaries(mine, len(outfits), (MEAN, WORST), METRICS[name].higher_is_better)
    if Axis.outfit not in axes:
        outfits = [MEAN]
    elif len(outfits) > 1:
        outfits = [*(outfits if form.outfits else []), *((MEAN, WORST) if form.summary else ())]
    methods.sort(key=aggregate.floor_rank)
    fractions.sort(key=lambda share: -float(share.rstrip("%") or 100))
    labels = dict(zip(Axis, (methods, outfits, names, fractions)))
    notes = [*definitions(known), *seed_notes(rows), *([EXCESS_NOTE] if excess else [])]
    return _arrange(title, cells, form.rows, form.columns, labels, METRICS, notes, (MEAN, WORST))


def view_cells(cells: Mapping[Place, Cell], view: View, known: Mapping[str, Metric]) -> dict[Place, Cell]:
    """Cells as a view shows them, in displayed units; those that a missing floor leaves undefined are left out."""
    found = {}
    for (_, metric), places in grouped(cells, lambda place: (place.outfit, place.metric)).items():
        floors = [cells[place].value for place in places if base_method(place.method) == "sampling"]
        floor = 0.0 if view is View.VALUE else next(iter(floors), np.nan)
        scale = 1 if view in BASES else known[metric].scale
        values = {place: (cells[place].value - floor) * scale for place in places if np.isfinite(floor)}
        if view in BASES:
            by_method = {place.method: value for place, value in values.items()}
            bases = {m: by_method.get(aggregate.find_counterpart(m, by_method, BASES[view])) for m in by_method}
            values = {place: value / bases[place.method] for place, value in values.items() if bases[place.method]}
        found |= values
    frames = {place: 1 if view in BASES else cell.frames for place, cell in cells.items()}  # ratios count alike
    return {p: Cell(found[p], frames[p], cell.points) for p, cell in cells.items() if p in found}


def _summaries(cells: dict[Place, Cell], outfits: int, ends: tuple[str, str], falls: bool) -> dict[Place, Cell]:
    """The mean over frames and the worst outfit of every method that has all the outfits, at outfits named ``ends``."""
    found = {}
    for place, places in grouped(cells, lambda place: place._replace(outfit="")).items():
        if len(places) == outfits:
            mine = [cells[one] for one in places]
            for end, value in zip(ends, (aggregate.frame_weighted_mean(mine), aggregate.worst_outfit(mine, falls))):
                found[place._replace(outfit=end)] = mine[0]._replace(value=value)
    return found


def _arrange(
    title: str,
    cells: Mapping[Place, Cell],
    down: Sequence[Axis],
    across: Sequence[Axis],
    labels: Mapping[Axis, Sequence[str]],
    known: Mapping[str, Metric],
    notes: Iterable[str],
    summaries: Sequence[str] = (),
    whole: bool = False,
) -> Table:
    """A table of all combinations of the labels on its axes; lines without a number stay only in a ``whole`` one. Axes
    that it lacks have their first label. Rows of outfits named in ``summaries`` are set off.
    """

    def heading(axis: Axis, label: str) -> str:
        return known[label].heading if axis is Axis.metric else label

    fixed = {axis: mine[0] for axis, mine in labels.items() if mine}
    rows, columns = (list(product(*(labels[axis] for axis in axes))) for axes in (down, across))
    grid = []
    for row in rows:
        places = [fixed | dict(zip(down, row)) | dict(zip(across, column)) for column in columns]
        found = [cells.get(Place(*(place[axis] for axis in Axis))) for place in places]
        grid.append([None if cell is None else cell.value for cell in found])
    kept = [i for i in range(len(columns)) if whole or any(line[i] is not None for line in grid)]
    body = []
    for row, line in zip(rows, grid):
        if whole or any(value is not None for value in line):
            summary = dict(zip(down, row)).get(Axis.outfit) in summaries
            body.append(TableRow(", ".join(map(heading, down, row)), tuple(line[i] for i in kept), summary))
    names = [list(map(heading, across, columns[i])) for i in kept]
    groups = tuple(", ".join(parts[:-1]) for parts in names) if len(across) > 1 else ()
    corner = ", ".join(axis.value for axis in down)
    return Table(title, corner, tuple(parts[-1] for parts in names), tuple(body), tuple(notes), groups)


def reported_table(reported: ReportedTable) -> Table:
    """A paper's numbers as a table."""
    body = tuple(TableRow(label, values) for label, values in reported.rows.items())
    return Table(f"Reported: {reported.source}", "paper", reported.columns, body)


def interval_row(label: str, intervals: Sequence[Interval | None], scale: float, summary: bool = False) -> TableRow:
    """Differences with their intervals, in units ``1 / scale`` of the metric's."""
    scaled = [None if i is None else [scale * value for value in i[:3]] for i in intervals]
    texts = tuple("–" if s is None else f"{s[0]:+.3f} [{s[1]:+.3f}, {s[2]:+.3f}]" for s in scaled)
    return TableRow(label, tuple(None if s is None else s[0] for s in scaled), summary, texts)


def difference_table(found: Sequence[Difference], metric: str) -> Table:
    """Outfits by methods: differences to the baseline with their intervals, negative where the method is lower."""
    known, mine = METRICS[metric], [difference for difference in found if difference.metric == metric]
    methods = tuple(dict.fromkeys(difference.method for difference in mine))
    cells = {(d.outfit, d.method): d.interval for d in mine}
    rows = []
    for outfit in sorted(dict.fromkeys(d.outfit for d in mine), key=lambda outfit: outfit.startswith(aggregate.ALL)):
        intervals = [cells.get((outfit, method)) for method in methods]
        rows.append(interval_row(outfit, intervals, known.scale, outfit.startswith(aggregate.ALL)))
    confidence = 100 * mine[0].interval.confidence if mine else 95
    note = (
        f"Difference to the baseline ({', '.join(dict.fromkeys(d.baseline for d in mine))}) with its {confidence:g}% "
        "interval: percentile bootstrap over frames, paired by frame, redrawn within each outfit. An interval speaks "
        "of other frames, not of another training."
    )
    return Table(f"{known.name}, difference ({known.shown_in})", "outfit", methods, tuple(rows), (note,))


def budget_table(rows: Sequence[Score]) -> Table:
    """What each method's training took: steps and minutes a run, and whether the methods had the same."""
    trained = grouped((row for row in rows if row.steps), method_key)
    body, steps, minutes = [], set(), []
    for method in aggregate.order_methods(trained):
        runs = {(row.outfit, row.seed): (row.steps, row.seconds / 60) for row in trained[method]}
        counts, times = zip(*runs.values())
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
    notes = (note, "Minutes are those of the budget: by the wall clock, or of all threads (`train.clock=processor`).")
    return Table("training of one run", "method", ("steps", "minutes"), tuple(body), notes)


def definitions(metrics: Iterable[Metric]) -> list[str]:
    """What stands below a table of some metrics."""
    return [f"{metric.name}: {metric.definition}" for metric in metrics]


def _point_notes(cells: Mapping[Place, Cell]) -> list[str]:
    """A warning where methods predict other point counts than the sampling floor was taken at."""
    counts = {m: sorted({cells[p].points for p in mine}) for m, mine in grouped(cells, lambda p: p.method).items()}
    if len(set().union(*counts.values())) <= 1:
        return []
    listed = "; ".join(f"{m} {', '.join(f'{c:,}' for c in counts[m])}" for m in aggregate.order_methods(counts))
    return [f"Point counts differ, and with them the sampling floor: {listed}."]


def seed_notes(rows: Sequence[Score]) -> list[str]:
    """Which methods' numbers are means over several trainings."""
    seeds = {method: sorted({row.seed for row in mine}) for method, mine in grouped(rows, method_key).items()}
    return [f"Mean over seeds: {m} {', '.join(map(str, found))}." for m, found in seeds.items() if len(found) > 1]


def to_markdown(table: Table) -> str:
    """The table as GitHub Markdown: title, table, notes."""

    def line(cells: Iterable[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    lines = [f"**{table.title}**", "", line((table.corner, *table.heads)), "|---" + "|---:" * len(table.columns) + "|"]
    for row in table.rows:
        cells = (row.label, *row.cells)
        lines.append(line(f"*{cell}*" for cell in cells) if row.summary else line(cells))
    return "\n".join([*lines, "", *(f"- {note}" for note in table.notes), ""])


def to_latex(table: Table) -> str:
    """The table as a LaTeX ``table`` for booktabs, its notes in the caption."""

    def line(cells: Iterable[str]) -> str:
        return " & ".join(map(_escape, cells)) + " \\\\"

    lines = ["\\begin{table}", "\\centering", f"\\begin{{tabular}}{{l{'r' * len(table.columns)}}}", "\\toprule"]
    heads, rules, column = [], [], 2
    for group, members in groupby(table.groups):
        width = len(list(members))
        heads.append(f"\\multicolumn{{{width}}}{{c}}{{{_escape(group)}}}")
        rules.append(f"\\cmidrule(lr){{{column}-{column + width - 1}}}")
        column += width
    if heads:  # above the columns, each with a rule below it
        lines += ["& " + " & ".join(heads) + " \\\\", " ".join(rules)]
    lines.append(line((table.corner, *table.columns)))
    for _, rows in groupby(table.rows, lambda row: row.summary):
        lines += ["\\midrule", *(line((row.label, *row.cells)) for row in rows)]
    caption = " ".join(map(_escape, (f"{table.title}.", *table.notes)))
    return "\n".join([*lines, "\\bottomrule", "\\end{tabular}", f"\\caption{{{caption}}}", "\\end{table}", ""])


LATEX = {
    **{c: f"\\{c}" for c in "&%$#_{}"},
    **{"\\": "\\textbackslash{}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}"},
    **{"²": "\\textsuperscript{2}", "–": "--"},
}


def _escape(text: str) -> str:
    return "".join(LATEX.get(character, character) for character in text)
