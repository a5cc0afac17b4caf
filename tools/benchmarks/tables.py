"""Tables of the benchmarks: figures as tidy scores and as Markdown; topics that are not run again keep their rows."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from avatar.evaluation.scores import FrameScore, Score, Scores, read_scores
from benchmarks.comparisons import Figure

MACHINE = "machine"  # the topic whose rows describe the machine
COLUMNS = {  # metric: its column's heading and how a number of it is written
    "ratio": ("time / baseline", "{:.2f}"),
    "processor_ratio": ("processor time / baseline", "{:.2f}"),
    "seconds": ("seconds", "{:.3g}"),
    "processor_seconds": ("processor seconds", "{:.3g}"),
    "spread": ("spread", "{:.0%}"),
    "gap": ("largest difference", "{:.1e}"),
    "memory": ("peak MiB", "{:,.0f}"),
    "exponent": ("exponent", "{:.2f}"),
    "rate": ("rate", "{:,.0f}"),
    "work": ("Gflop", "{:,.0f}"),
    "share": ("share of the matrix product's rate", "{:.0%}"),
}
TITLES = {
    "nearest": "Nearest neighbours (points in points; ours is the baseline; differences of distances, metres)",
    "chamfer": "Chamfer distance both ways with normals (ours is the baseline; differences are relative)",
    "pointnet2": "PointNet++ forward and back (ours is the baseline; differences are relative)",
    "step": "Training step (POP is the baseline, in the largest size of the case)",
    "predict": "Prediction of one frame (POP at full size is the baseline)",
    "canonicalizer": "A step of the canonicalizer (its first stage is the baseline)",
    "extraction": "Surface of a signed distance (ours is the baseline; differences of vertices, metres)",
    "poisson": "Poisson meshing (the deepest is the baseline; its worker's processor time and memory are not counted)",
    "mesh": "Mesh of a frame: the layered avatar's own, 12,272 garment vertices, and Poisson meshing of points",
    "simulation": "Simulated frame (the tee is the baseline)",
    "growth": "Growth of the small CloSET's training step (in processor seconds, those of the largest size shown)",
    "ceilings": "Share of the machine's ceilings (rates a processor second, of one core; a step is timed once)",
}


def to_scores(table: str, figures: Iterable[Figure], repeats: int, commit: str) -> Scores:
    """Figures as rows of a results table: the topic as outfit, the candidate as method, the case as variant.

    A missing candidate has no value, and the reason as unit.
    """
    rows, rounds = [], []
    for figure in figures:
        who = (figure.topic, figure.candidate, figure.case)
        rest = (figure.metric, figure.value, figure.unit, repeats, 0, 0, sum(figure.rounds), figure.points, commit)
        rows.append(Score(table, *who, *rest))
        for place, seconds in enumerate(figure.rounds):
            rounds.append(FrameScore(*who, 0, f"round.{place:05d}", figure.metric, seconds))
    return Scores(rows, rounds)


def keep_others(path: Path, new: Scores) -> Scores:
    """New scores and those of other topics in an existing table, in the order of the topics."""
    old = read_scores(path) if path.is_file() else Scores()
    topics = {row.outfit for row in new.rows}
    order = [MACHINE, *TITLES]
    rows = [row for row in old.rows if row.outfit not in topics] + new.rows
    rounds = [score for score in old.frames if score.outfit not in topics] + new.frames
    return Scores(
        sorted(rows, key=lambda row: order.index(row.outfit)),
        sorted(rounds, key=lambda score: order.index(score.outfit)),
    )


def to_markdown(rows: list[Score]) -> str:
    """Markdown table of every topic, after the description of the machine."""
    lines = [f"- {row.method}: {row.variant}" for row in rows if row.outfit == MACHINE]
    for topic in (topic for topic in TITLES if any(row.outfit == topic for row in rows)):
        mine = [row for row in rows if row.outfit == topic]
        load = next((row.value for row in mine if row.metric == "load"), 0.0)
        lines += ["", f"**{TITLES[topic]}**", ""]
        lines += [
            f"Medians of {mine[0].frames} rounds; load average {load:.1f} before. {mine[0].commit}",
            "",
        ]
        lines += topic_table([row for row in mine if row.metric != "load"])
    return "\n".join(lines) + "\n"


def topic_table(rows: list[Score]) -> list[str]:
    """Lines of one topic's table: a row for each candidate of each case, a column for each metric."""
    metrics = [metric for metric in COLUMNS if any(row.metric == metric for row in rows)]
    found: dict[tuple[str, str], dict[str, Score]] = {}
    for row in sorted(rows, key=lambda row: row.metric == "memory"):
        found.setdefault((row.variant, row.method), {})[row.metric] = row
    head = ["case", "candidate", *(COLUMNS[metric][0] for metric in metrics)]
    lines = [f"| {' | '.join(head)} |", f"|---|---|{'---:|' * len(metrics)}"]
    for (case, candidate), row in found.items():
        cells = [write_cell(row[metric]) if metric in row else "–" for metric in metrics]
        if "absent" in row:
            cells = [row["absent"].unit] + [""] * (len(metrics) - 1)
        lines.append(f"| {' | '.join([case, candidate, *cells])} |")
    return lines


def write_cell(row: Score) -> str:
    """Value as printed; rates have their own units."""
    return COLUMNS[row.metric][1].format(row.value) + (f" {row.unit}" if row.metric == "rate" else "")
