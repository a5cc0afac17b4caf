"""`train`: a run of any method, from its settings to its folder."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import yaml

from avatar.body.packed import write_template
from avatar.checks import AvatarError
from avatar.environment import prepared_process
from avatar.io.checkpoints import write_weights
from avatar.io.documents import read_yaml
from avatar.io.locks import lock_folder
from avatar.io.npz import write_whole
from avatar.methods.registry import find_method
from avatar.methods.settings import RunConfig
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
