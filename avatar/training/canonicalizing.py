"""SCANimate's first learned stage as runs: a canonicalizer from its settings to its folder and back, and its scans."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from avatar.body.packed import read_template, write_template
from avatar.canonical.canonicalizer import Canonicalizer, CanonicalizerConfig, Latent
from avatar.canonical.fields import SkinningField, bounding_box
from avatar.canonical.posed import prepare_scan, to_root_frame
from avatar.canonical.rivals import KNN, NearestBody, SkinningSource
from avatar.canonical.scans import STRETCH, canonicalize_scan
from avatar.checks import AvatarError, DataError, check_name
from avatar.data.batches import FrameDataset, name_frames
from avatar.data.layouts import find_outfit
from avatar.data.outfits import Outfit
from avatar.data.scanner import SCANNERS, ScanConfig
from avatar.data.soundness import check_frame_count
from avatar.data.splits import SplitConfig, split_outfit
from avatar.data.streaming import Streamed
from avatar.environment import choose_device, prepared_process
from avatar.geometry.chunks import in_chunks
from avatar.io.canonical_scans import write_canonical_scan
from avatar.io.ledger import Ledger, digest_of, file_digest, keyed, module_digest
from avatar.io.meshes import write_mesh
from avatar.io.points import write_points
from avatar.progress import tracked
from avatar.records import CanonicalScan, Frame, Mesh, PointCloud, Template
from avatar.settings import settings_from_dict, settings_to_dict
from avatar.training.building import building
from avatar.training.checkpoints import read_weights, write_weights
from avatar.training.cycles import CycleConfig, CycleTrainer, find_code
from avatar.training.distributed import refuse_team
from avatar.training.runs import save_settings

WEIGHTS = "canonicalizer"  # canonicalizer.safetensors and canonicalizer.json in the run's folder
# What makes canonical scans of trained weights, beside this module; how these were trained shows in the weights.
SOURCE = ("avatar.canonical.scans", "avatar.canonical.rivals", "avatar.training.cycles", "avatar.data.layouts")
CHUNK = 20_000  # points asked about at once, or fewer where memory runs out
POSES = "learned_poses"
FRAMES_ROOM = 128 << 20  # bytes of whole frames kept; what is learned from them is kept by itself


class Skinning(Enum):
    """Whose skinning weights carry a scan to the canonical pose."""

    learned = "learned"
    nearest = "nearest"  # the nearest body vertex's
    knn = "knn"  # the six nearest ones'


@dataclass
class CanonicalizeConfig:
    """One outfit's scans to the canonical pose: with what, and where."""

    dataset: str = "sample"
    outfit: str = "dress"
    name: str = "default"
    data_root: Path = Path("data")
    runs_root: Path = Path("runs")
    weights: Skinning = Skinning.learned
    scan: ScanConfig = field(default_factory=lambda: replace(SCANNERS["raw_mesh"]))
    split: SplitConfig = field(default_factory=lambda: SplitConfig(validation_share=0.0))
    canonicalizer: CanonicalizerConfig = field(default_factory=CanonicalizerConfig)
    train: CycleConfig = field(default_factory=CycleConfig)
    stretch: float = STRETCH  # longest that an edge of a scan may become, as a multiple
    pictures: int = 4  # frames of each split in pictures
    scored: int = 0  # frames of each split compared with their truth, beside both rivals; simulated outfits only
    device: str = "auto"  # auto takes CUDA where there is one

    def __post_init__(self):
        for what in ("name", "dataset", "outfit"):
            check_name(what, getattr(self, what))
        if self.stretch <= 1:
            raise AvatarError(f"stretch: expected above 1, got {self.stretch}.")
        if min(self.pictures, self.scored) < 0:
            raise AvatarError(f"pictures, scored: expected at least 0, got {self.pictures} and {self.scored}.")

    @property
    def folder(self) -> Path:
        """Where the run lives: ``<runs>/canonical/<dataset>/<outfit>/<name>``."""
        return self.runs_root / "canonical" / self.dataset / self.outfit / self.name

    def find_outfit(self) -> Outfit:
        """The outfit on disk."""
        return find_outfit(self.data_root, self.dataset, self.outfit, self.scan)

    def frames(self) -> FrameDataset:
        """The frames that are canonicalized: first those of training, which are learned from, then those of test."""
        outfit = self.find_outfit()
        names = name_frames([outfit], "train", [split_outfit(outfit, self.split).train])
        if outfit.has_frames("test"):
            names += name_frames([outfit], "test", [outfit.frames("test")])
        return FrameDataset([outfit], names, points=1, cache_bytes=FRAMES_ROOM)


