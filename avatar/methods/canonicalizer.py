"""SCANimate's canonicalizer: skinning fields learned from posed scans, first apart, then together through the cycle."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from avatar.body.packed import read_template
from avatar.canonical.canonicalizer import TERMS, Canonicalizer, CanonicalizerConfig, CanonicalLossConfig, cycle_loss
from avatar.canonical.fields import BodyField, SkinningField, bounding_box
from avatar.canonical.scans import STRETCH, DrawConfig, PosedScan, ScanBatch, draw_batch, prepare_scan, to_root_frame
from avatar.checks import DataError, check_name, check_range
from avatar.data.batches import FrameDataset, name_frames
from avatar.data.layouts import CanonicalOutfit, find_outfit
from avatar.data.outfits import Outfit
from avatar.data.scanner import SCANNERS, ScanConfig
from avatar.data.splits import SplitConfig, split_outfit
from avatar.environment import choose_device
from avatar.geometry.chunks import in_chunks
from avatar.invocation import command_line, option
from avatar.io.checkpoints import building, read_weights
from avatar.io.documents import read_yaml
from avatar.methods.base import SEED_STRIDE, Inputs, Position, Stage, Task
from avatar.methods.settings import CANONICALIZERS, Clock
from avatar.records import Frame, LossTerms, Template, map_tensors
from avatar.settings import settings_from_dict

WEIGHTS = "canonicalizer"  # canonicalizer.safetensors and canonicalizer.json in the run's folder
CHUNK = 20_000  # points queried at once, or fewer where memory runs out
POSES = "learned_poses"
FRAMES_BYTES = 128 << 20  # bytes of whole frames kept; what is learned from them is kept by itself
SAME_BODY = 1e-3  # metres between the vertices of a canonicalizer's body and an outfit's, at most


@dataclass
class CycleConfig:
    """Budget and optimiser of both stages; the defaults are the paper's for 500 scans (80 and 200 epochs)."""

    first_steps: int = 10_000  # optimiser steps with the fields apart
    second_steps: int = 25_000  # and together
    minutes: float | None = None  # budget of time; training ends at whichever comes first, stages keep their shares
    clock: Clock = Clock.wall  # that minutes are read from
    batch: int = 4  # frames a step
    first_lr: float = 0.004
    second_lr: float = 0.001
    decay: float = 0.1  # factor on both at half, and again at three quarters, of each stage
    clip: float | None = None  # largest gradient norm
    code_steps: int = 200  # to find the code of a frame that was not learned from
    code_lr: float = 0.02
    draw: DrawConfig = field(default_factory=DrawConfig)
    loss: CanonicalLossConfig = field(default_factory=CanonicalLossConfig)
    save_every: int = 500  # steps
    log_every: int = 20  # steps
    seed: int = 0

    def __post_init__(self):
        check_range(self, "first_steps", "batch", "code_steps", "save_every", "log_every", low=1)
        check_range(self, "second_steps", low=0)
        check_range(self, "minutes", "first_lr", "second_lr", "clip", "code_lr", above=0)
        check_range(self, "decay", above=0, high=1)

    @property
    def validate_every(self) -> int:
        """Never: no frames are held back."""
        return self.steps + 1

    @property
    def steps(self) -> int:
        """Both stages' steps."""
        return self.first_steps + self.second_steps

    def rate_factor(self, step: int, progress: float) -> float:
        """The learning rate's factor at a share of a stage: it falls at half and at three quarters."""
        return self.decay ** ((progress >= 0.5) + (progress >= 0.75))


