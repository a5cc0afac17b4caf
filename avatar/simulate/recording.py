"""Recording: settled frames checked by gates and written one by one, over processes, so that runs resume."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch
import yaml
from tqdm import tqdm

from avatar import __version__
from avatar.body.open import open_body
from avatar.checks import AvatarError, DataError
from avatar.io.frames import OpenFrame, OpenGarment, read_open_frame, write_manifest, write_open_frame, write_open_garment
from avatar.simulate.dressing import DressedBody, TravelConfig
from avatar.simulate.implicit import mesh_edges
from avatar.simulate.outfits import OutfitConfig
from avatar.simulate.poses import NamedPose
from avatar.simulate.visibility import measure_penetration, visible_faces

STRIDES = (1.0, 0.6, 0.35)  # shares of the configured stride, tried in turn until a frame passes the gates


@dataclass
class GateConfig:
    """What a frame must meet to be written."""

    share: float = 0.005  # largest share of cloth vertices inside the body
    depth: float = 0.005  # m, deepest of them
    stretch: float = 1.3  # 99th percentile of edge lengths, in rest lengths
    speed: float = 1e-3  # m a step, 99th percentile of vertex ways when the frame is taken

    def __post_init__(self):
        for name, value in vars(self).items():
            if not value > 0:
                raise AvatarError(f"{name}: expected a positive number, got {value}.")


@dataclass(frozen=True)
class FrameReport:
    """How one frame went: its file ``name``, the gates it ``failed`` (empty when written) and its numbers."""

    name: str
    failed: tuple[str, ...]
    share: float = 0.0
    depth: float = 0.0
    stretch: float = 1.0
    speed: float = 0.0
    attempts: int = 0


def edge_stretch(dressed: DressedBody, cloth: np.ndarray) -> float:
    """The 99th percentile of edge lengths in units of their rest lengths."""
    edges, _ = mesh_edges(dressed.faces)
    rest = np.concatenate([garment.vertices for garment in dressed.garments])
    lengths = [np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1) for points in (cloth, rest)]
    return float(np.percentile(lengths[0] / lengths[1], 99))


def examine(dressed: DressedBody, pose: np.ndarray, cloth: np.ndarray) -> OpenFrame:
    """A frame with its measured penetration and visibility, from a pose and the cloth resting in it."""
    body = dressed.posed_body(pose[None])[0]
    body_faces = dressed.body.faces.numpy()
    inside = measure_penetration(body, body_faces, cloth)
    seen = visible_faces(np.concatenate([body, cloth]), np.concatenate([body_faces, dressed.faces + len(body)]))
    return OpenFrame(
        pose=np.asarray(pose, np.float32),
        translation=np.zeros(3, np.float32),
        cloth=cloth.astype(np.float32),
        visible_body=seen[: len(body_faces)],
        visible_cloth=seen[len(body_faces) :],
        penetration_share=inside.share,
        penetration_depth=inside.deepest,
    )


def record_frame(dressed: DressedBody, pose: NamedPose, path: Path, gates: GateConfig) -> FrameReport:
    """Settles one pose and writes its frame if it passes the gates, travelling more slowly if it does not.

    A frame that fails at every stride is not written; the report says why.
    """
    for attempt, share in enumerate(STRIDES, 1):
        try:
            rest = dressed.settle(pose.pose, stride=share * dressed.travel.stride)
        except AvatarError as error:
            report = FrameReport(pose.name, (str(error),), attempts=attempt)
            continue
        frame = examine(dressed, pose.pose, rest.cloth)
        measured = {
            "share": frame.penetration_share,
            "depth": frame.penetration_depth,
            "stretch": edge_stretch(dressed, rest.cloth),
            "speed": rest.speed,
        }
        failed = tuple(f"{k} {v:.4g} > {getattr(gates, k):.4g}" for k, v in measured.items() if v > getattr(gates, k))
        report = FrameReport(pose.name, failed, **measured, attempts=attempt)
        if not failed:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_open_frame(path, frame)
            return report
    return report


def is_sound(path: Path, pose: np.ndarray, vertex_count: int) -> bool:
    """Whether a frame is there, readable, of this pose and this outfit."""
    try:
        frame = read_open_frame(path)
    except DataError:
        return False
    return len(frame.cloth) == vertex_count and np.array_equal(frame.pose, np.asarray(pose, np.float32))


def dress(outfit: OutfitConfig, travel: TravelConfig) -> DressedBody:
    """An open body in an outfit."""
    return DressedBody(open_body(outfit.shape), outfit, travel)


def write_outfit(dressed: DressedBody, folder: Path, gates: GateConfig) -> None:
    """Writes what all frames share: ``garment.npz`` with the cloth settled in the T-pose, and ``outfit.yaml``."""
    outfit = dressed.outfit
    canonical = dressed.settle(np.zeros_like(dressed.start_pose)).cloth
    folder.mkdir(parents=True, exist_ok=True)
    names = tuple(garment.name for garment in outfit.garments)
    write_open_garment(folder / "garment.npz", OpenGarment(dressed.faces, canonical, dressed.labels, names))
    text = {
        "name": outfit.name,
        "body": {"model": "open", "shape": outfit.shape, "canonical": "t"},
        "units": "metres",
        "up": "y",
        "licence": "CC0-1.0",
        "garments": [asdict(garment) for garment in outfit.garments],
        "travel": asdict(dressed.travel),
        "gates": asdict(gates),
        "versions": {"avatar": __version__} | {name: version(name) for name in ("newton", "warp-lang", "numpy")},
    }
    (folder / "outfit.yaml").write_text(yaml.safe_dump(text, sort_keys=False), encoding="utf-8")


_worker: dict[str, object] = {}  # what a worker process keeps between frames


def _start_worker(outfit: OutfitConfig, travel: TravelConfig, gates: GateConfig) -> None:
    """Dresses the body once in a worker process, on one thread."""
    torch.set_num_threads(1)
    _worker["dressed"], _worker["gates"] = dress(outfit, travel), gates


def _record_in_worker(pose: NamedPose, path: Path) -> FrameReport:
    """One frame in a worker process."""
    return record_frame(_worker["dressed"], pose, path, _worker["gates"])


def simulate_outfit(
    outfit: OutfitConfig,
    root: Path,
    poses: dict[str, Sequence[NamedPose]],
    workers: int = 1,
    travel: TravelConfig | None = None,
    gates: GateConfig | None = None,
    progress: bool = True,
) -> list[FrameReport]:
    """Simulates and writes an outfit's frames; those already there and sound are kept, so that a run resumes.

    Args:
        outfit: what is worn, by which body.
        root: dataset folder; frames go to ``<root>/<outfit>/<split>/<sequence>.<frame>.npz``.
        poses: poses of each split.
        workers: processes; 1 works in this one.
        travel, gates: settings; defaults if None.
        progress: whether to show a progress bar.

    Returns:
        A report of every frame made in this run; those with ``failed`` were not written.
    """
    travel, gates = travel or TravelConfig(), gates or GateConfig()
    folder = Path(root) / outfit.name
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    dressed = dress(outfit, travel)
    if not (folder / "garment.npz").is_file() or not (folder / "outfit.yaml").is_file():
        write_outfit(dressed, folder, gates)
    count = len(dressed.faces), len(dressed.labels)
    jobs = [(pose, folder / split / f"{pose.name}.npz") for split, named in poses.items() for pose in named]
    jobs = [(pose, path) for pose, path in jobs if not is_sound(path, pose.pose, count[1])]
    bar = tqdm(total=len(jobs), desc=f"{outfit.name} on {outfit.shape}", unit="frame", disable=not progress)
    reports = []
    if workers == 1 or len(jobs) < 2:
        for pose, path in jobs:
            reports.append(record_frame(dressed, pose, path, gates))
            bar.update()
    else:
        with ProcessPoolExecutor(
            workers, get_context("spawn"), _start_worker, (outfit, travel, gates)
        ) as pool:
            for future in as_completed([pool.submit(_record_in_worker, *job) for job in jobs]):
                reports.append(future.result())
                bar.update()
    bar.close()
    torch.set_num_threads(threads)
    write_manifest(folder)
    return reports
