"""One picture of the same unseen poses by all methods beside the ground truth, as in CloSET's figure 4."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from avatar.data.layouts import find_outfit
from avatar.data.outfits import Outfit
from avatar.data.scanner import ScanConfig
from avatar.evaluation.aggregate import method_key, order_methods
from avatar.evaluation.scores import read_scores
from avatar.export.pictures import contact_sheet, frame_camera, render_points, save_picture
from avatar.io.points import read_points
from avatar.pipeline.scores import predictions_folder
from avatar.pipeline.surfaces import spaced_frames
from avatar.progress import tracked
from avatar.records import PointCloud
from avatar.settings import settings_from_dict

PICTURE = (400, 600)
TRUTH = "ground truth"


@dataclass(frozen=True)
class Predicted:
    """A folder of one method's predictions of one outfit, and where the outfit's data are."""

    method: str
    outfit: str
    dataset: str
    folder: Path
    data_root: Path
    scan: ScanConfig

    def load_outfit(self) -> Outfit:
        """The outfit that is predicted."""
        return find_outfit(self.data_root, self.dataset, self.outfit, self.scan)


def draw_pose_grid(path: Path, runs: Sequence[Path], count: int, split: str, data_root: Path | None = None) -> bool:
    """Writes a picture with ``count`` evenly spaced poses of every outfit as rows, and methods and truth as columns.

    Args:
        path: the picture.
        runs: folders of runs or of scored foreign predictions; what has no predictions of the split is left empty.
        count: poses an outfit.
        split: which of the predictions.
        data_root: where the data are now; where they were at training if None.

    Returns:
        Whether there were any predictions to draw.
    """
    found = [one for run in runs for one in find_predictions(run, split, data_root)]
    if not found:
        return False
    methods = order_methods({one.method for one in found})
    rows, labels = [], []
    for name in dict.fromkeys(one.outfit for one in found):
        mine = {one.method: one.folder for one in found if one.outfit == name}
        outfit = next(one for one in found if one.outfit == name).load_outfit()
        for frame in tracked(spaced_frames(list(outfit.frames(split)), count), f"pictures of {name}", unit="picture"):
            rows.append(draw_pose(outfit, split, frame, [mine.get(method) for method in methods]))
            labels.append(f"{name}: {frame}" if len({one.outfit for one in found}) > 1 else frame)
    save_picture(path, contact_sheet(rows, labels, [*methods, TRUTH]))
    return True


def find_predictions(run: Path, split: str, data_root: Path | None) -> list[Predicted]:
    """The predictions of a run's outfits, or those of a foreign program in the folder itself."""
    settings = yaml.safe_load((run / "config.yaml").read_text()) if (run / "config.yaml").is_file() else {}
    scan = settings_from_dict(ScanConfig, settings.get("scan", {}))
    root = data_root or Path(settings.get("data_root", "data"))
    found = []
    for row in {row.outfit: row for row in read_scores(run / "scores.csv").rows}.values():
        inside = predictions_folder(run, split, row.outfit)
        folder = inside if settings else run
        if any(folder.glob("*.ply")):
            dataset = row.dataset or str(settings.get("dataset", "sample"))
            found.append(Predicted(method_key(row), row.outfit, dataset, folder, root, scan))
    return found


def draw_pose(outfit: Outfit, split: str, name: str, folders: Sequence[Path | None]) -> list[np.ndarray]:
    """One pose by every method, and its scan, in one framing; blank where there is no prediction."""
    scan = outfit.load(split, name).scan
    camera = frame_camera(scan.points, "three_quarter", PICTURE)
    truth = render_points(PointCloud(scan.points, scan.normals), camera)
    blank = np.full_like(truth, 255)
    paths = [folder / f"{name}.ply" if folder else None for folder in folders]
    return [render_points(read_points(p), camera) if p and p.is_file() else blank for p in paths] + [truth]
