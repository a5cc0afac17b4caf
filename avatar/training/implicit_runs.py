"""SCANimate's avatar from its settings to its run folder, and back from the folder to the trained avatar."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from avatar.body.packed import read_template, write_template
from avatar.canonical.fields import SkinningField, SkinningFieldConfig, bounding_box
from avatar.checks import AvatarError, DataError
from avatar.data.mirroring import mirror_map
from avatar.data.outfits import Outfit
from avatar.data.splits import split_outfit
from avatar.data.streaming import Streamed
from avatar.environment import choose_device, prepared_process
from avatar.implicit.avatar import ImplicitAvatar, ImplicitConfig
from avatar.implicit.body_field import BodyField
from avatar.io.documents import read_yaml
from avatar.records import Template
from avatar.settings import settings_from_dict, settings_to_dict
from avatar.training.building import building
from avatar.training.canonical_runs import canonical_outfits, canonicalizer_folder
from avatar.training.canonicalizing import CanonicalizeConfig, Skinning, load_canonicalizer
from avatar.training.checkpoints import read_weights, write_weights
from avatar.training.distributed import refuse_team
from avatar.training.implicit_batches import CanonicalFrame, CanonicalFrames, canonical_frame
from avatar.training.implicit_loop import ImplicitTrainConfig, ImplicitTrainer
from avatar.training.loop import Precision
from avatar.training.runs import WEIGHTS, RunConfig, TrainedAvatar, choose_weights, save_settings

METHOD = "scanimate"  # its name in RunConfig.method
FIELD = "field."  # how the forward field's weights are named in the avatar's
BOX_MARGIN = 0.05  # of the longest side: room around scans and body, so that the box's sides lie in empty space


@dataclass
class ScanimateConfig:
    """The `scanimate` method's own options: ``method.settings`` of a run.

    Of ``train`` the budget and the optimiser count (steps, minutes, batch, scan_points, lr, schedule, warmup, clip,
    mirror, seed and how often to log, validate and save); template points and point losses have no part in it.
    """

    avatar: ImplicitConfig = field(default_factory=ImplicitConfig)
    train: ImplicitTrainConfig = field(default_factory=ImplicitTrainConfig)


@prepared_process()
def train_implicit(config: RunConfig) -> Path:
    """Trains an implicit avatar on its canonicalizer's T-pose scans, or goes on with it; gives the run's folder.

    Raises:
        AvatarError: for unknown options, several outfits, or when the folder holds a run with other settings.
        DataError: when the canonicalizer or one of its scans is missing, naming the command that makes it.
    """
    refuse_team(METHOD)
    if config.train.precision is not Precision.fp32:
        raise AvatarError(f"train.precision: expected fp32 for {METHOD}, got {config.train.precision.value}.")
    settings = settings_from_dict(ScanimateConfig, config.method.settings, "method.settings.")
    config = replace(config, method=replace(config.method, settings=settings_to_dict(settings)))
    if len(config.outfit) != 1:
        raise AvatarError(f"outfit: {METHOD} learns one outfit at a time, got {', '.join(config.outfit)}.")
    outfits = config.outfits()
    template, outfit = outfits[0].template, canonical_outfits(config.runs_root, outfits, config.canonical)[0]
    forward_field = find_field(canonicalizer_folder(config.runs_root, outfits[0], config.canonical), template)
    split = split_outfit(outfit, config.split)
    seen, held_back = (read_frames(outfit, names, settings.avatar.colored) for names in (split.train, split.validation))
    corners = [torch.stack([frame.points.amin(dim=0), frame.points.amax(dim=0)]) for frame in seen]
    box = bounding_box(torch.cat([*corners, template.vertices]), BOX_MARGIN)
    torch.manual_seed(config.train.seed)
    model = ImplicitAvatar(template, forward_field, box, settings.avatar).to(choose_device(config.device))
    save_settings(config)

    trainer = ImplicitTrainer(model, template.vertices, config.train, settings.train, config.folder)
    options = (config.train.scan_points, config.train.seed)
    symmetry = mirror_map(template) if config.train.mirror else None
    checks = CanonicalFrames(held_back, *options) if held_back else None
    trainer.fit(CanonicalFrames(seen, *options, symmetry), checks)
    write_template(config.folder / "template.npz", template)
    facts = {"config": settings_to_dict(config), "steps": trainer.step, "seconds": trainer.seconds}
    facts |= {"box": box.tolist(), "field": describe_field(forward_field)}
    write_weights(config.folder / WEIGHTS, model.state_dict(), facts)
    return config.folder


def read_frames(outfit: Outfit, names: tuple[str, ...], colored: bool) -> Sequence[CanonicalFrame]:
    """The canonical scans of training frames, with the poses they were taken in; read when they are needed.

    Raises:
        DataError: for a scan that is not there, or without colours where they are to be learned.
    """

    def read(index: int) -> CanonicalFrame:
        frame = canonical_frame(outfit.load("train", names[index]))
        if colored and frame.colors is None:
            path = outfit.frame_path("train", frame.name)
            raise DataError(path, "this scan has no colours to learn.", "Set method.settings.avatar.colored=false.")
        return frame

    return Streamed(read, len(names))


def find_field(folder: Path, template: Template) -> nn.Module:
    """The forward skinning field of a canonicalizer's run: the learned one, or the body's for its rivals.

    Rivals (nearest, knn) learn no field. Both are posed by the six nearest body vertices, for with the nearest one
    alone the posed surface would tear wherever the neighbour changes.
    """
    path = folder / "config.yaml"
    if not path.is_file():
        raise DataError(path, "no such file.", "Run tools/canonicalize.py to its end.")
    if settings_from_dict(CanonicalizeConfig, read_yaml(path), f"{path}: ").weights is Skinning.learned:
        return load_canonicalizer(folder, "cpu").forward_field
    return BodyField(template)


def describe_field(forward_field: nn.Module) -> dict[str, Any]:
    """What `build_field` needs, beside the weights, to make a forward field again."""
    if isinstance(forward_field, BodyField):
        return {"neighbours": forward_field.neighbours}
    return {"learned": settings_to_dict(forward_field.config)}


def build_field(facts: dict[str, Any], template: Template, weights: dict[str, Tensor]) -> nn.Module:
    """The forward field of a run's own facts and weights; the canonicalizer's folder is not looked at."""
    if "neighbours" in facts:
        return BodyField(template, facts["neighbours"])
    settings = settings_from_dict(SkinningFieldConfig, facts["learned"])
    forward_field = SkinningField(len(template.parents), settings, template.vertices[:2])
    own = {name.removeprefix(FIELD): value for name, value in weights.items() if name.startswith(FIELD)}
    forward_field.load_state_dict(own)
    return forward_field


def load_implicit(folder: Path, checkpoint: str = "last", device: str = "auto") -> TrainedAvatar:
    """The trained implicit avatar of a run's folder: a `TrainedAvatar` whose model is an `ImplicitAvatar`.

    Args:
        folder: the run's folder.
        checkpoint: ``last`` (the shared weights) or ``best`` on the held-back frames.
        device: where to put it.

    Raises:
        DataError: when the folder is no finished run of this method, or a file in it is damaged.
    """
    if checkpoint not in ("last", "best"):
        raise AvatarError(f"checkpoint: expected last or best, got {checkpoint!r}.")
    weights, facts = read_weights(folder / WEIGHTS, ("config", "steps", "seconds", "field", "box"))
    with building(folder, weights):
        config = settings_from_dict(RunConfig, facts["config"], f"{folder / WEIGHTS}.json: ")
        if config.method.name != METHOD:
            raise DataError(folder, f"expected a run of {METHOD}, this is one of {config.method.name}.")
        weights, steps, seconds = choose_weights(folder, checkpoint, weights, facts)
        template = read_template(folder / "template.npz")
        settings = settings_from_dict(ScanimateConfig, config.method.settings, "method.settings.")
        forward_field = build_field(facts["field"], template, weights)
        model = ImplicitAvatar(template, forward_field, torch.tensor(facts["box"]), settings.avatar)
        model.load_state_dict(weights)
    return TrainedAvatar(model.to(choose_device(device)).eval(), template, config, steps, seconds)
