"""A training run from its settings to its folder, and back from the folder to the trained avatar."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor, nn

from avatar.body.packed import read_template, write_template
from avatar.checks import AvatarError, DataError, check_name
from avatar.data.batches import FrameDataset, name_frames
from avatar.data.layouts import find_outfit
from avatar.data.mirroring import mirror_batch, mirror_coins, mirror_map
from avatar.data.outfits import Outfit
from avatar.data.scanner import ScanConfig
from avatar.data.splits import SplitConfig, split_outfit
from avatar.environment import choose_device, prepared_process
from avatar.io.documents import read_yaml
from avatar.io.npz import write_whole
from avatar.nn.closet import Skinning
from avatar.nn.methods import build_avatar, find_method
from avatar.records import Batch, Template
from avatar.settings import settings_from_dict, settings_to_dict
from avatar.training.building import building
from avatar.training.canonical_runs import (
    CANONICALIZERS,
    canonical_outfits,
    describe_fields,
    learned_skinning,
    rebuild_skinning,
)
from avatar.training.checkpoints import load_checkpoint, read_weights, write_weights
from avatar.training.distributed import current_team
from avatar.training.locks import lock_folder
from avatar.training.loop import TrainConfig, Trainer

MAX_FOLDER = 200  # letters of a folder's name; file systems take 255
WEIGHTS = "avatar"  # avatar.safetensors and avatar.json in the run's folder


class Space(Enum):
    """Where an avatar is compared with its scans in training; it predicts posed surfaces either way."""

    posed = "posed"  # CloSET: with the scans as they are
    canonical = "canonical"  # with the T-pose scans of the outfits' canonicalizers


@dataclass
class MethodChoice:
    """A method by name; ``variant`` names the run's folder, ``settings`` are the method's own options."""

    name: str = "closet"
    variant: str = "closet"
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass
class RunConfig:
    """One training run: what to train, on which outfits, where."""

    method: MethodChoice = field(default_factory=MethodChoice)
    dataset: str = "sample"
    outfit: tuple[str, ...] = ("dress",)  # several train one network with a garment code each
    name: str = "default"
    data_root: Path = Path("data")
    runs_root: Path = Path("runs")
    scan: ScanConfig = field(default_factory=ScanConfig)
    split: SplitConfig = field(default_factory=SplitConfig)
    space: Space = Space.posed  # of the run, not the method: the network is the same
    canonical: str = "default"  # name of the canonicalizers' runs, for space=canonical and learned skinning
    train: TrainConfig = field(default_factory=TrainConfig)
    device: str = "auto"  # auto takes CUDA where there is one

    def __post_init__(self):
        names = {"name": self.name, "method.variant": self.method.variant, "canonical": self.canonical}
        for what, value in (names | {"dataset": self.dataset}).items():
            check_name(what, value)
        if self.method.variant == CANONICALIZERS:
            raise AvatarError(f"method.variant: {CANONICALIZERS!r} is where canonicalizers are. Choose another name.")
        if not self.outfit or len(set(self.outfit)) != len(self.outfit):
            raise AvatarError(f"outfit: expected one or more different outfits, got {self.outfit}.")
        for name in self.outfit:
            check_name("outfit", name)
        if len(self.folder.parent.name) > MAX_FOLDER:
            raise AvatarError(f"outfit: expected outfits whose names together have at most {MAX_FOLDER} letters.")

    @property
    def folder(self) -> Path:
        """Where the run lives: ``<runs>/<variant>/<dataset>/<outfit>/<name>``."""
        return self.runs_root / self.method.variant / self.dataset / "+".join(self.outfit) / self.name

    def outfits(self) -> list[Outfit]:
        """The run's outfits on disk."""
        return [find_outfit(self.data_root, self.dataset, name, self.scan) for name in self.outfit]


@dataclass(frozen=True)
class TrainedAvatar:
    """A trained network with what it was trained on: ``config``, the ``template`` it is built on, ``steps`` done."""

    model: nn.Module
    template: Template
    config: RunConfig
    steps: int
    seconds: float


