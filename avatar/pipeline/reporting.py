"""`report` and `compare`: a page about one run, with pictures; tables, plots and pictures of many runs' scores."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from avatar.checks import AvatarError, DataError, check_name
from avatar.data.folders import SPLITS, VALIDATION
from avatar.data.layouts import find_outfit
from avatar.data.outfits import Outfit
from avatar.data.scanner import ScanConfig
from avatar.data.splits import spaced_frames
from avatar.environment import prepared_process
from avatar.evaluation import aggregate, plots, tables
from avatar.evaluation.aggregate import FLOORS, method_key
from avatar.evaluation.canonical import OVERVIEW, canonical_table
from avatar.evaluation.metrics import find_metrics
from avatar.evaluation.report import COLUMNS, Picture, PictureRow, ReportContent, write_report
from avatar.evaluation.scores import Score, Scores, read_scores, write_scores
from avatar.evaluation.tables import Axis, FormConfig, ReportedTable, Table, View
from avatar.export import pictures
from avatar.geometry.trees import build_tree
from avatar.io.meshes import read_mesh
from avatar.io.npz import write_whole
from avatar.io.points import read_points
from avatar.methods.base import TrainedAvatar
from avatar.pipeline import scores as scored
from avatar.progress import tracked
from avatar.records import PointCloud
from avatar.runs.training import load_avatar
from avatar.settings import settings_from_dict

log = logging.getLogger(__name__)
PICTURE = (400, 600)  # pixels of a pose in the picture of all methods
MAX_ERROR = 0.05  # metres at the hot end of the error pictures
USUAL_METRICS = (
    *("cd_point", "cd_pop", "normal_l1_mean", "normal_map", "silhouette", "holes"),
    *("penetration_share", "uniformity"),
)


@dataclass
class ReportConfig:
    """One self-contained HTML page about a run: scores of every split, poses of one."""

    run: Path = Path("runs/closet/sample/dress/default")
    against: tuple[Path, ...] = ()  # other runs whose scores stand in the same table, such as the static floor
    split: str = "test"
    frames: int = 4  # poses shown
    data_root: Path | None = None  # where the data are now; where they were at training if null


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
def report(config: ReportConfig) -> Path:
    """Writes ``<run>/report.html`` and, as one picture, ``<run>/pictures.png``. What has not been predicted, meshed or
    scored is said to be missing on the page.
    """
    avatar = load_avatar(config.run)
    rows, settings = [], avatar.config
    splits, root = ("test", *sorted({*SPLITS, VALIDATION} - {"test"})), scored.floors_root(config.run, settings)
    scores = gather_scores((*config.against, config.run), splits, root, against=True)
    for outfit in scored.run_outfits(avatar, config.data_root):
        names = spaced_frames(outfit.frames(config.split), config.frames)
        rows += [pose_pictures(config, avatar, outfit, name) for name in names]
        garment = avatar.method.garment(avatar, outfit.name, 50_000)  # at rest, of methods that have one
        if garment is not None:
            image = pictures.render_points(garment, pictures.frame_camera(garment.points))
            template = Picture(image, f"garment template of {outfit.name}")
            rows.append(PictureRow(f"{outfit.name}: at rest", (None, None, template, None, None)))
    pictures.save_picture(config.run / "pictures.png", picture_sheet(rows))
    facts = {
        "training": f"{avatar.steps} steps, {avatar.seconds / 60:.1f} min",
        "parameters": f"{sum(p.numel() for p in avatar.model.parameters()):,}",
    }
    for row in aggregate.by_split(scores.rows):
        if row.metric == "cd_point" and row.split == scores.rows[0].split:
            facts[f"cd_point, {row.method}, {row.outfit}"] = f"{row.value * 1e4:.3f} x 1e-4 m²"
    files = [path for path in config.run.iterdir() if path.is_file() and path.name[0] != "."]
    folders = {path.parent for of in ("predictions", "meshes", "export") for path in (config.run / of).rglob("*.*")}
    seen = "of those trained on" if config.split == "train" else "none of which were trained on"
    content = ReportContent(
        title=f"{settings.method.variant} on {', '.join(settings.outfit)}",
        subtitle=f"data set {settings.dataset}, {config.split} poses, {seen}",
        summary="Points are predicted from the posed body alone; ground truth is a scan of the simulated clothes.",
        facts=facts,
        config_yaml=(config.run / "config.yaml").read_text(),
        metrics_csv=config.run / "metrics.csv",
        tables=tuple(scored.score_tables(scores.rows)),
        pictures=tuple(rows),
        files=(*sorted(path for path in files if path.name != "report.html"), *sorted(folders)),
    )
    return write_report(config.run, content)


def gather_scores(runs: Sequence[Path], splits: Sequence[str], root: Path, against: bool = False) -> Scores:
    """The scores of runs, split by split, each behind the floors of its outfits below ``root``. Files that are missing
    are left out of runs that a report sets ``against`` its own. Outfits of one name in several data sets are an
    `AvatarError`.
    """
    found, datasets = Scores(), {}
    for split in splits:
        mine, floors = Scores(), Scores()
        for run in runs:
            if not against or scored.scores_file(run, split).is_file():
                new = read_scores(scored.scores_file(run, split))
                for row in new.rows:
                    datasets.setdefault(row.outfit, set()).add(row.dataset or dataset_of(run))
                mine += new
        for outfit in sorted({row.outfit for row in mine.rows}):
            if len(datasets[outfit]) > 1:
                name, several = "against" if against else "runs", ", ".join(sorted(datasets[outfit]))
                raise AvatarError(
                    f"{name}: outfit {outfit!r} is in several data sets ({several}) and would share a row. "
                    "Compare one data set at a time."
                )
            if split != VALIDATION:  # each run has held back frames of its own
                floors += scored.read_floors(root, *datasets[outfit], outfit, mine.rows, split)
        found += floors + mine
    return found


def pose_pictures(config: ReportConfig, avatar: TrainedAvatar, outfit: Outfit, name: str) -> PictureRow:
    """Ground truth, prediction, garment template, mesh and error of one unseen pose, in one framing."""
    frame = outfit.load(config.split, name)
    scan = frame.scan
    camera = pictures.frame_camera(scan.points, "three_quarter")
    own = "normals" if scan.colors is None else scan.colors
    truth = pictures.render_points(PointCloud(scan.points, scan.normals), camera, own)
    shown = {"ground truth": Picture(truth, f"scan of {name}")}
    path = scored.predictions_folder(config.run, config.split, outfit.name) / f"{name}.ply"
    if path.is_file():
        cloud = read_points(path)
        errors = build_tree(scan.points).query(cloud.points, workers=-1)[0]
        hot = pictures.render_error(cloud, errors, MAX_ERROR, camera)
        image = pictures.render_points(cloud, camera, "normals" if cloud.colors is None else cloud.colors)
        shown["prediction"] = Picture(image, f"predicted points for {name}")
        shown["error"] = Picture(
            np.concatenate([hot, pictures.color_bar(MAX_ERROR, hot.shape[0])], axis=1),
            f"distance of predicted points of {name} to the scan",
            f"mean {errors.mean() * 1000:.1f} mm",
        )
    garment = avatar.method.garment(avatar, outfit.name, 50_000, frame.body)
    if garment is not None:
        shown["template"] = Picture(pictures.render_points(garment, camera), f"garment template posed as {name}")
    mesh = scored.meshes_folder(config.run, config.split, outfit.name) / f"{name}.ply"
    if mesh.is_file():
        shown["mesh"] = Picture(pictures.render_mesh(read_mesh(mesh), camera), f"mesh of {name}")
    return PictureRow(f"{outfit.name}: {name}", tuple(map(shown.get, COLUMNS)))


def picture_sheet(rows: list[PictureRow]) -> np.ndarray:
    """The poses' pictures as one, without the error column; empty where one could not be made, no column of nothing."""
    shown = [row.pictures[:-1] for row in rows if row.pictures[0] is not None]
    blank = np.full_like(shown[0][0].image, 255)
    kept = [column for column in range(len(COLUMNS) - 1) if any(row[column] for row in shown)]
    images = [[row[column].image if row[column] else blank for column in kept] for row in shown]
    return pictures.contact_sheet(images, column_labels=[COLUMNS[column] for column in kept])


