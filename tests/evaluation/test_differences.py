"""Differences to a baseline: paired values, the right baseline, all outfits together; and what training cost."""

import csv
from dataclasses import replace

import pytest

from avatar.checks import AvatarError
from avatar.evaluation.aggregate import ALL, compare_methods, differences_csv
from avatar.evaluation.scores import FrameScore, Score, Scores
from avatar.evaluation.tables import budget_table, difference_table


def frames(method, outfit, values, variant=""):
    rows = [(f"walk.{i:04d}", "cd_point", value * 1e-4) for i, value in enumerate(values)]
    return [FrameScore(outfit, method, variant, 0, *row) for row in rows]


def row(method, steps, seconds, seed=0):
    return Score("t", "tee", method, "", "cd_point", 1e-4, "m^2", 1, seed, steps, seconds, 100, "c")


def test_differences_are_paired_by_frame_for_each_outfit_and_for_all():
    scores = Scores([], frames("pop", "tee", [1, 2, 3]) + frames("csf", "tee", [2, 3, 4]))
    scores = scores + Scores([], frames("pop", "dress", [9]) + frames("csf", "dress", [4]))
    scores = scores + Scores([], frames("csf", "shirt", [7]))  # pop has no shirt: nothing to pair
    held_back = [replace(f, frame="random.00001", variant="validation") for f in frames("csf", "tee", [2])]
    scores = scores + Scores([], held_back)  # frames of another split: nothing to pair either
    scores = scores + Scores([], frames("sampling", "tee", [0, 0, 0]) + frames("body", "tee", [5, 6, 7]))
    found = {(d.outfit, d.method): d.interval for d in compare_methods(scores, "cd_point", "pop")}
    assert set(found) == {("tee", "body"), ("tee", "csf"), ("dress", "csf"), (ALL, "csf")}
    assert found["tee", "csf"].difference == pytest.approx(1e-4)
    assert (found["tee", "csf"].low, found["tee", "csf"].high) == pytest.approx((1e-4, 1e-4))
    assert found[ALL, "csf"].difference == pytest.approx((3 * 1 - 5) / 4 * 1e-4)
    assert found[ALL, "csf"].frames == 4


def test_a_baseline_of_the_same_variant_comes_first():
    rows = frames("pop", "tee", [1, 1]) + frames("pop", "tee", [5, 5], "12.5%")
    rows += frames("csf", "tee", [2, 2]) + frames("csf", "tee", [2, 2], "12.5%") + frames("scale", "tee", [2, 2], "knn")
    found = {d.method: d for d in compare_methods(Scores([], rows), "cd_point", "pop")}
    assert (found["csf"].baseline, found["csf (12.5%)"].baseline) == ("pop", "pop (12.5%)")
    assert found["csf (12.5%)"].interval.difference == pytest.approx(-3e-4)
    assert found["scale (knn)"].baseline == "pop"
    with pytest.raises(AvatarError, match=r"baseline: expected one of csf, .*got 'closet'"):
        compare_methods(Scores([], rows), "cd_point", "closet")


def test_without_a_baseline_of_their_own_methods_of_many_variants_are_left_out():
    rows = frames("pop", "tee", [1], "10%") + frames("pop", "tee", [5], "5%") + frames("csf", "tee", [2])
    assert compare_methods(Scores([], rows), "cd_point", "pop") == []


def test_tables_show_intervals_in_displayed_units_and_files_in_the_metrics_own():
    scores = Scores([], frames("pop", "tee", [1, 2]) + frames("csf", "tee", [2, 3]))
    found = compare_methods(scores, "cd_point", "pop", confidence=0.9)
    table = difference_table(found, "cd_point")
    assert table.rows[0].cells == ("+1.000 [+1.000, +1.000]",)
    assert "90% interval" in table.notes[0] and "(pop)" in table.notes[0]
    (line,) = csv.DictReader(differences_csv(found).splitlines())
    assert float(line["difference"]) == pytest.approx(1e-4) and line["unit"] == "m^2"
    assert (line["method"], line["baseline"], line["frames"]) == ("csf", "pop", "2")


@pytest.mark.parametrize(
    ("spent", "note"),
    [
        ({"pop": (600, 100.0), "csf": (600, 300.0)}, "Equal steps: 600 each."),
        ({"pop": (900, 300.0), "csf": (600, 301.0)}, "Equal time: 5.0 minutes each."),
        ({"pop": (900, 300.0), "csf": (600, 400.0)}, "Neither steps nor time were equal."),
        ({"sampling": (0, 0.0)}, "Nothing here was trained."),
    ],
)
def test_the_budget_says_what_was_equal(spent, note):
    table = budget_table([row(method, *values) for method, values in spent.items()])
    assert table.notes[0] == note
    assert [line.label for line in table.rows] == sorted(method for method in spent if method != "sampling")


def test_the_budget_is_that_of_one_run():
    table = budget_table([row("pop", 1000, 60.0), row("pop", 2000, 180.0, seed=1)])
    assert table.rows[0].cells == ("1,500", "2.0")
