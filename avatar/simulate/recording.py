"""Recording the open dataset: what is asked for, and its frames, one independent run each, resumable."""

from __future__ import annotations

import itertools
import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from avatar import __version__
from avatar.body.open import open_body_shapes
from avatar.body.packed import write_body
from avatar.checks import AvatarError, DataError, check_range, unknown_name
from avatar.environment import prepared_process
from avatar.io.frames import OpenGarment, read_open_frame, read_open_garment, write_manifest, write_open_garment
from avatar.io.ledger import Ledger, digest_of, file_digest
from avatar.io.motions import read_motion
from avatar.io.stance import check_up
from avatar.processes import in_workers
from avatar.progress import tracked
from avatar.records import Motion
from avatar.settings import FileName
from avatar.simulate.angles import EVERYDAY, SEQUENCES, authored_motion, check_timing
from avatar.simulate.dressing import DressedBody, TravelConfig, pose_path
from avatar.simulate.gates import (
    FrameReport,
    GateConfig,
    frames_of,
    history_error,
    pose_sensitivity,
    record_frame,
    record_motion,
)
from avatar.simulate.outfits import DEFAULT_SHAPES, OUTFIT_NAMES, OutfitConfig, outfit
from avatar.simulate.poses import KINDS, NamedPose, draw_poses, everyday_poses, split_distances

log = logging.getLogger(__name__)
Job = NamedPose | Motion  # a pose to settle in, or a sequence to play


# How much is simulated: settled frames a split, or continuous sequences a split instead
PRESETS: dict[str, dict[str, Any]] = {
    "quick": {"outfits": ("tee",), "train": 32, "test": 12, "interpolation": 8},
    "sample": {"outfits": ("tee", "dress"), "train": 60, "test": 20, "interpolation": 10},
    "full": {"outfits": OUTFIT_NAMES, "train": 300, "test": 100, "interpolation": 50},
    "motion": {"outfits": ("tee", "dress"), "train_motions": tuple(EVERYDAY), "test_motions": tuple(SEQUENCES)},
}


@dataclass
class SimulateConfig:
    """What to simulate. Anything left at None or empty is as the preset has it."""

    preset: str = "quick"  # quick, sample, full, motion
    root: Path = Path("data/open")  # of <outfit>, <outfit>_<shape> on other bodies, <outfit>_motion of sequences
    outfits: list[str] = field(default_factory=list)  # tee, dress, shirt, skirt, jacket, coat, slacks, hoodie
    shapes: list[FileName] = field(default_factory=list)  # who wears them: female, male, files of tools/make_body.py
    edge: float | None = None  # m, target edge length of all garments; each garment's own if null
    train: int | None = None  # settled frames, half of everyday and half of random poses
    test: int | None = None  # settled frames of authored sequences
    interpolation: int | None = None  # settled frames of unseen random poses, a test split of its own
    train_motions: list[FileName] = field(default_factory=list)  # everyday families, authored sequences, files
    test_motions: list[FileName] = field(default_factory=list)  # the same for the test split
    up: str | None = None  # y, z, -y or -z, the axis of motion files that points up, or auto; their format's if null
    joints: Path | None = None  # YAML of SMPL's joint names to those of BVH skeletons with other names
    settled: bool = False  # record motion files as settled poses, spread over them, not as continuous sequences
    fps: float = 30.0  # frames per second of continuous sequences
    seconds: float = 3.0  # longest part taken of a sequence
    seed: int = 0
    workers: int = 0  # processes; 0 is one a core
    history: int = 0  # poses on which history error and pose sensitivity are measured instead of recording
    distances: bool = False  # measure how far the poses of the splits are apart instead of recording
    progress: bool = True
    travel: TravelConfig = field(default_factory=TravelConfig)
    gates: GateConfig = field(default_factory=GateConfig)

    def __post_init__(self):
        files = [shape for shape in self.shapes if shape.endswith(".npz")]
        for name, given, known in (
            ("preset", [self.preset], PRESETS),
            ("outfits", self.outfits, OUTFIT_NAMES),
            ("shapes", [shape for shape in self.shapes if shape not in files], open_body_shapes()),
        ):
            for value in given:
                if value not in known:
                    raise unknown_name(name, value, known)
        for shape in files:
            if not Path(shape).is_file():
                raise AvatarError(f"shapes: {shape}: expected a file of tools/make_body.py, there is none.")
        for name in (*KINDS, "workers", "history"):
            if (getattr(self, name) or 0) < 0:
                raise AvatarError(f"{name}: expected a number of at least 0, got {getattr(self, name)}.")
        check_range(self, "seconds", above=0)
        check_up(self.up)
        check_timing(self.fps, self.seconds)


