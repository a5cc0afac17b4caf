"""`compare`: the scores of many runs as one table, in a tidy CSV and as Markdown."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from avatar.checks import AvatarError, check_name
from avatar.evaluation.scores import Scores, read_scores, write_scores
from avatar.evaluation.tables import View, outfit_table, to_markdown
from avatar.io.npz import write_whole


@dataclass
class CompareConfig:
    """A table over runs: every scored run below ``runs_root`` with one of the names, and the floors."""

    table: str = "main"  # the name of the table's files
    runs_root: Path = Path("runs")
    dataset: tuple[str, ...] = ("sample",)  # one or several; outfits of one name in two would share a row
    name: str = "default"  # runs of this name
    methods: tuple[str, ...] = ("static", "closet")
    metrics: tuple[str, ...] = ("cd_point", "cd_pop", "normal_l1_mean", "penetration_share", "uniformity")
    out: Path = Path("docs/results")

    def __post_init__(self):
        check_name("table", self.table)


def compare(config: CompareConfig) -> Path:
    """Writes ``<out>/<table>.csv`` (tidy), ``<table>.frames.csv`` and ``<table>.md``; gives the Markdown's path.

    Raises:
        AvatarError: when nothing was scored.
    """
    scores = Scores()
    for path in scored_files(config):
        scores = scores + read_scores(path)
    if not scores.rows:
        raise AvatarError(f"runs_root: no scores below {config.runs_root}. Run tools/evaluate.py first.")
    rows = [replace(row, table=config.table) for row in scores.rows]
    write_scores(config.out / f"{config.table}.csv", Scores(rows, scores.frames))
    views = [(metric, View.VALUE) for metric in config.metrics]
    methods = {row.method for row in rows}
    if {"sampling", "body"} <= methods:
        views += [("cd_point", View.EXCESS), ("cd_point", View.OF_BODY)]
        views += [("cd_point", View.OF_STATIC)] if "static" in methods else []
    text = "\n".join(to_markdown(outfit_table(rows, metric, view)) for metric, view in views)
    path = config.out / f"{config.table}.md"
    write_whole(path, text.encode())
    print(text)
    return path


def scored_files(config: CompareConfig) -> Iterator[Path]:
    """The score files of the runs and of their outfits' floors."""
    for dataset in config.dataset:
        outfits: set[str] = set()
        for method in config.methods:
            for path in sorted((config.runs_root / method / dataset).glob(f"*/{config.name}/scores.csv")):
                outfits |= set(path.parent.parent.name.split("+"))
                yield path
        for outfit in sorted(outfits):
            path = config.runs_root / "floors" / dataset / outfit / "scores.csv"
            if path.is_file():
                yield path
