"""The training loop: resuming, budgets, bookkeeping and its guards, on a small sphere of a body."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from spheres import TEMPLATE, random_batch, small_config

from avatar.checks import AvatarError
from avatar.nn.closet import ClosetAvatar
from avatar.training.logs import read_log
from avatar.training.loop import Schedule, TrainConfig, Trainer
from avatar.training.losses import TERMS


def make_trainer(folder: Path, **options) -> Trainer:
    torch.manual_seed(3)
    defaults = {"points": 60, "scan_points": 50, "batch": 3, "log_every": 1, "fresh_points": True, "lr": 1e-2}
    model = ClosetAvatar(TEMPLATE, 2, small_config(pose_noise=0.01))
    return Trainer(model, TEMPLATE.vertices, TEMPLATE.faces, TrainConfig(**(defaults | options)), folder)


def fit(trainer: Trainer, batches=None) -> Trainer:
    trainer.fit(batches or (lambda step: random_batch()), 2, lambda: iter([random_batch(2)]))
    return trainer


@pytest.mark.parametrize("stop", [3, 4, 7])
def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(tmp_path, stop):
    whole = fit(make_trainer(tmp_path / "whole", steps=8, save_every=2, validate_every=3))

    def interrupted(step: int):
        if step == stop:
            raise KeyboardInterrupt
        return random_batch()

    with pytest.raises(KeyboardInterrupt):
        fit(make_trainer(tmp_path / "parts", steps=8, save_every=2, validate_every=3), interrupted)
    again = make_trainer(tmp_path / "parts", steps=8, save_every=2, validate_every=3)
    torch.rand(5)  # the random state on entry must not matter
    parts = fit(again)
    assert parts.step == 8
    for name, value in whole.model.state_dict().items():
        assert torch.equal(value, parts.model.state_dict()[name]), name


def test_log_has_every_term_of_every_step_once_even_after_resuming(tmp_path):
    fit(make_trainer(tmp_path, steps=3, save_every=2, validate_every=5))
    fit(make_trainer(tmp_path, steps=5, save_every=2, validate_every=5))
    rows = read_log(tmp_path / "metrics.csv")
    assert [int(row["step"]) for row in rows if row["split"] == "train"] == [1, 2, 3, 4, 5]
    assert [int(row["step"]) for row in rows if row["split"] == "validation"][-1] == 5
    assert all(math.isfinite(float(row[term])) for row in rows for term in (*TERMS, "loss", "chamfer"))


def test_training_lowers_the_loss(tmp_path):
    fit(make_trainer(tmp_path, steps=60, fresh_points=False))
    losses = [float(row["chamfer"]) for row in read_log(tmp_path / "metrics.csv") if row["split"] == "train"]
    assert sum(losses[-5:]) < 0.8 * sum(losses[:5])


def test_clock_ends_training_and_drives_progress(tmp_path):
    trainer = make_trainer(tmp_path, steps=100_000, minutes=0.01)
    fit(trainer)
    assert 1 <= trainer.step < 100_000
    assert trainer.progress() >= 1


def test_rates_follow_their_schedule(tmp_path):
    trainer = make_trainer(tmp_path, steps=100, schedule=Schedule.cosine, warmup=10)
    factors = []
    for trainer.step in (0, 9, 50, 100):
        factors.append(trainer.rate_factor())
    expected = [0.1, 0.01 + 0.495 * (1 + math.cos(0.09 * math.pi)), 0.505, 0.01]
    assert factors == pytest.approx(expected, abs=2e-3)
    flat = make_trainer(tmp_path, steps=100)
    flat.step = 99
    assert flat.rate_factor() == 1


def test_template_points_are_fixed_or_fresh(tmp_path):
    fixed, fresh = make_trainer(tmp_path, fresh_points=False), make_trainer(tmp_path)
    assert torch.equal(fixed.samples_at(0).barycentric, fixed.samples_at(5).barycentric)
    assert not torch.equal(fresh.samples_at(0).barycentric, fresh.samples_at(5).barycentric)
    assert torch.equal(fresh.samples_at(5).barycentric, fresh.samples_at(5).barycentric)


def test_non_finite_losses_leave_the_weights_alone_and_end_training(tmp_path):
    trainer = make_trainer(tmp_path, steps=30)
    before = {name: value.clone() for name, value in trainer.model.named_parameters()}
    broken = random_batch()
    broken = replace(broken, scan_normals=torch.full_like(broken.scan_normals, float("nan")))
    with pytest.raises(AvatarError, match=r"not finite for 11 steps.*walk\.00000"):
        fit(trainer, lambda step: broken)
    assert all(torch.equal(value, before[name]) for name, value in trainer.model.named_parameters())


def test_wrong_options_are_refused_by_name():
    for option in ({"steps": 0}, {"lr": 0.0}, {"minutes": -1.0}, {"clip": 0.0}, {"warmup": -1}):
        with pytest.raises(AvatarError, match=next(iter(option))):
            TrainConfig(**option)
