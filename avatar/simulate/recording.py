"""Recording the open dataset: presets, poses from draws, sequences or motion files, and the history error."""

from __future__ import annotations

import itertools
import logging
import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from avatar.body.open import open_body_shapes
from avatar.checks import AvatarError, unknown_name
from avatar.environment import prepared_process
from avatar.io.motions import read_motion, resample_motion
from avatar.records import Motion
from avatar.simulate.angles import EVERYDAY, SEQUENCES, authored_motion
from avatar.simulate.dressing import TravelConfig, pose_path
from avatar.simulate.gates import FrameReport, GateConfig
from avatar.simulate.memory import history_error, pose_sensitivity
from avatar.simulate.outfits import DEFAULT_SHAPES, OUTFIT_NAMES, OutfitConfig, outfit
from avatar.simulate.poses import KINDS, NamedPose, draw_poses, everyday_poses, split_distances
from avatar.simulate.production import dress, simulate_outfit
from avatar.values import FileName

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Preset:
    """How much is simulated: ``outfits``, settled frames a split, or continuous sequences a split instead."""

    outfits: tuple[str, ...]
    train: int = 0
    test: int = 0
    interpolation: int = 0
    train_motions: tuple[str, ...] = ()
    test_motions: tuple[str, ...] = ()


PRESETS = {
    "quick": Preset(("tee",), 32, 12, 8),
    "sample": Preset(("tee", "dress"), 60, 20, 10),
    "full": Preset(OUTFIT_NAMES, 300, 100, 50),
    "motion": Preset(("tee", "dress"), train_motions=tuple(EVERYDAY), test_motions=tuple(SEQUENCES)),
}


@dataclass
class SimulateConfig:
    """What to simulate. Anything left at None or empty is as the preset has it."""

    preset: str = "quick"  # quick, sample, full, motion
    root: Path = Path(
        "data/open"
    )  # of folders <outfit>, <outfit>_<shape> on other bodies, <outfit>_motion of sequences
    outfits: list[str] = field(default_factory=list)  # tee, dress, shirt, skirt, jacket, coat, slacks, hoodie
    shapes: list[FileName] = field(default_factory=list)  # who wears them: female, male, files of tools/make_body.py
    edge: float | None = None  # m, target edge length of all garments; each garment's own if null
    train: int | None = None  # settled frames, half of everyday and half of random poses
    test: int | None = None  # settled frames of authored sequences
    interpolation: int | None = None  # settled frames of unseen random poses, a test split of its own
    train_motions: list[FileName] = field(default_factory=list)  # everyday families, authored sequences, files
    test_motions: list[FileName] = field(default_factory=list)  # the same for the test split
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
        check_names("preset", [self.preset], tuple(PRESETS))
        check_names("outfits", self.outfits, OUTFIT_NAMES)
        check_names("shapes", [s for s in self.shapes if not s.endswith(".npz")], open_body_shapes())
        for shape in self.shapes:
            if shape.endswith(".npz") and not Path(shape).is_file():
                raise AvatarError(f"shapes: {shape}: expected a file of tools/make_body.py, there is none.")
        for name in (*KINDS, "workers", "history"):
            if (getattr(self, name) or 0) < 0:
                raise AvatarError(f"{name}: expected a number of at least 0, got {getattr(self, name)}.")
        for name in ("fps", "seconds"):
            if not getattr(self, name) > 0:
                raise AvatarError(f"{name}: expected a positive number, got {getattr(self, name)}.")


def check_names(name: str, given: list[str], known: tuple[str, ...]) -> None:
    """Refuses names that are not known, listing those that are."""
    for value in given:
        if value not in known:
            raise unknown_name(name, value, known)


def dressed_outfits(config: SimulateConfig) -> list[tuple[str, OutfitConfig]]:
    """Folder names and outfits on bodies that a configuration asks for."""
    asked = []
    for name in config.outfits or PRESETS[config.preset].outfits:
        usual = DEFAULT_SHAPES[name]
        for shape in config.shapes or [usual]:
            folder = name if shape == usual else f"{name}_{Path(shape).stem}"
            folder += "_motion" if is_continuous(config) else ""
            asked.append((folder, outfit(name, shape, config.edge)))
    return asked


def is_continuous(config: SimulateConfig) -> bool:
    """Whether sequences are played, not poses settled."""
    preset = PRESETS[config.preset]
    sources = config.train_motions or config.test_motions or preset.train_motions or preset.test_motions
    return bool(sources) and not config.settled and not config.history


def load_motion(source: str, fps: float, seconds: float, seed: int = 0) -> Motion:
    """An authored or everyday sequence by name, or a motion file without its translation (the pelvis stays in place).

    An everyday sequence passes one drawn pose of its family a second.
    """
    if source in SEQUENCES:
        return authored_motion(source, fps, seconds)
    if source in EVERYDAY:
        stops = everyday_poses(source, int(np.ceil(seconds)) + 1, seed)
        legs = [pose_path(a, b, round(fps)) for a, b in itertools.pairwise(stops)]
        poses = np.concatenate([stops[0][None], *legs])[: round(fps * seconds)]
        return Motion(poses, np.zeros((len(poses), 3), np.float32), fps, source)
    if Path(source).suffix not in (".npz", ".bvh"):
        known = ", ".join((*SEQUENCES, *EVERYDAY))
        raise AvatarError(f"motion: expected {known} or a .npz or .bvh file, got {source!r}.")
    motion = resample_motion(read_motion(Path(source)), fps)
    count = round(fps * seconds)
    return Motion(motion.poses[:count], np.zeros_like(motion.translations[:count]), fps, motion.name)


def spread_poses(motions: list[Motion], count: int) -> list[NamedPose]:
    """Poses at even distances over motions, ``count`` in all."""
    frames = [(motion, frame) for motion in motions for frame in range(len(motion.poses))]
    chosen = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
    picked = [frames[i] for i in chosen]
    return [NamedPose(f"{motion.name}.{frame:05d}", motion.poses[frame]) for motion, frame in picked]


def settled_poses(config: SimulateConfig) -> dict[str, list[NamedPose]]:
    """The poses of each split: drawn (see `draw_poses`), or frames of the given motion files."""
    preset, poses = PRESETS[config.preset], {}
    for split in KINDS:
        count = getattr(config, split)
        count = getattr(preset, split) if count is None else count
        sources = getattr(config, f"{split}_motions", ())
        motions = [load_motion(source, config.fps, config.seconds, config.seed) for source in sources]
        if count:
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
    workers = config.workers or len(os.sched_getaffinity(0))
    preset = PRESETS[config.preset]
    sources = {
        split: getattr(config, f"{split}_motions") or list(getattr(preset, f"{split}_motions"))
        for split in ("train", "test")
    }
    if is_continuous(config):
        work = {k: [load_motion(s, config.fps, config.seconds, config.seed) for s in v] for k, v in sources.items()}
    elif not config.history:
        work = settled_poses(config)
    reports: list[FrameReport] = []
    for folder, clothes in dressed_outfits(config):
        if config.history:
            dressed = dress(clothes, config.travel)
            measured = draw_poses(config.history + 1, config.seed, "test")
            log.info("%s: %s", folder, history_error(dressed, measured))
            log.info("%s: %s", folder, pose_sensitivity(dressed, measured[:-1], seed=config.seed))
        else:
            place = config.root / folder
            reports += simulate_outfit(clothes, place, work, workers, config.travel, config.gates, config.progress)
    for report in reports:
        if report.failed:
            log.warning(
                "%s: gates missed after %d attempts: %s", report.name, report.attempts, "; ".join(report.failed)
            )
    return reports