@prepared_process()
def compare(config: CompareConfig) -> Path:
    """Writes ``<out>/<table>.*``, which it prints; gives the path of the Markdown. ``.csv`` and ``.frames.csv`` hold
    the tidy scores, ``.md`` and ``.tex`` the tables, ``.differences.csv`` those to the baseline, ``.<plot>.png`` the
    plots, ``.poses.jpg`` the same unseen poses by all methods. Canonicalizers can be compared alone; ``.canonical.csv``
    holds their scores. Raises `AvatarError` when nothing was scored, or when outfits of one name in two data sets would
    share a row.
    """
    found, made = [], []
    if config.runs or not config.canonicalizers:
        folders = [config.runs_root / method / dataset for dataset in config.dataset for method in config.methods]
        scores = [path for folder in folders for path in sorted(folder.glob(f"*/{config.name}/scores.csv"))]
        found, made = compare_runs(config, config.runs or tuple(path.parent for path in scores))
    found += canonical_tables(config)
    text = "\n".join([*map(tables.to_markdown, found), *(f"![{path.stem}]({path.name})" for path in made), ""])
    write_whole(file_of(config, "md"), text.encode())
    write_whole(file_of(config, "tex"), "\n".join(map(tables.to_latex, found)).encode())
    print(f"{text}\nwritten: {file_of(config, '*')}")
    return file_of(config, "md")


