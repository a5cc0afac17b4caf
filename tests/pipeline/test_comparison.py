"""Comparison of runs on several splits: each split stands by itself, with floors and differences of its own."""

import csv

import pytest

from avatar.evaluation.scores import FrameScore, Score, Scores, read_scores, write_scores
from avatar.evaluation.tables import Axis, FormConfig
from avatar.pipeline.reporting import CompareConfig, compare
from avatar.pipeline.scores import floors_folder, scores_file

VALUES = {  # 1e-4 m², two frames each
    ("sampling", "test"): (1, 1),
    ("sampling", "interpolation"): (2, 2),
    ("closet", "test"): (4, 6),
    ("closet", "interpolation"): (5, 5),
    ("pop", "test"): (3, 3),
    ("pop", "interpolation"): (9, 7),
}


def scored(method, split):
    values = [value * 1e-4 for value in VALUES[method, split]]
    frames = [FrameScore("tee", method, "", 0, f"{split}.{i}", "cd_point", v, split) for i, v in enumerate(values)]
    steps = 0 if method == "sampling" else 10
    row = ("t", "tee", method, "", "cd_point", sum(values) / 2, "m^2", 2, 0, steps, 1.0, 100, "c", "open", 1.0, split)
    return Scores([Score(*row)], frames)


@pytest.fixture
def settings(tmp_path):
    runs = tmp_path / "runs"
    for method, split in VALUES:
        folder = runs / method / "open" / "tee" / "default"
        if method == "sampling":
            folder = floors_folder(runs, "open", "tee", 100)
        write_scores(scores_file(folder, split), scored(method, split))
    made = tuple(runs / method / "open" / "tee" / "default" for method in ("closet", "pop"))
    splits = ("test", "interpolation")
    return CompareConfig("two", made, runs, metrics=("cd_point",), splits=splits, plots=False, pictures=0, out=tmp_path)


def lines_of(path, start):
    return [line for line in path.read_text().splitlines() if line.startswith(start)]


def test_each_split_has_its_table_and_its_own_floor(settings):
    settings.baseline = "pop"
    page = compare(settings)
    assert lines_of(page, "**test: cd_point, value") and lines_of(page, "**interpolation: cd_point, value")
    text = page.read_text()
    assert "| tee | 1.000 | 5.000 | 3.000 |" in text and "| tee | 2.000 | 5.000 | 8.000 |" in text
    written = read_scores(page.with_suffix(".csv"))
    assert {(row.method, row.split) for row in written.rows} == set(VALUES)
    assert {row.split for row in written.frames} == {"test", "interpolation"}
    with page.with_suffix(".differences.csv").open() as file:
        found = {(row["outfit"], row["method"]): float(row["difference"]) for row in csv.DictReader(file)}
    assert found == pytest.approx({("tee", "closet"): 2e-4, ("tee (interpolation)", "closet"): -3e-4})


def test_a_form_names_the_split_with_the_outfit(settings):
    settings.form = FormConfig(rows=(Axis.metric,), columns=(Axis.method,))
    text = compare(settings).read_text()
    assert "| tee, cd_point (1e-4 m²) | 1.000 | 5.000 | 3.000 |" in text
    assert "| tee (interpolation), cd_point (1e-4 m²) | 2.000 | 5.000 | 8.000 |" in text
    assert "| tee, cd_point (1e-4 m²) | 4.000 | 2.000 |" in text  # excess over the split's own floor
    assert "| tee (interpolation), cd_point (1e-4 m²) | 3.000 | 6.000 |" in text


def test_scores_without_a_split_are_of_test_frames(tmp_path):
    path = tmp_path / "scores.csv"
    write_scores(path, scored("closet", "test"))
    lines = [line.rpartition(",")[0] for line in path.read_text().splitlines()]
    path.write_text("\n".join(lines) + "\n")
    assert [row.split for row in read_scores(path).rows] == ["test"]
