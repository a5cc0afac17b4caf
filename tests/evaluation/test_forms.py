"""The papers' forms: every number where its labels say, summaries by hand, and what paper tables cannot hold."""

import pytest

from avatar.checks import AvatarError
from avatar.evaluation.scores import Score
from avatar.evaluation.tables import Axis, FormConfig, ReportedTable, form_table, reported_table

CD = {("dress", "sampling"): 1e-4, ("dress", "pop"): 9e-4, ("tee", "sampling"): 2e-4, ("tee", "pop"): 4e-4}
FRAMES = {"dress": 30, "tee": 10}


def score(outfit, method, value, metric="cd_point", variant="", seed=0, fraction=1.0):
    unit = {"cd_point": "m^2", "normal_l1": "1"}[metric]
    row = (metric, value, unit, FRAMES[outfit], seed, 600, 60.0, 100, "c", "sample", fraction)
    return Score("t", outfit, method, variant, *row)


def some_rows():
    rows = [score(outfit, method, value) for (outfit, method), value in CD.items()]
    return rows + [score(outfit, method, 1000 * value, "normal_l1") for (outfit, method), value in CD.items()]


def cells(table):
    return {row.label: dict(zip(table.heads, row.values)) for row in table.rows}


def test_methods_down_metrics_with_mean_and_max_across_as_in_table_1():
    form = FormConfig(rows=(Axis.method,), columns=(Axis.metric, Axis.outfit), outfits=False)
    table = cells(form_table(some_rows(), ["cd_point", "normal_l1"], form))
    assert list(table) == ["sampling", "pop"]
    expected = {"cd_point (1e-4 m²), mean": (30 * 9 + 10 * 4) / 40, "cd_point (1e-4 m²), max": 9}
    expected |= {"normal_l1 (1e-1), mean": 10 * (30 * 0.9 + 10 * 0.4) / 40, "normal_l1 (1e-1), max": 9}
    assert table["pop"] == pytest.approx(expected)


def test_outfits_down_methods_across_as_in_table_3():
    table = form_table(some_rows(), ["cd_point"], FormConfig(), "closet3")
    assert cells(table)["tee"] == pytest.approx({"cd_point (1e-4 m²), sampling": 2, "cd_point (1e-4 m²), pop": 4})
    assert [(row.label, row.summary) for row in table.rows][2:] == [("mean", True), ("max", True)]
    assert cells(table)["max"]["cd_point (1e-4 m²), pop"] == pytest.approx(9)


def test_one_outfit_has_no_summary_and_no_axis_of_its_own_as_in_table_5():
    rows = [row for row in some_rows() if row.outfit == "dress"]
    form = FormConfig(rows=(Axis.metric,), columns=(Axis.method,))
    table = cells(form_table(rows, ["cd_point", "normal_l1"], form))
    assert table["cd_point (1e-4 m²)"] == pytest.approx({"sampling": 1, "pop": 9})


def test_excess_is_less_the_sampling_floor_of_each_outfit():
    table = form_table(some_rows(), ["cd_point"], FormConfig(), excess=True)
    column = "cd_point (1e-4 m²), pop"
    assert table.heads == (column,)
    found = {label: row[column] for label, row in cells(table).items()}
    assert found == pytest.approx({"dress": 8, "tee": 2, "mean": (30 * 8 + 10 * 2) / 40, "max": 8})


def test_fractions_have_their_own_axis_or_stay_in_the_methods_name():
    rows = [score("tee", "pop", 4e-4), score("tee", "pop", 5e-4, variant="12.5%", fraction=0.125)]
    rows += [score("tee", "closet", 3e-4, variant="knn, 12.5%", fraction=0.125)]
    form = FormConfig(rows=(Axis.metric, Axis.method), columns=(Axis.fraction,))
    table = cells(form_table(rows, ["cd_point"], form))
    assert table["cd_point (1e-4 m²), pop"] == pytest.approx({"100%": 4, "12.5%": 5})
    assert table["cd_point (1e-4 m²), closet (knn)"]["100%"] is None
    plain = cells(form_table(rows, ["cd_point"], FormConfig(rows=(Axis.method,), columns=(Axis.metric,))))
    assert list(plain) == ["pop", "pop (12.5%)", "closet (knn, 12.5%)"]


def test_a_method_that_lacks_an_outfit_has_no_mean():
    rows = [*some_rows(), score("tee", "csf", 1e-4)]
    table = cells(form_table(rows, ["cd_point"], FormConfig()))
    assert table["mean"]["cd_point (1e-4 m²), csf"] is table["dress"]["cd_point (1e-4 m²), csf"] is None
    assert table["tee"]["cd_point (1e-4 m²), csf"] == pytest.approx(1)


def test_seeds_are_averaged_and_said_to_be_and_two_of_one_seed_are_refused():
    rows = [score("tee", "pop", 4e-4), score("tee", "pop", 6e-4, seed=1)]
    table = form_table(rows, ["cd_point"], FormConfig())
    assert cells(table)["tee"]["cd_point (1e-4 m²), pop"] == pytest.approx(5)
    assert "Mean over seeds: pop 0, 1." in table.notes
    with pytest.raises(AvatarError, match="two scores of cd_point for pop on tee, seed 1"):
        form_table([*rows, rows[1]], ["cd_point"], FormConfig())


def test_what_makes_no_table_is_refused():
    with pytest.raises(AvatarError, match="every axis once"):
        FormConfig(rows=(Axis.outfit,), columns=(Axis.outfit, Axis.metric))
    with pytest.raises(AvatarError, match="outfits, summary or both"):
        FormConfig(outfits=False, summary=False)
    with pytest.raises(AvatarError, match="no score of cd_pop"):
        form_table(some_rows(), ["cd_pop"], FormConfig())
    with pytest.raises(AvatarError, match="expected 2 numbers a row, row 'CD' has others"):
        ReportedTable("paper", ("a", "b"), {"CD": (1.0,)})


def test_reported_numbers_keep_their_places():
    table = reported_table(ReportedTable("paper, table 5", ("POP", "CSF"), {"CD": (7.34, None)}))
    assert table.title == "Reported: paper, table 5"
    assert table.rows[0].cells == ("7.340", "–")
