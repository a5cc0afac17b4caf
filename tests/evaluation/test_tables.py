"""Tables: numbers, floors, definitions and the two formats."""

from dataclasses import replace

import pytest

from avatar.evaluation.metrics import METRICS
from avatar.evaluation.scores import Score
from avatar.evaluation.tables import Table, TableRow, View, metric_table, outfit_table, to_latex, to_markdown

VALUES = {
    "dress": {"sampling": 1e-4, "body": 21e-4, "static": 6e-4, "closet": 5e-4},
    "long_shirt": {"sampling": 1e-4, "body": 5e-4, "static": 3e-4, "closet": 2e-4},
}


def some_rows(metric="cd_point", points=100):
    return [
        Score("t", outfit, method, "", metric, value, "m^2", frames, 0, 0, 0.0, points, "c")
        for (outfit, methods), frames in zip(VALUES.items(), (30, 10))
        for method, value in methods.items()
    ]


def cells(table):
    return {row.label: dict(zip(table.columns, row.values)) for row in table.rows}


def test_values_are_scaled_for_display_with_mean_and_max():
    table = cells(outfit_table(some_rows(), "cd_point"))
    assert table["dress"] == pytest.approx({"sampling": 1, "body": 21, "static": 6, "closet": 5})
    assert table["mean over frames"]["closet"] == pytest.approx((30 * 5 + 10 * 2) / 40)
    assert table["max over outfits"]["closet"] == pytest.approx(5)


def test_excess_and_its_shares_of_the_floors():
    excess = cells(outfit_table(some_rows(), "cd_point", View.EXCESS))
    assert excess["dress"] == pytest.approx({"sampling": 0, "body": 20, "static": 5, "closet": 4})
    of_body = cells(outfit_table(some_rows(), "cd_point", View.OF_BODY))
    assert (of_body["dress"]["closet"], of_body["long_shirt"]["closet"]) == pytest.approx((0.2, 0.25))
    of_static = cells(outfit_table(some_rows(), "cd_point", View.OF_STATIC))
    assert (of_static["dress"]["closet"], of_static["long_shirt"]["closet"]) == pytest.approx((0.8, 0.5))
    assert of_static["mean over outfits"]["closet"] == pytest.approx(0.65)
    assert of_static["max over outfits"]["closet"] == pytest.approx(0.8)


def test_each_variant_is_measured_by_its_own_static_floor():
    rows = some_rows()
    extra = {"static": 11e-4, "closet": 6e-4}
    rows += [replace(r, variant="10%", value=extra[r.method]) for r in rows if r.method in extra]
    of_static = cells(outfit_table(rows, "cd_point", View.OF_STATIC))["dress"]
    assert of_static["closet"] == pytest.approx(0.8) and of_static["closet (10%)"] == pytest.approx(0.5)
    without = [r for r in rows if (r.method, r.variant) != ("static", "10%")]
    lone = cells(outfit_table(without, "cd_point", View.OF_STATIC))["dress"]
    assert lone["closet (10%)"] == pytest.approx(1.0)  # the only floor there is


def test_the_worst_of_a_metric_where_higher_is_better_is_its_minimum():
    table = cells(outfit_table(some_rows("f_score_1cm"), "f_score_1cm"))
    assert table["min over outfits"]["closet"] == pytest.approx(100 * 2e-4)


def test_a_method_that_misses_an_outfit_has_no_mean():
    rows = [row for row in some_rows() if (row.outfit, row.method) != ("dress", "closet")]
    table = outfit_table(rows, "cd_point")
    assert cells(table)["dress"]["closet"] is cells(table)["mean over frames"]["closet"] is None
    assert "–" in table.rows[0].cells
    assert cells(table)["long_shirt"]["closet"] == pytest.approx(2)


def test_notes_define_the_metric_and_warn_of_other_point_counts():
    table = outfit_table(some_rows(), "cd_point")
    assert METRICS["cd_point"].definition in table.notes[0] and len(table.notes) == 2
    rows = [row for row in some_rows() if row.method == "sampling"] + [
        row for row in some_rows(points=50_000) if row.method == "closet"
    ]
    assert "sampling 100; closet 50,000" in outfit_table(rows, "cd_point").notes[-1]


def test_metric_table_lists_all_that_was_scored_with_definitions():
    rows = some_rows() + some_rows("normal_l1")
    table = metric_table(rows, "dress")
    assert [row.label for row in table.rows] == ["cd_point (1e-4 m²)", "normal_l1 (1e-1)"]
    assert cells(table)["normal_l1 (1e-1)"]["closet"] == pytest.approx(5e-3)
    for name in ("cd_point", "normal_l1"):
        assert any(METRICS[name].definition in note for note in table.notes)


def test_markdown():
    text = to_markdown(outfit_table(some_rows(), "cd_point")).splitlines()
    assert text[0] == "**cd_point, value (1e-4 m²)**"
    assert text[2:5] == [
        "| outfit | sampling | body | static | closet |",
        "|---|---:|---:|---:|---:|",
        "| dress | 1.000 | 21.000 | 6.000 | 5.000 |",
    ]
    assert "| *max over outfits* | *1.000* | *21.000* | *6.000* | *5.000* |" in text
    assert text[-1].startswith("- Floors") and any(METRICS["cd_point"].definition in line for line in text)


def test_latex_is_escaped_and_complete():
    text = to_latex(outfit_table(some_rows(), "cd_point"))
    assert "long\\_shirt & 1.000 & 5.000 & 3.000 & 2.000 \\\\" in text
    assert text.count("\\midrule") == 2 and "\\end{table}" in text
    assert "m\\textsuperscript{2}" in text and text.isascii()


def test_grouped_columns_have_one_heading_in_latex_and_full_names_elsewhere():
    rows = (TableRow("pop", (1.0, 2.0, 3.0)),)
    table = Table("t", "method", ("mean", "max", "mean"), rows, (), ("CD_1", "CD_1", "NML"))
    assert "| method | CD_1, mean | CD_1, max | NML, mean |" in to_markdown(table)
    lines = to_latex(table).splitlines()
    start = lines.index("\\toprule")
    assert lines[start + 1 : start + 4] == [
        "& \\multicolumn{2}{c}{CD\\_1} & \\multicolumn{1}{c}{NML} \\\\",
        "\\cmidrule(lr){2-3} \\cmidrule(lr){4-4}",
        "method & mean & max & mean \\\\",
    ]