def asked(config: SimulateConfig, name: str) -> Any:
    """A setting, or the preset's where it is left at None or empty; an empty one where the preset has none."""
    value = getattr(config, name)
    return PRESETS[config.preset].get(name, ()) if value in (None, []) else value


def is_continuous(config: SimulateConfig) -> bool:
    """Whether sequences are played, not poses settled."""
    sources = asked(config, "train_motions") or asked(config, "test_motions")
    return bool(sources) and not config.settled and not config.history


def dressed_outfits(config: SimulateConfig) -> list[tuple[str, OutfitConfig]]:
    """Folder names and outfits on bodies that a configuration asks for."""
    found, ending = [], "_motion" if is_continuous(config) else ""
    for name in asked(config, "outfits"):
        for shape in config.shapes or [DEFAULT_SHAPES[name]]:
            other = "" if shape == DEFAULT_SHAPES[name] else f"_{Path(shape).stem}"
            found.append((f"{name}{other}{ending}", outfit(name, shape, config.edge)))
    return found


def load_motion(
    source: str, fps: float, seconds: float, seed: int = 0, up: str | None = None, joints: Path | None = None
) -> Motion:
    """An authored or everyday sequence by name, or a motion file without its translation (the pelvis stays in place).

    An everyday sequence passes one drawn pose of its family a second. ``up`` and ``joints`` as in `read_motion`.
    """
    check_timing(fps, seconds)
    if source in SEQUENCES:
        return authored_motion(source, fps, seconds)
    if source in EVERYDAY:
        stops = everyday_poses(source, int(np.ceil(seconds)) + 1, seed)
        legs = [pose_path(a, b, round(fps)) for a, b in itertools.pairwise(stops)]
        motion = Motion(np.concatenate([stops[0][None], *legs]), np.zeros(0), fps, source)
    elif Path(source).suffix in (".npz", ".bvh"):
        # translations are not used, so their unit does not matter
        given = {"joints": joints} if Path(source).suffix == ".bvh" else {"units": "m"}
        motion = read_motion(Path(source), fps, up, **given)
    else:
        known = ", ".join((*SEQUENCES, *EVERYDAY))
        raise AvatarError(f"motion: expected {known} or a .npz or .bvh file, got {source!r}.")
    poses = motion.poses[: round(fps * seconds)]
    return Motion(poses, np.zeros((len(poses), 3), np.float32), fps, motion.name)


def load_motions(config: SimulateConfig, sources: Sequence[str]) -> list[Motion]:
    """Motions as long and as fine as configured."""
    return [
        load_motion(source, config.fps, config.seconds, config.seed, config.up, config.joints) for source in sources
    ]


def spread_poses(motions: list[Motion], count: int) -> list[NamedPose]:
    """Poses at even distances over motions, ``count`` in all."""
    frames = [frame for motion in motions for frame in frames_of(motion)]
    return [frames[i] for i in np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)]


