"""Scores as tidy rows on disk: one file of means that tables are made of, and one of single frames beside it."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Iterable
from dataclasses import MISSING, astuple, dataclass, field, fields
from pathlib import Path
from typing import TypeVar, get_type_hints

from avatar.checks import DataError
from avatar.io.npz import write_whole

Row = TypeVar("Row", "Score", "FrameScore")


@dataclass(frozen=True)
class Score:
    """One number of a results table: a metric's mean over the frames of one outfit for one method. ``variant`` tells
    settings of a method apart, ``seed``, ``steps``, ``seconds`` and ``fraction`` of the frames are of its training,
    ``points`` is the mean count of predicted points, ``commit`` the code that made it. Files without the last three
    columns are older.
    """

    table: str
    outfit: str
    method: str
    variant: str
    metric: str
    value: float
    unit: str
    frames: int
    seed: int
    steps: int
    seconds: float
    points: int
    commit: str
    dataset: str = ""
    fraction: float = 1.0
    split: str = "test"


@dataclass(frozen=True)
class FrameScore:
    """One metric of one method on one frame."""

    outfit: str
    method: str
    variant: str
    seed: int
    frame: str
    metric: str
    value: float
    split: str = "test"


@dataclass(frozen=True)
class Scores:
    """Means and the single frames behind them. Adding two joins them."""

    rows: list[Score] = field(default_factory=list)
    frames: list[FrameScore] = field(default_factory=list)

    def __add__(self, other: Scores) -> Scores:
        return Scores(self.rows + other.rows, self.frames + other.frames)

    def only(self, column: str, values: Collection[str]) -> Scores:
        """Those with one of some values in a column: of some splits, or metrics."""
        return Scores(*([row for row in rows if getattr(row, column) in values] for rows in (self.rows, self.frames)))


def write_scores(path: str | Path, scores: Scores) -> None:
    """Writes means to a CSV and single frames, if any, to ``<stem>.frames.csv`` beside it, so that no bit is lost."""
    path = Path(path)
    for file, kind, rows in ((path, Score, scores.rows), (frames_path(path), FrameScore, scores.frames)):
        if rows or kind is Score:
            write_whole(file, csv_text((f.name for f in fields(kind)), map(astuple, rows)).encode())
        else:
            file.unlink(missing_ok=True)


def read_scores(*paths: str | Path) -> Scores:
    """Reads what `write_scores` wrote to one or several files; those of single frames may be missing. Raises
    `DataError` for a missing file, other columns, or a value of the wrong kind.
    """
    scores = Scores()
    for path in map(Path, paths):
        if not path.is_file():
            raise DataError(path, "there are no scores here.", "Run tools/evaluate.py first.")
        beside = frames_path(path)
        scores += Scores(_from_csv(Score, path), _from_csv(FrameScore, beside) if beside.is_file() else [])
    return scores


def frames_path(path: Path) -> Path:
    """Where the single frames of a scores file stand."""
    return path.with_name(f"{path.stem}.frames.csv")


def csv_text(columns: Iterable[str], rows: Iterable[Iterable]) -> str:
    """A CSV file's text: its header and its rows."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows((columns, *rows))
    return text.getvalue()


def _from_csv(kind: type[Row], path: Path) -> list[Row]:
    columns = get_type_hints(kind)
    needed = {f.name for f in fields(kind) if f.default is MISSING}
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        given = [name for name in columns if name in (reader.fieldnames or [])]
        missing = [name for name in columns if name in needed.difference(given)]
        if missing:
            raise DataError(path, f"expected the columns {', '.join(columns)}; {', '.join(missing)} missing.")
        rows = []
        for line in reader:
            try:
                rows.append(kind(**{name: columns[name](line[name]) for name in given}))
            except (TypeError, ValueError) as error:
                raise DataError(path, f"line {reader.line_num} cannot be read ({error}).") from error
    return rows
