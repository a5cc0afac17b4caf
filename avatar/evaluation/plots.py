"""Plots of training logs and scores: matplotlib figures, as files or as SVG that takes on a page's colours."""

from __future__ import annotations

import csv
import html
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from avatar.checks import DataError, require
from avatar.evaluation import aggregate
from avatar.evaluation.aggregate import FLOORS, Place, base_method, frame_weighted_mean, grouped, method_key
from avatar.evaluation.metrics import find_metrics
from avatar.evaluation.scores import Score

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LOG_COLUMNS = ("split", "step", "epoch", "seconds")
INK = "#010203"  # stands for the page's text colour, which inline_svg puts in its place
COLOURS = ("#3b7dd8", "#e07a3f", "#3fa37c", "#b65fc2", "#c9a227", "#d1495b", "#5b8c9e", "#8a8f98")


def plot_losses(metrics_csv: str | Path) -> Figure:
    """Every term of a training log over its steps, one panel a term, validation beside training."""
    curves = read_curves(Path(metrics_csv))
    figure, panels = make_panels(len(curves))
    for panel, (term, splits) in zip(panels, curves.items()):
        for split, points in splits.items():
            dots = {"marker": "o", "markersize": 3} if len(points) < 30 else {}
            panel.plot(*np.array(points).T, linewidth=1.4, label=split, **dots)
        values = np.array([value for points in splits.values() for _, value in points])
        if (values > 0).all() and values.max() > 20 * values.min():
            panel.set_yscale("log")
        panel.set_title(term, fontsize=9, color=INK)
    return _finish(figure, panels, "step")


def plot_outfits(rows: Sequence[Score], metric: str) -> Figure:
    """Bars of one metric, a group an outfit and a bar a method."""
    (known,) = find_metrics([metric])
    cells = aggregate.average_seeds(aggregate.rows_of(rows, [metric]))
    outfits, methods = sorted({p.outfit for p in cells}), aggregate.order_methods({p.method for p in cells})
    figure, (panel,) = make_panels(1, (max(5.0, 1.2 + 0.9 * len(outfits) * max(1, len(methods) / 3)), 3.0))
    width = 0.8 / len(methods)
    for place, method in enumerate(methods):
        bars = [(x, cells.get(Place(method, outfit, metric))) for x, outfit in enumerate(outfits)]
        left = [x - 0.4 + width * (place + 0.5) for x, cell in bars if cell]
        heights = [cell.value * known.scale for _, cell in bars if cell]
        panel.bar(left, heights, 0.92 * width, label=method)
    panel.set_xticks(range(len(outfits)), outfits, fontsize=8)
    return _finish(figure, [panel], "", f"{known.name} ({known.shown_in})")


def plot_fractions(rows: Sequence[Score], metric: str) -> Figure:
    """The mean over frames of one metric against the share of the training frames, a line a method. Floors that were
    not trained are level lines.
    """
    (known,) = find_metrics([metric])
    groups = grouped(grouped(aggregate.rows_of(rows, [metric]), method_key).values(), lambda mine: mine[0].method)
    figure, (panel,) = make_panels(1, (6.0, 3.4))
    for place, method in enumerate(aggregate.order_methods(groups)):
        points = sorted((100 * mine[0].fraction, frame_weighted_mean(mine) * known.scale) for mine in groups[method])
        style = {"color": COLOURS[place % len(COLOURS)], "label": method}
        if method in FLOORS[:2]:
            panel.axhline(points[0][1], linewidth=1.2, linestyle=":", **style)
        else:
            panel.plot(*zip(*points), linewidth=1.4, marker="o", markersize=4, **style)
    shares = sorted({100 * row.fraction for row in rows if row.steps})
    panel.set_xscale("log")
    panel.set_xticks(shares, [f"{share:g}%" for share in shares])
    panel.minorticks_off()
    return _finish(figure, [panel], "share of the training frames", f"{known.name} ({known.shown_in})")


def plot_times(rows: Sequence[Score], metric: str) -> Figure:
    """The mean over frames of one metric against the minutes of training a run, a point a method and variant."""
    (known,) = find_metrics([metric])
    groups = grouped(aggregate.rows_of(rows, [metric]), method_key)
    means = {method: frame_weighted_mean(mine) * known.scale for method, mine in groups.items()}
    figure, (panel,) = make_panels(1, (6.0, 3.4))
    for method in (m for m in aggregate.order_methods(groups) if groups[m][0].steps):
        minutes = sum(row.seconds for row in groups[method]) / len(groups[method]) / 60
        panel.plot(minutes, means[method], "o", markersize=6, label=method)
    for method, level in means.items():
        if base_method(method) == "sampling":
            panel.axhline(level, color=INK, linewidth=1.0, linestyle=":", label=method)
    panel.set_xlim(left=0)
    return _finish(figure, [panel], "minutes of training a run", f"{known.name} ({known.shown_in})")


