"""Runs on a simulated outfit: learning beats the static floor, folders come back as avatars, errors are clear."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from scipy.spatial import cKDTree
from tiny import SETTINGS, quick_training

from avatar.body.open import open_body
from avatar.checks import AvatarError, DataError
from avatar.data.batches import mirror_batch, mirror_coins, mirror_map
from avatar.data.splits import SplitConfig, split_outfit
from avatar.environment import choose_device
from avatar.io.checkpoints import save_checkpoint
from avatar.io.documents import read_yaml
from avatar.io.points import read_points
from avatar.methods.base import TrainedAvatar
from avatar.methods.closet import ClosetConfig
from avatar.methods.points import body_batch, predict, template_samples
from avatar.methods.registry import find_method
from avatar.methods.settings import Clock, MethodChoice, Precision, RunConfig
from avatar.runs.prediction import predict_frames
from avatar.runs.training import choose_weights, load_avatar, mean_template, save_settings
from avatar.runs.training import train as train_run
from avatar.settings import settings_from_dict, settings_to_dict
from avatar.simulate.angles import authored_motion
from avatar.training.logs import read_log
from avatar.training.trainer import Trainer

POSE = ("pose_vertices", "vertices", "vertex_transforms", "joint_transforms")
TENSORS = (*POSE, "scan_points", "scan_normals", "outfit_ids")


@pytest.fixture(scope="module")
def settings(tiny_folder, tmp_path_factory) -> RunConfig:
    train = quick_training(steps=260, points=3000, scan_points=3000, validate_every=130, save_every=130)
    return RunConfig(
        method=MethodChoice("closet", "closet", SETTINGS),
        dataset=tiny_folder.parent.name,
        outfit=(tiny_folder.name,),
        data_root=tiny_folder.parents[1],
        runs_root=tmp_path_factory.mktemp("runs"),
        split=SplitConfig(validation_share=0.2),
        train=train,
    )


@pytest.fixture(scope="module")
def trained(settings):
    torch.manual_seed(0)
    return train_run(settings)


def distance(points: np.ndarray, scan: np.ndarray) -> float:
    return float((cKDTree(scan).query(points)[0] ** 2).mean() + (cKDTree(points).query(scan)[0] ** 2).mean())


def held_out_error(folder, outfit) -> float:
    avatar, samples = load_avatar(folder), None
    errors = []
    for name in outfit.frames("test"):
        frame = outfit.load("test", name)
        samples = template_samples(avatar, 8000)
        cloud = predict(avatar.model, body_batch([frame.body], 0, (name,)), samples)
        floor = distance(outfit.resample("test", name, 8000, 1).points, frame.scan.points)
        errors.append(distance(cloud.points, frame.scan.points) - floor)
    return float(np.mean(errors))


@pytest.fixture(scope="module")
def still(settings, tiny_outfit) -> float:
    """The error of the static floor."""
    static = replace(settings, method=MethodChoice("closet", "static", SETTINGS | {"pose": False}))
    return held_out_error(train_run(static), tiny_outfit)


@pytest.mark.slow
def test_learning_beats_the_static_floor_on_unseen_poses(trained, still, tiny_outfit):
    assert held_out_error(trained, tiny_outfit) < 0.4 * still  # measured: 0.13 to 0.20 of it, four seeds


@pytest.mark.slow
def test_training_in_half_precision_learns_what_float32_learns(settings, trained, still, tiny_outfit):
    """`train.precision=bf16`, by autocast on the CPU: the loss falls, and unseen poses are about as good."""
    narrow = replace(settings, name="bf16", train=replace(settings.train, precision=Precision.bf16))
    folder = train_run(narrow)
    rows = {each: read_log(each / "metrics.csv") for each in (trained, folder)}
    first, *_, last = (float(row["loss"]) for row in rows[folder] if row["split"] == "train")
    normals = [float(row["normal"]) for row in rows[folder] if row["split"] == "train"]
    assert last < first and normals[-1] < 0.8 * normals[0]
    wide, half = ([row for row in rows[each] if row["split"] == "validation"][-1] for each in (trained, folder))
    assert wide["loss"] != half["loss"] and float(half["loss"]) == pytest.approx(float(wide["loss"]), rel=0.02)
    assert held_out_error(folder, tiny_outfit) < 0.4 * still  # measured: 0.08 to 0.22 of it, four seeds


@pytest.mark.slow
def test_a_run_comes_back_as_it_was_trained(settings, trained, tiny_outfit, tmp_path):
    avatar = load_avatar(trained)
    assert avatar.steps == settings.train.steps
    assert not avatar.model.training
    paths = predict_frames(avatar, tiny_outfit, "test", tmp_path / "a", tmp_path, 2000)
    assert [path.stem for path in paths] == list(tiny_outfit.frames("test"))
    again = predict_frames(load_avatar(trained), tiny_outfit, "test", tmp_path / "b", tmp_path, 2000)
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(paths, again))
    assert read_points(paths[0]).points.shape == (2000, 3)
    best = load_avatar(trained, "best")
    assert best.steps in (130, 260)
    motion = authored_motion("walk", fps=10, seconds=0.5)
    posed = predict_frames(avatar, tiny_outfit, motion, tmp_path / "m", tmp_path, 1000)
    assert len(posed) == len(motion.poses)
    assert np.ptp(read_points(posed[0]).points[:, 1]) > 1.2


@pytest.mark.slow
def test_going_on_with_other_settings_is_refused(settings, trained):
    with pytest.raises(AvatarError, match=r"train\.lr.*another name"):
        train_run(replace(settings, train=replace(settings.train, lr=1.0)))
    assert train_run(settings) == trained  # finished: nothing left to do, nothing lost


@pytest.mark.slow
def test_runs_of_earlier_versions_go_on_by_the_wall_clock_and_without_spread_groups_are_refused(
    settings, trained, tmp_path
):
    config = replace(settings, runs_root=tmp_path)
    plain = settings_to_dict(config)
    del plain["train"]["clock"]
    config.folder.mkdir(parents=True)
    (config.folder / "config.yaml").write_text(yaml.safe_dump(plain))
    with pytest.raises(AvatarError, match=r"other settings \(train\.clock\)"):
        save_settings(replace(config, train=replace(config.train, clock=Clock.processor)))
    save_settings(config)
    assert read_yaml(config.folder / "config.yaml")["train"]["clock"] == "wall"
    for name in ("avatar.safetensors", "avatar.json", "template.npz"):
        (config.folder / name).write_bytes((trained / name).read_bytes())
    facts = json.loads((trained / "avatar.json").read_text())
    del facts["config"]["method"]["settings"]["garment_encoder"]["hierarchy"]["spread"]
    (config.folder / "avatar.json").write_text(json.dumps(facts))
    with pytest.raises(AvatarError, match=r"garment_encoder\.hierarchy\.spread.*train the run again"):
        load_avatar(config.folder)


@pytest.mark.slow
def test_damaged_and_unfinished_runs_are_refused(trained, tmp_path):
    with pytest.raises(DataError, match=r"avatar\.safetensors.*no such file.*tools/train\.py"):
        load_avatar(tmp_path)
    copy = tmp_path / "run"
    copy.mkdir()
    for name in ("avatar.safetensors", "avatar.json", "template.npz"):
        (copy / name).write_bytes((trained / name).read_bytes())
    assert load_avatar(copy).steps == 260
    with pytest.raises(DataError, match="no best checkpoint"):
        load_avatar(copy, "best")
    (copy / "avatar.safetensors").write_bytes(b"x" * 100)
    with pytest.raises(DataError, match="sha256"):
        load_avatar(copy)


def test_a_mirroring_run_learns_from_half_of_its_frames_in_a_mirror(settings, tiny_outfit, monkeypatch):
    """Through `train`: what the network sees of the pose and what it is compared with, both or neither."""
    drawn = {}

    def note(trainer):
        task = trainer.task
        drawn[task.config.mirror] = [task.batch_at(step) for step in range(6)], list(task.validation())

    monkeypatch.setattr(Trainer, "fit", note)
    for mirror in (False, True):
        train = replace(settings.train, mirror=mirror, seed=2, scan_points=1000)
        train_run(replace(settings, name=f"mirror-{mirror}", train=train))
    symmetry, coins = mirror_map(tiny_outfit.template), [mirror_coins(2, step, 2) for step in range(6)]
    assert 3 <= sum(map(sum, coins)) <= 9
    for before, after, chosen in zip(*(drawn[mirror][0] for mirror in (False, True)), coins, strict=True):
        image = mirror_batch(before, torch.tensor([True, True]), symmetry)
        for row, turned in enumerate(chosen):
            assert turned == (not torch.equal(before.scan_points[row], after.scan_points[row]))
            for field in TENSORS:
                assert torch.equal(getattr(after, field)[row], getattr(image if turned else before, field)[row]), field
    for before, after in zip(drawn[False][1], drawn[True][1], strict=True):  # what is held back is left as it is
        assert all(torch.equal(getattr(before, field), getattr(after, field)) for field in TENSORS)
    learned, held = ({name for batch in batches for name in batch.names} for batches in drawn[True])
    assert (learned, held) == tuple(map(set, vars(split_outfit(tiny_outfit, settings.split)).values()))
    assert image.scan_points.shape == (2, 1000, 3)


def test_fresh_networks_follow_the_seed(settings, tiny_outfit):
    one, again, other = (
        find_method("closet")
        .prepare(
            replace(settings, train=replace(settings.train, seed=seed)),
            settings_from_dict(ClosetConfig, SETTINGS),
            tiny_outfit.template,
        )
        .model.codes
        for seed in (1, 1, 2)
    )
    assert torch.equal(one, again) and not torch.equal(one, other)


def test_a_run_is_built_on_the_mean_body_of_its_outfits():
    bodies = [open_body(shape).template for shape in ("female", "male")]
    mean = mean_template(bodies)
    for name in ("vertices", "joints"):
        torch.testing.assert_close(getattr(mean, name), (getattr(bodies[0], name) + getattr(bodies[1], name)) / 2)


def test_the_best_weights_are_those_of_the_best_checkpoint(tmp_path):
    for step, score in ((1, 0.5), (2, 0.3), (3, 0.4)):
        state = {"model": {"weight": torch.tensor(float(step))}, "step": step, "seconds": 10.0 * step}
        save_checkpoint(tmp_path / "checkpoints", state, step, score)
    last, facts = {"weight": torch.tensor(3.0)}, {"steps": 3, "seconds": 30.0}
    assert choose_weights(tmp_path, "last", last, facts) == (last, 3, 30)
    assert choose_weights(tmp_path, "best", last, facts) == ({"weight": torch.tensor(2.0)}, 2, 20)


def test_point_counts_and_outfits_out_of_range_are_refused(settings, tiny_outfit):
    with pytest.raises(AvatarError, match="1,000 to 400,000"):
        template_samples(tiny_outfit.template, 10)
    with pytest.raises(AvatarError, match="400,000"):
        template_samples(tiny_outfit.template, 400_001)
    with pytest.raises(DataError, match=r"no such outfit.*Did you mean 'tiny'"):
        train_run(replace(settings, outfit=("tinny",)))
    config = replace(settings, outfit=("tee", "tiny"))
    closet, model = find_method("closet"), torch.nn.Identity()
    avatar = TrainedAvatar(closet, ClosetConfig(), model, tiny_outfit.template, config, 0, 0.0)
    assert [avatar.outfit_index(name) for name in ("tee", "tiny")] == [0, 1]
    with pytest.raises(AvatarError, match=r"trained on tee, tiny, not on 'skirt'"):
        avatar.outfit_index("skirt")
    with pytest.raises(AvatarError, match="different outfits"):
        replace(settings, outfit=("tiny", "tiny"))
    with pytest.raises(AvatarError, match="device: expected auto, cpu"):
        choose_device("warpdrive")
