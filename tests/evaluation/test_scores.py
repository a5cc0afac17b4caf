"""Tidy score files: what goes out comes back, and what cannot be read is named."""

import pytest

from avatar.checks import DataError
from avatar.evaluation.scores import FrameScore, Score, Scores, frames_path, read_scores, write_scores

COLUMNS = "table,outfit,method,variant,metric,value,unit,frames,seed,steps,seconds,points,commit,dataset,fraction,split"


def some_scores():
    row = Score(
        "main",
        "dress, long",
        "closet",
        'no "pose"',
        "cd_point",
        1 / 3e4,
        "m^2",
        20,
        1,
        4000,
        0.1 + 0.2,
        50000,
        "ab",
        "open",
        0.125,
    )
    return Scores([row], [FrameScore("dress, long", "closet", "", 1, "walk.0001", "cd_point", 1e-300)])


def test_round_trip_keeps_every_bit(tmp_path):
    write_scores(tmp_path / "main.csv", some_scores())
    assert read_scores(tmp_path / "main.csv") == some_scores()


def test_columns_are_those_of_the_design(tmp_path):
    write_scores(tmp_path / "main.csv", some_scores())
    with (tmp_path / "main.csv").open() as file:
        assert next(file) == COLUMNS + "\n"


def test_frames_file_may_be_missing(tmp_path):
    write_scores(tmp_path / "main.csv", some_scores())
    assert frames_path(tmp_path / "main.csv").name == "main.frames.csv"
    frames_path(tmp_path / "main.csv").unlink()
    assert read_scores(tmp_path / "main.csv") == Scores(some_scores().rows, [])


def test_scores_add_up():
    both = some_scores() + some_scores()
    assert (len(both.rows), len(both.frames)) == (2, 2)


def test_unreadable_files_are_named(tmp_path):
    path = tmp_path / "main.csv"
    with pytest.raises(DataError, match=r"main\.csv.*no scores"):
        read_scores(path)
    path.write_text("outfit,method\na,b\n")
    with pytest.raises(DataError, match=r"main\.csv.*metric.*missing"):
        read_scores(path)
    path.write_text(COLUMNS + "\nmain,dress,closet,,cd_point,much,m^2,20,1,1,1,1,ab,open,1\n")
    with pytest.raises(DataError, match=r"line 2.*much"):
        read_scores(path)


def test_files_from_before_data_sets_and_fractions_were_kept_are_read(tmp_path):
    older = COLUMNS.removesuffix(",dataset,fraction,split")
    (tmp_path / "main.csv").write_text(older + "\nmain,dress,closet,,cd_point,0.5,m^2,20,1,1,1,1,ab\n")
    (row,) = read_scores(tmp_path / "main.csv").rows
    assert (row.value, row.dataset, row.fraction) == (0.5, "", 1.0)
