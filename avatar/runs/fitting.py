"""An unseen outfit from one scan: the network is frozen and only a new garment code is learned (as POP does)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from avatar.body.packed import write_template
from avatar.checks import AvatarError
from avatar.data.batches import FrameDataset, name_frames
from avatar.data.layouts import find_outfit
from avatar.environment import prepared_process
from avatar.io.checkpoints import write_weights
from avatar.methods.settings import FitConfig
from avatar.runs.loading import load_avatar
from avatar.runs.training import WEIGHTS, save_settings
from avatar.settings import settings_to_dict


@prepared_process()
def fit_outfit(config: FitConfig) -> Path:
    """Fits the outfit and leaves a run folder like that of training, with the new outfit as its only one."""
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
    fitted = replace(avatar.config, method=choice, outfit=(config.outfit,), **same)
    save_settings(fitted)
    write_template(fitted.folder / "template.npz", avatar.template)
    facts = {"config": settings_to_dict(fitted), "steps": config.steps, "seconds": 0.0, "fitted_to": frame}
    write_weights(fitted.folder / WEIGHTS, avatar.model.state_dict() | {"codes": code}, facts)
    return fitted.folder
