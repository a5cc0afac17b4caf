"""Errors of fitted bodies: scans of the open data whose bodies are withheld, in the direction they have or turned."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from avatar.body.families import anny_family
from avatar.body.model import BodyModel
from avatar.checks import SAFE_NAME, AvatarError, check_range, unknown_name
from avatar.data.folders import SPLITS
from avatar.data.layouts import find_outfit
from avatar.data.outfits import Outfit
from avatar.data.scanner import SCANNERS, frame_seed
from avatar.environment import prepared_process
from avatar.evaluation.scores import FrameScore, Score, Scores, read_scores, write_scores
from avatar.export.pictures import save_picture
from avatar.fitting.quality import picture_fit, write_quality
from avatar.fitting.settings import FittingConfig
from avatar.fitting.subjects import SubjectFit, fit_subject
from avatar.io.npz import write_whole
from avatar.pipeline.scores import current_commit
from avatar.records import Mesh, PointCloud

UNITS = {"vertex_median": "mm", "vertex_p95": "mm", "joint_median": "mm", "joint_max": "mm"}
CLOCKS = {"seconds": "s", "processor_seconds": "s"}  # a scan, of wall time and of one core's
UNITS |= {"failed": "1", **CLOCKS}
PLACES = 0.5  # m, standard deviation of where turned scans stand
report = logging.getLogger(__name__)


@dataclass
class FitBodiesConfig:
    """Outfits and frames that bodies are fitted to."""

    data: Path = Path("data")  # root of data sets
    dataset: str = "sample"  # data set of the outfits
    outfits: list[str] = field(default_factory=lambda: ["tee", "dress"])  # outfits of the open layout
    split: str = "test"  # split of their frames
    frames: int = 8  # of each outfit, spread over the split
    scanner: str = "raw"  # perfect, raw or raw_mesh
    turned: bool = True  # each scan turned about the vertical and moved, at random
    pictures: bool = False  # also a picture of each frame
    seed: int = 0  # of headings and places
    fitting: FittingConfig = field(default_factory=FittingConfig)
    out: Path = Path("runs/tables")  # where the table's files go, and a folder of quality reports
    table: str = "fitting"  # the name of the table's files

    def __post_init__(self):
        for name, value, known in (("scanner", self.scanner, SCANNERS), ("split", self.split, SPLITS)):
            if value not in known:
                raise unknown_name(name, value, known)
        if not self.outfits:
            raise AvatarError("outfits: expected at least one, got none.")
        check_range(self, "frames", low=1)
        if not SAFE_NAME.fullmatch(self.table):
            raise AvatarError(f"table: expected a plain name, got {self.table!r}.")


@dataclass(frozen=True)
class HiddenBody:
    """A scan and the body that is withheld from its fit: vertices ``(V, 3)`` and joints ``(J, 3)``, metres."""

    cloud: PointCloud
    vertices: np.ndarray
    joints: np.ndarray


@prepared_process()
def fit_bodies(config: FitBodiesConfig) -> Path:
    """Fits anny's bodies to scans of each outfit, one shape an outfit, and measures them against the true ones.

    Writes ``<out>/<table>.csv``, ``.frames.csv`` and ``.md``, in which other outfits and variants keep their rows, and
    ``<out>/<table>/<data set>_<outfit>_<variant>/``: a quality report and, if asked for, pictures. Gives the Markdown.
    """
    path = config.out / f"{config.table}.csv"
    for name in config.outfits:
        outfit = find_outfit(config.data, config.dataset, name, SCANNERS[config.scanner])
        scores = keep_others(path, fit_outfit(outfit, config))
        write_scores(path, scores)  # after each outfit, so that an interrupted run keeps those finished
        text = to_markdown(scores.rows)
        write_whole(path.with_suffix(".md"), text.encode())
    print(f"{text}\nwritten: {config.out / config.table}.*")
    return path.with_suffix(".md")


def fit_outfit(outfit: Outfit, config: FitBodiesConfig) -> Scores:
    """Scores of one outfit's frames, and its report."""
    names = outfit.frames(config.split)
    names = [names[i] for i in np.unique(np.linspace(0, len(names) - 1, config.frames).astype(int))]
    hidden = [hide_body(outfit, name, config) for name in names]
    variant = f"{config.scanner}_{'turned' if config.turned else 'as_scanned'}"
    report.info("fit_bodies: %s, %s", outfit.name, variant)
    clock, work = time.monotonic(), time.process_time()
    found = fit_subject([body.cloud for body in hidden], anny_family(), config.fitting, names)
    seconds, processor = time.monotonic() - clock, time.process_time() - work
    write_report(config.out / config.table / f"{outfit.dataset}_{outfit.name}_{variant}", hidden, found, config)
    frames = []
    for body, fit in zip(hidden, found.frames):
        errors = body_errors(found.body, fit.pose, fit.translation, body) | {"failed": float(bool(fit.failed))}
        who = (outfit.name, "anny", variant, config.seed, fit.name)
        frames += [FrameScore(*who, metric, value, config.split) for metric, value in errors.items()]
    values = {metric: float(np.mean([f.value for f in frames if f.metric == metric])) for metric in errors}
    values |= {"seconds": seconds / len(names), "processor_seconds": processor / len(names)}
    points = round(np.mean([len(body.cloud.points) for body in hidden]))
    rows = [
        Score(
            *(config.table, outfit.name, "anny", variant, metric, value, UNITS[metric], len(names), config.seed),
            *(0, seconds, points, current_commit(), outfit.dataset),
            split=config.split,
        )
        for metric, value in values.items()
    ]
    return Scores(rows, frames)


