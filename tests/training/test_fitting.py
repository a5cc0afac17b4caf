"""An unseen outfit: only its code is learned, and it comes nearer to the scan than the mean outfit."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from spheres import TEMPLATE, random_batch, small_config

from avatar.checks import AvatarError
from avatar.geometry.surface import sample_surface
from avatar.nn.closet import ClosetAvatar, Skinning
from avatar.training import fitting
from avatar.training.fitting import FitConfig, fit_code, fit_outfit
from avatar.training.losses import LossConfig, point_avatar_loss
from avatar.training.runs import RunConfig, TrainedAvatar


def test_only_the_code_is_learned_and_it_fits_the_scan():
    torch.manual_seed(0)
    model = ClosetAvatar(TEMPLATE, 3, small_config()).eval()
    with torch.no_grad():
        model.codes.mul_(100)  # codes that matter, as after training
    samples = sample_surface(TEMPLATE.vertices, TEMPLATE.faces, 300, torch.Generator().manual_seed(0))
    batch = random_batch(1)
    truth = model(replace(batch, outfit_ids=torch.tensor([2])), samples)
    batch = replace(batch, scan_points=truth.points.detach(), scan_normals=truth.normals.detach())
    before = {name: value.clone() for name, value in model.state_dict().items() if name != "codes"}
    config = FitConfig(steps=60, code_lr=0.05, points=300, loss=LossConfig(normal_start=0.0, offset=0, code=0))

    def distance() -> float:
        terms = point_avatar_loss(model(replace(batch, outfit_ids=torch.tensor([0])), samples), batch, config.loss, 1.0)
        return float(terms.raw["scan_to_points"] + terms.raw["points_to_scan"])

    mean = model.codes.mean(dim=0, keepdim=True)
    avatar = TrainedAvatar(model, TEMPLATE, RunConfig(), 0, 0.0)
    code = fit_code(avatar, batch, config)
    assert code.shape == mean.shape
    fitted = distance()
    model.codes.data = mean.data
    assert fitted < 0.5 * distance()
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items() if name != "codes")


def test_another_wearer_s_field_is_not_fitted(monkeypatch):
    model = ClosetAvatar(TEMPLATE, 1, small_config(skinning=Skinning.learned))
    avatar = TrainedAvatar(model, TEMPLATE, RunConfig(), 0, 0.0)
    monkeypatch.setattr(fitting, "load_run", lambda *_, **__: avatar)
    with pytest.raises(AvatarError, match="skinning=body"):
        fit_outfit(FitConfig())


def test_bad_options_are_refused():
    with pytest.raises(AvatarError, match="steps"):
        FitConfig(run=Path("x"), steps=0)