def plot_progress(logs: Mapping[str, Mapping[str, Path]]) -> Figure:
    """Chamfer distance on held-back training frames against the minutes trained: a panel an outfit, a line a method.
    ``logs`` are training logs by outfit and method; those that never validated a Chamfer distance draw no line.
    """
    figure, panels = make_panels(len(logs))
    methods = aggregate.order_methods({method for mine in logs.values() for method in mine})
    for panel, (outfit, mine) in zip(panels, logs.items()):
        for method in methods:
            points = read_curves(mine[method], "seconds").get("chamfer", {}) if method in mine else {}
            curve = [(seconds / 60, value * 1e4) for seconds, value in points.get("validation", [])]
            panel.plot(*zip(*curve or [(np.nan, np.nan)]), ".-", linewidth=1.4, label=method)
        panel.set_title(outfit, fontsize=9, color=INK)
    return _finish(figure, panels, "minutes of training", "Chamfer, held back (1e-4 m²)")


def _finish(figure: Figure, panels: Sequence[Axes], across: str = "", up: str = "") -> Figure:
    """Names the axes of panels and adds the legend of the first."""
    for panel in panels:
        panel.set_xlabel(across, fontsize=8, color=INK)
        panel.set_ylabel(up, fontsize=8, color=INK)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=8, frameon=False, fontsize=8, labelcolor=INK)
    return figure


def inline_svg(figure: Figure, prefix: str, title: str) -> str:
    """A figure as one ``<svg>`` element for an HTML page, drawn in the page's text colour on its background. ``prefix``
    is put before all ids, which must be unique in a page; ``title`` is plain text for screen readers.
    """
    text = io.StringIO()
    style = {"svg.fonttype": "none", "svg.hashsalt": prefix, "font.family": "sans-serif"}
    with require("matplotlib").rc_context(style):
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    svg = text.getvalue()
    svg = svg[svg.index("<svg") :].strip()
    svg = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>|<style.*?</style>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(\sid="|url\(#|href="#)', rf"\g<1>{prefix}-", svg).replace(INK, "currentColor")
    view = re.search(r'viewBox="([^"]*)"', svg)[1]
    width = float(view.split()[2]) * 4 / 3  # points to CSS pixels: text at its true size where there is room
    root = f'<svg viewBox="{view}" style="max-width:{width:.0f}px" role="img" aria-label="{html.escape(title)}">'
    return (root + svg[svg.index(">") + 1 :]).replace("xlink:href", "href")


def read_curves(path: Path, against: str = "step") -> dict[str, dict[str, list[tuple[float, float]]]]:
    """A training log as term to split to (step or seconds, value) points. Raises `DataError` when the log is missing,
    lacks a column, or holds no number.
    """
    if not path.is_file():
        raise DataError(path, "there is no training log here.", "Train first.")
    curves: dict[str, dict[str, list[tuple[float, float]]]] = {}
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        names = reader.fieldnames or []
        if not {"split", against} <= set(names):
            raise DataError(path, f"expected the columns split and {against}, got {', '.join(names) or 'none'}.")
        for row in reader:
            for term in (name for name in names if name not in LOG_COLUMNS and row[name]):
                try:
                    point = (float(row[against]), float(row[term]))
                except ValueError as error:
                    raise DataError(path, f"line {reader.line_num}, {term}: {error}.") from error
                curves.setdefault(term, {}).setdefault(row["split"], []).append(point)
    if not curves:
        raise DataError(path, "the training log holds no numbers yet.")
    return curves


def make_panels(count: int, size: tuple[float, float] | None = None) -> tuple[Figure, list[Axes]]:
    """A figure with panels in rows of three, in the house's style."""
    columns = min(3, count)
    rows = -(-count // columns)
    size = size or (3.6 * max(columns, 2), 2.3 * rows + 0.3)  # inches
    figure = require("matplotlib.figure").Figure(figsize=size, layout="constrained")
    panels = [figure.add_subplot(rows, columns, place + 1) for place in range(count)]
    for panel in panels:
        panel.set_prop_cycle(color=COLOURS)
        panel.spines[["top", "right"]].set_visible(False)
        panel.spines[["left", "bottom"]].set_color(INK)
        panel.tick_params(colors=INK, labelsize=7, width=0.6, which="both")
        panel.grid(axis="y", color="#8888884d", linewidth=0.6)
        panel.set_axisbelow(True)
    return figure, panels