@prepared_process()
def train_run(config: RunConfig) -> Path:
    """Trains a run, or goes on with it, and leaves its weights to share; gives the run's folder.

    Raises:
        AvatarError: for unknown names or options, and when the folder holds a run with other settings.
    """
    method = find_method(config.method.name)
    settings = settings_from_dict(method.settings, config.method.settings, "method.settings.")
    config = replace(config, method=replace(config.method, settings=settings_to_dict(settings)))
    outfits = config.outfits()
    template = mean_template([outfit.template for outfit in outfits])
    splits = [split_outfit(outfit, config.split) for outfit in outfits]
    scans, size = (config.train.scan_points, config.train.seed), config.train.batch
    at_rest = config.space is Space.canonical
    seen = canonical_outfits(config.runs_root, outfits, config.canonical) if at_rest else outfits
    frames = FrameDataset(seen, name_frames(outfits, "train", [s.train for s in splits]), *scans)
    held_back = name_frames(outfits, "train", [s.validation for s in splits])
    checks = FrameDataset(seen, held_back, *scans) if held_back else None
    model = fresh_avatar(config, settings, template, outfits)
    symmetry = mirror_map(template) if config.train.mirror else None
    team = current_team()
    share = team.share(size)

    def batch_at(step: int) -> Batch:
        batch = replace(frames.batch_at(step * team.size + team.rank, size // team.size), canonical=at_rest)
        coins = mirror_coins(config.train.seed, step, size)[share]
        return batch if symmetry is None else mirror_batch(batch, coins, symmetry)

    def validation() -> Iterator[Batch]:
        return (replace(batch, canonical=at_rest) for batch in checks.ordered_batches(size)) if checks else iter(())

    with lock_folder(config.folder) if team.leads else nullcontext():
        if team.leads:
            save_settings(config)
        trainer = Trainer(model, template.vertices, template.faces, config.train, config.folder)
        trainer.fit(batch_at, frames.epoch_length(size), validation)
        if team.leads:
            write_template(config.folder / "template.npz", template)
            facts = {"config": settings_to_dict(config), "steps": trainer.step, "seconds": trainer.seconds}
            if takes_fields(settings):
                facts["fields"] = describe_fields(model.skinning)
            write_weights(config.folder / WEIGHTS, model.state_dict(), facts)
    return config.folder


def fresh_avatar(config: RunConfig, settings: Any, template: Template, outfits: list[Outfit]) -> nn.Module:
    """The untrained network of a run on its device, with its canonicalizers' fields where it is skinned by them."""
    torch.manual_seed(config.train.seed)
    model = build_avatar(config.method.name, template, len(outfits), settings)
    if takes_fields(settings):
        model.skin_with(learned_skinning(config.runs_root, outfits, config.canonical, settings.train_field))
    return model.to(choose_device(config.device))


def save_settings(config: RunConfig) -> None:
    """Writes the run's ``config.yaml``, or checks that a run to go on with has the same settings.

    The budget (``train.steps``, ``train.minutes``) and bookkeeping may change between the two.

    Raises:
        AvatarError: naming the options that differ.
    """
    path = config.folder / "config.yaml"
    plain = settings_to_dict(config)
    if path.is_file():
        before = flatten(read_yaml(path))
        now = flatten(plain)
        free = {"train.steps", "train.minutes", "train.save_every", "train.log_every", "device", "data_root"}
        free |= {"pictures", "scored"}  # of canonicalizers' runs
        changed = [key for key in sorted(before.keys() | now.keys()) if before.get(key) != now.get(key)]
        changed = [key for key in changed if key not in free]
        if changed:
            raise AvatarError(
                f"{path}: this run was begun with other settings ({', '.join(changed[:5])}). "
                "Give the new one another name (name=...), or delete the folder."
            )
    write_whole(path, yaml.safe_dump(plain, sort_keys=False).encode())


def flatten(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested options as ``a.b.c: value``."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def mean_template(templates: list[Template]) -> Template:
    """The template a network is built on: the outfits' mean body where they differ in shape."""
    first = templates[0]
    if any(not torch.equal(template.faces, first.faces) for template in templates):
        raise AvatarError("outfit: expected bodies of one topology in a run, got several.")
    vertices = torch.stack([template.vertices for template in templates]).mean(dim=0)
    joints = torch.stack([template.joints for template in templates]).mean(dim=0)
    return replace(first, vertices=vertices, joints=joints)


def takes_fields(settings: Any) -> bool:
    """Whether a method's settings ask for the skinning fields of canonicalizers."""
    return getattr(settings, "skinning", Skinning.body) is Skinning.learned


def load_run(folder: Path, checkpoint: str = "last", device: str = "auto") -> TrainedAvatar:
    """The trained avatar of a run's folder.

    Args:
        folder: the run's folder.
        checkpoint: ``last`` (the shared weights) or ``best`` on the held-back frames.
        device: where to put it.

    Raises:
        DataError: when the folder is no finished run, or a file in it is damaged.
    """
    if checkpoint not in ("last", "best"):
        raise AvatarError(f"checkpoint: expected last or best, got {checkpoint!r}.")
    weights, facts = read_weights(folder / WEIGHTS, ("config", "steps", "seconds"))
    with building(folder, weights):
        config = settings_from_dict(RunConfig, facts["config"], f"{folder / WEIGHTS}.json: ")
        weights, steps, seconds = choose_weights(folder, checkpoint, weights, facts)
        template = read_template(folder / "template.npz")
        settings = settings_from_dict(find_method(config.method.name).settings, config.method.settings)
        model = build_avatar(config.method.name, template, len(config.outfit), settings)
        if takes_fields(settings):
            model.skin_with(rebuild_skinning(facts["fields"], template))
        model.load_state_dict(weights)
    return TrainedAvatar(model.to(choose_device(device)).eval(), template, config, steps, seconds)


def choose_weights(
    folder: Path, checkpoint: str, last: dict[str, Tensor], facts: dict[str, Any]
) -> tuple[dict[str, Tensor], int, float]:
    """Weights, steps and seconds of a run: the ``last``, which are given, or those of its ``best`` checkpoint.

    Raises:
        DataError: for the best of a run that held no frames back.
    """
    if checkpoint == "last":
        return last, int(facts["steps"]), float(facts["seconds"])
    state = load_checkpoint(folder / "checkpoints", "best")
    if state is None:
        raise DataError(folder / "checkpoints", "no best checkpoint: the run held no frames back for validation.")
    return state["model"], int(state["step"]), float(state["seconds"])
