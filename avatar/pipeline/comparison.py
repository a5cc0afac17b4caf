"""`compare`: the scores of many runs in one table: tidy CSV, Markdown, LaTeX, differences, plots and pictures."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from avatar.checks import AvatarError, DataError, check_name
from avatar.data.folders import SPLITS
from avatar.data.layouts import find_outfit
from avatar.data.outfits import Outfit
from avatar.data.scanner import ScanConfig
from avatar.environment import prepared_process
from avatar.evaluation.aggregate import FLOORS, by_split, method_key, named, order_methods
from avatar.evaluation.canonical_scores import canonical_overview, canonical_table
from avatar.evaluation.differences import budget_table, compare_methods, difference_table, differences_csv
from avatar.evaluation.forms import Axis, FormConfig, ReportedTable, form_table, reported_table
from avatar.evaluation.metrics import find_metrics
from avatar.evaluation.plots import plot_fractions, plot_outfits, plot_progress, plot_times, save_figure
from avatar.evaluation.scores import Score, Scores, read_scores, write_scores
from avatar.evaluation.tables import Table, View, outfit_table, to_latex, to_markdown
from avatar.export.pictures import contact_sheet, frame_camera, render_points, save_picture
from avatar.io.npz import write_whole
from avatar.io.points import read_points
from avatar.pipeline.scores import are_current, predictions_folder, read_all_scores, read_floors, scores_file
from avatar.pipeline.surfaces import spaced_frames
from avatar.progress import tracked
from avatar.records import PointCloud, Scan
from avatar.settings import settings_from_dict

log = logging.getLogger(__name__)
PICTURE = (400, 600)
USUAL_METRICS = (
    *("cd_point", "cd_pop", "normal_l1_mean", "normal_map", "silhouette", "holes"),
    *("penetration_share", "uniformity"),
)


@dataclass
class CompareConfig:
    """A table over runs: those listed, or every scored run below ``runs_root`` with the name; and their floors."""

    table: str = "main"  # the name of the table's files
    runs: tuple[Path, ...] = ()  # folders of runs, or of scored predictions of foreign programs
    runs_root: Path = Path("runs")
    dataset: tuple[str, ...] = ("sample",)  # where runs are not listed: one or several
    name: str = "default"  # and runs of this name
    methods: tuple[str, ...] = ("static", "closet")  # columns of the table, in this order
    metrics: tuple[str, ...] = USUAL_METRICS  # in it, as far as they were scored
    form: FormConfig | None = None  # of one table of all metrics; null gives outfits by methods, a table a metric
    baseline: str = ""  # the method that others are set against, with bootstrap intervals; empty for none
    resamples: int = 2000  # of the bootstrap
    confidence: float = 0.95
    reported: ReportedTable | None = None  # what the paper's table says
    canonicalizers: tuple[Path, ...] = ()  # folders of scored canonicalizers (tools/canonicalize.py scored=...)
    plots: bool = True
    pictures: int = 3  # unseen poses an outfit in the picture of all methods; 0 for none
    splits: tuple[str, ...] = ("test",)  # that were scored; the first is that of plots and pictures
    data_root: Path | None = None  # where the data are now; where they were at training if null
    out: Path | None = None  # where the table's files go; <runs_root>/tables if null

    def __post_init__(self):
        check_name("table", self.table)
        if self.pictures < 0 or self.resamples < 100 or not 0 < self.confidence < 1:
            raise AvatarError(
                "pictures: expected at least 0, resamples: at least 100, confidence: in (0, 1); "
                f"got {self.pictures}, {self.resamples}, {self.confidence}."
            )
        find_metrics(self.metrics)


@prepared_process()
def compare(config: CompareConfig) -> Path:
    """Writes ``<out>/<table>.*``, which it prints; gives the path of the Markdown.

    ``.csv`` and ``.frames.csv`` hold the tidy scores, ``.md`` and ``.tex`` the tables, ``.differences.csv`` those to
    the baseline, ``.<plot>.png`` the plots, ``.poses.jpg`` the same unseen poses by all methods. Canonicalizers can be
    compared alone; ``.canonical.csv`` holds their scores.

    Raises:
        AvatarError: when nothing was scored, or when outfits of one name in two data sets would share a row.
    """
    tables, pictures = [], []
    if config.runs or not config.canonicalizers:
        tables, pictures = compare_runs(config, config.runs or tuple(named_runs(config)))
    tables += canonical_tables(config)
    text = "\n".join([*map(to_markdown, tables), *(f"![{path.stem}]({path.name})" for path in pictures), ""])
    write_whole(file_of(config, "md"), text.encode())
    write_whole(file_of(config, "tex"), "\n".join(map(to_latex, tables)).encode())
    print(f"{text}\nwritten: {file_of(config, '*')}")
    return file_of(config, "md")


def compare_runs(config: CompareConfig, runs: tuple[Path, ...]) -> tuple[list[Table], list[Path]]:
    """The tables of runs and their pictures, which are written, as are the scores."""
    scores = gather_scores(config, runs)
    write_scores(file_of(config, "csv"), scores)
    scores, shared = without_shared_variant(scores)
    splits = list(dict.fromkeys(row.split for row in scores.rows))
    tables = [*main_tables(config, scores.rows, splits), *side_tables(config, scores, splits)]
    tables[0] = replace(tables[0], notes=(*tables[0].notes, *([f"All methods: {shared}."] if shared else [])))
    if config.reported is not None:
        tables.append(reported_table(config.reported))
    pictures = [*save_plots(config, scores.of_split(splits[0]).rows, runs)]
    if config.pictures:
        grid = file_of(config, "poses.jpg")
        pictures += [grid] if draw_pose_grid(grid, runs, config.pictures, config.splits[0], config.data_root) else []
    return tables, pictures


def file_of(config: CompareConfig, suffix: str) -> Path:
    """One of the table's files."""
    return (config.out or config.runs_root / "tables") / f"{config.table}.{suffix}"