def compare_runs(config: CompareConfig, runs: tuple[Path, ...]) -> tuple[list[Table], list[Path]]:
    """The tables of runs and their pictures, which are written, as are the scores."""
    files = [scored.scores_file(run, split) for run in runs for split in config.splits]
    if old := [str(path) for path in files if path.is_file() and not scored.are_current(path)]:
        log.warning("compare: scored by other code than today's, or edited: %s. Score them again.", ", ".join(old))
    scores = gather_scores(runs, config.splits, config.runs_root)
    if not scores.rows:
        raise AvatarError(f"runs_root: no scores below {config.runs_root}. Run tools/evaluate.py first.")
    scores = Scores([replace(row, table=config.table) for row in scores.rows], scores.frames)
    write_scores(file_of(config, "csv"), scores)
    variants = {row.variant for row in scores.rows if row.method not in FLOORS[:2]}
    shared = variants.pop() if len(variants) == 1 else ""  # of all trained methods: it tells nothing apart
    rows, frames = (
        [replace(row, variant="") if row.variant == shared else row for row in mine]
        for mine in (scores.rows, scores.frames)
    )
    scores = Scores(rows, frames)
    splits = list(dict.fromkeys(row.split for row in scores.rows))
    found = [*main_tables(config, scores.rows, splits), *side_tables(config, scores, splits)]
    found[0] = replace(found[0], notes=(*found[0].notes, *([f"All methods: {shared}."] if shared else [])))
    found += [] if config.reported is None else [tables.reported_table(config.reported)]
    made = [*save_plots(config, scores.only("split", splits[:1]).rows, runs)]
    grid = file_of(config, "poses.jpg")
    return found, made + ([grid] if config.pictures and draw_pose_grid(config, grid, runs) else [])


def file_of(config: CompareConfig, suffix: str) -> Path:
    """One of the table's files."""
    return (config.out or config.runs_root / "tables") / f"{config.table}.{suffix}"


def dataset_of(run: Path) -> str:
    """The data set that a run's settings name; that of older scores, which do not say."""
    path = run / "config.yaml"
    if not path.is_file():
        raise DataError(run / "scores.csv", "these scores do not say their data set.", "Score them again.")
    return str(yaml.safe_load(path.read_text())["dataset"])


def main_tables(config: CompareConfig, rows: list[Score], splits: list[str]) -> list[Table]:
    """The table in the form asked for, or outfits by methods for each metric with the excess over the floors. A form
    has all splits as outfits of their own and then no summary over outfits; else each split has its tables.
    """
    if config.form is None and len(splits) > 1:
        found = {split: main_tables(config, [row for row in rows if row.split == split], [split]) for split in splits}
        return [replace(table, title=f"{split}: {table.title}") for split, mine in found.items() for table in mine]
    metrics = [name for name in config.metrics if name in {row.metric for row in rows}]
    methods = {row.method for row in rows}
    if config.form is not None:
        form, rows = config.form, aggregate.by_split(rows)
        if len(splits) > 1:  # outfits stand in it, and no mean or worst of all rows
            down = form.rows if Axis.outfit in (*form.rows, *form.columns) else (Axis.outfit, *form.rows)
            form = replace(form, rows=down, outfits=True, summary=False)
        found = [tables.form_table(rows, metrics, form, config.table)]
        distances = [name for name in metrics if name.startswith("cd_")]
        if distances and "sampling" in methods:
            title = f"{config.table}, excess over the sampling floor"
            found.append(tables.form_table(rows, distances, form, title, excess=True))
        return found
    views = [(metric, View.VALUE) for metric in metrics]
    if {"sampling", "body"} <= methods and "cd_point" in metrics:
        views += [("cd_point", View.EXCESS), ("cd_point", View.OF_BODY)]
        views += [("cd_point", View.OF_STATIC)] if "static" in methods else []
    return [tables.outfit_table(rows, metric, view) for metric, view in views]