class CanonicalizerTask(Task):
    """Training of a canonicalizer: points of posed scans, and the terms of SCANimate eqs. 4-13 in two stages."""

    terms = TERMS
    label = "canonicalizer"

    def __init__(self, model: Canonicalizer, template: Template, scans: Sequence, names: Sequence, config: CycleConfig):
        """Prepares training of a canonicalizer on its `PosedScan`s; ``names`` are theirs, for messages."""
        self.model, self.config, self.scans, self.names = model, config, scans, names
        self.nearest = BodyField(template, 1).to(next(model.parameters()).device)
        self.weights, self.frames, self.batch = template.weights, len(scans), config.batch
        self.groups = (list(model.parameters()),)
        plan = ((config.first_steps, config.first_lr), (config.second_steps, config.second_lr))
        self.stages = tuple(Stage(steps / config.steps, (rate,), config.rate_factor) for steps, rate in plan if steps)

    def inputs_at(self, step: int) -> tuple[ScanBatch]:
        frames = [self.frame_at(place) for place in range(step * self.batch, (step + 1) * self.batch)]
        generator = torch.Generator().manual_seed(self.config.seed * SEED_STRIDE + step)
        return (draw_batch(self.scans, frames, self.weights, self.config.draw, generator),)

    def frame_at(self, place: int) -> int:
        """The scan at a place in the endless sequence of epochs, each a permutation of all scans."""
        epoch, offset = divmod(place, len(self.scans))
        generator = torch.Generator().manual_seed((self.config.seed + 1) * SEED_STRIDE + epoch)
        return int(torch.randperm(len(self.scans), generator=generator)[offset])

    def loss(self, inputs: Inputs, position: Position) -> LossTerms:
        """The fields apart in the first stage; together, through the cycle, in the second."""
        (batch,), together = inputs, position.stage > 0
        cycle = self.model(batch, self.model.batch_codes(batch), together=together)
        progress = position.progress if together else 0.0
        return cycle_loss(cycle, batch, self.nearest, self.config.loss, progress)

    def shown(self, values: dict[str, float]) -> dict[str, str]:
        return super().shown(values) | {"cycle": f"{1e3 * values.get('cycle_points', 0):.1f}mm"}

    def frame_names(self, inputs: Inputs) -> tuple[str, ...]:
        return tuple(self.names[frame] for frame in inputs[0].frames.tolist())


def fit_latent(model: Canonicalizer, template: Template, scan: PosedScan, start: Tensor, config: CycleConfig) -> Tensor:
    """Fits the code ``(L,)`` of a frame that was not trained on, from that of a similar pose, with frozen networks."""
    if not model.coded:
        return scan.pose.to(start)
    code = start.detach().clone().requires_grad_()
    nearest = BodyField(template, 1).to(code.device)
    optimiser = torch.optim.Adam([code], lr=config.code_lr)
    for step in range(config.code_steps):
        optimiser.param_groups[0]["lr"] = config.code_lr * config.rate_factor(step, step / config.code_steps)
        generator = torch.Generator().manual_seed(config.seed * SEED_STRIDE + step)
        batch = draw_batch([scan], [0], template.weights.cpu(), config.draw, generator)
        batch = map_tensors(batch, lambda tensor: tensor.to(code.device))
        cycle = model(batch, code[None], together=True)
        loss = cycle_loss(cycle, batch, nearest, config.loss, step / config.code_steps).total
        (code.grad,) = torch.autograd.grad(loss, [code])
        optimiser.step()
    return code.detach()


class WeightSource(Enum):
    """Source of the skinning weights that unpose a scan."""

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
    weights: WeightSource = WeightSource.learned
    scan: ScanConfig = field(default_factory=lambda: replace(SCANNERS["raw_mesh"]))
    split: SplitConfig = field(default_factory=lambda: SplitConfig(validation_share=0.0))
    canonicalizer: CanonicalizerConfig = field(default_factory=CanonicalizerConfig)
    train: CycleConfig = field(default_factory=CycleConfig)
    stretch: float = STRETCH  # longest that an edge of a scan may become, as a multiple
    pictures: int = 4  # frames of each split in pictures
    scored: int = 0  # frames of each split compared with their truth, beside both baselines; simulated outfits only
    device: str = "auto"  # auto takes CUDA where there is one

    def __post_init__(self):
        for what in ("name", "dataset", "outfit"):
            check_name(what, getattr(self, what))
        check_range(self, "stretch", above=1)
        check_range(self, "pictures", "scored", low=0)

    @property
    def folder(self) -> Path:
        """Where the run lives: ``<runs>/canonical/<dataset>/<outfit>/<name>``."""
        return self.runs_root / CANONICALIZERS / self.dataset / self.outfit / self.name

    def frames(self) -> FrameDataset:
        """The frames that are canonicalized: first those of training, which are learned from, then those of test."""
        outfit = find_outfit(self.data_root, self.dataset, self.outfit, self.scan)
        names = name_frames([outfit], "train", [split_outfit(outfit, self.split).train])
        if outfit.has_frames("test"):
            names += name_frames([outfit], "test", [outfit.frames("test")])
        return FrameDataset([outfit], names, points=1, cache_bytes=FRAMES_BYTES)


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
        if learned and self.model.coded:
            return codes[self.frames.index(frame.name)]
        scan = prepare_scan(frame, self.template, self.config.train.draw.pool)
        alike = (self.poses - scan.joint_transforms).square().sum(dim=(1, 2, 3)).argmin()
        return fit_latent(self.model, self.template, scan, codes[alike], self.config.train)

    def weights_of(self, points: np.ndarray, frame: Frame) -> np.ndarray:
        """Weights ``(M, J)`` of posed points ``(M, 3)`` in the frame's world, metres."""
        code = self.code_of(frame)[None]
        box = bounding_box(to_root_frame(frame.body.vertices, frame.body))[None].to(code.device)
        places = to_root_frame(points, frame.body).to(code.device)
        with torch.no_grad():
            parts = in_chunks(lambda chunk: self.model.inverse(places[chunk][None], code, box)[0], len(places), CHUNK)
        return torch.cat(parts).cpu().numpy()


