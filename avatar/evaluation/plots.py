"""Plots of training logs and scores: matplotlib figures, as files or as SVG that takes on a page's colours."""

from __future__ import annotations

import csv
import html
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from avatar.checks import AvatarError, DataError, require
from avatar.evaluation.aggregate import method_key, order_methods, tabulate
from avatar.evaluation.metrics import find_metrics
from avatar.evaluation.scores import FrameScore, Score

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LOG_COLUMNS = ("split", "step", "epoch", "seconds")
INK = "#010203"  # stands for the page's text colour, which inline_svg puts in its place
COLOURS = ("#3b7dd8", "#e07a3f", "#3fa37c", "#b65fc2", "#c9a227", "#d1495b", "#5b8c9e", "#8a8f98")
PANEL = (3.6, 2.3)  # inches


def plot_losses(metrics_csv: str | Path) -> Figure:
    """Every term of a training log over its steps, one panel a term, validation beside training.

    Raises:
        DataError: when the log is missing, lacks ``split`` and ``step``, or holds no number.
    """
    curves = read_curves(Path(metrics_csv))
    figure, panels = make_panels(len(curves))
    for panel, (term, splits) in zip(panels, curves.items()):
        for colour, (split, points) in zip(COLOURS, splits.items()):
            steps, values = np.array(points).T
            dots = {"marker": "o", "markersize": 3} if len(steps) < 30 else {}
            panel.plot(steps, values, color=colour, linewidth=1.4, label=split, **dots)
        values = np.array([value for points in splits.values() for _, value in points])
        if (values > 0).all() and values.max() > 20 * values.min():
            panel.set_yscale("log")
        panel.set_title(term, fontsize=9, color=INK)
        panel.set_xlabel("step", fontsize=8, color=INK)
    add_legend(figure, panels[0])
    return figure


def plot_outfits(rows: Sequence[Score], metric: str) -> Figure:
    """Bars of one metric, a group an outfit and a bar a method."""
    (known,) = find_metrics([metric])
    grid = tabulate(rows, metric)
    methods = order_methods({method for cells in grid.values() for method in cells})
    figure, (panel,) = make_panels(1, (max(5.0, 1.2 + 0.9 * len(grid) * max(1, len(methods) / 3)), 3.0))
    width = 0.8 / len(methods)
    for place, method in enumerate(methods):
        bars = [(x, cells[method]) for x, cells in enumerate(grid.values()) if method in cells]
        left = [x - 0.4 + width * (place + 0.5) for x, _ in bars]
        heights = [cell.value * known.scale for _, cell in bars]
        panel.bar(left, heights, 0.92 * width, color=COLOURS[place % len(COLOURS)], label=method)
    panel.set_xticks(range(len(grid)), list(grid), fontsize=8)
    panel.set_ylabel(f"{known.name} ({known.shown_in})", fontsize=8, color=INK)
    add_legend(figure, panel)
    return figure


def plot_frames(frames: Sequence[FrameScore], metric: str, outfit: str) -> Figure:
    """One metric over the frames of an outfit, a line a method."""
    (known,) = find_metrics([metric])
    lines: dict[str, dict[str, float]] = {}
    for row in frames:
        if row.metric == metric and row.outfit == outfit:
            lines.setdefault(method_key(row), {})[row.frame] = row.value * known.scale
    if not lines:
        raise AvatarError(f"frames: no score of {metric} on {outfit}.")
    names = sorted({name for values in lines.values() for name in values})
    figure, (panel,) = make_panels(1, (7.2, 3.0))
    for place, method in enumerate(order_methods(set(lines))):
        heights = [lines[method].get(name, np.nan) for name in names]
        panel.plot(heights, color=COLOURS[place % len(COLOURS)], linewidth=1.4, marker="o", markersize=3, label=method)
    step = -(-len(names) // 24)
    panel.set_xticks(range(0, len(names), step), names[::step], fontsize=6, rotation=60, ha="right")
    panel.set_ylabel(f"{known.name} ({known.shown_in})", fontsize=8, color=INK)
    add_legend(figure, panel)
    return figure


def save_figure(figure: Figure, path: str | Path) -> None:
    """Writes a figure as the kind of file its name says: png, svg or pdf."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(Path(path), dpi=150, facecolor="white")


def inline_svg(figure: Figure, prefix: str, title: str) -> str:
    """A figure as one ``<svg>`` element for an HTML page, drawn in the page's text colour on its background.

    Args:
        prefix: put before all ids, which must be unique in a page.
        title: what a screen reader says in the picture's place; plain text.
    """
    text = io.StringIO()
    with require("matplotlib").rc_context(
        {"svg.fonttype": "none", "svg.hashsalt": prefix, "font.family": "sans-serif"}
    ):
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
    """A training log as term to split to (step or seconds, value) points.

    Raises:
        DataError: when the log is missing, lacks a column, or holds no number.
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
    size = size or (PANEL[0] * max(columns, 2), PANEL[1] * rows + 0.3)
    figure = require("matplotlib.figure").Figure(figsize=size, layout="constrained")
    panels = [figure.add_subplot(rows, columns, place + 1) for place in range(count)]
    for panel in panels:
        panel.spines[["top", "right"]].set_visible(False)
        panel.spines[["left", "bottom"]].set_color(INK)
        panel.tick_params(colors=INK, labelsize=7, width=0.6, which="both")
        panel.grid(axis="y", color="#8888884d", linewidth=0.6)
        panel.set_axisbelow(True)
    return figure, panels


def add_legend(figure: Figure, panel: Axes) -> None:
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=8, frameon=False, fontsize=8, labelcolor=INK)