def named_runs(config: CompareConfig) -> Iterator[Path]:
    """The scored runs of the data sets, methods and name asked for."""
    for dataset in config.dataset:
        for method in config.methods:
            found = sorted((config.runs_root / method / dataset).glob(f"*/{config.name}/scores.csv"))
            yield from (path.parent for path in found)


def gather_scores(config: CompareConfig, runs: tuple[Path, ...]) -> Scores:
    """The scores of runs behind those of their outfits' floors.

    Raises:
        AvatarError: when there are none, or outfits of one name come from several data sets.
    """
    scores, datasets = Scores(), {}
    files = [scores_file(run, split) for run in runs for split in config.splits]
    if old := [str(path) for path in files if path.is_file() and not are_current(path)]:
        log.warning("compare: scored by other code than today's, or edited: %s. Score them again.", ", ".join(old))
    for run in runs:
        mine = read_all_scores(scores_file(run, split) for split in config.splits)
        for row in mine.rows:
            datasets.setdefault(row.outfit, set()).add(row.dataset or dataset_of(run))
        scores = scores + mine
    if not scores.rows:
        raise AvatarError(f"runs_root: no scores below {config.runs_root}. Run tools/evaluate.py first.")
    for outfit, found in datasets.items():
        if len(found) > 1:
            raise AvatarError(
                f"runs: outfit {outfit!r} is in several data sets ({', '.join(sorted(found))}) and would share a row. "
                "Compare one data set at a time."
            )
    floors = Scores()
    for outfit, (dataset,) in sorted(datasets.items()):
        for split in set(config.splits) & set(SPLITS):
            floors = floors + read_floors(config.runs_root, dataset, outfit, scores.rows, split)
    whole = floors + scores
    return Scores([replace(row, table=config.table) for row in whole.rows], whole.frames)


