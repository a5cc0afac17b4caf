"""Plots across runs: error by the share of training frames, by the time training took, and as training went on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from avatar.checks import AvatarError
from avatar.evaluation.aggregate import FLOORS, Cell, base_method, frame_weighted_mean, method_key, order_methods
from avatar.evaluation.metrics import find_metrics
from avatar.evaluation.plots import COLOURS, INK, add_legend, make_panels, read_curves
from avatar.evaluation.scores import Score

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_fractions(rows: Sequence[Score], metric: str) -> Figure:
    """The mean over frames of one metric against the share of the training frames, a line a method.

    Floors that were not trained are level lines.

    Raises:
        AvatarError: for a metric that nobody scored.
    """
    (known,) = find_metrics((metric,))
    groups = _grouped(rows, metric)
    shares = sorted({100 * row.fraction for row in rows if row.steps})
    figure, (panel,) = make_panels(1, (6.0, 3.4))
    for place, method in enumerate(order_methods({row.method for row in rows if row.metric == metric})):
        points = sorted(
            (100 * mine[0].fraction, _mean(mine) * known.scale) for mine in groups if mine[0].method == method
        )
        colour = COLOURS[place % len(COLOURS)]
        if method in FLOORS[:2]:
            panel.axhline(points[0][1], color=colour, linewidth=1.2, linestyle=":", label=method)
        else:
            panel.plot(*zip(*points), color=colour, linewidth=1.4, marker="o", markersize=4, label=method)
    panel.set_xscale("log")
    panel.set_xticks(shares, [f"{share:g}%" for share in shares])
    panel.minorticks_off()
    panel.set_xlabel("share of the training frames", fontsize=8, color=INK)
    panel.set_ylabel(f"{known.name} ({known.shown_in})", fontsize=8, color=INK)
    add_legend(figure, panel)
    return figure


def plot_times(rows: Sequence[Score], metric: str) -> Figure:
    """The mean over frames of one metric against the minutes of training a run, a point a method and variant.

    Raises:
        AvatarError: for a metric that nobody scored.
    """
    (known,) = find_metrics((metric,))
    groups = {method_key(mine[0]): mine for mine in _grouped(rows, metric)}
    figure, (panel,) = make_panels(1, (6.0, 3.4))
    trained = [method for method in order_methods(groups) if groups[method][0].steps]
    for place, method in enumerate(trained):
        mine = groups[method]
        minutes = sum(row.seconds for row in mine) / len(mine) / 60
        colour = COLOURS[place % len(COLOURS)]
        panel.plot(minutes, _mean(mine) * known.scale, "o", color=colour, markersize=6, label=method)
    for method in groups:
        if base_method(method) == "sampling":
            level = _mean(groups[method]) * known.scale
            panel.axhline(level, color=INK, linewidth=1.0, linestyle=":", label=method)
    panel.set_xlim(left=0)
    panel.set_xlabel("minutes of training a run", fontsize=8, color=INK)
    panel.set_ylabel(f"{known.name} ({known.shown_in})", fontsize=8, color=INK)
    add_legend(figure, panel)
    return figure


def plot_progress(logs: Mapping[str, Mapping[str, Path]]) -> Figure:
    """Chamfer distance on held-back training frames against the minutes trained: a panel an outfit, a line a method.

    Args:
        logs: training logs by outfit and method; those that never validated a Chamfer distance draw no line.
    """
    figure, panels = make_panels(len(logs))
    methods = order_methods({method for mine in logs.values() for method in mine})
    for panel, (outfit, mine) in zip(panels, logs.items()):
        for place, method in enumerate(methods):
            points = read_curves(mine[method], "seconds").get("chamfer", {}) if method in mine else {}
            curve = [(seconds / 60, value * 1e4) for seconds, value in points.get("validation", [])]
            colour = COLOURS[place % len(COLOURS)]
            panel.plot(*zip(*curve or [(np.nan, np.nan)]), ".-", color=colour, linewidth=1.4, label=method)
        panel.set_title(outfit, fontsize=9, color=INK)
        panel.set_xlabel("minutes of training", fontsize=8, color=INK)
        panel.set_ylabel("Chamfer, held back (1e-4 m²)", fontsize=8, color=INK)
    add_legend(figure, panels[0])
    return figure


def _grouped(rows: Sequence[Score], metric: str) -> list[list[Score]]:
    """The rows of one metric by method and variant."""
    groups: dict[str, list[Score]] = {}
    for row in rows:
        if row.metric == metric:
            groups.setdefault(method_key(row), []).append(row)
    if not groups:
        raise AvatarError(f"rows: no score of {metric} among them.")
    return list(groups.values())


def _mean(rows: Sequence[Score]) -> float:
    return frame_weighted_mean([Cell(row.value, row.frames, row.points) for row in rows])