@dataclass(frozen=True)
class TrainedCanonicalizer:
    """A trained canonicalizer with what it was trained on; gives any frame of its outfit skinning weights.

    ``frames`` are the names of the training frames in the order of the model's codes, ``poses (frames, J, 4, 4)``
    their joint transforms in root frames; ``steps`` and ``seconds`` of training.
    """

    model: Canonicalizer
    template: Template
    config: CanonicalizeConfig
    frames: tuple[str, ...]
    poses: Tensor
    steps: int
    seconds: float

    @property
    def forward_field(self) -> SkinningField:
        """Skinning weights of canonical space: frozen, differentiable in the points."""
        return copy.deepcopy(self.model.forward_field).eval().requires_grad_(False)

    def code_of(self, frame: Frame) -> Tensor:
        """The code ``(L,)`` of a frame: the learned one, or found for its scan where it was not learned from."""
        codes = self.model.codes.detach()
        learned = frame.split == "train" and frame.outfit == self.config.outfit and frame.name in self.frames
        if learned and self.model.config.latent is Latent.auto_decoded:
            return codes[self.frames.index(frame.name)]
        scan = prepare_scan(frame, self.template, self.config.train.draw.pool)
        alike = (self.poses - scan.joint_transforms).square().sum(dim=(1, 2, 3)).argmin()
        return find_code(self.model, self.template, scan, codes[alike], self.config.train)

    def weights_of(self, points: np.ndarray, frame: Frame) -> np.ndarray:
        """Weights ``(M, J)`` of posed points ``(M, 3)`` in the frame's world, metres (see `SkinningSource`)."""
        code = self.code_of(frame)[None]
        box = bounding_box(to_root_frame(frame.body.vertices, frame.body))[None].to(code.device)
        places = to_root_frame(points, frame.body).to(code.device)
        with torch.no_grad():
            parts = in_chunks(lambda chunk: self.model.inverse(places[chunk][None], code, box)[0], len(places), CHUNK)
        return torch.cat(parts).cpu().numpy()


@prepared_process()
def train_canonicalizer(config: CanonicalizeConfig, frames: FrameDataset | None = None) -> Path:
    """Trains a run's canonicalizer, or goes on with it; gives the run's folder. Rivals have nothing to learn.

    Args:
        config: the run.
        frames: its frames, where somebody has them in memory already.

    Raises:
        AvatarError: when the folder holds a run with other settings, or training fails.
    """
    refuse_team("canonicalizer")
    frames = frames or config.frames()
    template = frames.outfits[0].template
    save_settings(config)
    write_template(config.folder / "template.npz", template)
    if config.weights is not Skinning.learned or is_trained(config):
        return config.folder
    learned = [index for index, where in enumerate(frames.names) if where.split == "train"]
    names = [frames.names[index].name for index in learned]
    check_frame_count(names, frames.outfits[0].path / "train", "the canonicalizer")
    pool = config.train.draw.pool
    scans = Streamed(
        lambda place: prepare_scan(frames.frame(learned[place]), template, pool, config.train.seed), len(learned)
    )
    torch.manual_seed(config.train.seed)
    model = Canonicalizer(template, len(scans), config.canonicalizer).to(choose_device(config.device))
    trainer = CycleTrainer(model, template, scans, names, config.train, config.folder)
    trainer.fit()
    poses = torch.stack([scan.joint_transforms for scan in scans])
    facts = {"config": settings_to_dict(config), "frames": names, "steps": trainer.step, "seconds": trainer.seconds}
    write_weights(config.folder / WEIGHTS, model.state_dict() | {POSES: poses}, facts)
    return config.folder