def without_shared_variant(scores: Scores) -> tuple[Scores, str]:
    """The scores without a variant that all trained methods share, and that variant: it tells nothing apart."""
    variants = {row.variant for row in scores.rows if row.method not in FLOORS[:2]}
    shared = variants.pop() if len(variants) == 1 else ""
    rows, frames = (
        [replace(row, variant="") if row.variant == shared else row for row in mine]
        for mine in (scores.rows, scores.frames)
    )
    return Scores(rows, frames), shared


def dataset_of(run: Path) -> str:
    """The data set that a run's settings name; that of older scores, which do not say."""
    path = run / "config.yaml"
    if not path.is_file():
        raise DataError(run / "scores.csv", "these scores do not say their data set.", "Score them again.")
    return str(yaml.safe_load(path.read_text())["dataset"])


def main_tables(config: CompareConfig, rows: list[Score], splits: list[str]) -> list[Table]:
    """The table in the form asked for, or outfits by methods for each metric with the excess over the floors.

    A form has all splits as outfits of their own and then no summary over outfits; else each split has its tables.
    """
    if config.form is None and len(splits) > 1:
        tables = []
        for split in splits:
            mine = main_tables(config, [row for row in rows if row.split == split], [split])
            tables += [replace(table, title=f"{split}: {table.title}") for table in mine]
        return tables
    metrics = [name for name in config.metrics if name in {row.metric for row in rows}]
    if config.form is not None:
        form = config.form if len(splits) == 1 else split_form(config.form)
        rows = by_split(rows)
        tables = [form_table(rows, metrics, form, config.table)]
        distances = [name for name in metrics if name.startswith("cd_")]
        if distances and any(row.method == "sampling" for row in rows):
            title = f"{config.table}, excess over the sampling floor"
            tables.append(form_table(rows, distances, form, title, excess=True))
        return tables
    tables = [outfit_table(rows, metric) for metric in metrics]
    methods = {row.method for row in rows}
    if {"sampling", "body"} <= methods and "cd_point" in metrics:
        tables += [outfit_table(rows, "cd_point", View.EXCESS), outfit_table(rows, "cd_point", View.OF_BODY)]
        tables += [outfit_table(rows, "cd_point", View.OF_STATIC)] if "static" in methods else []
    return tables


def split_form(form: FormConfig) -> FormConfig:
    """A form for several splits: outfits stand in it, and no mean or worst of all rows."""
    rows = form.rows if Axis.outfit in (*form.rows, *form.columns) else (Axis.outfit, *form.rows)
    return replace(form, rows=rows, outfits=True, summary=False)


def side_tables(config: CompareConfig, scores: Scores, splits: list[str]) -> list[Table]:
    """What training cost, and differences to the baseline on each split, which are written as CSV too."""
    tables = [budget_table(scores.rows)]
    if config.baseline:
        scored = {row.metric for row in scores.frames if row.method not in FLOORS[:2]}  # floors may have more
        metrics = [name for name in config.metrics if name in scored]
        how = (config.baseline, config.resamples, config.confidence)
        found = [
            replace(difference, outfit=named(difference.outfit, *({split} - {"test"})))
            for metric in metrics
            for split in splits
            for difference in compare_methods(scores.of_split(split), metric, *how)
        ]
        write_whole(file_of(config, "differences.csv"), differences_csv(found).encode())
        tables += [difference_table(found, metric) for metric in metrics]
    return tables


def canonical_tables(config: CompareConfig) -> list[Table]:
    """Canonical scans against their truth: an overview a split where there are several outfits, a table an outfit."""
    if not config.canonicalizers:
        return []
    scores = read_all_scores(folder / "scores.csv" for folder in config.canonicalizers)
    write_scores(file_of(config, "canonical.csv"), scores)
    rows = scores.rows
    tables, single = [], []
    for split in dict.fromkeys(row.variant for row in rows if row.variant):
        title = f"canonical scans of {split} frames"
        mine = [replace(row, variant="") for row in rows if row.variant == split]
        outfits = list(dict.fromkeys(row.outfit for row in mine))
        if len(outfits) > 1:
            tables.append(replace(canonical_overview(mine), title=title))
        single += [replace(canonical_table(mine, outfit), title=f"{outfit}: {title}") for outfit in outfits]
    return tables + single


