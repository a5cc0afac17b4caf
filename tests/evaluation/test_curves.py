"""Plots across runs: the points are the displayed means, and floors are levels."""

import pytest

from avatar.evaluation.plots import plot_fractions, plot_progress, plot_times
from avatar.evaluation.scores import Score

LOG = "split,step,seconds,chamfer\ntrain,1,30,9e-4\nvalidation,1,60,5e-4\nvalidation,2,120,4e-4\n"


def score(method, value, outfit="tee", frames=1, steps=600, seconds=120.0, fraction=1.0):
    variant = f"{100 * fraction:g}%" if fraction < 1 else ""
    row = ("cd_point", value * 1e-4, "m^2", frames, 0, steps, seconds, 100, "c", "sample", fraction)
    return Score("t", outfit, method, variant, *row)


def test_a_line_a_method_over_fractions_and_untrained_floors_as_levels():
    rows = [score("pop", 3), score("pop", 5, fraction=0.5), score("pop", 9, "dress", frames=3, fraction=0.5)]
    rows.append(score("sampling", 1, steps=0))
    (panel,) = plot_fractions(rows, "cd_point").axes
    lines = {line.get_label(): line.get_xydata() for line in panel.lines}
    assert lines["pop"].ravel().tolist() == pytest.approx([50, (5 + 3 * 9) / 4, 100, 3])
    assert set(lines["sampling"][:, 1]) == {1.0}
    assert [tick.get_text() for tick in panel.get_xticklabels()] == ["50%", "100%"]


def test_a_point_a_method_over_minutes():
    rows = [score("pop", 3, seconds=60.0), score("pop", 5, "dress", seconds=180.0), score("sampling", 1, steps=0)]
    (panel,) = plot_times(rows, "cd_point").axes
    pop, sampling = panel.lines
    assert pop.get_xydata().ravel().tolist() == pytest.approx([2, 4])
    assert sampling.get_label() == "sampling" and panel.get_xlim()[0] == 0


def test_held_back_error_over_minutes_is_a_panel_an_outfit(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text(LOG)
    tee, dress = plot_progress({"tee": {"pop": path, "csf": path}, "dress": {"csf": path}}).axes
    assert tee.get_title() == "tee" and len(dress.lines) == 2
    line = next(line for line in dress.lines if line.get_label() == "csf")
    assert line.get_xydata().ravel().tolist() == pytest.approx([1, 5, 2, 4])
