"""The training loop: resuming, budgets, bookkeeping and its guards, on a small sphere of a body."""

import errno
import math
import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from spheres import TEMPLATE, random_batch, small_config

from avatar.checks import AvatarError, DataError
from avatar.io.checkpoints import load_checkpoint
from avatar.io.locks import HELD, lock_folder
from avatar.methods import points
from avatar.methods.closet import ClosetAvatar
from avatar.methods.losses import TERMS, LossConfig, point_avatar_loss
from avatar.methods.points import PointTask
from avatar.methods.settings import Clock, Schedule, TrainConfig
from avatar.training.logs import read_log
from avatar.training.signals import Stopped
from avatar.training.trainer import Trainer


def make_trainer(folder: Path, **options) -> Trainer:
    torch.manual_seed(3)
    defaults = {"points": 60, "scan_points": 50, "batch": 3, "log_every": 1, "fresh_points": True, "lr": 1e-2}
    model = ClosetAvatar(TEMPLATE, 2, small_config(pose_noise=0.01))
    config = TrainConfig(**(defaults | options))
    return Trainer(PointTask(model, TEMPLATE, config, lambda step: random_batch(), 6), config, folder)


def fit(trainer: Trainer, batches=None) -> Trainer:
    trainer.task.batch_at = batches or trainer.task.batch_at
    trainer.task.validation = lambda: [random_batch(2)]
    trainer.fit()
    return trainer


def validate(trainer: Trainer, batches) -> dict[str, float]:
    trainer.task.validation = lambda: batches
    return trainer.validate()


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


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGUSR1])
def test_a_signal_saves_and_the_run_goes_on_as_if_nothing_had_been(tmp_path, number):
    options = {"steps": 6, "save_every": 100, "validate_every": 3}
    whole = fit(make_trainer(tmp_path / "whole", **options))

    trainer = make_trainer(tmp_path / "parts", **options)
    take_step = trainer.train_step

    def signalled(*inputs):
        if trainer.step == 3:
            os.kill(os.getpid(), number)
        return take_step(*inputs)

    trainer.train_step = signalled
    with pytest.raises(Stopped, match="The same command goes on"):
        fit(trainer)
    assert load_checkpoint(tmp_path / "parts" / "checkpoints")["step"] == 4  # the step at hand was finished
    parts = fit(make_trainer(tmp_path / "parts", **options))
    for name, value in whole.model.state_dict().items():
        assert torch.equal(value, parts.model.state_dict()[name]), name


def test_a_run_folder_takes_one_job_and_is_free_after_it(tmp_path):
    second = make_trainer(tmp_path, steps=2)

    def nested(step: int):
        if step == 1:
            refused = os.fork()
            if refused == 0:
                try:
                    HELD.clear()  # what a fork takes over, another job would not have
                    fit(second)
                except AvatarError as error:
                    os._exit(7 if f"process {os.getppid()}" in str(error) else 8)
                os._exit(9)
            assert os.waitstatus_to_exitcode(os.waitpid(refused, 0)[1]) == 7
        return random_batch()

    assert fit(make_trainer(tmp_path, steps=2), nested).step == 2
    with lock_folder(tmp_path):
        pass


def test_a_full_disk_ends_training_with_the_last_checkpoint_sound(tmp_path, monkeypatch):
    fit(make_trainer(tmp_path, steps=3))
    rows = (tmp_path / "metrics.csv").read_text()

    def full(part, target):
        if target.suffix == refused[-1]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return replace_file(part, target)

    replace_file, refused = Path.replace, []
    monkeypatch.setattr(Path, "replace", full)
    for kind in (".pt", ".json", ".csv"):
        refused.append(kind)
        with pytest.raises(DataError, match="No space left"):
            fit(make_trainer(tmp_path, steps=5))
        assert load_checkpoint(tmp_path / "checkpoints")["step"] == 3
        assert (tmp_path / "metrics.csv").read_text().startswith(rows)


def test_a_half_written_log_is_read_as_far_as_it_goes(tmp_path):
    fit(make_trainer(tmp_path, steps=3))
    path = tmp_path / "metrics.csv"
    rows = read_log(path)
    whole, last = path.read_text(), ",".join(rows[-1].values()) + "\n"
    for cut in range(1, len(last), 7):
        path.write_text(whole + last[:-cut])
        assert read_log(path) == rows
    path.write_text(whole)
    path.write_bytes(path.read_bytes() + b"\xff\x00garbage\n")
    fit(make_trainer(tmp_path, steps=4))
    assert [row["step"] for row in read_log(path) if row["split"] == "train"] == ["1", "2", "3", "4"]


