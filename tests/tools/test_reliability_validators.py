"""Validators of what readers return, and checks of the trials: each must detect a planted difference."""

import copy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from avatar.data.batches import FrameDataset
from avatar.records import CanonicalScan
from avatar.training.trainer import Trainer
from reliability import hostile_names, killing, nan_injection
from reliability.corruption import digest
from reliability.formats import SHARED, cloud, make_checkpoint, read_checkpoint, validate_checkpoint
from reliability.hostile_names import try_names
from reliability.killing import kill_trial
from reliability.nan_injection import nan_trial
from reliability.small_jobs import run_config
from reliability.streaming import stream_trial
from reliability.validators import validate_bvh, validate_config, validate_scan, validate_weights
from reliability.workers import run_worker


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return tmp_path_factory.mktemp("reliability")


def unmet(findings):
    return [finding.what for finding in findings if not finding.met]


def changed_states(state):
    """A state with one of its values changed by the smallest amount, for each of them."""

    def visit(value, path):
        items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        for key, item in items:
            if isinstance(item, (dict, list)):
                yield from visit(item, [*path, key])
            else:
                changed = copy.deepcopy(state)
                place = changed
                for step in path:
                    place = place[step]
                if isinstance(item, torch.Tensor):
                    place[key].flatten().view(torch.uint8)[0] ^= 1
                else:
                    place[key] = item + 1
                yield "/".join(map(str, [*path, key])), changed

    return dict(visit(state, []))


def test_validation_of_a_checkpoint_compares_all_of_its_content(tmp_path):
    given = read_checkpoint(make_checkpoint(tmp_path))
    assert validate_checkpoint(given) == ""
    planted = changed_states(given)
    assert {"model/weight", "model/bias", "optimiser/state/0/exp_avg", "optimiser/param_groups/0/lr"} < planted.keys()
    assert {"random/0/cpu", "score"} < planted.keys()
    for name, state in planted.items():
        assert name == "step" or "not what was saved" in validate_checkpoint(state), name
        assert digest(state) != digest(given), name
    assert digest({**given, "seconds": 3.0}) == digest(given)
    assert "not what was saved" in validate_checkpoint({**given, "more": 1})
    assert "not what was saved" in validate_checkpoint(
        {**given, "model": {"weight": given["model"]["weight"].double()}}
    )
    given["optimiser"]["state"][0]["exp_avg"][3] = torch.nan
    assert validate_checkpoint({**given, "step": 7}) == "not finite" and validate_checkpoint([given]) == "no state"


def test_validation_of_weights_scans_rotations_and_settings():
    assert validate_weights((SHARED, {}), SHARED) == ""
    assert validate_weights(({"weight": SHARED["weight"] + 2**-18}, {}), SHARED)
    points = cloud()
    scan = CanonicalScan(points.points, points.normals, np.ones((60, 1)), np.arange(60))
    assert (
        validate_scan(scan) == "" and validate_scan(replace(scan, normals=2 * scan.normals)) == "not finite or not unit"
    )
    motion = SimpleNamespace(positions=np.zeros((2, 3)), rotations=np.eye(3)[None].repeat(2, 0))
    assert validate_bvh(motion) == ""
    motion.rotations[1, 0, 0] = -1  # a mirror
    assert validate_bvh(motion) == "no rotations"
    config = run_config("closet", Path("root"))
    assert validate_config(config) == ""
    config.train.loss.offset = float("inf")
    assert "loss" in validate_config(config)


class BesideTheRoots:
    """An entry point by which a folder is made whose path begins like an allowed one's."""

    def __init__(self, root):
        self.root = root

    def all(self):
        return [lambda name: (self.root / "runs-up").mkdir(exist_ok=True)]


def test_a_folder_whose_name_begins_like_an_allowed_one_is_outside(tmp_path, monkeypatch):
    monkeypatch.setattr(hostile_names, "EntryPoints", BesideTheRoots)
    (tmp_path / "data").mkdir()
    assert len(run_worker(try_names, tmp_path, ["x"]).value["outside"]) == 1


@pytest.mark.slow
def test_a_resumed_run_whose_optimiser_differs_is_detected(root, monkeypatch):
    resume = Trainer.resume

    def incomplete(trainer):
        resume(trainer)
        if trainer.step:
            trainer.optimiser.param_groups[1]["weight_decay"] = 1e-30  # changes no weight

    monkeypatch.setattr(Trainer, "resume", incomplete)
    monkeypatch.setattr(killing, "JOBS", ("closet",))
    assert unmet(kill_trial(root, 1, 1, seed=2)) == [
        "last checkpoints equal to its, bit for bit: model, optimiser, random state"
    ]


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["no injection", "moments"])
def test_a_missing_injection_and_a_step_that_changes_moments_are_detected(root, monkeypatch, fault):
    monkeypatch.setattr(nan_injection, "JOBS", ("closet",))
    monkeypatch.setattr(nan_injection, "PLACES", ("loss",))
    if fault == "no injection":
        monkeypatch.setattr(nan_injection, "inject_into_functions", lambda *arguments: None)
    else:
        step = Trainer.train_step

        def spoiling(trainer, *inputs):
            result = step(trainer, *inputs)
            if trainer.bad_steps:
                next(iter(trainer.optimiser.state.values()))["exp_avg"] += 1
            return result

        monkeypatch.setattr(Trainer, "train_step", spoiling)
    assert "injected steps that left all other weights unchanged" in unmet(nan_trial(root, 2, seed=1))


@pytest.mark.slow
def test_a_stream_that_is_not_read_is_detected(root, monkeypatch):
    batch_at = FrameDataset.batch_at
    monkeypatch.setattr(FrameDataset, "batch_at", lambda frames, step, size: batch_at(frames, 0, size))
    assert unmet(stream_trial(root, 0.3, 8)) == ["frames read while training"]