def settled_poses(config: SimulateConfig) -> dict[str, list[NamedPose]]:
    """The poses of each split: drawn (see `draw_poses`), or frames of the given motion files."""
    poses = {}
    for split in KINDS:
        motions = load_motions(config, getattr(config, f"{split}_motions", ()))
        if count := asked(config, split):
            poses[split] = spread_poses(motions, count) if motions else draw_poses(count, config.seed, split)
    return poses


@prepared_process()
def simulate(config: SimulateConfig) -> list[FrameReport]:
    """Makes an open dataset, or measures its history error, as configured.

    Returns:
        Reports of the frames made in this run; those refused by the gates say why and are logged as warnings.
    """
    if config.distances:
        for line in split_distances(settled_poses(config)):
            log.info("%s", line)
        return []
    if config.history:
        poses = draw_poses(config.history + 1, config.seed, "test")
        for folder, clothes in dressed_outfits(config):
            dressed = DressedBody(clothes, config.travel)
            log.info("%s: %s", folder, history_error(dressed, poses))
            log.info("%s: %s", folder, pose_sensitivity(dressed, poses[:-1], seed=config.seed))
        return []
    if is_continuous(config):
        work = {split: load_motions(config, asked(config, f"{split}_motions")) for split in ("train", "test")}
    else:
        work = settled_poses(config)
    found = (simulate_outfit(clothes, config.root / name, work, config) for name, clothes in dressed_outfits(config))
    reports = list(itertools.chain.from_iterable(found))
    for report in reports:
        if report.failed:
            why = "; ".join(report.failed)
            log.warning("%s: gates missed after %d attempts: %s", report.name, report.attempts, why)
    return reports


def simulate_outfit(
    outfit: OutfitConfig, folder: Path, work: dict[str, Sequence[Job]], config: SimulateConfig
) -> list[FrameReport]:
    """Simulates and writes an outfit's frames; those finished are kept, so that a run resumes.

    Every pose of a split's ``work`` is settled by itself; every frame of a motion follows from the one before. Frames
    go to ``<folder>/<split>/<sequence>.<frame>.npz``. Sequences resume as a whole, and their frames are written where
    they miss a gate too, since a gap would break the sequence. Gives a report of every frame made in this run.
    """
    workers = config.workers or len(os.sched_getaffinity(0))
    with one_thread():
        dressed = DressedBody(outfit, config.travel)
        write_outfit(dressed, folder, config.gates)
        done = FrameLedger(folder, len(dressed.labels))

        def frames(job: Job, place: Path) -> list[tuple[Path, np.ndarray, int]]:
            named = frames_of(job) if isinstance(job, Motion) else [job]
            return [(place / f"{frame.name}.npz", frame.pose, history) for history, frame in enumerate(named)]

        jobs = [(job, folder / split) for split, jobs in work.items() for job in jobs]
        jobs = [job for job in jobs if not all(done.has(*frame) for frame in frames(*job))]
        what = f"simulate {outfit.name} on {outfit.shape}, {len(dressed.labels):,} cloth vertices"
        if workers == 1 or len(jobs) < 2:
            made = ((job, record(dressed, config.gates, *job)) for job in jobs)
        else:
            made = in_workers(_record_in_worker, jobs, workers, _start_worker, (outfit, config.travel, config.gates))
        reports = []
        with closing(made):
            for job, found in tracked(made, what, total=len(jobs), silent=not config.progress):
                reports += found
                for frame in frames(*job):
                    done.note(*frame)
    write_manifest(folder)
    return reports


@contextmanager
def one_thread() -> Iterator[None]:
    """Torch on one thread: a process a core is faster, and its sums are the same on every machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def record(dressed: DressedBody, gates: GateConfig, job: Job, folder: Path) -> list[FrameReport]:
    """Writes a settled frame, or all frames of a sequence, into a split's folder."""
    if isinstance(job, Motion):
        return record_motion(dressed, job, folder, gates)
    return [record_frame(dressed, job, folder / f"{job.name}.npz", gates)]


_worker: list[Any] = []  # what a worker process keeps between frames: a dressed body and gates