def side_tables(config: CompareConfig, scores: Scores, splits: list[str]) -> list[Table]:
    """What training cost, and differences to the baseline on each split, which are written as CSV too."""
    if not config.baseline:
        return [tables.budget_table(scores.rows)]
    known = {row.metric for row in scores.frames if row.method not in FLOORS[:2]}  # floors may have more
    metrics = [name for name in config.metrics if name in known]
    found = [
        difference._replace(outfit=aggregate.named(difference.outfit, *({split} - {"test"})))
        for metric in metrics
        for split in splits
        for difference in aggregate.compare_methods(
            scores.only("split", [split]), metric, config.baseline, config.resamples, config.confidence
        )
    ]
    write_whole(file_of(config, "differences.csv"), aggregate.differences_csv(found).encode())
    return [tables.budget_table(scores.rows), *(tables.difference_table(found, metric) for metric in metrics)]


def canonical_tables(config: CompareConfig) -> list[Table]:
    """Canonical scans against their truth: an overview a split where there are several outfits, a table an outfit."""
    if not config.canonicalizers:
        return []
    scores = read_scores(*(folder / "scores.csv" for folder in config.canonicalizers))
    write_scores(file_of(config, "canonical.csv"), scores)
    overviews, single = [], []
    for split in dict.fromkeys(row.variant for row in scores.rows if row.variant):
        title = f"canonical scans of {split} frames"
        mine = [replace(row, variant="") for row in scores.rows if row.variant == split]
        outfits = list(dict.fromkeys(row.outfit for row in mine))
        if len(outfits) > 1:
            overviews.append(replace(canonical_table(mine, outfits, OVERVIEW), title=title))
        single += [replace(canonical_table(mine, [name]), title=f"{name}: {title}") for name in outfits]
    return overviews + single


def save_plots(config: CompareConfig, rows: list[Score], runs: tuple[Path, ...]) -> Iterator[Path]:
    """Error by outfit, by share of the training frames where there are several, and against training time."""
    metric = next((name for name in config.metrics if name in {row.metric for row in rows}), None)
    if not config.plots or metric is None:
        return
    figures = {"outfits": plots.plot_outfits(rows, metric), "times": plots.plot_times(rows, metric)}
    if len({row.fraction for row in rows if row.method not in FLOORS}) > 1:
        figures["fractions"] = plots.plot_fractions(rows, metric)
    logs: dict[str, dict[str, Path]] = {}
    for run in runs:
        if (run / "metrics.csv").is_file():
            first = read_scores(scored.scores_file(run, config.splits[0])).rows[0]
            logs.setdefault(run.parent.name, {})[method_key(first)] = run / "metrics.csv"
    if logs:
        figures["progress"] = plots.plot_progress(logs)
    for name, figure in figures.items():
        figure.savefig(file_of(config, f"{name}.png"), dpi=150, facecolor="white")
        yield file_of(config, f"{name}.png")


def draw_pose_grid(config: CompareConfig, path: Path, runs: Sequence[Path]) -> bool:
    """Writes the same unseen poses by all methods beside the ground truth, as in CloSET's figure 4; false for none.
    Rows are evenly spaced poses of every outfit, columns the methods, blank without a prediction, and the truth.
    """
    split, outfits = config.splits[0], {}
    folders: dict[str, dict[str, Path]] = {}  # of predictions, by outfit and method
    for run in runs:
        settings = yaml.safe_load((run / "config.yaml").read_text()) if (run / "config.yaml").is_file() else {}
        for name, row in {row.outfit: row for row in read_scores(scored.scores_file(run, split)).rows}.items():
            folder = scored.predictions_folder(run, split, name) if settings else run
            if not any(folder.glob("*.ply")):
                continue
            folders.setdefault(name, {})[method_key(row)] = folder
            if name not in outfits:
                root = config.data_root or Path(settings.get("data_root", "data"))
                scan = settings_from_dict(ScanConfig, settings.get("scan", {}))
                outfits[name] = find_outfit(root, row.dataset or str(settings.get("dataset", "sample")), name, scan)
    methods = aggregate.order_methods({method for mine in folders.values() for method in mine})
    rows, labels = [], []
    for name, outfit in outfits.items():
        names = spaced_frames(outfit.frames(split), config.pictures)
        for frame in tracked(names, f"pictures of {name}", unit="picture"):
            scan = outfit.load(split, frame).scan
            camera = pictures.frame_camera(scan.points, "three_quarter", PICTURE)
            truth = pictures.render_points(PointCloud(scan.points, scan.normals), camera)
            paths = [folders[name][method] / f"{frame}.ply" if method in folders[name] else None for method in methods]
            blank = np.full_like(truth, 255)
            shown = [pictures.render_points(read_points(p), camera) if p and p.is_file() else blank for p in paths]
            rows.append([*shown, truth])
            labels.append(f"{name}: {frame}" if len(outfits) > 1 else frame)
    if outfits:
        pictures.save_picture(path, pictures.contact_sheet(rows, labels, [*methods, "ground truth"]))
    return bool(outfits)
