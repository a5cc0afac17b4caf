"""`report`: one page about a run, with pictures of unseen poses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar.data.outfits import SPLITS, VALIDATION, Outfit
from avatar.environment import prepared_process
from avatar.evaluation.aggregate import by_split
from avatar.evaluation.report import COLUMNS, Picture, PictureRow, ReportContent, write_report
from avatar.evaluation.scores import Scores, read_scores
from avatar.export import pictures
from avatar.geometry.trees import build_tree
from avatar.io.meshes import read_mesh
from avatar.io.points import read_points
from avatar.methods.base import TrainedAvatar
from avatar.pipeline import scores
from avatar.pipeline.surfaces import spaced_frames
from avatar.records import PointCloud
from avatar.runs.training import load_avatar

MAX_ERROR = 0.05  # metres at the hot end of the error pictures


@dataclass
class ReportConfig:
    """One self-contained HTML page about a run."""

    run: Path = Path("runs/closet/sample/dress/default")
    against: tuple[Path, ...] = ()  # other runs whose scores stand in the same table, such as the static floor
    split: str = "test"  # whose poses are shown; scores are those of every split
    frames: int = 4  # poses shown
    data_root: Path | None = None  # where the data are now; where they were at training if null


@prepared_process()
def report(config: ReportConfig) -> Path:
    """Writes ``<run>/report.html`` and, as one picture, ``<run>/pictures.png``.

    What has not been predicted, meshed or scored is said to be missing on the page.
    """
    avatar = load_avatar(config.run)
    found, rows, settings = gather_scores(config, avatar), [], avatar.config
    for outfit in scores.run_outfits(avatar, config.data_root):
        names = spaced_frames(list(outfit.frames(config.split)), config.frames)
        rows += [pose_pictures(config, avatar, outfit, name) for name in names]
        rows += template_pictures(avatar, outfit)
    pictures.save_picture(config.run / "pictures.png", picture_sheet(rows))
    seen = "of those trained on" if config.split == "train" else "none of which were trained on"
    content = ReportContent(
        title=f"{settings.method.variant} on {', '.join(settings.outfit)}",
        subtitle=f"data set {settings.dataset}, {config.split} poses, {seen}",
        summary="Points are predicted from the posed body alone; ground truth is a scan of the simulated clothes.",
        facts=headline_facts(avatar, found),
        config_yaml=(config.run / "config.yaml").read_text(),
        metrics_csv=config.run / "metrics.csv",
        tables=tuple(scores.score_tables(found.rows)),
        pictures=tuple(rows),
        files=made_files(config.run),
    )
    return write_report(config.run, content)


def gather_scores(config: ReportConfig, avatar: TrainedAvatar) -> Scores:
    """Scores of the run, of those it is set against and of floors, as far as they are there: every split, test first."""
    settings, found = avatar.config, Scores()
    root = scores.floors_root(config.run, settings)
    for split in ("test", *sorted({*SPLITS, VALIDATION} - {"test"})):
        files = [scores.scores_file(folder, split) for folder in (*config.against, config.run)]
        mine = read_scores(*filter(Path.is_file, files))
        for name in dict.fromkeys(row.outfit for row in mine.rows):
            mine = scores.read_floors(root, settings.dataset, name, mine.rows, split) + mine
        found += mine
    return found


def headline_facts(avatar: TrainedAvatar, found: Scores) -> dict[str, str]:
    """The numbers on top of the page: of the test split, or of another where that was not scored."""
    facts = {
        "training": f"{avatar.steps} steps, {avatar.seconds / 60:.1f} min",
        "parameters": f"{sum(p.numel() for p in avatar.model.parameters()):,}",
    }
    for row in by_split(found.rows):
        if row.metric == "cd_point" and row.split == found.rows[0].split:
            facts[f"cd_point, {row.method}, {row.outfit}"] = f"{row.value * 1e4:.3f} x 1e-4 m²"
    return facts


def pose_pictures(config: ReportConfig, avatar: TrainedAvatar, outfit: Outfit, name: str) -> PictureRow:
    """Ground truth, prediction, garment template, mesh and error of one unseen pose, in one framing."""
    frame = outfit.load(config.split, name)
    scan = frame.scan
    camera = pictures.frame_camera(scan.points, "three_quarter")
    truth = draw_cloud(PointCloud(scan.points, scan.normals, scan.colors), camera)
    shown = {"ground truth": Picture(truth, f"scan of {name}")}
    path = scores.predictions_folder(config.run, config.split, outfit.name) / f"{name}.ply"
    if path.is_file():
        cloud = read_points(path)
        errors = build_tree(scan.points).query(cloud.points, workers=-1)[0]
        hot = pictures.render_error(cloud, errors, MAX_ERROR, camera)
        shown["prediction"] = Picture(draw_cloud(cloud, camera), f"predicted points for {name}")
        shown["error"] = Picture(
            np.concatenate([hot, pictures.color_bar(MAX_ERROR, hot.shape[0])], axis=1),
            f"distance of predicted points of {name} to the scan",
            f"mean {errors.mean() * 1000:.1f} mm",
        )
    garment = avatar.method.garment(avatar, outfit.name, 50_000, frame.body)
    if garment is not None:
        shown["template"] = Picture(pictures.render_points(garment, camera), f"garment template posed as {name}")
    mesh = scores.meshes_folder(config.run, config.split, outfit.name) / f"{name}.ply"
    if mesh.is_file():
        shown["mesh"] = Picture(pictures.render_mesh(read_mesh(mesh), camera), f"Poisson mesh of {name}")
    return PictureRow(f"{outfit.name}: {name}", tuple(map(shown.get, COLUMNS)))


def draw_cloud(cloud: PointCloud, camera: pictures.Camera) -> np.ndarray:
    """A picture of points in their own colours, where they have some, or by their normals."""
    return pictures.render_points(cloud, camera, "normals" if cloud.colors is None else cloud.colors)


def picture_sheet(rows: list[PictureRow]) -> np.ndarray:
    """The poses' pictures as one, without the error column; empty where one could not be made, no column of nothing."""
    shown = [row.pictures[:-1] for row in rows if row.pictures[0] is not None]
    blank = np.full_like(shown[0][0].image, 255)
    kept = [column for column in range(len(COLUMNS) - 1) if any(row[column] for row in shown)]
    images = [[row[column].image if row[column] else blank for column in kept] for row in shown]
    return pictures.contact_sheet(images, column_labels=[COLUMNS[column] for column in kept])


def template_pictures(avatar: TrainedAvatar, outfit: Outfit) -> list[PictureRow]:
    """The explicit garment template in the canonical pose; no row for methods without one."""
    cloud = avatar.method.garment(avatar, outfit.name, 50_000)
    if cloud is None:
        return []
    image = pictures.render_points(cloud, pictures.frame_camera(cloud.points))
    template = Picture(image, f"garment template of {outfit.name}")
    return [PictureRow(f"{outfit.name}: at rest", (None, None, template, None, None))]


def made_files(run: Path) -> tuple[Path, ...]:
    """What the run made: its files and, for folders of many, the folder."""
    files = [path for path in run.iterdir() if path.is_file() and path.name != "report.html" and path.name[0] != "."]
    folders = {path.parent for kind in ("predictions", "meshes", "export") for path in (run / kind).rglob("*.*")}
    return (*sorted(files), *sorted(folders))
