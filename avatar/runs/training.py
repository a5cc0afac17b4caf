"""Avatars' runs: trained into a folder, loaded from it, and fitted to an unseen outfit."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from avatar.body.packed import read_template, write_template
from avatar.checks import AvatarError, DataError
from avatar.data.batches import FrameDataset, name_frames
from avatar.data.layouts import find_outfit
from avatar.data.splits import SplitConfig
from avatar.environment import choose_device, prepared_process
from avatar.io.checkpoints import building, load_checkpoint, read_weights, write_weights
from avatar.io.documents import read_yaml
from avatar.io.locks import lock_folder
from avatar.io.npz import write_whole
from avatar.methods.base import TrainedAvatar
from avatar.methods.registry import find_method
from avatar.methods.settings import FitConfig, RunConfig
from avatar.records import Template
from avatar.settings import settings_from_dict, settings_to_dict
from avatar.training.trainer import Trainer
from avatar.world import current_world

WEIGHTS = "avatar"  # avatar.safetensors and avatar.json in the run's folder


@prepared_process()
def train(config: RunConfig) -> Path:
    """Trains a run by its method, or resumes it, and writes its weights to share; gives the run's folder.

    Raises `AvatarError` for unknown names or options, and when the folder holds a run with other settings. Raises
    `DataError` when something the method needs is missing, naming the command that makes it.
    """
    method = find_method(config.method.name)
    settings = settings_from_dict(method.Settings, config.method.settings, "method.settings.")
    config = replace(config, method=replace(config.method, settings=settings_to_dict(settings)))
    method.check(config, settings)
    template, world = mean_template([outfit.template for outfit in config.outfits()]), current_world()
    task = method.prepare(config, settings, template)
    with lock_folder(config.folder) if world.is_main else nullcontext():
        if world.is_main:
            save_settings(config)
        trainer = Trainer(task, config.train, config.folder)
        trainer.fit()
        if world.is_main:
            write_template(config.folder / "template.npz", template)
            facts = {"config": settings_to_dict(config), "steps": trainer.step, "seconds": trainer.seconds}
            write_weights(config.folder / WEIGHTS, task.model.state_dict(), facts | method.describe(task.model))
    return config.folder


def save_settings(config: RunConfig) -> None:
    """Writes the run's ``config.yaml``, or checks that a run to go on with has the same settings.

    The budget (``train.steps``, ``train.minutes``) and bookkeeping may change between the two. Raises `AvatarError`
    naming the options that differ.
    """
    path, plain = config.folder / "config.yaml", settings_to_dict(config)
    if path.is_file():
        before, now = {"train.clock": "wall"} | flatten(read_yaml(path)), flatten(plain)  # older runs name no clock
        free = {"train.steps", "train.minutes", "train.save_every", "train.log_every", "device", "data_root", "spent"}
        free |= {"pictures", "scored"}  # of canonicalizers' runs
        if changed := [key for key in sorted((before | now).keys() - free) if before.get(key) != now.get(key)]:
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
    if any(not torch.equal(template.faces, templates[0].faces) for template in templates):
        raise AvatarError("outfit: expected bodies of one topology in a run, got several.")
    mean = {name: torch.stack([getattr(t, name) for t in templates]).mean(dim=0) for name in ("vertices", "joints")}
    return replace(templates[0], **mean)


def load_avatar(folder: Path, checkpoint: str = "last", device: str = "auto") -> TrainedAvatar:
    """The trained avatar of a run's folder, of any method.

    ``checkpoint`` is ``last`` (the shared weights) or ``best`` on the held-back frames. Raises `DataError` when the
    folder is no finished run, or a file in it is damaged.
    """
    if checkpoint not in ("last", "best"):
        raise AvatarError(f"checkpoint: expected last or best, got {checkpoint!r}.")
    weights, facts = read_weights(folder / WEIGHTS, ("config", "steps", "seconds"))
    with building(folder, weights):
        config = settings_from_dict(RunConfig, facts["config"], f"{folder / WEIGHTS}.json: ")
        method = find_method(config.method.name)
        settings = settings_from_dict(method.Settings, config.method.settings, "method.settings.")
        weights, steps, seconds = choose_weights(folder, checkpoint, weights, facts)
        template = read_template(folder / "template.npz")
        model = method.rebuild(settings, template, len(config.outfit), facts, weights)
        model.load_state_dict(weights)
    return TrainedAvatar(method, settings, model.to(choose_device(device)).eval(), template, config, steps, seconds)


def choose_weights(folder: Path, checkpoint: str, last: dict, facts: dict) -> tuple[dict[str, Tensor], int, float]:
    """Weights, steps and seconds of a run: the ``last``, which are given, or those of its ``best`` checkpoint."""
    if checkpoint == "last":
        return last, int(facts["steps"]), float(facts["seconds"])
    state = load_checkpoint(folder / "checkpoints", "best")
    if state is None:
        raise DataError(folder / "checkpoints", "no best checkpoint: the run held no frames back for validation.")
    return state["model"], int(state["step"]), float(state["seconds"])


@prepared_process()
def fit_outfit(config: FitConfig) -> Path:
    """Fits a garment code to an unseen outfit, the network frozen (as POP does); gives a run's folder with it alone."""
    avatar = load_avatar(config.run, device=config.device)
    outfit = find_outfit(config.data_root, config.dataset, config.outfit, avatar.config.scan)
    if not torch.equal(outfit.template.faces, avatar.template.faces):
        raise AvatarError(f"outfit: {outfit.name} has a body of another topology than {config.run} was trained on.")
    frame = config.frame or outfit.frames("train")[0]
    names = name_frames([outfit], "train", [[frame]])
    batch = FrameDataset([outfit], names, config.scan_points, config.seed).batch_at(0, 1)
    code = avatar.method.fit_code(avatar, batch, config)
    choice = replace(avatar.config.method, variant=f"{avatar.config.method.variant}-fitted")
    same = {option: getattr(config, option) for option in ("dataset", "name", "data_root", "runs_root")}
    nothing_held_back = SplitConfig(validation_share=0.0)
    fitted = replace(avatar.config, method=choice, outfit=(config.outfit,), split=nothing_held_back, **same)
    save_settings(fitted)
    write_template(fitted.folder / "template.npz", avatar.template)
    facts = {"config": settings_to_dict(fitted), "steps": config.steps, "seconds": 0.0, "fitted_to": frame}
    write_weights(fitted.folder / WEIGHTS, avatar.model.state_dict() | {"codes": code}, facts)
    return fitted.folder
