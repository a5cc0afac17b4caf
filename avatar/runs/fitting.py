"""An unseen outfit from one scan: the network is frozen and only a new garment code is learned (as POP does)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from avatar.body.packed import write_template
from avatar.checks import AvatarError, check_name
from avatar.data.batches import FrameDataset, name_frames
from avatar.data.layouts import find_outfit
from avatar.environment import prepared_process
from avatar.io.checkpoints import write_weights
from avatar.methods.losses import LossConfig
from avatar.runs.loading import load_avatar
from avatar.runs.training import WEIGHTS, save_settings
from avatar.settings import settings_to_dict


@dataclass
class FitConfig:
    """Fitting an outfit that a network has not seen, from its first training scan or any other one frame."""

    run: Path = Path("runs/closet/open/several/default")
    dataset: str = "open"
    outfit: str = "skirt"
    frame: str | None = None  # the scan to fit; the first training frame if null
    data_root: Path = Path("data")
    runs_root: Path = Path("runs")
    name: str = "fitted"
    steps: int = 401  # POP
    code_lr: float = 5e-4  # POP; divided by ten for the second half
    points: int = 50000  # template points predicted
    scan_points: int = 40000
    seed: int = 0
    loss: LossConfig = field(default_factory=lambda: LossConfig(normal_start=0.0))
    device: str = "auto"

    def __post_init__(self):
        for what in ("name", "dataset", "outfit"):
            check_name(what, getattr(self, what))
        if self.steps < 1 or self.code_lr <= 0:
            raise AvatarError(f"steps, code_lr: expected positive values, got {self.steps} and {self.code_lr}.")


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
    fitted = replace(
        avatar.config,
        method=choice,
        dataset=config.dataset,
        outfit=(config.outfit,),
        name=config.name,
        data_root=config.data_root,
        runs_root=config.runs_root,
    )
    save_settings(fitted)
    write_template(fitted.folder / "template.npz", avatar.template)
    weights = avatar.model.state_dict() | {"codes": code}
    facts = {"config": settings_to_dict(fitted), "steps": config.steps, "seconds": 0.0, "fitted_to": frame}
    write_weights(fitted.folder / WEIGHTS, weights, facts)
    return fitted.folder
