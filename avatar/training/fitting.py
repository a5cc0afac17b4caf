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
from avatar.nn.methods import draw_samples
from avatar.progress import tracked
from avatar.records import Batch
from avatar.settings import settings_to_dict
from avatar.training.checkpoints import write_weights
from avatar.training.losses import LossConfig, point_avatar_loss
from avatar.training.runs import WEIGHTS, TrainedAvatar, load_run, save_settings, takes_fields


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
    avatar = load_run(config.run, device=config.device)
    if takes_fields(avatar.model.config):
        raise AvatarError(
            "run: learned skinning belongs to the outfits it was trained on. Canonicalize and train the new one, or "
            "fit a run with skinning=body."
        )
    outfit = find_outfit(config.data_root, config.dataset, config.outfit, avatar.config.scan)
    if not torch.equal(outfit.template.faces, avatar.template.faces):
        raise AvatarError(f"outfit: {outfit.name} has a body of another topology than {config.run} was trained on.")
    frame = config.frame or outfit.frames("train")[0]
    names = name_frames([outfit], "train", [[frame]])
    batch = FrameDataset([outfit], names, config.scan_points, config.seed).batch_at(0, 1)
    code = fit_code(avatar, batch, config)

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


def fit_code(avatar: TrainedAvatar, batch: Batch, config: FitConfig) -> torch.Tensor:
    """The garment code ``(1, V, C)`` that explains one scan best, begun at the mean of the trained codes."""
    model, device = avatar.model.eval().requires_grad_(False), next(avatar.model.parameters()).device
    model.codes = torch.nn.Parameter(model.codes.mean(dim=0, keepdim=True))
    optimiser = torch.optim.Adam([model.codes], lr=config.code_lr)
    half = torch.optim.lr_scheduler.StepLR(optimiser, max(1, config.steps // 2), 0.1)
    batch = replace(batch, outfit_ids=torch.zeros_like(batch.outfit_ids)).to(device)
    vertices, faces = avatar.template.vertices, avatar.template.faces
    generator = torch.Generator().manual_seed(config.seed)
    samples = draw_samples(model, vertices, faces, config.points, generator).to(device)
    for step in tracked(range(config.steps), "fit", unit="step"):
        terms = point_avatar_loss(model(batch, samples), batch, config.loss, step / config.steps)
        optimiser.zero_grad()
        terms.total.backward()
        optimiser.step()
        half.step()
    return model.codes.detach()