SkinningSource = TrainedCanonicalizer | BodyField  # what gives posed points their weights, by `weights_of`


def load_canonicalizer(folder: Path, device: str = "auto") -> TrainedCanonicalizer:
    """The canonicalizer of a finished run of learned weights; `DataError` where it is missing or damaged."""
    if not (folder / f"{WEIGHTS}.json").is_file():
        hint = "Canonicalize the outfit first (tools/canonicalize.py) with weights=learned."
        raise DataError(folder, "no trained canonicalizer here.", hint)
    weights, facts = read_weights(folder / WEIGHTS, ("config", "frames", "steps", "seconds"))
    with building(folder, weights):
        config = settings_from_dict(CanonicalizeConfig, facts["config"], f"{folder / WEIGHTS}.json: ")
        template, poses = read_template(folder / "template.npz"), weights.pop(POSES)
        model = Canonicalizer(template, len(facts["frames"]), config.canonicalizer)
        model.load_state_dict(weights)
    model, frames = model.to(choose_device(device)).eval().requires_grad_(False), tuple(facts["frames"])
    return TrainedCanonicalizer(model, template, config, frames, poses, facts["steps"], facts["seconds"])


def find_field(folder: Path, template: Template) -> nn.Module:
    """The forward skinning field of a checked run: the learned one, or the body's for its baselines (nearest, knn).

    Both take the six nearest vertices: with one alone the posed surface would tear wherever the neighbour changes.
    """
    path = folder / "config.yaml"
    if settings_from_dict(CanonicalizeConfig, read_yaml(path), f"{path}: ").weights is WeightSource.learned:
        return load_canonicalizer(folder, "cpu").forward_field
    return BodyField(template)


def canonicalizer_folder(runs_root: Path, outfit: Outfit, name: str) -> Path:
    """The folder of an outfit's canonicalizer; `DataError` with the command that makes it, if missing or another's."""
    folder = runs_root / CANONICALIZERS / outfit.dataset / outfit.name / name
    where = [f"dataset={outfit.dataset}", f"outfit={outfit.name}", f"name={name}"]
    where += [] if runs_root == Path("runs") else [option("runs_root", runs_root)]
    command = command_line("canonicalize", *where)
    settings, anew = folder / "config.yaml", f"Delete {folder}, then run: {command}"
    if not settings.is_file():
        raise DataError(folder, f"expected the canonicalizer of {outfit.name}, there is none.", f"Make it: {command}")
    made = read_yaml(settings)
    whose = (made.get("dataset"), made.get("outfit"))
    if whose != (outfit.dataset, outfit.name):
        raise DataError(settings, f"expected the canonicalizer of {outfit.name}, it is one of {whose[1]}.", anew)
    found, body = read_template(folder / "template.npz"), outfit.template
    same = torch.equal(found.faces, body.faces) and found.parents == body.parents
    apart = float((found.vertices - body.vertices).norm(dim=1).max()) if same else torch.inf
    if apart > SAME_BODY:
        how = f"its canonical body is up to {apart * 100:.1f} cm elsewhere" if same else "its body is another mesh"
        raise DataError(folder / "template.npz", f"expected {outfit.name}'s body at rest, {how}.", anew)
    return folder


def canonical_outfits(runs_root: Path, outfits: list[Outfit], name: str) -> list[Outfit]:
    """The outfits with their canonicalizers' scans; `DataError` when a training frame's has not been canonicalized."""
    resting = []
    for outfit in outfits:
        scans = canonicalizer_folder(runs_root, outfit, name) / "scans"
        resting.append(CanonicalOutfit(outfit, scans))
        missing = [frame for frame in outfit.frames("train") if not (scans / "train" / f"{frame}.npz").is_file()]
        if missing:
            problem = f"{len(missing)} of {outfit.name}'s train frames have no canonical scan, {missing[0]} for one."
            raise DataError(scans / "train", problem, "Run tools/canonicalize.py to its end.")
    return resting