def test_log_has_every_term_of_every_step_once_even_after_resuming(tmp_path):
    fit(make_trainer(tmp_path, steps=3, save_every=2, validate_every=5))
    fit(make_trainer(tmp_path, steps=5, save_every=2, validate_every=5))
    rows = read_log(tmp_path / "metrics.csv")
    assert [int(row["step"]) for row in rows if row["split"] == "train"] == [1, 2, 3, 4, 5]
    assert [int(row["epoch"]) for row in rows if row["split"] == "train"] == [0, 1, 1, 2, 2]  # of two steps
    held = [row for row in rows if row["split"] == "validation"]
    assert int(held[-1]["step"]) == 5
    lowest = min(float(row["chamfer"]) for row in held)
    assert load_checkpoint(tmp_path / "checkpoints", "best")["score"] == pytest.approx(lowest, rel=1e-4)
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
    trainer.step, trainer.seconds = 10_000, 0.3
    assert trainer.progress() == pytest.approx(0.5)  # of 0.6 seconds
    trainer.step = 70_000
    assert trainer.progress() == pytest.approx(0.7)


def test_processor_time_does_not_pass_while_others_work(tmp_path):
    def spent(clock):
        started = clock.seconds()
        time.sleep(0.2)
        return clock.seconds() - started

    assert spent(Clock.processor) < 0.1 < 0.2 <= spent(Clock.wall)
    trainer = make_trainer(tmp_path, steps=100_000, minutes=0.01, clock=Clock.processor)
    used = Clock.processor.seconds()
    fit(trainer)
    assert 0.6 <= trainer.seconds <= Clock.processor.seconds() - used
    trainer.model.to("meta")  # another device, whose work processor time leaves out
    with pytest.raises(AvatarError, match=r"train\.clock: .* leaves out the work of meta\. Hint: train\.clock=wall"):
        Trainer(trainer.task, trainer.budget, tmp_path)
    Trainer(trainer.task, replace(trainer.budget, clock=Clock.wall), tmp_path)


def test_rates_follow_their_schedule(tmp_path):
    trainer = make_trainer(tmp_path, steps=100, schedule=Schedule.cosine, warmup=10)
    factors = []
    for trainer.step in (0, 9, 50, 100):
        factors.append(trainer.task.stages[0].factor(trainer.step, trainer.position().progress))
    expected = [0.1, 0.01 + 0.495 * (1 + math.cos(0.09 * math.pi)), 0.505, 0.01]
    assert factors == pytest.approx(expected, abs=2e-3)
    assert TrainConfig(steps=100).rate_factor(99, 0.99) == 1


def test_normals_are_not_trained_before_their_term_starts(tmp_path):
    """Adam makes full steps of a gradient however small, so there must be none."""
    trainer = make_trainer(tmp_path, steps=10, loss=LossConfig(normal_start=0.5))
    last = [*trainer.model.pose_decoder.normal_branch.parameters()]
    before = [value.clone() for value in last]
    for step in range(10):
        trainer.step = step
        trainer.train_step((random_batch(), trainer.task.samples_at(trainer.step)))
        moved = not all(torch.equal(value, old) for value, old in zip(last, before))
        assert moved == (step >= 5)


def changes(trainer: Trainer) -> dict[str, float]:
    """The longest way that one training step moves a number of each parameter."""
    after = list(trainer.model.named_parameters())
    before = [value.detach().clone() for _, value in after]
    trainer.train_step((random_batch(), trainer.task.samples_at(trainer.step)))
    return {name: float((value.detach() - was).abs().max()) for (name, value), was in zip(after, before)}


def test_codes_and_networks_move_at_their_own_rates(tmp_path):
    """Adam's first step is as long as the rate wherever there is a gradient; both rates warm up."""
    moved = changes(make_trainer(tmp_path, lr=1e-2, code_lr=3e-4, warmup=4))
    assert moved.pop("codes") == pytest.approx(3e-4 / 4, rel=1e-3)
    assert max(moved.values()) == pytest.approx(1e-2 / 4, rel=1e-3)
    trainer = make_trainer(tmp_path, lr=1e-2, warmup=4)
    assert trainer.train_step((random_batch(), trainer.task.samples_at(0)))[1] == pytest.approx(1e-2 / 4)  # logged


def test_rates_of_pop_are_the_defaults():
    config = TrainConfig()
    assert (config.lr, config.code_lr, config.batch, config.schedule) == (3e-4, 5e-4, 4, Schedule.constant)
    assert (config.warmup, config.clip, config.mirror, config.fresh_points) == (0, None, False, False)


def test_clipping_shortens_the_gradient_before_the_step_and_logs_it_unclipped(tmp_path):
    all_terms = LossConfig(normal_start=0.0)  # every parameter has a gradient
    free, clipped = make_trainer(tmp_path, loss=all_terms), make_trainer(tmp_path, clip=1e-9, loss=all_terms)
    norms = []
    for trainer in (free, clipped):
        torch.manual_seed(0)  # the same noise on the bodies
        norms.append(float(trainer.train_step((random_batch(), trainer.task.samples_at(0)))[2]))
    assert norms[0] == norms[1] > 1e-3
    gradients = [[value.grad for value in trainer.model.parameters()] for trainer in (free, clipped)]
    assert float(torch.cat([g.flatten() for g in gradients[1]]).norm()) == pytest.approx(1e-9, rel=1e-2)
    for whole, short in zip(*gradients):
        torch.testing.assert_close(short, whole * (1e-9 / norms[0]), rtol=1e-2, atol=1e-13)
    assert max(changes(make_trainer(tmp_path, clip=1e-9)).values()) < 1e-3  # a tenth of the rate: the step was short