def save_plots(config: CompareConfig, rows: list[Score], runs: tuple[Path, ...]) -> Iterator[Path]:
    """Error by outfit, by share of the training frames where there are several, and against training time."""
    metric = next((name for name in config.metrics if name in {row.metric for row in rows}), None)
    if not config.plots or metric is None:
        return
    figures = {"outfits": plot_outfits(rows, metric), "times": plot_times(rows, metric)}
    if len({row.fraction for row in rows if row.method not in FLOORS}) > 1:
        figures["fractions"] = plot_fractions(rows, metric)
    logs: dict[str, dict[str, Path]] = {}
    for run in runs:
        if (run / "metrics.csv").is_file():
            first = read_scores(run / "scores.csv").rows[0]
            logs.setdefault(run.parent.name, {})[method_key(first)] = run / "metrics.csv"
    if logs:
        figures["progress"] = plot_progress(logs)
    for name, figure in figures.items():
        save_figure(figure, file_of(config, f"{name}.png"))
        yield file_of(config, f"{name}.png")


def draw_pose_grid(path: Path, runs: Sequence[Path], count: int, split: str, data_root: Path | None = None) -> bool:
    """Writes the same unseen poses by all methods beside the ground truth, as in CloSET's figure 4.

    Rows are ``count`` evenly spaced poses of every outfit, columns the methods and the truth.

    Args:
        path: the picture.
        runs: folders of runs or of scored foreign predictions; what has no predictions of the split is left empty.
        count: poses an outfit.
        split: which of the predictions.
        data_root: where the data are now; where they were at training if None.

    Returns:
        Whether there were any predictions to draw.
    """
    outfits: dict[str, Outfit] = {}
    folders: dict[str, dict[str, Path]] = {}  # of predictions, by outfit and method
    for run in runs:
        settings = yaml.safe_load((run / "config.yaml").read_text()) if (run / "config.yaml").is_file() else {}
        for name, row in {row.outfit: row for row in read_scores(run / "scores.csv").rows}.items():
            folder = predictions_folder(run, split, name) if settings else run
            if not any(folder.glob("*.ply")):
                continue
            folders.setdefault(name, {})[method_key(row)] = folder
            if name not in outfits:
                root = data_root or Path(settings.get("data_root", "data"))
                scan = settings_from_dict(ScanConfig, settings.get("scan", {}))
                outfits[name] = find_outfit(root, row.dataset or str(settings.get("dataset", "sample")), name, scan)
    methods = order_methods({method for mine in folders.values() for method in mine})
    rows, labels = [], []
    for name, outfit in outfits.items():
        for frame in tracked(spaced_frames(list(outfit.frames(split)), count), f"pictures of {name}", unit="picture"):
            paths = [folders[name][method] / f"{frame}.ply" if method in folders[name] else None for method in methods]
            rows.append(draw_pose(outfit.load(split, frame).scan, paths))
            labels.append(f"{name}: {frame}" if len(outfits) > 1 else frame)
    if outfits:
        save_picture(path, contact_sheet(rows, labels, [*methods, "ground truth"]))
    return bool(outfits)


def draw_pose(scan: Scan, predictions: Sequence[Path | None]) -> list[np.ndarray]:
    """One pose by every method, and its scan, in one framing; blank where there is no prediction."""
    camera = frame_camera(scan.points, "three_quarter", PICTURE)
    truth = render_points(PointCloud(scan.points, scan.normals), camera)
    blank = np.full_like(truth, 255)
    return [render_points(read_points(p), camera) if p and p.is_file() else blank for p in predictions] + [truth]
