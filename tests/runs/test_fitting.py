"""An unseen outfit: only its code is learned, and it comes nearer to the scan than the mean outfit."""

import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from scipy.spatial import cKDTree
from spheres import TEMPLATE, random_batch, small_config
from tiny import SETTINGS, quick_training, write_tiny_outfit

from avatar.checks import AvatarError
from avatar.data.layouts import find_outfit
from avatar.data.splits import SplitConfig
from avatar.geometry.surface import sample_surface
from avatar.io.checkpoints import read_weights
from avatar.io.frames import write_manifest
from avatar.methods import points
from avatar.methods.base import TrainedAvatar
from avatar.methods.closet import Closet, ClosetAvatar, Skinning
from avatar.methods.losses import LossConfig, point_avatar_loss
from avatar.methods.points import body_batch, predict, template_samples
from avatar.methods.settings import FitConfig, MethodChoice, RunConfig
from avatar.pipeline.scores import PredictConfig
from avatar.pipeline.scores import predict as predict_run
from avatar.runs.training import WEIGHTS, fit_outfit, load_avatar
from avatar.runs.training import train as train_run


def trained(model: ClosetAvatar) -> TrainedAvatar:
    return TrainedAvatar(Closet(), model.config, model, TEMPLATE, RunConfig(), 0, 0.0)


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
    avatar = trained(model)
    code = avatar.method.fit_code(avatar, batch, config)
    assert code.shape == mean.shape
    fitted = distance()
    model.codes.data = mean.data
    assert fitted < 0.5 * distance()
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items() if name != "codes")


def test_rates_of_the_code_fall_for_the_second_half(monkeypatch):
    torch.manual_seed(0)
    model, seen = ClosetAvatar(TEMPLATE, 2, small_config(code_std=1.0)), []

    def watch(prediction, *rest):
        seen.append(model.codes.detach().clone())
        return point_avatar_loss(prediction, *rest)

    monkeypatch.setattr(points, "point_avatar_loss", watch)
    avatar = trained(model)
    seen.append(avatar.method.fit_code(avatar, random_batch(1), FitConfig(steps=8, code_lr=1e-3, points=300)))
    moved = [float((after - before).abs().max()) for before, after in pairwise(seen)]
    assert moved[0] == pytest.approx(1e-3, rel=1e-3)  # Adam's first step is as long as the rate
    assert all(move > 5e-4 for move in moved[:4]) and all(move < 2e-4 for move in moved[4:])


@pytest.fixture(scope="module")
def garments(tmp_path_factory) -> Path:
    """A data folder: one garment in three widths, the third like the second."""
    root = tmp_path_factory.mktemp("garments")
    for name, ease in (("tight", 0.005), ("wide", 0.06), ("unseen", 0.055)):
        write_tiny_outfit(root / "open" / name, ease)
    return root


@pytest.fixture(scope="module")
def settings(garments, tmp_path_factory) -> FitConfig:
    """Of fitting the third garment with a network that has learned the others."""
    train = quick_training(steps=80, points=1500, scan_points=1500, validate_every=1000)
    where = {"dataset": "open", "data_root": garments, "runs_root": tmp_path_factory.mktemp("runs")}
    choice = MethodChoice("closet", "closet", SETTINGS)
    run = train_run(RunConfig(choice, outfit=("tight", "wide"), train=train, split=SplitConfig(0.0), **where))
    loss = LossConfig(normal_start=0.0, offset=20)
    return FitConfig(run, outfit="unseen", steps=60, code_lr=2e-2, points=3000, scan_points=3000, loss=loss, **where)


@pytest.mark.parametrize(("asked", "fitted"), [(None, "rise.00000"), ("rise.00003", "rise.00003")])
def test_the_scan_that_is_fitted_is_the_first_or_the_one_asked_for(settings, monkeypatch, asked, fitted):
    seen = []
    monkeypatch.setattr(
        Closet, "fit_code", lambda method, avatar, batch, config: seen.append(batch) or avatar.model.codes[:1]
    )
    folder = fit_outfit(replace(settings, frame=asked, name=f"frame-{asked}"))
    assert seen[0].names == (fitted,)
    assert read_weights(folder / WEIGHTS, ("fitted_to",))[1]["fitted_to"] == fitted


def test_an_unseen_outfit_is_fitted_from_one_scan_and_comes_nearer_in_unseen_poses(settings):
    folder = fit_outfit(settings)
    base, fitted = load_avatar(settings.run), load_avatar(folder)
    assert (folder.parents[2].name, fitted.config.outfit, fitted.steps) == ("closet-fitted", ("unseen",), 60)
    for name, value in base.model.state_dict().items():
        assert name == "codes" or torch.equal(value, fitted.model.state_dict()[name]), name
    assert len(fitted.model.codes) == 1

    outfit = find_outfit(settings.data_root, "open", "unseen", fitted.config.scan)

    def error(avatar: TrainedAvatar, code: torch.Tensor) -> float:
        avatar.model.codes = torch.nn.Parameter(code[None])
        samples, errors = template_samples(avatar, 3000), []
        for name in outfit.frames("test"):
            frame = outfit.load("test", name)
            cloud = predict(avatar.model, body_batch([frame.body], 0, (name,)), samples)
            perfect = outfit.resample("test", name, 3000, 1)
            found, floor = (cKDTree(c.points).query(frame.scan.points)[0].mean() for c in (cloud, perfect))
            errors.append(float(found - floor))  # as many points of the true surface are not nearer
        return sum(errors) / len(errors)

    codes = base.model.codes.detach()
    tight, start = (error(base, code) for code in (codes[0], codes.mean(dim=0)))
    assert error(fitted, fitted.model.codes[0].detach()) < 0.5 * min(tight, start)


def test_an_outfit_of_one_scan_is_fitted_and_predicted_by_a_run_that_held_frames_back(settings, garments):
    single = garments / "open" / "single"
    shutil.copytree(garments / "open" / "unseen", single)
    for path in sorted((single / "train").glob("*.npz"))[1:]:
        path.unlink()
    write_manifest(single)
    base = replace(load_avatar(settings.run).config, name="held", split=SplitConfig(0.2))
    run = train_run(replace(base, train=replace(base.train, steps=2)))
    fitted = fit_outfit(replace(settings, run=run, outfit="single", steps=2, name="single"))
    (folder,) = predict_run(PredictConfig(run=fitted, points=1000, data_root=garments))
    assert len(list(folder.glob("*.ply"))) == 3


def test_another_subject_s_field_is_not_fitted():
    model = ClosetAvatar(TEMPLATE, 1, small_config(skinning=Skinning.learned))
    with pytest.raises(AvatarError, match="skinning=body"):
        Closet().fit_code(trained(model), random_batch(1), FitConfig())


def test_bad_options_are_refused():
    with pytest.raises(AvatarError, match="steps"):
        FitConfig(run=Path("x"), steps=0)