def test_late_loss_terms_follow_the_progress_and_count_in_validation(tmp_path, monkeypatch):
    trainer, seen = make_trainer(tmp_path, steps=30), []
    monkeypatch.setattr(points, "point_avatar_loss", lambda *given: seen.append(given[3]) or point_avatar_loss(*given))
    for trainer.step in (0, 15):
        trainer.train_step((random_batch(), trainer.task.samples_at(trainer.step)))
    validate(trainer, [random_batch()])
    assert seen == [0, 0.5, 1]


def test_validation_asks_the_evaluated_network_and_leaves_it_as_it_was(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.train_step((random_batch(), trainer.task.samples_at(trainer.step)))
    before = {name: value.clone() for name, value in trainer.model.state_dict().items()}
    larger = random_batch()
    batches = [random_batch(2), replace(larger, scan_points=3 * larger.scan_points)]
    values = validate(trainer, batches)
    assert all(torch.equal(value, before[name]) for name, value in trainer.model.state_dict().items())
    model, expected = trainer.model.eval(), dict.fromkeys(("loss", "chamfer", "normal"), 0.0)
    for batch in batches:
        terms = point_avatar_loss(model(batch, trainer.task.fixed_points), batch, trainer.budget.loss, 1.0)
        raw, share = terms.raw, len(batch.names) / 5  # a mean over frames, not over batches
        expected["loss"] += share * float(terms.total.detach())
        expected["chamfer"] += share * float(raw["scan_to_points"] + raw["points_to_scan"])
        expected["normal"] += share * float(raw["normal"])
    assert {name: values[name] for name in expected} == pytest.approx(expected, rel=1e-5)
    assert validate(trainer, ()) == {}
    trainer.train_step((random_batch(), trainer.task.samples_at(trainer.step)))  # running statistics move
    running = [name for name in before if name.endswith("running_mean")]
    assert not any(torch.equal(trainer.model.state_dict()[name], before[name]) for name in running)


def test_template_points_are_fixed_or_fresh(tmp_path):
    fixed, fresh = make_trainer(tmp_path, fresh_points=False).task, make_trainer(tmp_path).task
    assert fixed.samples_at(0) is fixed.samples_at(5) is fixed.fixed_points  # drawn once
    assert torch.equal(fixed.samples_at(0).barycentric, fresh.fixed_points.barycentric)  # those of validation
    assert not torch.equal(fresh.samples_at(0).barycentric, fresh.samples_at(5).barycentric)
    assert torch.equal(fresh.samples_at(5).barycentric, fresh.samples_at(5).barycentric)


def test_non_finite_losses_leave_the_weights_alone_and_end_training(tmp_path):
    trainer = make_trainer(tmp_path, steps=30, loss=LossConfig(normal_start=0.0))
    before = {name: value.clone() for name, value in trainer.model.named_parameters()}
    broken = random_batch()
    broken = replace(broken, scan_normals=torch.full_like(broken.scan_normals, float("nan")))
    with pytest.raises(AvatarError, match=r"not finite for 11 steps.*walk\.00000"):
        fit(trainer, lambda step: broken)
    assert all(torch.equal(value, before[name]) for name, value in trainer.model.named_parameters())


def test_a_bad_step_leaves_no_trace(tmp_path):
    """Running statistics too: a forward pass in training changes them before anyone knows that the loss is bad."""
    trainer = make_trainer(tmp_path, steps=30)
    samples = trainer.task.fixed_points
    trainer.train_step((random_batch(), samples))
    before = {name: value.clone() for name, value in trainer.model.state_dict().items()}
    moments = [value.clone() for group in trainer.optimiser.state.values() for value in group.values()]
    good = random_batch()
    broken = replace(good, pose_vertices=torch.full_like(good.pose_vertices, float("inf")))
    assert not math.isfinite(float(trainer.train_step((broken, samples))[2]))
    for name, value in trainer.model.state_dict().items():
        assert torch.equal(value, before[name]) or name.endswith("num_batches_tracked"), name
    after = [value for group in trainer.optimiser.state.values() for value in group.values()]
    assert all(torch.equal(a, b) for a, b in zip(moments, after))
    trainer.train_step((good, samples))
    trainer.save(0.0)


def test_a_step_that_a_search_refuses_leaves_running_statistics_as_they_were(tmp_path):
    trainer = make_trainer(tmp_path, steps=30)
    samples = trainer.task.fixed_points
    trainer.train_step((random_batch(), samples))
    before = {name: value.clone() for name, value in trainer.model.state_dict().items()}
    good = random_batch()
    broken = replace(good, scan_points=torch.full_like(good.scan_points, float("nan")))
    with pytest.raises(AvatarError, match="finite"):
        trainer.train_step((broken, samples))
    assert all(torch.equal(value, before[name]) for name, value in trainer.model.state_dict().items())


def test_wrong_options_are_refused_by_name():
    for option in ({"steps": 0}, {"lr": 0.0}, {"minutes": -1.0}, {"clip": 0.0}, {"warmup": -1}):
        with pytest.raises(AvatarError, match=next(iter(option))):
            TrainConfig(**option)