def _start_worker(outfit: OutfitConfig, travel: TravelConfig, gates: GateConfig) -> None:
    """Dresses the body once in a worker process, on one thread."""
    torch.set_num_threads(1)
    _worker[:] = DressedBody(outfit, travel), gates


def _record_in_worker(job: Job, folder: Path) -> list[FrameReport]:
    """One frame or sequence in a worker process."""
    return record(*_worker, job, folder)


class FrameLedger:
    """Finished frames of an outfit's folder: by hash, and by the pose, garment and history they are made from.

    A valid frame that no ledger lists, as an interrupted run leaves it, is taken over.
    """

    def __init__(self, folder: Path, vertices: int):
        self.folder, self.vertices = folder, vertices
        self.ledger, self.garment = Ledger(folder), file_digest(folder / "garment.npz")

    def has(self, path: Path, pose: np.ndarray, history: int = 0) -> bool:
        """Whether a frame is there as it was written."""
        name, key = self._identify(path, pose, history)
        if name in self.ledger.entries or not is_valid(path, pose, self.vertices, history):
            return self.ledger.find(name, key) is not None
        self.ledger.record(name, key, [path])
        return True

    def note(self, path: Path, pose: np.ndarray, history: int = 0) -> None:
        """Records a frame that was made, if it passed its gates and was written."""
        if path.is_file():
            self.ledger.record(*self._identify(path, pose, history), [path])

    def _identify(self, path: Path, pose: np.ndarray, history: int) -> tuple[str, str]:
        """A frame's name and key."""
        made_of = {"pose": np.asarray(pose, np.float32).tolist(), "garment": self.garment}
        made_of |= {"history": history} if history else {}
        return path.relative_to(self.folder).as_posix(), digest_of(made_of)


def is_valid(path: Path, pose: np.ndarray, vertex_count: int, history: int = 0) -> bool:
    """Whether a frame is there, readable, of this pose, this outfit and this history."""
    try:
        frame = read_open_frame(path)
    except DataError:
        return False
    same = np.array_equal(frame.pose, np.asarray(pose, np.float32)) and frame.history == history
    return same and len(frame.cloth) == vertex_count


def write_outfit(dressed: DressedBody, folder: Path, gates: GateConfig) -> None:
    """Writes what all frames share: ``garment.npz`` with the cloth settled in the T-pose, and ``outfit.yaml``.

    Raises `DataError` when the folder holds frames of a garment other than the one that would be written.
    """
    outfit, names = dressed.outfit, ("newton", "warp-lang", "numpy")
    if (folder / "garment.npz").is_file():
        if not np.array_equal(read_open_garment(folder / "garment.npz").faces, dressed.faces):
            hint = "Choose another root or remove it."
            raise DataError(folder, "it holds frames of the same outfit cut otherwise.", hint)
        if (folder / "outfit.yaml").is_file():
            return
    canonical = dressed.settle(np.zeros_like(dressed.start_pose)).cloth
    folder.mkdir(parents=True, exist_ok=True)
    body = {"model": "open", "shape": outfit.shape, "canonical": "t"}
    if outfit.shape.endswith(".npz"):
        body = {"model": "packed", "canonical": "t"}
        write_body(folder / "body.npz", dressed.body)
    layers = tuple(garment.name for garment in outfit.garments)
    write_open_garment(folder / "garment.npz", OpenGarment(dressed.faces, canonical, dressed.labels, layers))
    text = {
        "name": outfit.name,
        "body": body,
        "units": "metres",
        "up": "y",
        "licence": "CC0-1.0",
        "garments": [asdict(garment) for garment in outfit.garments],
        "travel": asdict(dressed.travel),
        "gates": asdict(gates),
        "versions": {"avatar": __version__} | {name: version(name) for name in names},
    }
    (folder / "outfit.yaml").write_text(yaml.safe_dump(text, sort_keys=False), encoding="utf-8")