def is_trained(config: CanonicalizeConfig) -> bool:
    """Whether a run's canonicalizer is there, sound and trained to its end."""
    try:
        return int(read_weights(config.folder / WEIGHTS, ("steps",))[1]["steps"]) >= config.train.steps
    except DataError:
        return False


def load_canonicalizer(folder: Path, device: str = "auto") -> TrainedCanonicalizer:
    """The trained canonicalizer of a run's folder.

    Raises:
        DataError: when the folder is no finished run of learned weights, or a file in it is damaged.
    """
    if not (folder / f"{WEIGHTS}.json").is_file():
        mend = "Canonicalize the outfit first (tools/canonicalize.py) with weights=learned."
        raise DataError(folder, "no trained canonicalizer here.", mend)
    weights, facts = read_weights(folder / WEIGHTS, ("config", "frames", "steps", "seconds"))
    with building(folder, weights):
        config = settings_from_dict(CanonicalizeConfig, facts["config"], f"{folder / WEIGHTS}.json: ")
        template, poses = read_template(folder / "template.npz"), weights.pop(POSES)
        model = Canonicalizer(template, len(facts["frames"]), config.canonicalizer)
        model.load_state_dict(weights)
    model = model.to(choose_device(device)).eval().requires_grad_(False)
    return TrainedCanonicalizer(
        model, template, config, tuple(facts["frames"]), poses, facts["steps"], facts["seconds"]
    )


@prepared_process()
def canonicalize_frames(config: CanonicalizeConfig, frames: FrameDataset | None = None) -> list[Path]:
    """Writes every frame's canonical scan to ``<run>/scans/<split>/<frame>.npz``; gives the files in order.

    Training frames get a ``<frame>.ply`` beside it, for other programs. What an earlier call with the same weights
    and settings has finished is checked by hash and left as it is.
    """
    frames = frames or config.frames()
    template = frames.outfits[0].template
    source, made_by = skinning_source(config, template), scans_digest(config)
    done = Ledger(config.folder / "scans")
    written = []
    for index, where in enumerate(tracked(frames.names, "canonicalize", unit="scan")):
        path = config.folder / "scans" / where.split / f"{where.name}.npz"
        written.append(path)
        made_of = frames.outfits[where.outfit].digest(where.split, where.name)
        name, key = f"{where.split}/{where.name}", digest_of({"canonicalizer": made_by, "frame": made_of})
        if done.find(name, key):
            continue
        frame = frames.frame(index)
        weights = source.weights_of(frame.scan.points, frame)
        scan = canonicalize_scan(frame.scan, frame.body, weights, template, config.stretch)
        files = [path]
        if where.split == "train":
            files.append(path.with_suffix(".ply"))
            write_surface(files[-1], scan)
        write_canonical_scan(path, scan)
        done.record(name, key, files)
    return written


def skinning_source(config: CanonicalizeConfig, template: Template) -> SkinningSource:
    """What gives a run's scans their weights: its trained canonicalizer, or the body nearby."""
    if config.weights is Skinning.learned:
        return load_canonicalizer(config.folder, config.device)
    return NearestBody(template, KNN if config.weights is Skinning.knn else 1)


def scans_digest(config: CanonicalizeConfig) -> str:
    """One hash over all that a run's canonical scans depend on but the data: weights, scanner, cut and code."""
    plain = settings_to_dict(config)
    parts = {key: plain[key] for key in ("weights", "scan", "stretch")}
    if config.weights is Skinning.learned:
        parts["learned"] = file_digest(config.folder / f"{WEIGHTS}.safetensors")
    return keyed(SOURCE, program=module_digest(__name__), **parts)


def write_surface(path: Path, scan: CanonicalScan) -> None:
    """A canonical scan for other programs: a mesh where it is one, oriented points otherwise."""
    if scan.faces is None:
        write_points(path, PointCloud(scan.points, scan.normals))
    else:
        write_mesh(path, Mesh(scan.points, scan.faces, scan.colors))