def hide_body(outfit: Outfit, name: str, config: FitBodiesConfig) -> HiddenBody:
    """A frame's scan with its body, both turned and moved alike where so configured."""
    frame, body = outfit.load(config.split, name), outfit.posable_body()
    joints = posed_joints(body, frame.body.pose, frame.body.translation)
    rng = np.random.default_rng(frame_seed(config.seed, f"{outfit.name}/{name}/heading"))
    turn = Rotation.from_euler("y", rng.uniform(0, 360) if config.turned else 0, degrees=True)
    shift = rng.normal(scale=PLACES if config.turned else 0, size=3)
    cloud = PointCloud(
        (turn.apply(frame.scan.points) + shift).astype(np.float32), turn.apply(frame.scan.normals).astype(np.float32)
    )
    return HiddenBody(cloud, turn.apply(frame.body.vertices) + shift, turn.apply(joints) + shift)


@torch.no_grad()
def posed_joints(body: BodyModel, pose: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Joints ``(J, 3)`` of a body in a pose, metres."""
    posed = body(torch.from_numpy(pose)[None], torch.from_numpy(translation)[None])
    ones = torch.ones(len(body.parents), 1)
    return (posed.joint_transforms[0] @ torch.cat([body.canonical_joints, ones], dim=1).unsqueeze(-1))[:, :3, 0].numpy()


@torch.no_grad()
def body_errors(body: BodyModel, pose: np.ndarray, translation: np.ndarray, truth: HiddenBody) -> dict[str, float]:
    """Distances of a fitted body's vertices and joints from the true ones, which are its own topology's, mm."""
    vertices = body(torch.from_numpy(pose)[None], torch.from_numpy(translation)[None]).vertices[0].numpy()
    off = 1000 * np.linalg.norm(vertices - truth.vertices, axis=1)
    joints = 1000 * np.linalg.norm(posed_joints(body, pose, translation) - truth.joints, axis=1)
    return {
        "vertex_median": float(np.median(off)),
        "vertex_p95": float(np.percentile(off, 95)),
        "joint_median": float(np.median(joints)),
        "joint_max": float(joints.max()),
    }


@torch.no_grad()
def write_report(folder: Path, hidden: list[HiddenBody], found: SubjectFit, config: FitBodiesConfig) -> None:
    """The quality report that a user of the fit sees, and pictures."""
    names, qualities = [fit.name for fit in found.frames], [fit.quality for fit in found.frames]
    write_quality(folder / "quality.csv", names, qualities, [fit.failed for fit in found.frames])
    if config.pictures:
        for body, fit in zip(hidden, found.frames):
            posed = found.body(torch.from_numpy(fit.pose)[None], torch.from_numpy(fit.translation)[None])
            mesh = Mesh(posed.vertices[0].numpy(), found.body.faces.numpy())
            save_picture(folder / f"{fit.name}.png", picture_fit(body.cloud, mesh, fit.heading))


def keep_others(path: Path, new: Scores) -> Scores:
    """New scores and those of other outfits and variants in an existing table."""
    old = read_scores(path) if path.is_file() else Scores()
    mine = {(row.outfit, row.variant) for row in new.rows}
    kept, frames = ([one for one in ones if (one.outfit, one.variant) not in mine] for ones in (old.rows, old.frames))
    return Scores(sorted(kept + new.rows, key=lambda r: (r.dataset, r.outfit, r.variant)), frames + new.frames)


def to_markdown(rows: list[Score]) -> str:
    """A Markdown table: a row for each outfit and variant, a column for each metric."""
    found: dict[tuple[str, ...], dict[str, Score]] = {}
    for row in rows:
        found.setdefault((row.dataset, row.outfit, row.variant), {})[row.metric] = row
    lines = [
        f"| data set | outfit | scans | frames | {' | '.join(f'{name} ({unit})' for name, unit in UNITS.items())} |"
    ]
    lines += ["|---|---|---|---:|" + "---:|" * len(UNITS)]
    for who, metrics in found.items():
        cells = [f"{metrics[name].value:.3g}" for name in UNITS]
        lines.append(f"| {' | '.join([*who, str(metrics['seconds'].frames), *cells])} |")
    return "\n".join(lines) + "\n"
